"""The studio in a real browser: from an empty folder to a tracked video by clicks and drops, as by the command line."""

import json
import shutil
import subprocess
import sys
from urllib.parse import urlsplit

import cv2
import h5py
import numpy as np
import pytest

from morph_dslam import load_camera, load_model, load_study, open_source, simulate
from tests.support.chromium import Page, find_chromium
from tests.support.studio import Client, running_studio, write_part, write_scene

pytestmark = [pytest.mark.slow, pytest.mark.skipif(find_chromium() is None, reason="no Chromium on this machine")]
#: Points on the part's faces that both the camera and the first view of the mesh see, millimetres.
POINTS = [
    (8, 0, 10), (32, 0, 10), (8, 0, 70), (32, 0, 70), (20, 0, 40), (0, 10, 12), (0, 32, 40), (0, 30, 70),
]  # fmt: skip


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """A project folder that a browser filled, and the folder of the film."""
    folder = tmp_path_factory.mktemp("studio")
    write_part(folder / "part.inp")
    with running_studio(folder / "project") as server, Page(folder / "profile", (1440, 900)) as page:
        page.send("Page.navigate", url=server.address)
        page.wait_for("document.querySelector('#panel')?.dataset.ready === 'object'")
        shots = folder / "shots"
        shots.mkdir()
        describe_object(page, folder / "part.inp", shots)
        describe_study(page, shots)
        build(page, shots)
        shutil.copy(folder / "project" / "model.morph", folder)
        simulate(write_scene(folder), folder / "film", progress=False)
        give_camera(page, folder / "film", shots)
        click_start(page, folder, shots)
        track(page, shots)
        assert page.problems == []
        assert {urlsplit(url).hostname for url in page.requests if not url.startswith(("blob:", "data:"))} <= {
            "127.0.0.1"
        }
    return folder / "project", folder / "film", shots


def shoot(page, path):
    cv2.imwrite(str(path), page.screenshot())


def describe_object(page, part, shots):
    shoot(page, shots / "0_empty.png")
    page.drop("#drop-object", part)
    page.wait_for("document.querySelector('#object-view')?.view !== undefined")
    for name, point in (("foot", (20, 20, 0)), ("head", (20, 20, 80))):
        if name == "foot":  # the lower face is turned into sight
            x, y = page.middle_of("#object-view")
            page.drag((x, y), (x, y - 330))
        x, y = page.evaluate(f"document.querySelector('#object-view').view.onPage({[1e-3 * c for c in point]})")
        page.click_at(x, y)
        page.wait_for("document.querySelector('#picked').textContent === '9 faces picked'")
        page.enter("#set-name", name)
        shoot(page, shots / f"1_object_{name}.png")
        page.click("#name-set")
        page.wait_for(f"document.querySelector('#sets').textContent.includes('{name}')")
        if name == "foot":
            x, y = page.middle_of("#object-view")
            page.drag((x, y), (x, y + 330))
    shoot(page, shots / "1_object.png")


def describe_study(page, shots):
    page.click("#to-study")
    page.choose("#material", "own")
    page.enter("#material-name", "rubber")
    page.enter("#constant-young", "3 MPa")
    page.enter("#constant-poisson", "0.45")
    page.click("#add-material")
    page.wait_for("document.querySelector('#materials li') !== null")
    page.click("#add-parameters")
    page.enter("#parameter-name", "push")
    page.enter("#parameter-low", "-4 mm")
    page.enter("#parameter-high", "12 mm")
    page.click("#save-parameters")
    page.wait_for("document.querySelector('#parameters li') !== null")
    page.click("#add-supports")
    page.choose("#supports-on", "foot")
    page.click("#save-supports")
    page.wait_for("document.querySelectorAll('#supports li').length === 1")
    page.click("#add-supports")
    page.choose("#supports-kind", "displacement")
    page.choose("#supports-on", "head")
    page.enter("#supports-x", "push")
    page.enter("#supports-y", "0")
    page.enter("#supports-z", "0")
    shoot(page, shots / "2_study_form.png")
    page.click("#save-supports")
    page.wait_for("document.querySelector('#study-good') !== null")
    shoot(page, shots / "2_study.png")


def build(page, shots):
    page.click("#to-build")
    page.enter("#training", "8")
    page.enter("#held-out", "4")
    page.click("#build")
    page.wait_for("document.querySelector('#job-words')?.textContent.includes(' of ')")
    shoot(page, shots / "3_building.png")
    page.wait_for("document.querySelector('#model-page') !== null", 200)
    page.wait_for("document.querySelector('#model-page').contentDocument?.getElementById('largest')?.value")
    shoot(page, shots / "3_build.png")


def give_camera(page, film, shots):
    page.click("#to-camera")
    page.drop("#drop-recording", *sorted((film / "frames").iterdir()))
    page.wait_for("document.querySelector('#panel').textContent.includes('480 × 360')")
    page.drop("#drop-camera", film / "camera.yaml")
    page.wait_for("document.querySelector('#step-camera').className === 'done'")
    shoot(page, shots / "4_camera.png")


def click_start(page, folder, shots):
    """Click each point on the mesh, and its pixel by the truth, as near as the screen's pixels allow."""
    page.click("#to-start")
    page.wait_for("document.querySelector('#panel').dataset.ready === 'start'")
    camera, truth = load_camera(folder / "film" / "camera.yaml"), np.load(folder / "film" / "truth.npz")
    pose = truth["camera_from_object"][0]
    for count, point in enumerate(POINTS, start=1):
        pixel = camera.project((1e-3 * np.array([point])) @ pose[:3, :3].T + pose[:3, 3])[0]
        x, y = page.evaluate(f"document.querySelector('#start-mesh').view.onPage({[1e-3 * c for c in point]})")
        page.click_at(round(x), round(y))
        page.wait_for("document.querySelector('#fit').textContent.includes('in the image')")
        x, y = page.evaluate(f"document.querySelector('#start-image').view.onPage({pixel.tolist()})")
        page.click_at(round(x), round(y))
        page.wait_for(f"document.querySelector('#fit').dataset.pairs === '{count}'")
    shoot(page, shots / "5_start.png")
    page.click("#save-start")
    page.wait_for("document.querySelector('#save-start').textContent === 'Saved'")


def track(page, shots):
    page.click("#to-track")
    page.click("#track")
    page.wait_for("document.querySelector('#track-image').dataset.frame !== undefined", 200)
    shoot(page, shots / "6_tracking.png")
    page.wait_for("document.querySelector('#to-results') !== null", 200)
    shoot(page, shots / "6_track.png")
    page.click("#to-results")
    page.wait_for("document.querySelector('#frame-facts')?.textContent.includes('Force on head')")
    page.evaluate(
        "(s => { s.value = s.max; s.dispatchEvent(new Event('input', {bubbles: true})); })"
        "(document.querySelector('#scrub'))"
    )
    page.wait_for("document.querySelector('#result-image').dataset.frame === '7'")
    page.wait_for("document.querySelector('.bar') !== null")
    shoot(page, shots / "7_results.png")


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
    assert sorted(mesh.surfaces) == ["foot", "head"]
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
        subprocess.run([sys.executable, "-m", "morph_dslam.cli", *words], cwd=tmp_path, check=True, capture_output=True)
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


def test_steps_that_are_opened_in_haste_do_not_mix(tmp_path):
    with running_studio(tmp_path / "project") as server, Page(tmp_path / "profile", (1440, 900)) as page:
        page.send("Page.navigate", url=server.address)
        page.wait_for("document.querySelector('#step-camera') !== null")
        names = ["study", "camera", "object", "study", "camera"]
        page.evaluate(f"{names}.forEach(name => document.getElementById('step-' + name).click())")
        page.wait_for("document.querySelector('#panel').dataset.ready === 'camera'")
        assert page.evaluate("[...document.querySelectorAll('#panel h2')].map(h => h.textContent)") == ["Camera"]
        assert page.problems == []
