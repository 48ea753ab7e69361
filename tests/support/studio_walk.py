"""A browser's way through all steps of the studio: from an empty folder to a tracked film, by clicks and drops."""

import shutil
import time

import cv2
import numpy as np

from morph_dslam import load_camera, simulate
from tests.support.chromium import Page
from tests.support.studio import running_studio, write_part, write_scene

SIZE = (1440, 900)
#: Points on the part's faces that both the camera and the first view of the mesh see, millimetres.
POINTS = [
    (8, 0, 10), (32, 0, 10), (8, 0, 70), (32, 0, 70), (20, 0, 40), (0, 10, 12), (0, 32, 40), (0, 30, 70),
]  # fmt: skip


def walk(folder, shots):
    """Go through all steps.

    Parameters
    ----------
    folder : gets ``project``, ``film`` and what the browser needs.
    shots : folder that gets a picture of each step.

    Returns
    -------
    What the page complained of, and the addresses that it asked for.
    """
    write_part(folder / "part.inp")
    with running_studio(folder / "project") as server, Page(folder / "profile", SIZE) as page:
        page.send("Page.navigate", url=server.address)
        page.wait_for("document.querySelector('#panel')?.dataset.ready === 'object'")
        describe_object(page, folder / "part.inp", shots)
        describe_study(page, shots)
        build(page, shots)
        shutil.copy(folder / "project" / "model.morph", folder)
        simulate(write_scene(folder), folder / "film", progress=False)
        give_camera(page, folder / "film", shots)
        click_start(page, folder, shots)
        track(page, shots)
        return page.problems, page.requests


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
    page.wait_for("document.querySelectorAll('#supports li').length === 2")
    page.wait_for("document.querySelector('#study-good') !== null")
    page.evaluate("document.querySelector('#panel').scrollTo(0, 0)")
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
    page.click("#at-rest")
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
    time.sleep(1.0)  # the thorough fit, half a second after the last click
    shoot(page, shots / "5_start.png")
    page.click("#save-start")
    page.wait_for("document.querySelector('#save-start').textContent === 'Saved'")


def track(page, shots):
    page.click("#to-track")
    page.click("#track")
    page.wait_for("document.querySelector('#track-image').dataset.frame !== undefined", 200)
    shoot(page, shots / "6_tracking.png")
    page.wait_for("document.querySelector('#to-results') !== null", 200)
    page.wait_for("document.querySelector('#track-image').dataset.frame === '7'")
    page.wait_for("document.querySelector('.bar') !== null")
    time.sleep(0.5)  # the last values are drawn
    shoot(page, shots / "6_track.png")
    page.click("#to-results")
    page.wait_for("document.querySelector('#frame-facts')?.textContent.includes('Force on head')")
    page.evaluate(
        "(s => { s.value = s.max; s.dispatchEvent(new Event('input', {bubbles: true})); })"
        "(document.querySelector('#scrub'))"
    )
    page.wait_for("document.querySelector('#result-image').dataset.frame === '7'")
    page.wait_for("document.querySelector('.bar') !== null")
    page.click("#export-gltf")
    page.wait_for("document.querySelector('a[href=\"/files/export-gltf/model.glb\"]') !== null")
    shoot(page, shots / "7_results.png")
