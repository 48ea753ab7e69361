"""A file of the studio that another one takes the place of: what was made of the first is not shown with the second."""

import asyncio
import json

import cv2
import numpy as np
import pytest

from morph_dslam import load_camera, save_model
from morph_dslam.errors import MorphError, StudioError
from morph_dslam.extend.mechanics import block, save_mesh
from morph_dslam.studio import clicks, object_mesh, recording
from morph_dslam.studio.jobs import Jobs
from morph_dslam.studio.project import Project
from morph_dslam.studio.scan_steps import ScanSteps
from morph_dslam.studio.worker import Worker
from tests.support.stretched_block import stretched_block_model
from tests.support.studio import Client, running_studio, write_part

GREYS = {0: 60, 10: 90, 20: 120}


def image_of(grey, kind=".png"):
    """A picture of one grey, as a file's content."""
    return cv2.imencode(kind, np.full((48, 64, 3), grey, np.uint8))[1].tobytes()


def grey_of(jpeg):
    """Mean of a JPEG's values."""
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).mean()


@pytest.fixture
def images(tmp_path):
    """A folder of three images of one grey each, with gaps between their numbers."""
    folder = tmp_path / "live"
    folder.mkdir()
    for number, grey in GREYS.items():
        (folder / f"{number:06d}.png").write_bytes(image_of(grey))
    return folder


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    folder = tmp_path_factory.mktemp("studio") / "project"
    with running_studio(folder) as server:
        write_part(folder.parent / "part.inp")
        client = Client(server)
        client.folder, client.part = folder, (folder.parent / "part.inp").read_bytes()
        # What reads meshes is imported once.
        assert client.upload("object", "first.inp", client.part) == 200
        client.call("load_object", file="first.inp", unit="mm")
        yield client


def test_an_image_that_was_replaced_in_a_folder_is_the_one_that_is_shown(images):
    shown = {number: recording.frame_jpeg(images, number) for number in GREYS}
    assert {number: grey_of(jpeg) for number, jpeg in shown.items()} == pytest.approx(GREYS, abs=1.0)
    for number in GREYS:  # not the last one alone
        (images / f"{number:06d}.png").write_bytes(image_of(200))
        assert grey_of(recording.frame_jpeg(images, number)) == pytest.approx(200, abs=1.0)


def test_the_numbers_of_frames_are_known_where_some_are_missing(images, client):
    assert recording.frame_numbers(images) == [0, 10, 20]
    facts = recording.recording_facts(images)
    assert (facts["first"], facts["last"], facts["frames"]) == (0, 20, 3)
    for number in range(20):
        (images / f"{number:06d}.png").write_bytes(image_of(number))
    assert recording.frame_numbers(images) is None
    assert recording.recording_facts(images)["last"] == 20
    assert "there is no recording yet" in client.refused("frame_numbers")


def test_a_camera_of_another_program_becomes_one_of_this(tmp_path):
    target = tmp_path / "camera.yaml"
    (tmp_path / "cameras.txt").write_text("# Camera list\n1 PINHOLE 64 48 60 61 32 24\n")
    clicks.take_camera(tmp_path / "cameras.txt", target)
    camera = load_camera(target)
    # COLMAP puts (0, 0) into the corner of the first pixel, here it is the pixel's centre.
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (64, 48, 60, 61, 31.5, 23.5)
    (tmp_path / "cameras.txt").write_text("1 UNKNOWN 64 48 60\n")
    with pytest.raises(MorphError):
        clicks.take_camera(tmp_path / "cameras.txt", target)
    assert load_camera(target) == camera


def test_an_uploaded_camera_of_colmap_can_be_read(client):
    assert client.upload("camera", "cameras.txt", b"1 SIMPLE_PINHOLE 640 480 500 320 240\n") == 200
    camera = client.state()["camera"]
    assert (camera["fx"], camera["cx"], camera["cy"]) == (500.0, 319.5, 239.5)
    assert client.state()["choices"]["camera_from"] == "cameras.txt"


def test_an_object_that_cannot_be_read_leaves_the_earlier_one_with_its_sets(client):
    assert client.upload("object", "part.inp", client.part) == 200
    client.call("load_object", file="part.inp", unit="mm")
    client.call("name_set", name="foot", faces=[0, 1, 2])
    mesh, choices = (client.folder / "mesh.inp").read_bytes(), client.state()["choices"]
    for content, status in ((b"garbage", 400), (client.part, 200)):
        assert client.upload("object", "part.inp", content) == status
        client.call("load_object", file="part.inp", unit="mm")
        assert client.state()["choices"] == choices
        assert (client.folder / "part.inp").read_bytes() == client.part
        assert (client.folder / "mesh.inp").read_bytes() == mesh
    # Another part of the same name has other faces.
    assert client.upload("object", "part.inp", client.part.replace(b"*NODE", b"** another\n*NODE", 1)) == 200
    client.call("load_object", file="part.inp", unit="mm")
    assert "sets" not in client.state()["choices"]
    assert (client.folder / "mesh.inp").read_bytes() != mesh


def test_a_unit_that_is_chosen_later_refuses_no_object(tmp_path):
    write_part(tmp_path / "part.inp")  # which is of a plausible size in some of them alone
    for unit in object_mesh.UNITS:
        object_mesh.check_object(tmp_path / "part.inp", unit)
    (tmp_path / "part.inp").write_bytes(b"garbage")
    with pytest.raises(MorphError):
        object_mesh.check_object(tmp_path / "part.inp", "mm")


def test_a_note_on_an_uploaded_object_names_its_file_alone(client, tmp_path):
    save_mesh(tmp_path / "small.inp", block((0.003, 0.002, 0.002), (2, 2, 2), "hex8"), "mm")
    assert client.upload("object", "small.inp", (tmp_path / "small.inp").read_bytes()) == 200
    (note,) = client.call("load_object", file="small.inp", unit="mm")["notes"]
    assert note.startswith("small.inp measures 3 x 2 x 2 mm")


def test_a_name_as_long_as_uploads_may_have_is_loaded(client):
    name = "a" * 96 + ".inp"
    assert client.upload("object", name, client.part) == 200
    assert client.call("load_object", file=name, unit="mm")["n_cells"] == 54


def test_another_recording_of_the_same_name_has_no_map(client):
    save_model(client.folder / "model.morph", stretched_block_model())
    for grey in (40, 180):
        assert client.upload("frame", "000.png", image_of(grey)) == 200
        if grey == 40:
            # As `morph slam` and `map_scan` leave it.
            (client.folder / "map").mkdir()
            (client.folder / "map/map.h5").write_bytes(b"")
            (client.folder / "map/summary.json").write_text("{}")
            choices = json.loads((client.folder / "studio.json").read_text())
            (client.folder / "studio.json").write_text(json.dumps(choices | {"mapped": "frames"}))
        assert grey_of(client.ask("GET", "/api/scan/0")[2]) == pytest.approx(grey, abs=1.0)
    assert not (client.folder / "map/summary.json").exists()
    assert "mapped" not in client.state()["choices"]


def test_a_map_that_is_made_while_its_scan_is_replaced_is_forgotten(tmp_path):
    project = Project(tmp_path)
    (tmp_path / "map").mkdir()
    summary = tmp_path / "map/summary.json"

    async def replaced_while_mapped(is_replaced):
        jobs = Jobs(tmp_path, lambda: scan.job_ended())
        scan = ScanSteps(project, Worker(), jobs)
        await jobs.start("slam", ["--version"])
        project.choose(mapped="phone.webm")
        if is_replaced:
            scan.recording_replaced("another.webm")
            scan.recording_replaced("phone.webm")
        summary.write_text("{}")  # as the command does at its end
        await until_it_ended(jobs)

    asyncio.run(replaced_while_mapped(False))
    assert summary.exists()
    asyncio.run(replaced_while_mapped(True))
    assert not summary.exists()


def test_a_place_can_be_looked_for_as_often_as_one_likes(tmp_path):
    """`morph register` refuses a folder that holds a registration or its picture."""
    folder = tmp_path / "place"
    for name in ("model.morph", "camera.yaml", "map/map.h5", "place/registration.json", "place/registration.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    found = []

    class Waiting(Jobs):
        async def start(self, kind, words, then=lambda: None):
            found.append((kind, words[-2:], list(folder.iterdir())))

    scan = ScanSteps(Project(tmp_path), Worker(), Waiting(tmp_path, lambda: None))
    asyncio.run(scan.find_place())
    assert found == [("register", ["-o", "place"], [])]


async def until_it_ended(jobs):
    """Wait until a command has ended, and all that belongs to its end is done."""
    while jobs.job.running:
        await asyncio.sleep(0.02)
    await asyncio.sleep(0)


def test_what_follows_a_command_follows_only_if_it_ended_well(tmp_path):
    said = []

    async def run(words):
        jobs = Jobs(tmp_path, lambda: None)
        await jobs.start("words", words, lambda: said.append(words))
        await until_it_ended(jobs)
        return jobs.job.status

    assert asyncio.run(run(["--version"])) == 0
    assert asyncio.run(run(["no-command"])) == 2
    assert said == [["--version"]]


def test_a_command_that_cannot_be_started_is_no_command_that_runs(tmp_path, monkeypatch):
    async def none_starts(*_, **__):
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(asyncio, "create_subprocess_exec", none_starts)
    jobs = Jobs(tmp_path, lambda: None)
    with pytest.raises(StudioError):
        asyncio.run(jobs.start("build", ["--version"]))
    assert jobs.content() is None
    jobs.check_idle()
