"""Streams by WebSocket: what comes over the wire, late and slow clients, and who is not let in."""

import http.client
import socket
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from urllib.parse import urlsplit

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.sync.client import connect

from morph_dslam.errors import StreamError
from morph_dslam.extend.streams import StreamedObject, StreamSink
from morph_dslam.extend.studies import build_rigid
from morph_dslam.streams.messages import FrameMessage, ObjectInfo, SceneMessage
from morph_dslam.streams.websocket import WAITING, WebSocketPublisher
from morph_dslam.tracking.displacement_jumps import DisplacementJump
from morph_dslam.tracking.outcomes import FewPointsAgree, TiltAmbiguous
from tests.support.inner_structures import NODES, TRIANGLES, inner_structure, moved
from tests.support.rendered_sequence import CAMERA
from tests.support.streamed import (
    DEVIATIONS,
    POSE,
    held_block_model,
    hidden_result,
    lost_result,
    rigid_result,
    stream_example,
    stress_at,
    tracked_frame,
    tracked_result,
    vertices_at,
)
from tests.support.stretched_block import SIZE

pytestmark = pytest.mark.usefixtures("ends_in_time")

client = stream_example("client")
#: Of a client that takes messages of any size and reads one ahead.
PLAIN = {"max_size": None, "compression": None, "max_queue": 1}
STATES = [(0.1, 0.002), (-0.05, 0.004), (0.15, -0.006)]


@pytest.fixture
def model():
    return held_block_model()


@pytest.fixture
def publisher():
    publisher = WebSocketPublisher()
    yield publisher
    publisher.close()


@pytest.fixture
def sink(publisher, model):
    return StreamSink([publisher]).begin({"block": model}, CAMERA)


def wait_until(condition):
    end = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def taking(publisher):
    """A client that is connected and has the scene."""
    received = client.messages(publisher.place)
    assert next(received)["type"] == "scene"
    wait_until(lambda: publisher.is_watched)
    return received


def test_the_scene_says_what_will_be_tracked(publisher, sink, model):
    scene = next(client.messages(publisher.place))
    assert (scene["protocol"], scene["version"], scene["type"]) == ("morph-stream", 1, "scene")
    assert scene["camera"] == {"width": 640, "height": 480, "fx": 528.0, "fy": 528.0, "cx": 320.0, "cy": 240.0}
    (block,) = scene["objects"]
    assert (block["name"], block["model"], block["supports"]) == ("block", "stretched block", ["left end"])
    stretch, slide = block["parameters"]
    assert (stretch["name"], stretch["unit"], stretch["shown_unit"]) == ("stretch", "1", "1")
    assert (slide["unit"], slide["shown_unit"], slide["shown_factor"]) == ("m", "mm", 1e-3)
    assert (slide["lower"], slide["upper"]) == (-0.01, 0.01)
    scalar = block["scalar"]
    assert (scalar["name"], scalar["unit"], scalar["shown_unit"]) == ("von Mises stress", "Pa", "MPa")
    # No state of the box has more than its corner.
    assert 0.5 * stress_at(0.2, 0.01) < scalar["high"] <= stress_at(0.2, 0.01)
    arrays = scene["arrays"]
    nodes = arrays["block/nodes"]
    np.testing.assert_allclose(arrays["block/rest"].reshape(-1, 3), model.nodes[nodes], atol=1e-9)
    corners = arrays["block/rest"].reshape(-1, 3)[arrays["block/triangles"].reshape(-1, 3)].astype(float)
    # Outward triangles enclose the block's volume.
    volume = np.einsum("ti,ti->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    assert volume == pytest.approx(np.prod(SIZE), rel=1e-6)


def test_structures_inside_move_with_the_object(publisher, model):
    sink = StreamSink([publisher])
    sink.begin({"block": StreamedObject(model, inner=[inner_structure(model).carried_by(model)])}, CAMERA)
    scene, received = next(client.messages(publisher.place)), taking(publisher)
    assert scene["objects"][0]["inner"] == ["tumour"]
    np.testing.assert_allclose(scene["arrays"]["block/inner/tumour/rest"].reshape(-1, 3), NODES, atol=1e-9)
    np.testing.assert_array_equal(scene["arrays"]["block/inner/tumour/triangles"].reshape(-1, 3), TRIANGLES)
    stretch, slide = STATES[0]
    sink(tracked_frame(0, 0.0, block=tracked_result(model, stretch, slide)))
    vertices = next(received)["arrays"]["block/inner/tumour/vertices"].reshape(-1, 3)
    np.testing.assert_allclose(vertices, moved(NODES, stretch, slide), atol=1e-8)
    sink(tracked_frame(1, 0.1, block=lost_result(model)))
    assert not any("inner" in name for name in next(received)["arrays"])


def test_a_frame_has_the_values_of_the_closed_form(publisher, sink, model):
    received = taking(publisher)
    for number, (stretch, slide) in enumerate(STATES):
        result = replace(tracked_result(model, stretch, slide), modulus_std=0.1)
        sink(tracked_frame(10 + number, 0.1 * number, block=result))
        message = next(received)
        assert (message["type"], message["number"], message["frame"]) == ("frame", number, 10 + number)
        assert message["timestamp"] == pytest.approx(0.1 * number)
        assert message["captured"] is None
        (block,) = message["objects"]
        assert (block["name"], block["status"]) == ("block", "tracked")
        assert block["parameters"] == pytest.approx([stretch, slide])
        assert block["parameter_std"] == pytest.approx(DEVIATIONS[:2])
        np.testing.assert_allclose(block["camera_from_object"], POSE.matrix)
        assert block["pose_std"] == pytest.approx(DEVIATIONS[2:])
        vertices = message["arrays"]["block/vertices"].reshape(-1, 3)
        np.testing.assert_allclose(vertices, vertices_at(model, stretch, slide), atol=1e-8)
        np.testing.assert_allclose(message["arrays"]["block/scalar"], stress_at(stretch, slide), rtol=1e-5)
        held = block["reactions"]["left end"]
        # The left end, x = 0, slides by half of what the top does in the mean.
        assert held["point"] == pytest.approx([slide / 2, SIZE[1] / 2, SIZE[2] / 2])
        assert held["force"] == pytest.approx([-400.0 * stretch, 0.0, 5000.0 * slide])
        along = np.array(held["force"]) / np.linalg.norm(held["force"])
        size_std = np.hypot(np.linalg.norm(along * [4.0, 0.0, 2.5]), 0.1 * np.linalg.norm(held["force"]))
        assert held["force_size_std"] == pytest.approx(size_std)
        # Of the parameters, and of a tenth of the force itself.
        of_parameters = np.array([400.0, 0.0, 5000.0]) * DEVIATIONS[[0, 0, 1]]
        assert held["force_std"] == pytest.approx(np.hypot(of_parameters, 0.1 * np.array(held["force"])))


def test_an_object_that_is_lost_has_a_reason_and_no_shape(publisher, sink, model):
    received = taking(publisher)
    sink(tracked_frame(3, 0.0, block=lost_result(model)))
    message = next(received)
    (block,) = message["objects"]
    assert block["status"] == "lost"
    assert "4 of 300 points" in block["text"]
    assert block["camera_from_object"] is None
    assert block["parameters"] == block["parameter_std"] == [None, None]
    assert block["reactions"] == message["arrays"] == {}


def test_a_hidden_object_has_a_pose_and_no_shape(publisher, sink, model):
    received = taking(publisher)
    sink(tracked_frame(3, 0.0, block=hidden_result(model)))
    message = next(received)
    (block,) = message["objects"]
    assert block["status"] == "hidden"
    np.testing.assert_allclose(block["camera_from_object"], POSE.matrix)
    assert block["pose_std"] == pytest.approx(DEVIATIONS[2:])
    assert block["parameters"] == [None, None]
    assert message["arrays"] == {}


def test_a_rigid_object_has_a_shape_and_no_values(publisher, tmp_path):
    corners = "v 0 0 0\nv 40 0 0\nv 0 40 0\nv 0 0 40\n"
    (tmp_path / "part.obj").write_text(corners + "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    block = build_rigid(tmp_path / "part.obj", "mm")
    sink = StreamSink([publisher]).begin({"part": block}, CAMERA)
    received = client.messages(publisher.place)
    scene = next(received)
    (known,) = scene["objects"]
    assert (known["parameters"], known["scalar"], known["supports"]) == ([], None, [])
    sink(tracked_frame(0, 0.0, part=rigid_result(block)))
    message = next(received)
    assert set(message["arrays"]) == {"part/vertices"}
    np.testing.assert_array_equal(message["arrays"]["part/vertices"], scene["arrays"]["part/rest"])
    assert message["objects"][0]["pose_std"] == pytest.approx(DEVIATIONS[2:])


def test_stress_near_a_crack_is_not_a_number(publisher, sink, model):
    """Within 25 mm of the corner at the origin there is no other node: the next is 40 mm away."""
    received = taking(publisher)
    result = replace(tracked_result(model, 0.1, 0.0), jumps=(DisplacementJump(np.zeros(3), 1e-3, 0.025),))
    sink(tracked_frame(0, 0.0, block=result))
    values = next(received)["arrays"]["block/scalar"]
    at_corner = np.linalg.norm(model.nodes, axis=1) == 0.0
    assert at_corner.sum() == 1
    np.testing.assert_array_equal(np.isnan(values), at_corner)
    np.testing.assert_allclose(values[~at_corner], stress_at(0.1, 0.0), rtol=1e-5)


def test_stress_of_a_frame_that_is_not_to_be_relied_on_is_not_a_number(publisher, sink, model):
    received, found = taking(publisher), []
    for frame, warning in enumerate([FewPointsAgree(3.0), TiltAmbiguous(0.4, 12.0)]):
        sink(tracked_frame(frame, 0.0, block=replace(tracked_result(model, 0.1, 0.0), warnings=(warning,))))
        found.append(next(received)["arrays"])
    mistaken, sure = found
    assert np.isnan(mistaken["block/scalar"]).all()
    np.testing.assert_array_equal(mistaken["block/vertices"], sure["block/vertices"])
    np.testing.assert_allclose(sure["block/scalar"], stress_at(0.1, 0.0), rtol=1e-5)


def test_several_objects_by_their_names(publisher, model):
    shown = {"run": StreamedObject(model, "seal", "displacement"), "run/lid": StreamedObject(model, "lid", "strain")}
    sink = StreamSink([publisher]).begin(shown, CAMERA)
    received = client.messages(publisher.place)
    assert [(part["name"], part["scalar"]["unit"]) for part in next(received)["objects"]] == [
        ("seal", "m"),
        ("lid", "1"),
    ]
    sink(tracked_frame(0, 0.0, **{"run": tracked_result(model, 0.1, 0.0), "run/lid": tracked_result(model, 0.0, 0.01)}))
    arrays = next(received)["arrays"]
    np.testing.assert_allclose(arrays["seal/scalar"], 0.1 * model.nodes[:, 0], atol=1e-8)
    # Simple shear by 1/4 has a Green-Lagrange shear of 1/8, of which the model holds the linear part.
    np.testing.assert_allclose(arrays["lid/scalar"], np.sqrt(4.0 / 3.0) * 0.125, rtol=1e-5)


def test_a_late_client_gets_the_mesh_and_then_the_newest_frame(publisher, sink, model):
    first = taking(publisher)
    for number, (stretch, slide) in enumerate(STATES):
        sink(tracked_frame(number, 0.0, block=tracked_result(model, stretch, slide)))
        assert next(first)["frame"] == number
    late = client.messages(publisher.place)
    assert [next(late)["type"], next(late)["frame"]] == ["scene", 2]


def test_a_client_after_nobody_watched_gets_no_frame_of_before(publisher, sink, model):
    first = taking(publisher)
    sink(tracked_frame(0, 0.0, block=tracked_result(model, 0.1, 0.0)))
    assert next(first)["frame"] == 0
    first.close()
    gone = tracked_frame(1, 1.0, block=tracked_result(model, 0.2, 0.0))
    wait_until(lambda: sink(gone) or not publisher.is_watched)  # noticed when it does not take a frame
    late = taking(publisher)
    sink(tracked_frame(2, 2.0, block=tracked_result(model, 0.3, 0.0)))
    assert next(late)["frame"] == 2


def test_a_frame_that_finds_no_client_is_not_kept(publisher, model):
    publisher.begin(SceneMessage(CAMERA, ()))
    publisher.publish(FrameMessage(0, 0, 0.0, None, np.zeros((4, 4, 3), np.uint8), tuple))
    late = taking(publisher)
    publisher.publish(FrameMessage(1, 1, 0.1, None, np.zeros((4, 4, 3), np.uint8), tuple))
    assert next(late)["number"] == 1


def test_nobody_waits_for_a_slow_client_who_misses_frames_and_gets_the_newest(publisher, sink, model):
    received, n_sent = taking(publisher), 3000
    with connect(stream_address(publisher), **PLAIN) as slow, ThreadPoolExecutor(2) as pool:
        quick = pool.submit(lambda: [message["number"] for message in received])
        # The slow one reads nothing until all frames are sent.
        for number in range(n_sent):
            sink(tracked_frame(number, 0.0, block=tracked_result(model, 0.1 * number / n_sent, 0.0)))
        behind = pool.submit(lambda: [client.unpack(data) for data in slow])
        publisher.close()
        assert quick.result(20)[-1] == n_sent - 1
        late = behind.result(20)
    assert [late[0]["type"], late[-1]["type"]] == ["scene", "end"]
    numbers = [message["number"] for message in late[1:-1]]
    assert numbers == sorted(set(numbers))
    assert len(numbers) < n_sent
    assert numbers[-1] == n_sent - 1


def test_few_messages_wait_for_a_client_that_reads_nothing(publisher, sink, model):
    """Small ones would fit into the buffers of both systems by the hundred, and get old there."""
    received, n_sent = taking(publisher), 100
    with connect(stream_address(publisher), **PLAIN) as slow:
        for number in range(n_sent):
            sink(tracked_frame(number, 0.0, block=tracked_result(model, 0.1, 0.0)))
            while next(received)["number"] < number:  # the server has had time for it
                pass
        late = [client.unpack(slow.recv(timeout=20.0))]
        while late[-1].get("number") != n_sent - 1:
            late.append(client.unpack(slow.recv(timeout=20.0)))
    assert late[0]["type"] == "scene"
    # One is being read, another waits in the library, another in the system; then comes the newest.
    assert len(late) <= 1 + 3 + 1


def test_a_client_that_takes_nothing_does_not_keep_the_stream_from_its_end(publisher):
    large = ObjectInfo("large", "large", np.zeros((200_000, 3)), np.zeros((1, 3), int), np.arange(1), (), None, ())
    narrow = socket.socket()
    narrow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
    narrow.connect(("127.0.0.1", publisher.port))
    received = client.messages(publisher.place)
    with connect(stream_address(publisher), sock=narrow, **PLAIN) as stuck:
        # Another takes each scene before the next is sent: what waits for the stuck one outgrows every buffer.
        for _ in range(8):
            publisher.begin(SceneMessage(CAMERA, (large,)))
            assert next(received)["arrays"]["large/rest"].nbytes > WAITING
        publisher.close()
        assert not publisher.is_watched
        with pytest.raises(ConnectionClosedError):
            list(iter(lambda: stuck.recv(timeout=60.0), None))


def stream_address(publisher, token=None):
    return f"ws://127.0.0.1:{publisher.port}/stream?token={publisher.token if token is None else token}"


@pytest.mark.parametrize(
    ("token", "headers", "status"),
    [
        ("wrong", {}, 401),
        ("", {}, 401),
        (None, {"Origin": "http://example.org"}, 403),
        (None, {"Origin": "null"}, 403),
        (None, {"Host": "example.org"}, 403),
        (None, {"Host": "10.0.0.1"}, 403),
    ],
)
def test_strangers_are_refused(publisher, token, headers, status):
    """By a wrong token, from a page elsewhere, or by a name that another site could take for its own."""
    answer, _, _ = ask(publisher, "/stream?token=" + (publisher.token if token is None else token), **headers)
    assert answer == status
    if "Host" not in headers:
        with (
            pytest.raises(InvalidStatus) as refused,
            connect(stream_address(publisher, token), additional_headers=headers),
        ):
            pass
        assert refused.value.response.status_code == status
    assert not publisher.is_watched


@pytest.mark.parametrize("target", ["//[", "http://[", "/[?token={token}"])
def test_what_is_no_url_is_not_there(publisher, target):
    asked = target.format(token=publisher.token)
    assert ask(publisher, asked, Host=f"127.0.0.1:{publisher.port}")[0] == (404 if "token" in target else 401)


def test_a_target_in_absolute_form_is_answered(publisher):
    """RFC 9112, 3.2.2: servers must accept it."""
    assert ask(publisher, publisher.place)[0] == 303


@pytest.mark.skipif(sys.platform != "linux", reason="has one address of this computer only")
def test_the_address_is_the_one_that_was_asked_for():
    # This computer's name may stand for another address, at which nobody listens.
    publisher = WebSocketPublisher("127.0.0.2")
    try:
        assert urlsplit(publisher.place).netloc == f"127.0.0.2:{publisher.port}"
        with connect(publisher.place.replace("http", "ws").replace("/?", "/stream?")):
            wait_until(lambda: publisher.is_watched)
    finally:
        publisher.close()


def ask(publisher, path, **headers):
    """Status, headers and content of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", publisher.port, timeout=20)
    try:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()
    finally:
        connection.close()


def test_the_page_exchanges_the_token_for_a_cookie(publisher):
    assert ask(publisher, "/")[0] == 401
    status, headers, _ = ask(publisher, f"/?{urlsplit(publisher.place).query}")
    assert (status, headers["Location"]) == (303, "/")
    cookie = headers["Set-Cookie"].partition(";")[0]
    assert {"HttpOnly", "SameSite=Strict"} <= set(headers["Set-Cookie"].split("; "))
    status, headers, content = ask(publisher, "/", Cookie=cookie)
    assert status == 200
    assert b"stream.js" in content
    assert "default-src 'self'" in headers["Content-Security-Policy"]
    assert ask(publisher, "/three/three.module.min.js", Cookie=cookie)[0] == 200
    assert ask(publisher, "/../messages.py", Cookie=cookie)[0] == 404
    assert ask(publisher, "/", Cookie=cookie.partition("=")[0] + "=wrong")[0] == 401
    assert ask(publisher, "/", Cookie=cookie, Host="example.org")[0] == 403
    own = f"http://127.0.0.1:{publisher.port}"
    with connect(f"ws://127.0.0.1:{publisher.port}/stream", origin=own, additional_headers={"Cookie": cookie}):
        wait_until(lambda: publisher.is_watched)


def test_a_token_may_be_kept_from_run_to_run(monkeypatch):
    monkeypatch.setenv("MORPH_STREAM_TOKEN", "kept-from-run-to-run")
    with StreamSink(["ws:0"]) as streams:
        assert streams.publishers[0].place.endswith("/?token=kept-from-run-to-run")
    monkeypatch.setenv("MORPH_STREAM_TOKEN", "short")
    with pytest.raises(StreamError, match="16 or more"):
        StreamSink(["ws:0"])


def test_a_client_may_start_before_the_stream(monkeypatch):
    monkeypatch.setenv("MORPH_STREAM_TOKEN", "kept-from-run-to-run")
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    address = f"http://127.0.0.1:{port}/?token=kept-from-run-to-run"
    with ExitStack() as stack, ThreadPoolExecutor() as pool:
        early = pool.submit(client.connected, stack, address)
        with StreamSink([f"ws:{port}"]):
            assert early.result(20.0).remote_address == ("127.0.0.1", port)


def test_a_client_without_a_stream_ends_with_one_line(publisher, capsys):
    publisher.close()
    for address, said in ((publisher.place, "nothing listens at"), ("nowhere", "there is no stream at this address")):
        with pytest.raises(SystemExit) as ended:
            client.run(partial(client.connected, ExitStack(), address, 0.0))
        assert ended.value.code == 2
        assert said in capsys.readouterr().err
    with closing(WebSocketPublisher()) as other, pytest.raises(ConnectionError, match=r"401.*with its token"):
        client.connected(ExitStack(), f"http://127.0.0.1:{other.port}/?token=wrong", 0.0)


def test_frames_before_the_scene_are_refused(publisher, model):
    with pytest.raises(StreamError, match="begin"):
        StreamSink([publisher])(tracked_frame(0, 0.0, block=tracked_result(model, 0.1, 0.0)))


def test_another_object_than_the_stream_was_begun_with_is_refused(publisher, model):
    """Whether anybody watches or not; an object that is not streamed may be tracked beside."""
    sink = StreamSink([publisher]).begin({"block": model}, CAMERA)
    one, other = tracked_result(model, 0.1, 0.0), tracked_result(model, 0.0, 0.0)
    with pytest.raises(
        StreamError, match="begun with the object 'block', and the session tracks seal, hand: give begin"
    ):
        sink(tracked_frame(0, 0.0, seal=one, hand=other))
    sink(tracked_frame(0, 0.0, block=one, hand=other))


def test_a_system_that_has_nothing_left_is_one_message(monkeypatch):
    def exhausted(*_, **__):
        raise OSError(24, "Too many open files")

    monkeypatch.setattr("morph_dslam.streams.websocket.serve", exhausted)
    with pytest.raises(StreamError, match=r"cannot be served: .*Too many open files"):
        WebSocketPublisher()


def test_a_port_that_is_taken(publisher):
    with pytest.raises(StreamError, match="ws:0 takes any free one"):
        StreamSink([f"ws:{publisher.port}"])


@pytest.mark.parametrize(
    "destination", ["carrier", "ws:", "ws:x", "ws:99999", "ws:127.0.0.1:", "ws:a b:80", "", ":80", "WS:80"]
)
def test_destinations_that_are_none(destination, refused, tmp_path):
    with pytest.raises(StreamError):
        StreamSink([destination])
    message = refused(
        "track", tmp_path, "--model", "a", "--camera", "b", "--landmarks", "c", "-o", tmp_path / "run",
        "--stream", destination,
    )  # fmt: skip
    assert "ws" in message
