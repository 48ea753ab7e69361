"""What a project of the studio has stays until there is something better, and is shown over what it belongs to."""

import json
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

import morph_dslam as md
from morph_dslam.errors import StudioError
from morph_dslam.io.camera_files import save_camera
from morph_dslam.studio.server import StudioServer
from tests.support.bent_sheet import bent_sheet_model
from tests.support.processes import ended_at_last
from tests.support.rendered_sequence import CAMERA, SheetFilm, sheet_state
from tests.support.stretched_block import stretched_block_model
from tests.support.studio import Client, running_studio

STATES = [sheet_state(0.008 * k) for k in range(8)]
GOOD_CAMERA = "width: 640\nheight: 480\nfx: 528.0\nfy: 528.0\ncx: 320.0\ncy: 240.0\n"


def video_of(path, images):
    """Content of a video of images (h, w, 3)."""
    height, width = images[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30, (width, height))
    for image in images:
        writer.write(image)
    writer.release()
    return path.read_bytes()


def pairs_of(model, state):
    """Points (k, 5) of the sheet in millimetres, and the pixels that show them."""
    nodes = np.arange(0, len(model.nodes), 60)
    seen = CAMERA.project(state.camera_from_object.apply(model.positions(state.parameters)))[nodes]
    return np.column_stack([1e3 * model.nodes[nodes], seen]).tolist()


def ended_job(client):
    """The job, once it has ended."""
    end = time.monotonic() + 200
    while (job := client.state()["job"])["running"]:
        assert time.monotonic() < end, job
        time.sleep(0.1)
    return job


@pytest.fixture(scope="module")
def videos(tmp_path_factory):
    """Two videos of a sheet that bends: 6 frames, and 4 of others."""
    folder, film = tmp_path_factory.mktemp("videos"), SheetFilm(bent_sheet_model())
    images = [film.frame(state) for state in STATES]
    return video_of(folder / "a.mp4", images[:6]), video_of(folder / "b.mp4", images[4:])


@pytest.fixture(scope="module")
def tracked_once(tmp_path_factory, videos):
    """A project whose recording a.mp4 was tracked from pairs in frame 1; never changed."""
    folder, model = tmp_path_factory.mktemp("tracked") / "project", bent_sheet_model()
    with running_studio(folder) as server:
        client = Client(server)
        md.save_model(folder / "model.morph", model)
        save_camera(folder / "camera.yaml", CAMERA)
        assert client.upload("recording", "a.mp4", videos[0]) == 200
        client.call("save_start", pairs=pairs_of(model, STATES[1]), frame=1, at_rest=False)
        client.call("track")
        job = ended_job(client)
        assert job["status"] == 0, job["lines"]
    return folder


@pytest.fixture
def tracked(tracked_once, tmp_path):
    """A client of a studio of a copy of that project, and its folder."""
    shutil.copytree(tracked_once, tmp_path / "project")
    with running_studio(tmp_path / "project") as server:
        yield Client(server), tmp_path / "project"


@pytest.fixture
def empty(tmp_path):
    """A client of a studio of an empty project, and its folder."""
    with running_studio(tmp_path / "project") as server:
        yield Client(server), tmp_path / "project"


@pytest.mark.slow
def test_a_refused_upload_leaves_the_file_of_its_name(empty, videos):
    client, folder = empty
    pairs = "x_mm,y_mm,z_mm,u_px,v_px\n" + "1,2,3,4,5\n" * 6
    for kind, name, good, broken in (
        ("camera", "camera.yaml", GOOD_CAMERA.encode(), b"width: hi\n"),
        ("camera", "phone.yaml", GOOD_CAMERA.encode(), b"width: hi\n"),
        ("landmarks", "landmarks.csv", pairs.encode(), b"x,y\n"),
        ("recording", "a.mp4", videos[0], videos[0][:2000]),
        ("scan", "s.mp4", videos[1], b"none"),
    ):
        path = folder / "scan" / name if kind == "scan" else folder / name
        status, _, said = client.ask("PUT", f"/api/upload/{kind}/{name}", broken)
        assert (status, path.exists()) == (400, False)
        assert b"is kept" not in said
        assert client.upload(kind, name, good) == 200
        before = client.state()
        status, _, said = client.ask("PUT", f"/api/upload/{kind}/{name}", broken)
        assert status == 400
        assert f"the {name} that was there before is kept" in said.decode()
        assert "upload" not in said.decode()  # where it waited
        assert path.read_bytes() == good
        assert client.state() == before
    assert not [path.name for path in folder.iterdir() if path.name.startswith(".upload")]


@pytest.mark.slow
def test_pairs_of_another_recording_are_set_aside(tracked, videos):
    client, folder = tracked
    pairs = (folder / "landmarks.csv").read_bytes()
    assert client.upload("recording", "a.mp4", videos[0]) == 200  # the same one again
    assert client.state()["done"]["start"]
    assert client.call("start_files")["frame"] == 1
    assert client.state()["notes"]["start"] is None
    status, _, said = client.ask("PUT", "/api/upload/recording/b.mp4", videos[1])
    assert status == 200
    for note in (json.loads(said)["note"], client.state()["notes"]["start"]):
        assert "clicked on an earlier recording (a.mp4), and are kept in landmarks-before.csv" in note
    assert (folder / "landmarks-before.csv").read_bytes() == pairs
    assert not client.state()["done"]["start"]
    assert client.call("start_files")["pairs"] == []
    assert "landmarks.csv is not there" in client.refused("track")
    client.call("save_start", pairs=pairs_of(bent_sheet_model(), STATES[4]), frame=0, at_rest=False)
    assert client.state()["notes"]["start"] is None
    assert client.state()["done"]["start"]
    assert client.upload("recording", "b.mp4", videos[0]) == 200  # another video of the same name
    assert not client.state()["done"]["start"]
    assert "(b.mp4)" in client.state()["notes"]["start"]


def test_pairs_clicked_on_a_recording_that_another_page_has_replaced_are_not_saved(tracked, videos):
    """By another name, under the same name, and with the number that a page loaded since has."""
    client, folder = tracked
    clicked = {"pairs": pairs_of(bent_sheet_model(), STATES[1]), "frame": 1, "at_rest": False}
    for name, video in (("b.mp4", videos[1]), ("b.mp4", videos[0])):
        number = client.state()["choices"].get("recording_number", 0)
        client.call("save_start", **clicked, recording_number=number)
        (folder / "landmarks.csv").unlink()
        assert client.upload("recording", name, video) == 200
        assert "was replaced while these pairs were clicked" in client.refused(
            "save_start", **clicked, recording_number=number
        )
        assert not (folder / "landmarks.csv").exists()
    client.call("save_start", **clicked, recording_number=client.state()["choices"]["recording_number"])
    assert client.state()["done"]["start"]


def started_command(client):
    """What *Track* starts, which is stopped at once."""
    client.call("track")
    client.call("stop")
    return ended_job(client)["command"].split()


def test_landmarks_are_those_of_an_undeformed_object_only_where_somebody_says_so(tracked, videos):
    """Said of pairs that were saved; neither of other ones that are uploaded, nor of those of another recording."""
    client, folder = tracked
    clicked = {"pairs": pairs_of(bent_sheet_model(), STATES[0]), "frame": 0}
    client.call("save_start", **clicked, at_rest=True)
    assert "--at-rest" in started_command(client)
    landmarks = (folder / "landmarks.csv").read_bytes()
    assert client.upload("landmarks", "landmarks.csv", landmarks) == 200
    assert not client.call("start_files")["at_rest"]
    assert "--at-rest" not in started_command(client)
    client.call("save_start", **clicked, at_rest=True)
    assert client.upload("recording", "b.mp4", videos[1]) == 200
    assert not client.call("start_files")["at_rest"]
    assert client.upload("landmarks", "landmarks.csv", landmarks) == 200
    assert "--at-rest" not in started_command(client)


def test_landmarks_of_another_object_are_named_when_they_come(tracked):
    """The sheet lies in z = 0, and the corners of a block 40 mm above it."""
    client, folder = tracked
    own = (folder / "landmarks.csv").read_bytes()
    rows = [f"{x},{y},40,{300 + x},{200 + y}" for x in (0, 80) for y in (0, 20, 40)]
    others = "\n".join(["x_mm,y_mm,z_mm,u_px,v_px", *rows, ""]).encode()
    status, _, said = client.ask("PUT", "/api/upload/landmarks/landmarks.csv", others)
    state = client.state()
    assert status == 200
    for note in (json.loads(said)["note"], state["notes"]["start"]):
        assert re.search(r"landmarks.csv does not fit model.morph: landmark 1 at .* is 40.0 mm off", note)
    assert not state["done"]["start"]
    _, _, said = client.ask("PUT", "/api/upload/landmarks/landmarks.csv", own)
    assert json.loads(said)["note"] is None
    assert client.state()["done"]["start"]


def test_every_page_is_told_of_another_recording(tracked, videos):
    client, _ = tracked
    uploaded = []

    def is_told(name, content):
        if not uploaded:
            uploaded.append(client.upload("recording", "b.mp4", videos[1]))
        return name == "recording"

    assert client.events(is_told)[-1] == ("recording", "b.mp4")
    assert uploaded == [200]


def test_pairs_of_pictures_are_set_aside_with_them(empty):
    client, folder = empty
    data = [cv2.imencode(".png", np.full((24, 32, 3), 40 * k, np.uint8))[1].tobytes() for k in range(3)]
    for number in (0, 1):
        assert client.upload("frame", f"{number}.png", data[number]) == 200
    client.call("save_start", pairs=[[1, 2, 3, 4, 5]] * 6, frame=1, at_rest=True)
    assert client.upload("frame", "2.png", data[2]) == 200  # one more of the same recording
    assert client.upload("frame", "1.png", data[1]) == 200
    assert client.state()["done"]["start"]
    assert client.call("start_files")["frame"] == 1
    client.call("forget_frames", folder="frames")
    assert client.upload("frame", "0.png", data[2]) == 200
    assert not client.state()["done"]["start"]
    assert client.call("start_files")["frame"] is None
    assert (folder / "landmarks-before.csv").is_file()


def test_results_are_those_of_the_run_folder(tracked):
    """As the frame log has them, which is there no more or is of a run that broke off."""
    client, folder = tracked
    logged = [json.loads(line) for line in (folder / "track.jsonl").read_text().splitlines()]
    assert [row["frame"] for row in logged] == list(range(6))
    drawn = client.call("overlay", frame=3, of="log")["pixels"]
    (folder / "track.jsonl").write_text(json.dumps(logged[0] | {"frame": 70}) + "\n")
    found = client.call("tracked_frames")
    assert found["problem"] is None
    assert found["summary"]["n_tracked"] == 6
    assert found["frames"] == logged
    np.testing.assert_allclose(client.call("overlay", frame=3)["pixels"], drawn, atol=1e-3)
    assert "was not tracked in frame 70" in client.refused("overlay", frame=70)


def test_a_run_that_fails_at_once_leaves_the_results_of_the_one_before(tracked):
    client, folder = tracked
    before, drawn = client.call("tracked_frames"), client.call("overlay", frame=3)["pixels"]
    other = GOOD_CAMERA.replace("528.0", "700.0")
    assert client.upload("camera", "other.yaml", other.encode()) == 200
    client.call("save_start", pairs=pairs_of(bent_sheet_model(), STATES[0]), frame=70, at_rest=False)  # there is none
    client.call("track")
    assert ended_job(client)["status"] == 2
    assert client.call("tracked_frames") == before
    assert client.state()["done"]["results"]
    np.testing.assert_array_equal(client.call("overlay", frame=3)["pixels"], drawn)  # by the camera of the run
    assert len((folder / "track.jsonl").read_text().splitlines()) == 6


@pytest.mark.slow
def test_a_run_that_is_refused_changes_nothing(tracked):
    client, folder = tracked
    (folder / "track.jsonl").write_text('{"frame": 1, "sta')  # of one that was killed
    client.call("track")
    for action in ("track", "go_live", "build"):
        assert "still runs" in client.refused(action)
    job = ended_job(client)
    assert job["status"] == 0, job["lines"]
    assert [json.loads(line)["frame"] for line in (folder / "track.jsonl").read_text().splitlines()] == list(range(6))


@pytest.mark.slow
def test_a_run_is_not_shown_over_another_recording(tracked, videos):
    client, _ = tracked
    client.call("overlay", frame=3)
    for name, content, words in (
        ("b.mp4", videos[1], "this run is of a.mp4, and the recording is b.mp4: track again"),
        ("a.mp4", videos[0], None),  # brought back
        ("a.mp4", videos[1], "this run is of an earlier a.mp4, which was replaced: track again"),
    ):
        assert client.upload("recording", name, content) == 200
        state = client.state()
        assert state["notes"]["run"] == client.call("tracked_frames")["problem"] == words
        assert state["done"]["track"] == state["done"]["results"] == (words is None)
        if words is None:
            client.call("overlay", frame=3)
        else:
            for of in ("run", "log"):
                assert client.refused("overlay", frame=3, of=of) == words
    client.call("save_start", pairs=pairs_of(bent_sheet_model(), STATES[4]), frame=0, at_rest=False)
    client.call("track")
    assert ended_job(client)["status"] == 0
    assert client.state()["done"]["results"]
    assert [row["frame"] for row in client.call("tracked_frames")["frames"]] == [0, 1, 2, 3]


@pytest.mark.slow
def test_a_recording_that_is_replaced_while_it_is_tracked_is_not_that_of_the_run(tracked, videos):
    """Whether it was opened before or after: its first frame, or its pairs, are of the one that was there."""
    client, _ = tracked
    client.call("track")
    end = time.monotonic() + 100
    while client.state()["job"]["what"] == "starting":
        assert time.monotonic() < end
        time.sleep(0.05)
    assert client.upload("recording", "a.mp4", videos[1]) == 200
    ended_job(client)
    assert "this run is of an earlier a.mp4" in client.state()["notes"]["run"]


def test_a_run_is_not_shown_with_another_model(tracked):
    client, folder = tracked
    model = bent_sheet_model()
    md.save_model(folder / "model.morph", model)  # built again
    client.call("overlay", frame=3)
    md.save_model(folder / "model.morph", stretched_block_model())
    words = "this run is of another model, kept as run/model.morph, than model.morph: track again"
    assert client.refused("overlay", frame=3) == client.refused("export", format="gltf") == words
    assert client.state()["notes"]["run"] == words
    assert not client.state()["done"]["results"]


def test_a_frame_log_that_is_begun_anew_between_two_looks_is_read_anew(empty):
    """Also where the new one is longer already."""
    client, folder = empty

    def rows(count, reason):
        return [{"frame": k, "reason": reason, "camera_from_object": None, "parameters": {}} for k in range(count)]

    def write(content):
        (folder / "track.jsonl").write_text("".join(json.dumps(row) + "\n" for row in content))

    first, second = rows(2, "old"), rows(5, "newer")
    write(first)
    timer = threading.Timer(1.0, write, [second])
    timer.start()
    events = client.events(lambda name, content: name == "frames" and content["frames"][-1]["reason"] == "newer")
    timer.join()
    told = [content for name, content in events if name == "frames"]
    assert told == [{"anew": True, "frames": first}, {"anew": True, "frames": second}]


def test_damaged_settings_are_set_aside(tracked):
    client, folder = tracked
    chosen = (folder / "studio.json").read_text()
    for name, damaged in (("studio-damaged.json", chosen[:-20]), ("studio-damaged-2.json", "[1, 2]")):
        (folder / "studio.json").write_text(damaged)
        client.call("start_by", way="pairs")
        assert json.loads((folder / "studio.json").read_text())["start"] == "pairs"
        assert (folder / name).read_text() == damaged
        state = client.state()
        assert "studio.json was damaged, and is kept as" in state["notes"]["settings"]
        assert name in state["notes"]["settings"]
        assert not state["done"]["start"]  # in which frame the pairs are is not known
        assert (folder / "landmarks-before.csv").is_file()
    for path in folder.glob("studio-damaged*.json"):
        path.unlink()
    assert client.state()["notes"]["settings"] is None


def test_one_studio_serves_a_project(empty, refused):
    client, folder = empty
    said = refused("studio", folder, "--port", 0)
    assert f"another studio at http://127.0.0.1:{client.port}/ serves {folder} already" in said
    with pytest.raises(StudioError, match="another studio"):
        StudioServer(folder, port=0)
    assert client.state()["folder"] == str(folder)


@pytest.mark.slow
def test_a_killed_studio_leaves_no_lock(tmp_path):
    program = "import sys; from morph_dslam.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "studio", str(tmp_path / "project"), "--port", "0"]
    with ended_at_last(subprocess.Popen(command, stdout=subprocess.PIPE, text=True)) as process:
        assert re.search(r"http://127\.0\.0\.1:\d+/", process.stdout.readline())
        with pytest.raises(StudioError, match="another studio"):
            StudioServer(tmp_path / "project", port=0)
        process.send_signal(signal.SIGKILL)
        process.wait(30)
        with running_studio(tmp_path / "project") as server:
            assert Client(server).state()["files"] == []


def test_a_folder_that_cannot_be_a_project_is_refused(tmp_path, refused):
    said = refused("studio", tmp_path / "mistyped" / "project", "--port", 0)
    assert f"there is no folder {tmp_path / 'mistyped'}" in said
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    assert "is a file" in refused("studio", tmp_path / "file", "--port", 0)


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="no folder that nobody can write to")
def test_a_folder_that_cannot_be_written_is_refused(refused):
    assert "nothing can be written into the project folder /proc" in refused("studio", "/proc", "--port", 0)


def test_a_build_without_a_study_is_refused_at_once(empty):
    client, _ = empty
    assert "study.toml is not there" in client.refused("build")
    assert client.state()["job"] is None
