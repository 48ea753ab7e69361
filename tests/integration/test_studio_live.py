"""Live tracking in the studio over WebSockets, without a browser: frames of a rendered sheet, sent as a phone does."""

import time

import cv2
import h5py
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

import morph_dslam as md
from morph_dslam.extend.registration import load_landmarks
from morph_dslam.io.camera_files import save_camera
from tests.support.bent_sheet import bent_sheet_model
from tests.support.live_camera import LivePage, phone_session
from tests.support.rendered_sequence import CAMERA, SheetFilm, mean_error, sheet_state, write_landmarks
from tests.support.studio import Client, running_studio

FRAMES = 12


def jpeg_of(image):
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes()


def decoded(jpeg):
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)


@pytest.fixture(scope="module")
def film():
    """The model, the true states, and JPEGs of a sheet that bends and moves."""
    model = bent_sheet_model()
    states = [sheet_state(0.008 * k) for k in range(FRAMES)]
    rendered = SheetFilm(model)
    return model, states, [jpeg_of(rendered.frame(state)) for state in states]


@pytest.fixture
def studio(tmp_path, film):
    """A studio that lets phones in, with a model and a camera file; a client of it, and the project folder."""
    folder = tmp_path / "project"
    folder.mkdir()
    md.save_model(folder / "model.morph", film[0])
    save_camera(folder / "camera.yaml", CAMERA)
    with running_studio(folder, phone=True) as server:
        yield server, Client(server), folder


def clicked_pairs(model, state, count=14):
    """Points (k, 5) of the sheet in millimetres, and the pixels that show them."""
    nodes = np.random.default_rng(4).choice(len(model.nodes), count, replace=False)
    seen = CAMERA.project(state.camera_from_object.apply(model.positions(state.parameters)))[nodes]
    return np.column_stack([1e3 * model.nodes[nodes], seen]).tolist()


def a_phone(server, client):
    """A phone that is let in and has begun to be the camera."""
    own = phone_session(server, client.state()["phone"])
    return LivePage(server.phone_port, "/api/camera", own, phone=True)


def wait_for_job(client, condition, seconds=120.0):
    """The job, once a condition of it holds."""
    end = time.monotonic() + seconds
    while not condition(job := client.state()["job"]):
        assert time.monotonic() < end, job
        time.sleep(0.1)
    return job


def test_a_phone_is_tracked_as_its_frames_are_in_python(studio, film):
    """Each frame is sent when the picture of the one before has come, so that none is dropped."""
    server, client, folder = studio
    model, states, jpegs = film
    with a_phone(server, client) as phone, LivePage(server.port, "/api/watch", client.own) as page:
        phone.wait_for("size", [640, 480])
        page.wait_for("camera", "of the phone")
        phone.send(0, jpegs[0])
        phone.wait_for("seen", 0)
        assert page.picture_of(0) == jpegs[0]  # untracked frames are shown as they are
        client.call("take_frame")
        client.call("save_start", pairs=clicked_pairs(model, states[0]), frame=0, at_rest=False)
        client.call("go_live")
        wait_for_job(client, lambda job: job["what"].startswith("tracking") or not job["running"])
        for number in range(1, FRAMES):
            phone.send(number, jpegs[number])
            picture = decoded(phone.picture_of(number))
            assert decoded(page.picture_of(number)).shape == picture.shape == (480, 640, 3)
        apart = np.abs(picture.astype(float) - decoded(jpegs[-1])).mean(axis=2)
        assert apart[:40, :40].mean() < 8.0 < apart[200:280, 300:400].mean()  # the object alone is coloured
        phone.wait_for("tracking", True)
        client.call("stop")
        phone.wait_for("tracking", False)
    job = wait_for_job(client, lambda job: not job["running"])
    assert (job["kind"], job["stopped"]) == ("live", True)
    with h5py.File(folder / "run" / "result.h5") as file:
        assert file["frame"][()].tolist() == list(range(1, FRAMES))
        assert file.attrs["reference_frame"] == -1
        parameters, poses = file["parameters"][()], file["camera_from_object"][()]
    errors, model = [], md.load_model(folder / "model.morph")
    state = md.register_landmarks(model, CAMERA, load_landmarks(folder / "landmarks.csv"))
    tracker = md.Tracker(model, CAMERA, state, reference=decoded(jpegs[0]), in_sequence=False)
    for k in range(1, FRAMES):
        result = tracker.track(md.Frame(k, 0.0, decoded(jpegs[k])))
        np.testing.assert_allclose(parameters[k - 1], result.estimate.state.parameters, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(poses[k - 1], result.pose.matrix, rtol=0, atol=1e-9)
        errors.append(mean_error(model, result.estimate.state, states[k]))
    assert np.mean(errors) < 0.5e-3
    assert (folder / "live" / "000005.jpg").read_bytes() == jpegs[5]  # what was tracked can be tracked again
    assert client.state()["recording"]["frames"] == FRAMES


@pytest.mark.slow
def test_what_cannot_be_tracked_is_one_message(studio, film):
    """Wrong sizes, a turned phone, no picture at all, steps in the wrong order; and the next good frame is taken."""
    server, client, folder = studio
    model, states, jpegs = film
    turned, small = (jpeg_of(np.zeros((height, width, 3), np.uint8)) for height, width in ((640, 480), (240, 320)))
    assert "no camera sends frames" in client.refused("take_frame")
    with a_phone(server, client) as phone, LivePage(server.port, "/api/watch", client.own) as page:
        for number, (jpeg, words) in enumerate(
            (
                (turned, "gives 480 × 640 pixels, the camera file is for 640 × 480: turn the phone"),
                (small, "gives 320 × 240 pixels, the camera file is for 640 × 480: calibrate"),
                (b"\x89PNG\r\n\x1a\n" + bytes(40), "no JPEGs"),
                (jpegs[0], ""),
            )
        ):
            phone.send(number, jpeg)
            phone.wait_for("seen", number)
            for told in (phone, page):
                while words not in told.facts.get("refused", "-") or (not words and told.facts["refused"]):
                    told.receive()
        assert "landmarks.csv is not there" in client.refused("go_live")
        client.call("take_frame")
        client.call("save_start", pairs=clicked_pairs(model, states[0]), frame=0, at_rest=False)
        phone.send(9, small)
        phone.wait_for("seen", 9)
        client.call("take_frame")  # of the last good frame; its pairs are to be clicked anew
        assert (folder / "live" / "000000.jpg").read_bytes() == jpegs[0]
        assert (folder / "landmarks-before.csv").is_file()
        assert not (folder / "landmarks.csv").exists()
    assert "no camera sends frames" in client.refused("take_frame")


@pytest.mark.slow
def test_another_camera_takes_the_place_and_a_phone_comes_back(studio, film):
    """While it is tracked: the run goes on with the frames of whoever sends, numbered on."""
    server, client, folder = studio
    model, states, jpegs = film
    with a_phone(server, client) as phone:
        phone.send(0, jpegs[0])
        phone.wait_for("seen", 0)
        client.call("take_frame")
        client.call("save_start", pairs=clicked_pairs(model, states[0]), frame=0, at_rest=False)
        client.call("go_live")
        assert "still runs" in client.refused("take_frame")
        wait_for_job(client, lambda job: job["what"].startswith("tracking") or not job["running"])
        phone.send(1, jpegs[1])
        phone.picture_of(1)
        with LivePage(server.port, "/api/camera", client.own) as webcam:
            webcam.send(50, jpegs[2])
            webcam.picture_of(50)
            with pytest.raises(ConnectionClosed) as closed:
                phone.wait_for("never", True)
            assert closed.value.rcvd.code == 4000
    with a_phone(server, client) as phone:
        phone.send(7, jpegs[3])
        phone.picture_of(7)
    client.call("stop")
    wait_for_job(client, lambda job: not job["running"])
    with h5py.File(folder / "run" / "result.h5") as file:
        assert file["frame"][()].tolist() == [1, 2, 3]
        found = list(zip(file["parameters"][()], file["camera_from_object"][()], strict=True))
    for (parameters, pose), truth in zip(found, states[1:4], strict=True):
        placed = model.positions(parameters) @ pose[:3, :3].T + pose[:3, 3]
        true = truth.camera_from_object.apply(model.positions(truth.parameters))
        assert np.linalg.norm(placed - true, axis=1).mean() < 1e-3


@pytest.mark.slow
def test_frames_of_an_earlier_run_stay_until_another_one_has_begun(studio, film):
    """Through a frame that is taken, and a run that fails at once; the recording is the one before meanwhile."""
    server, client, folder = studio
    model, states, jpegs = film
    (folder / "live").mkdir()
    for number in range(6):
        (folder / "live" / f"{number:06d}.jpg").write_bytes(jpegs[11])

    def kept():
        return sorted(path.name for path in (folder / "live").iterdir())

    earlier = [f"{number:06d}.jpg" for number in range(1, 6)]
    with a_phone(server, client) as phone:
        phone.send(0, jpegs[0])
        phone.wait_for("seen", 0)
        client.call("take_frame")
        assert kept() == ["000000.jpg", *earlier]
        assert (folder / "live" / "000000.jpg").read_bytes() == jpegs[0]
        off = np.add(clicked_pairs(model, states[0]), [1000, 0, 0, 0, 0])  # a metre beside the object
        client.call("save_start", pairs=off.tolist(), frame=0, at_rest=False)
        client.call("go_live")
        for number in range(1, 8):
            phone.send(number, jpegs[1])
        job = wait_for_job(client, lambda job: not job["running"])
        assert job["status"] == 2, job["lines"]
        assert kept() == ["000000.png", *earlier]
        assert client.state()["recording"]["frames"] == 6
        client.call("save_start", pairs=clicked_pairs(model, states[0]), frame=0, at_rest=True)
        assert client.upload("landmarks", "landmarks.csv", (folder / "landmarks.csv").read_bytes()) == 200
        client.call("go_live")
        assert "--at-rest" not in client.state()["job"]["command"]  # nobody said so of what was uploaded
        wait_for_job(client, lambda job: job["what"].startswith("tracking") or not job["running"])
        for number in (1, 2):
            phone.send(number, jpegs[number])
            phone.picture_of(number)
        client.call("stop")
    wait_for_job(client, lambda job: not job["running"])
    assert kept() == ["000000.png", "000001.jpg", "000002.jpg"]
    assert [(folder / "live" / f"{k:06d}.jpg").read_bytes() == jpegs[k] for k in (1, 2)] == [True, True]
    assert [row["frame"] for row in client.call("tracked_frames")["frames"]] == [1, 2]
    assert client.state()["notes"]["run"] is None


@pytest.mark.slow
def test_only_who_was_let_in_may_send_or_look(studio):
    server, client, _ = studio
    own = phone_session(server, client.state()["phone"])
    own_port, phone_port = server.port, server.phone_port

    def status(port, path, headers, phone=False):
        try:
            with LivePage(port, path, headers, phone):
                return 101
        except InvalidStatus as refused:
            return refused.response.status_code

    for path in ("/api/camera", "/api/watch"):
        assert status(own_port, path, client.own) == 101
        for change in (
            {"Cookie": ""}, {"Cookie": f"morph_studio_{own_port}=guess"}, {"Origin": "null"},
            {"Origin": f"https://127.0.0.1:{own_port}"}, {"Origin": "http://studio.example"}, own,
        ):  # fmt: skip
            assert status(own_port, path, client.own | change) == 403
        without = {name: value for name, value in client.own.items() if name != "Origin"}
        assert status(own_port, path, without) == 403
    assert status(phone_port, "/api/camera", own, phone=True) == 101
    assert status(phone_port, "/api/watch", own, phone=True) != 101  # a phone sees its own pictures alone
    assert status(phone_port, "/api/camera", client.own, phone=True) == 403
    assert status(phone_port, "/api/camera", own | {"Origin": f"http://127.0.0.1:{phone_port}"}, phone=True) == 403
    address = client.state()["phone"]
    for _ in range(2):
        with pytest.raises(PermissionError, match="401"):
            phone_session(server, address.partition("?")[0] + "?token=guess")
    phone_session(server, address)
    with pytest.raises(PermissionError, match="401"):
        phone_session(server, address)  # an address lets in once


def test_an_image_of_another_size_is_no_reference(film, tmp_path, refused):
    model, states, jpegs = film
    md.save_model(tmp_path / "model.morph", model)
    save_camera(tmp_path / "camera.yaml", CAMERA)
    write_landmarks(tmp_path / "landmarks.csv", model, states[0])
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "1.jpg").write_bytes(jpegs[1])
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((240, 320, 3), np.uint8))
    given = [f"--{name}={tmp_path / file}" for name, file in (
        ("model", "model.morph"), ("camera", "camera.yaml"), ("landmarks", "landmarks.csv"),
    )]  # fmt: skip
    start = ["live", str(tmp_path / "frames"), *given, "-o", str(tmp_path / "run")]
    assert "small.png is 320x240 pixels" in refused(*start, f"--reference-image={tmp_path / 'small.png'}")
    assert "the reference image: cannot read" in refused(*start, f"--reference-image={tmp_path / 'absent.png'}")
