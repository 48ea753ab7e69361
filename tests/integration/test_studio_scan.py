"""The start by a scan in the studio over HTTP: map, place, acceptance, and the run that starts from it."""

import json
import shutil
import time

import cv2
import h5py
import numpy as np
import pytest

from morph_dslam import load_camera, load_model
from tests.support.live_camera import LivePage
from tests.support.rendered_anchored import FRAMES, SCAN
from tests.support.studio import Client, running_studio

pytestmark = pytest.mark.slow

#: Frame of the scan in which pairs are set.
SET_IN = 20


def job_of(client):
    """The job, once it has ended."""
    end = time.monotonic() + 300
    while (job := client.state()["job"])["running"]:
        assert time.monotonic() < end, job
        time.sleep(0.2)
    return job


def errors(model, camera_from_object, pose, parameters):
    """Distances (n,) of deformed nodes from where they truly are in the camera, metres."""
    there, true = (
        (model.positions(mu) @ matrix[:3, :3].T + matrix[:3, 3])
        for mu, matrix in ((parameters[0], pose), (parameters[1], camera_from_object))
    )
    return np.linalg.norm(there - true, axis=1)


@pytest.fixture(scope="module")
def studio(anchored_recording, tmp_path_factory):
    """A client of a studio with the model, the camera, the recording and its truth; and the project folder."""
    source, truth = anchored_recording
    folder = tmp_path_factory.mktemp("scan") / "project"
    with running_studio(folder) as server:
        client = Client(server)
        shutil.copy(source / "sheet.morph", folder / "model.morph")
        assert client.upload("camera", "camera.yaml", (source / "sequence/camera.yaml").read_bytes()) == 200
        for path in sorted((source / "sequence/frames").iterdir()):
            assert client.upload("frame", path.name, path.read_bytes()) == 200
        yield client, folder, truth


@pytest.fixture(scope="module")
def placed(studio):
    """What the scan holds after its first part was mapped and pairs were given in it."""
    client, folder, truth = studio
    client.call("start_by", way="scan")
    client.call("map_scan", last=SCAN - 1)
    assert "still runs" in client.refused("find_place")
    assert job_of(client)["command"] == (
        f"morph slam frames --camera camera.yaml --range 0-{SCAN - 1} --no-video --overwrite -o map"
    )
    model, camera, pose = (
        load_model(folder / "model.morph"),
        load_camera(folder / "camera.yaml"),
        truth["camera_from_object"][SET_IN],
    )
    corners = np.array(
        [
            [a * model.nodes[:, 0].max(), b * model.nodes[:, 1].max(), 0.0]
            for a, b in ((1, 1), (0.5, 1), (1, 0.5), (0.5, 0.5))
        ]
    )
    corners = model.nodes[[np.linalg.norm(model.nodes - corner, axis=1).argmin() for corner in corners]]
    pixels = camera.project_recorded(corners @ pose[:3, :3].T + pose[:3, 3])
    client.call("find_place", pairs=np.column_stack([1e3 * corners, pixels]).tolist(), frame=SET_IN)
    job = job_of(client)
    assert job["status"] == 0, job["lines"]
    words = "morph register map/map.h5 --model model.morph --camera camera.yaml --landmarks scan_landmarks.csv -o place"
    assert job["command"] == words
    return client.call("scan")


def test_the_evidence_of_a_place_is_told(studio, placed):
    place, written = placed["place"], (studio[1] / "place/registration.json").read_text()
    assert placed["map"]["n_tracked"] > 0.8 * SCAN
    assert place["ambiguous"]  # the edges of a flat sheet alone are no proof
    assert place["accepted"] is None
    assert place["warnings"] == [warning["text"] for warning in json.loads(written)["warnings"]] != []
    assert any("points of the map lie on its surface" in line for line in place["evidence"])
    assert placed["problem"] is None
    assert placed["map"]["keyframes"][0] < SET_IN < placed["map"]["keyframes"][-1] < SCAN


def test_the_place_is_drawn_where_the_object_is(studio, placed):
    client, folder, truth = studio
    model, camera = load_model(folder / "model.morph"), load_camera(folder / "camera.yaml")
    used = np.unique(model.triangles)
    for frame in placed["map"]["keyframes"][::3]:
        pose = truth["camera_from_object"][frame]
        true = camera.project_recorded(model.nodes[used] @ pose[:3, :3].T + pose[:3, 3])
        drawn = client.call("place_overlay", frame=frame)["pixels"].reshape(-1, 2)
        assert np.linalg.norm(drawn - true, axis=1).mean() < 1.0
        status, headers, content = client.ask("GET", f"/api/scan/{frame}")
        assert (status, headers["content-type"]) == (200, "image/jpeg")
        assert cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR).shape == (
            camera.height,
            camera.width,
            3,
        )
    assert "is no keyframe of the map" in client.refused("place_overlay", frame=FRAMES - 1)
    assert "there is no other place 9" in client.refused("place_overlay", frame=placed["map"]["keyframes"][0], rival=9)


def test_an_ambiguous_place_is_accepted_on_purpose(studio, placed):
    client, folder, _ = studio
    assert not client.state()["done"]["start"]
    assert "no place in the scan is accepted" in client.refused("track")
    assert "is ambiguous" in client.refused("accept_place")
    client.call("accept_place", despite_ambiguity=True)
    assert json.loads((folder / "studio.json").read_text())["place"]["ambiguous"] is True
    assert client.state()["done"]["start"]


def test_the_video_is_tracked_from_the_place(studio, placed):
    client, folder, truth = studio
    client.call("accept_place", despite_ambiguity=True)
    client.call("track")
    job = job_of(client)
    assert job["status"] == 0, job["lines"]
    words = "--map map/map.h5 --registration place/registration.json --frame-log track.jsonl --overwrite -o run"
    assert job["command"] == f"morph track frames --model model.morph --camera camera.yaml {words}"
    model = load_model(folder / "model.morph")
    with h5py.File(folder / "run/result.h5") as file:
        seen = file["status"].asstr()[()] == "tracked"
        assert seen.mean() > 0.8
        found = zip(file["frame"][seen], file["camera_from_object"][seen], file["parameters"][seen], strict=True)
        off = [
            errors(model, truth["camera_from_object"][k], pose, (mu, truth["parameters"][k])).mean()
            for k, pose, mu in found
        ]
    assert np.median(off) < 3e-3


def test_a_live_camera_is_tracked_from_the_place(studio, placed):
    """The frames after the scan come from a camera, each when the picture of the one before has come; no pairs."""
    client, folder, truth = studio
    client.call("accept_place", despite_ambiguity=True)
    sent = list(range(SCAN, min(SCAN + 12, FRAMES)))
    with LivePage(client.port, "/api/camera", client.own) as camera:
        jpegs = []
        for number in sent:
            image = cv2.imread(str(sorted((folder / "frames").iterdir())[number]))
            jpegs.append(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes())
        camera.send(0, jpegs[0])
        camera.wait_for("seen", 0)
        client.call("go_live")
        while not client.state()["job"]["what"].startswith("tracking"):
            assert client.state()["job"]["running"], client.state()["job"]
            time.sleep(0.1)
        for number, jpeg in enumerate(jpegs):
            camera.send(number, jpeg)
            camera.picture_of(number)
        client.call("stop")
    assert "--map map/map.h5 --registration place/registration.json" in job_of(client)["command"]
    model = load_model(folder / "model.morph")
    with h5py.File(folder / "run/result.h5") as file:
        states = list(
            zip(file["status"].asstr()[()], file["camera_from_object"][()], file["parameters"][()], strict=True)
        )
    off = [
        errors(model, truth["camera_from_object"][k], pose, (mu, truth["parameters"][k])).mean()
        for k, (status, pose, mu) in zip(sent, states, strict=True)
        if status == "tracked"
    ]
    assert len(off) > 0.8 * len(sent)
    assert np.median(off) < 3e-3
    assert client.state()["choices"]["recording"] == "live"
    assert client.call("scan")["source"] == "frames"  # what the map is of
    (folder / "studio.json").write_text(json.dumps(client.state()["choices"] | {"recording": "frames"}))


def test_a_place_that_is_written_anew_is_accepted_anew(studio, placed):
    client, folder, _ = studio
    client.call("accept_place", despite_ambiguity=True)
    path = folder / "place/registration.json"
    before = path.read_text()
    path.write_text(before.replace('"score"', '"score" '))
    assert not client.state()["done"]["start"]
    path.write_text(before)
    assert client.state()["done"]["start"]
    client.call("start_by", way="pairs")
    assert not client.state()["done"]["start"]  # there are none
    client.call("start_by", way="scan")


def test_another_place_becomes_a_hint(studio, placed):
    """The place that was found is written as a rival; its points are those of the object there."""
    client, folder, truth = studio
    path, frame = folder / "place/registration.json", placed["map"]["keyframes"][2]
    content = json.loads(path.read_text())
    rival = {key: content[key] for key in ("world_from_object", "map_units_per_metre")}
    path.write_text(json.dumps(content | {"rivals": [rival | {"score": 0.4 * content["score"]}]}))
    assert client.call("scan")["place"]["rivals"] == [pytest.approx(0.4)]
    drawn, beside = (client.call("place_overlay", frame=frame, **which)["pixels"] for which in ({}, {"rival": 0}))
    np.testing.assert_allclose(drawn, beside, atol=2.0)  # keyframes are adjusted by themselves
    client.call("find_place", frame=frame, rival=0)
    client.call("stop")
    assert job_of(client)["command"].endswith("--landmarks scan_landmarks.csv -o place")
    table = np.loadtxt(folder / "scan_landmarks.csv", delimiter=",", skiprows=1)
    camera, pose = load_camera(folder / "camera.yaml"), truth["camera_from_object"][frame]
    seen = camera.project_recorded(1e-3 * table[:, 1:4] @ pose[:3, :3].T + pose[:3, 3])
    assert set(table[:, 0]) == {frame}
    assert np.linalg.norm(seen - table[:, 4:], axis=1).max() < 3.0
    assert not client.state()["done"]["start"]


def test_what_cannot_be_is_refused(studio):
    client, folder, _ = studio
    assert "ends after frame 0" in client.refused("map_scan", last=0)
    assert "say its number" in client.refused("find_place", region=[1, 2, 3, 4])
    for wrong in ({"distance": -1}, {"region": [1, 2, 3]}, {"frame": -1}, {"rival": -1}):
        assert "asked for wrongly" in client.refused("find_place", **wrong)
    _, data = cv2.imencode(".png", np.zeros((24, 32, 3), np.uint8))
    writer = cv2.VideoWriter(str(folder.parent / "small.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30, (32, 24))
    for _ in range(3):
        writer.write(cv2.imdecode(data, cv2.IMREAD_COLOR))
    writer.release()
    assert client.upload("scan", "small.mp4", (folder.parent / "small.mp4").read_bytes()) == 200
    assert client.call("scan")["source"] == "scan/small.mp4"
    assert "the scan has images of 32 x 24 pixels" in client.refused("map_scan")
    client.call("scan_the_recording")
    assert client.call("scan")["source"] == "frames"
