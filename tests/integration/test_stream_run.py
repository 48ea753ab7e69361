"""Results as they come from a run: what a client receives is what the run folder keeps, and near the rendered truth."""

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.cli.app import main
from morph_dslam.errors import StreamError
from morph_dslam.extend.streams import StreamSink
from morph_dslam.registration.registration import Registration
from morph_dslam.sources import Frame
from morph_dslam.streams.websocket import WebSocketPublisher
from tests.integration.test_session import frame as both_sheets, states
from tests.support.bent_sheet import bent_sheet_model
from tests.support.chromium import Page, find_chromium
from tests.support.documents import samples
from tests.support.rendered_sequence import CAMERA, SheetFilm, sheet_state, write_landmarks, write_recording
from tests.support.streamed import held_block_model, stream_example, stress_at, tracked_frame, tracked_result

client = stream_example("client")
TIMES = np.linspace(0.0, 0.3, 13)


@pytest.fixture(scope="module")
def sheet():
    return bent_sheet_model(43, 31)


@pytest.fixture(scope="module")
def recording(sheet, tmp_path_factory):
    """Frames of a moving sheet, its model, camera and landmarks."""
    folder, film = tmp_path_factory.mktemp("sheet"), SheetFilm(sheet)
    write_recording(folder, {n: film.frame(sheet_state(time)) for n, time in enumerate(TIMES)}, sheet)
    write_landmarks(folder / "landmarks.csv", sheet, sheet_state(TIMES[0]), count=24)
    return folder


def streamed_run(recording, output, capsys, *more, command="track"):
    """The messages of a run of the command line, which a client takes as they come."""
    words = [
        command, recording / "frames", "--model", recording / "sheet.morph", "--camera", recording / "camera.yaml",
        "--landmarks", recording / "landmarks.csv", "-o", output, "--no-video", "--stream", "ws:0", *more,
    ]  # fmt: skip
    with ThreadPoolExecutor(1) as pool:
        run = pool.submit(main, [str(word) for word in words])
        address = said_address(capsys, run, "streamed to ")
        received = list(client.messages(address))
        assert run.result(300) == 0
    return received


def said_address(capsys, run, before):
    """The address that a program prints while it runs."""
    said, end = "", time.monotonic() + 60.0
    while before not in said:
        assert time.monotonic() < end
        assert not run.done(), run.result()
        time.sleep(0.01)
        said += capsys.readouterr().out
    return said[said.index("http://") :].split()[0]


@pytest.mark.parametrize("more", [(), ("--refine",)])
def test_a_client_receives_what_the_run_folder_keeps(recording, sheet, tmp_path, capsys, more):
    scene, *frames = streamed_run(recording, tmp_path / "run", capsys, *more)
    assert [part["name"] for part in scene["objects"]] == ["sheet"]
    numbers = [message["frame"] for message in frames]
    # Of two passes the second is sent.
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == len(TIMES) - 1
    assert len(numbers) >= 3
    run = md.load_run(tmp_path / "run")
    nodes = scene["arrays"]["sheet/nodes"]
    for message in frames:
        (found,), row, truth = message["objects"], run.row(message["frame"]), sheet_state(TIMES[message["frame"]])
        assert found["status"] == "tracked"
        np.testing.assert_allclose(found["parameters"], run.parameters[row], atol=1e-12)
        np.testing.assert_allclose(found["camera_from_object"], run.camera_from_object[row], atol=1e-12)
        vertices = message["arrays"]["sheet/vertices"].reshape(-1, 3).astype(float)
        pose = np.array(found["camera_from_object"])
        in_camera = vertices @ pose[:3, :3].T + pose[:3, 3]
        np.testing.assert_allclose(in_camera, run.camera_points(row)[nodes], atol=1e-7)
        true = truth.camera_from_object.apply(sheet.positions(truth.parameters))[nodes]
        assert np.linalg.norm(in_camera - true, axis=1).mean() < 1e-3
        top, bottom = (sheet.von_mises(truth.parameters, place)[nodes] for place in ("top", "bottom"))
        largest = np.maximum(top, bottom).max()
        assert np.abs(message["arrays"]["sheet/scalar"] - np.maximum(top, bottom)).mean() < 0.05 * largest


def test_a_live_run_tells_when_frames_were_captured(recording, tmp_path, capsys):
    before = time.time()
    _, *frames = streamed_run(recording, tmp_path / "run", capsys, command="live")
    captured = [message["captured"] for message in frames]
    assert before < captured[0]
    assert captured == sorted(captured)
    assert captured[-1] < time.time()
    assert {message["objects"][0]["status"] for message in frames} == {"tracked"}


def test_a_stream_that_fails_at_the_end_loses_no_result(recording, tmp_path, monkeypatch, refused):
    def fails(publisher):
        raise StreamError("the viewer has gone")

    monkeypatch.setattr(WebSocketPublisher, "close", fails)
    message = refused(
        "track", recording / "frames", "--model", recording / "sheet.morph", "--camera", recording / "camera.yaml",
        "--landmarks", recording / "landmarks.csv", "-o", tmp_path / "run", "--no-video", "--stream", "ws:0",
    )  # fmt: skip
    assert message == "morph: the viewer has gone"
    assert md.load_run(tmp_path / "run").tracked.sum() == len(TIMES)


class Awaited:
    """Frames that come once somebody is connected to the stream of a program with these ``names``."""

    def __init__(self, frames, names):
        self.frames, self.names = frames, names

    def __iter__(self):
        end = time.monotonic() + 60.0
        while not self.names["streams"].publishers[0].is_watched:
            assert time.monotonic() < end
            time.sleep(0.005)
        yield from self.frames


def test_a_session_in_memory_hands_its_results_to_a_stream(sheet, capsys):
    """The program of the documentation: `FrameResult` of the same frames has the values that come over the wire."""
    film = SheetFilm(sheet)
    registration, reference = Registration(sheet, sheet_state(0.0)), film.frame(sheet_state(TIMES[0]))
    frames = [Frame(n, time, film.frame(sheet_state(time))) for n, time in enumerate(TIMES[1:])]
    names = {"md": md, "model": sheet, "camera": CAMERA}
    names |= {"tracker": md.Tracker(sheet, CAMERA, registration, reference=reference), "frames": Awaited(frames, names)}
    program = samples("streams", "python")[0].replace("ws:8767", "ws:0")
    with ThreadPoolExecutor(1) as pool:
        run = pool.submit(exec, compile(program, "streams", "exec"), names)
        scene, *messages = client.messages(said_address(capsys, run, "http://"))
        run.result(60)
    again = md.Tracker(sheet, CAMERA, registration, reference=reference)
    results = {frame.index: again.track(frame) for frame in frames}
    nodes = scene["arrays"]["seal/nodes"]
    assert len(messages) >= 3
    for message in messages:
        result, (found,) = results[message["frame"]], message["objects"]
        assert (found["name"], found["text"]) == ("seal", result.reason)
        arrays = message["arrays"]
        positions = result.pose.apply(arrays["seal/vertices"].reshape(-1, 3).astype(float))
        np.testing.assert_allclose(positions, result.positions()[nodes], atol=1e-7)
        np.testing.assert_allclose(arrays["seal/scalar"], result.von_mises()[nodes], rtol=1e-4, atol=10.0)
        np.testing.assert_allclose(found["parameter_std"], list(result.parameter_std.values()), rtol=1e-9)
        np.testing.assert_allclose(found["pose_std"], result.pose_std, rtol=1e-9)


@pytest.mark.skipif(find_chromium() is None, reason="no Chromium on this machine")
def test_the_page_shows_shape_stress_parameters_and_forces(tmp_path):
    model = held_block_model()
    publisher = WebSocketPublisher()
    sink = StreamSink([publisher]).begin({"block": model}, CAMERA)
    stretch, slide = 0.15, 0.004
    with Page(tmp_path / "profile") as page:
        page.send("Page.navigate", url=publisher.place)
        page.wait_for("document.title === 'block'")
        sink(tracked_frame(7, 0.25, block=tracked_result(model, stretch, slide)))
        page.wait_for("document.getElementById('view').dataset.frame === '7'")
        assert page.evaluate("location.search") == ""
        rows = page.evaluate(
            "Object.fromEntries([...document.querySelectorAll('tr')].map(r => [r.cells[0].textContent, "
            "r.cells[1].textContent]))"
        )
        assert rows["stretch"] == "0.150 ± 0.010"
        assert rows["slide"] == "4.00 ± 0.50 mm"
        # The force (-60, 0, 20) N has components known to (4, 0, 2.5) N.
        assert rows["left end"] == f"{np.hypot(60.0, 20.0):.1f} ± {np.sqrt(0.9 * 4.0**2 + 0.1 * 2.5**2):.1f} N"
        top = float(page.evaluate("document.querySelector('#bar li').textContent"))
        shot = page.screenshot()
        view = shot[:, 310:860].astype(int)
        solid = np.abs(view - view[2, 2]).max(axis=2) > 12
        assert 0.03 < solid.mean() < 0.7
        # All of it has one stress: the colour is that of its share of the bar.
        share = 1e-6 * stress_at(stretch, slide) / top
        assert 0.5 < share < 0.95
        blue, green, red = view[solid].mean(axis=0)
        assert red > 1.5 * blue
        assert red > green
        publisher.close()
        page.wait_for("document.getElementById('status').textContent === 'the stream has ended'")
        assert page.problems == []


@pytest.mark.slow
def test_each_object_is_told_by_its_name(sheet, tmp_path, capsys):
    """One sheet passes another: the first has the name of its model file, the other the one that is given."""
    films = {"behind": SheetFilm(sheet, seed=1), "before": SheetFilm(sheet, seed=2)}
    write_recording(tmp_path, {n: both_sheets(sheet, films, time) for n, time in enumerate(TIMES[:8])}, sheet)
    for name, path in (("behind", "landmarks.csv"), ("before", "before.csv")):
        write_landmarks(tmp_path / path, sheet, states(0.0)[name], count=24)
    also = ("--also", "before", tmp_path / "sheet.morph", tmp_path / "before.csv", "--show", "displacement")
    scene, *frames = streamed_run(tmp_path, tmp_path / "run", capsys, *also)
    shown = [(part["name"], part["scalar"]["name"]) for part in scene["objects"]]
    assert shown == [("sheet", "displacement"), ("before", "displacement")]
    for message in frames:
        truth = states(TIMES[message["frame"]])
        for found, name in zip(message["objects"], ("behind", "before"), strict=True):
            assert found["status"] == "tracked"
            nodes, arrays = scene["arrays"][f"{found['name']}/nodes"], message["arrays"]
            vertices = arrays[f"{found['name']}/vertices"].reshape(-1, 3).astype(float)
            pose = np.array(found["camera_from_object"])
            true = truth[name].camera_from_object.apply(sheet.positions(truth[name].parameters))[nodes]
            assert np.linalg.norm(vertices @ pose[:3, :3].T + pose[:3, 3] - true, axis=1).mean() < 1e-3
            moved = np.linalg.norm(sheet.displacement.value(np.array(found["parameters"])), axis=1)
            np.testing.assert_allclose(arrays[f"{found['name']}/scalar"], moved[nodes], atol=1e-7)
