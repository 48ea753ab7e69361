"""Hostile frames for the studio's live camera: each is refused or left out; neither server nor tracking stops."""

import random
import struct
import time

import cv2
import h5py
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed

from morph_dslam import save_model
from morph_dslam.io.camera_files import save_camera
from morph_dslam.studio.live import jpeg_size
from tests.support.bent_sheet import bent_sheet_model
from tests.support.live_camera import LivePage
from tests.support.rendered_sequence import CAMERA, SheetFilm, sheet_state
from tests.support.studio import Client, running_studio

#: Says that the camera was held upright: the picture is to be turned by a quarter.
EXIF_TURNED = (
    b"\xff\xe1\x00\x22Exif\x00\x00MM\x00*\x00\x00\x00\x08\x00\x01\x01\x12\x00\x03\x00\x00\x00\x01\x00\x06\x00\x00"
    + bytes(4)
)
STATES = [sheet_state(0.008 * k) for k in range(4)]


@pytest.fixture(scope="module")
def film():
    """The model, and JPEGs of four states of a sheet."""
    model = bent_sheet_model()
    rendered = SheetFilm(model)
    return model, [cv2.imencode(".jpg", rendered.frame(state))[1].tobytes() for state in STATES]


@pytest.fixture
def studio(tmp_path, film):
    """A client of a studio with a model, a camera file and landmarks; and its server and folder."""
    folder = tmp_path / "project"
    folder.mkdir()
    save_model(folder / "model.morph", film[0])
    save_camera(folder / "camera.yaml", CAMERA)
    with running_studio(folder, takes_over=False) as server:
        yield Client(server), server, folder


def pairs_of(model, state):
    """Points (k, 5) of the sheet in millimetres, and the pixels that show them."""
    nodes = np.arange(0, len(model.nodes), 60)
    seen = CAMERA.project(state.camera_from_object.apply(model.positions(state.parameters)))[nodes]
    return np.column_stack([1e3 * model.nodes[nodes], seen]).tolist()


def head_of(jpeg):
    """A JPEG up to and with its size."""
    return jpeg[: jpeg.index(b"\xff\xc0") + 19]


def with_size(jpeg, width, height):
    """A JPEG that says to be of another size."""
    at = jpeg.index(b"\xff\xc0") + 5
    return jpeg[:at] + struct.pack(">HH", height, width) + jpeg[at + 4 :]


def hostile_frames(good):
    """JPEGs that are none, are too large, or break off."""
    random_ = random.Random(5)
    yield b"\xff"
    yield b"\xff\xd8"
    yield b"\xff\xd8" + b"\xff" * 100_000
    yield b"\xff\xd8" + b"\xff\xe0\x00\x00" * 50_000
    yield b"\xff\xd8\xff\xe0\xff\xff" + bytes(100)
    yield b"GIF89a" + bytes(100)
    yield with_size(good, 65535, 65535)
    yield with_size(good, 0, 480)
    for _ in range(60):
        yield b"\xff\xd8" + random_.randbytes(random_.randrange(3000))
    for _ in range(60):
        broken = bytearray(good)
        for _ in range(random_.randrange(1, 200)):
            broken[random_.randrange(2, 600)] = random_.randrange(256)
        yield bytes(broken)


def test_the_size_is_that_of_another_decoder():
    """Of baseline and progressive JPEGs with all that may stand before the size; and none of what is no JPEG."""
    for width, height in ((1, 1), (17, 9), (640, 480), (4000, 3)):
        image = np.full((height, width, 3), 70, np.uint8)
        for options in ([], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_OPTIMIZE, 1]):
            jpeg = cv2.imencode(".jpg", image, options)[1].tobytes()
            assert jpeg_size(jpeg) == (width, height)
            filled = jpeg[:2] + b"\xff\xfe\x00\x08hello!" + b"\xff" * 3 + jpeg[2:]
            assert cv2.imdecode(np.frombuffer(filled, np.uint8), cv2.IMREAD_COLOR).shape == image.shape
            assert jpeg_size(filled) == (width, height)
    for count in range(len(jpeg) - 1):
        assert jpeg_size(jpeg[:count]) in (None, (4000, 3))
    assert jpeg_size(cv2.imencode(".png", image)[1].tobytes()) is None


def test_hostile_frames_are_refused_while_nothing_tracks(studio, film, capfd):
    client, server, folder = studio
    good = film[1][0]
    with LivePage(server.port, "/api/camera", client.own) as camera:
        for number, frame in enumerate(hostile_frames(good)):
            camera.send(number, frame)
            camera.wait_for("seen", number)
        camera.send(500, head_of(good))  # its head is right, and nothing else is there
        camera.wait_for("seen", 500)
        assert "cannot be decoded" in client.refused("take_frame")
        assert not (folder / "live").exists()
        for message in ("text", "", b"", b"\x00", bytes(4)):
            camera.say(message)
        camera.send(501, good)
        camera.wait_for("seen", 501)
        client.call("take_frame")
        assert (folder / "live" / "000000.jpg").read_bytes() == good
        # One byte too many, by itself: a large one would still be being sent when the server closes, and be lost.
        camera.say([bytes(2_000_000), b"\x00"])
        with pytest.raises(ConnectionClosed) as closed:
            camera.wait_for("seen", 502)
        assert closed.value.rcvd.code == 1009
    assert client.call("forms")["laws"]
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.slow
def test_who_sends_as_fast_as_the_line_allows_is_read_at_a_bounded_rate(studio, film):
    """Half a second of flood; other requests are answered meanwhile, and each frame is one of those that were sent."""
    client, server, _ = studio
    with LivePage(server.port, "/api/camera", client.own) as camera:
        camera.wait_for("size", [640, 480])
        begin = time.monotonic()
        for number in range(60):
            camera.send(number, film[1][0])
            if number % 20 == 0:
                assert client.call("forms")["laws"]
        camera.wait_for("seen", 59)
        assert time.monotonic() - begin > 0.9  # at most 60 a second, however fast the machine


@pytest.mark.slow
def test_hostile_frames_do_not_stop_a_run(studio, film):
    """Frames of the right size that break in the decoder come between good ones, which are found again."""
    client, server, folder = studio
    model, jpegs = film
    with LivePage(server.port, "/api/camera", client.own) as camera:
        camera.send(0, jpegs[0])
        camera.wait_for("seen", 0)
        client.call("take_frame")
        client.call("save_start", pairs=pairs_of(model, STATES[0]), frame=0, at_rest=False)
        client.call("go_live")
        while not (job := client.state()["job"])["what"].startswith("tracking"):
            assert job["running"], job["lines"]
            time.sleep(0.1)
        turned = b"\xff\xd8" + EXIF_TURNED + jpegs[2][2:]
        camera.send(1, jpegs[1])
        camera.picture_of(1)
        for number, frame in enumerate(hostile_frames(jpegs[1])):
            if jpeg_size(frame) == (640, 480):
                camera.send(2 + number, frame)
        camera.send(900, head_of(jpegs[1]))
        camera.send(1000, turned)
        camera.picture_of(1000)
        camera.send(1001, jpegs[3])
        camera.picture_of(1001)
        client.call("stop")
    job = client.state()["job"]
    assert job["stopped"], job["lines"]
    with h5py.File(folder / "run" / "result.h5") as file:
        frames, parameters, poses = (file[name][()] for name in ("frame", "parameters", "camera_from_object"))
    assert (np.diff(frames) > 0).all()
    for row, truth in zip((0, -2, -1), STATES[1:], strict=True):
        mu, pose = parameters[row], poses[row]
        true = truth.camera_from_object.apply(model.positions(truth.parameters))
        assert np.linalg.norm(model.positions(mu) @ pose[:3, :3].T + pose[:3, 3] - true, axis=1).mean() < 1e-3
