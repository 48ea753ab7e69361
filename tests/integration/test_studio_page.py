"""The studio in a real browser: from an empty folder to a tracked video by clicks and drops, as by the command line."""

import json
import shutil
import subprocess
import sys
from urllib.parse import urlsplit

import h5py
import numpy as np
import pygltflib
import pytest

from morph_dslam import load_model, load_study, open_source
from tests.support.chromium import Page, find_chromium
from tests.support.studio import Client, running_studio
from tests.support.studio_walk import shoot, walk

pytestmark = [pytest.mark.slow, pytest.mark.skipif(find_chromium() is None, reason="no Chromium on this machine")]


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A project folder that a browser filled, and the folder of the film."""
    folder = tmp_path_factory.mktemp("studio")
    shots = folder / "shots"
    shots.mkdir()
    problems, requests = walk(folder, shots)
    assert problems == []
    hosts = {urlsplit(url).hostname for url in requests if not url.startswith(("blob:", "data:"))}
    assert hosts <= {"127.0.0.1"}
    return folder / "project", folder / "film", shots


def test_a_camera_of_the_computer_is_recorded(tmp_path):
    """The browser's own fake camera, a clock on green ground."""
    fake = ("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream")
    with running_studio(tmp_path / "project") as server, Page(tmp_path / "profile", (1440, 900), fake) as page:
        page.send("Page.navigate", url=server.address)
        page.click("#step-camera")
        page.click("#record")
        page.wait_for("document.querySelector('#record-video')?.currentTime > 1")
        page.click("#record")
        page.wait_for("document.querySelector('#panel').textContent.includes('webcam.webm')")
        page.wait_for("document.querySelector('#view canvas') !== null")
        shoot(page, tmp_path / "recorded.png")
        assert page.problems == []
        facts = Client(server).state()["recording"]
    frames = list(open_source(tmp_path / "project" / "webcam.webm"))
    assert len(frames) == facts["frames"] >= 5
    assert 1.0 < facts["fps"] < 40.0
    image = frames[-1].image
    assert image.shape == (facts["height"], facts["width"], 3)
    green = (image[..., 1] > 1.5 * image[..., [0, 2]].max(axis=2)).mean()
    assert green > 0.2  # the ground of the fake camera's picture


def test_a_phone_records_for_the_computer(tmp_path):
    """Two browsers: one has the studio open, the other a fake camera and the address for phones."""
    fake = ("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream", "--ignore-certificate-errors")
    with (
        running_studio(tmp_path / "project", phone=True) as server,
        Page(tmp_path / "computer", (1440, 900)) as computer,
        Page(tmp_path / "phone", (420, 800), fake) as phone,
    ):
        computer.send("Page.navigate", url=server.address)
        computer.click("#step-camera")
        computer.wait_for("document.querySelector('#phone-address') !== null")
        phone.send("Page.navigate", url=computer.evaluate("document.querySelector('#phone-address').textContent"))
        phone.click("#record")
        phone.wait_for("document.querySelector('#record-video')?.currentTime > 1")
        shoot(phone, tmp_path / "phone.png")
        phone.click("#record")
        phone.wait_for("document.querySelector('#said').textContent.includes('is in the project')")
        computer.wait_for("document.querySelector('#panel').textContent.includes('phone.webm')")
        shoot(computer, tmp_path / "computer.png")
        assert computer.problems == phone.problems == []
        assert Client(server).state()["recording"]["frames"] >= 5


def test_the_study_is_what_was_clicked(project):
    folder, _, _ = project
    study = load_study(folder / "study.toml")
    mesh = study.solid_mesh()
    assert {"foot", "head"} <= set(mesh.surfaces)
    for name, height in (("foot", 0.0), ("head", 0.08)):
        nodes = mesh.nodes[mesh.surface_nodes(name)]
        assert len(nodes) == 16
        assert nodes[:, 2] == pytest.approx(height, abs=1e-12)


def test_the_run_is_that_of_the_command_line(project, tmp_path):
    """The same files give the same numbers, in the parameters and in the poses."""
    folder, film, _ = project
    for name in ("study.toml", "mesh.inp", "landmarks.csv"):
        shutil.copy(folder / name, tmp_path)
    given = ["--model", "model.morph", "--camera", str(film / "camera.yaml"), "--landmarks", "landmarks.csv"]
    given += ["--at-rest", "--reference-frame", "0"]
    for words in (["build", "study.toml", "-o", "model.morph"], ["track", str(film / "frames"), *given, "-o", "run"]):
        subprocess.run([sys.executable, "-m", "morph_dslam", *words], cwd=tmp_path, check=True, capture_output=True)
    model, again = load_model(folder / "model.morph"), load_model(tmp_path / "model.morph")
    np.testing.assert_allclose(model.nodes, again.nodes, rtol=0, atol=0)
    with h5py.File(folder / "run/result.h5") as studio, h5py.File(tmp_path / "run/result.h5") as line:
        for name in ("frame", "parameters", "camera_from_object", "largest_von_mises"):
            np.testing.assert_allclose(studio[name][()], line[name][()], rtol=1e-9, atol=1e-12)


def test_the_clicks_track_the_film(project):
    """Clicks as exact as a screen's pixels: where each node is, across the sight line, and how the part deforms."""
    folder, film, _ = project
    model, truth = load_model(folder / "model.morph"), np.load(film / "truth.npz")
    with h5py.File(folder / "run/result.h5") as file:
        assert (file["status"].asstr()[()] == "tracked").all()
        parameters, poses = file["parameters"][()], file["camera_from_object"][()]
    found, true = (
        np.array([model.positions(mu) @ pose[:3, :3].T + pose[:3, 3] for mu, pose in zip(*state, strict=True)])
        for state in ((parameters, poses), (truth["parameters"], truth["camera_from_object"]))
    )
    assert np.linalg.norm((found - true)[..., :2], axis=-1).mean() < 0.3e-3
    assert np.abs(parameters - truth["parameters"]).mean() < 0.2e-3


def test_the_frame_log_holds_the_run(project):
    folder, _, _ = project
    rows = [json.loads(line) for line in (folder / "track.jsonl").read_text().splitlines()]
    with h5py.File(folder / "run/result.h5") as file:
        assert [row["frame"] for row in rows] == file["frame"][()].tolist()
        assert [row["parameters"]["push"] for row in rows] == pytest.approx(file["parameters"][:, 0].tolist())
        force = np.array([row["forces"]["head"] for row in rows])
        np.testing.assert_allclose(force, file["reactions/head/force"][()], rtol=1e-12)


def test_the_exported_animation_is_the_tracked_film(project):
    """Positions of each state are those of the model in the parameters of the run."""
    folder, _, _ = project
    document = pygltflib.GLTF2().load(folder / "export-gltf/model.glb")
    model = load_model(folder / "model.morph")
    with h5py.File(folder / "run/result.h5") as file:
        parameters = file["parameters"][()]
    states = [document.nodes[number] for number in document.nodes[0].children]
    assert len(states) == len(parameters)
    for state, mu in zip(states, parameters, strict=True):
        (primitive,) = document.meshes[state.mesh].primitives
        bounds = document.accessors[primitive.attributes.POSITION]
        nodes = model.positions(mu)[np.unique(model.triangles)]
        np.testing.assert_allclose(np.add(bounds.min, state.translation), nodes.min(axis=0), atol=1e-7)
        np.testing.assert_allclose(np.add(bounds.max, state.translation), nodes.max(axis=0), atol=1e-7)


def test_steps_that_are_opened_in_haste_do_not_mix(tmp_path):
    with running_studio(tmp_path / "project") as server, Page(tmp_path / "profile", (1440, 900)) as page:
        page.send("Page.navigate", url=server.address)
        page.wait_for("document.querySelector('#step-camera') !== null")
        names = ["study", "camera", "object", "study", "camera"]
        page.evaluate(f"{names}.forEach(name => document.getElementById('step-' + name).click())")
        page.wait_for("document.querySelector('#panel').dataset.ready === 'camera'")
        assert page.evaluate("[...document.querySelectorAll('#panel h2')].map(h => h.textContent)") == ["Camera"]
        assert page.problems == []
