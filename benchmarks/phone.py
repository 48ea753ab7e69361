"""A phone's browser as the camera: how fast its frames are tracked and shown again, and how well.

    python benchmarks/phone.py [--seconds 30]

Two headless Chromium browsers on this computer: one has the studio open, the other is the phone, whose camera is a
file of the demo's recording, played back and forth at 30 frames a second. A scripted user takes a frame that comes,
gives the exact pixels of points in it, and goes live. Rate and latency are the phone's: from its camera's frame until
the picture with the object drawn over it is on its page. Each frame carries its number in a corner, as blocks of black
and white. The error is the mean distance of the model's nodes from where the film was rendered with them, over the
frames that were tracked; the share of tracked frames counts from the first of them on. Both browsers draw without a
graphics card. Run `make demo` first.
"""

from __future__ import annotations

import argparse
import http.client
import json
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.support.chromium import Page, find_chromium
from tests.support.live_film import NO_GPU, fake_camera, number_in, write_film

import morph_dslam as md
from morph_dslam.extend import run_and_report_errors

DEMO = Path(__file__).resolve().parents[1] / "demo"
#: How many points the user gives.
N_POINTS = 13
PICTURES = "document.querySelector('#live-picture').camera.drawn"


class Studio:
    """A studio that lets phones in, in a process of its own; a context manager.

    Attributes
    ----------
    address : of its page.
    phone_address : that a phone opens.
    """

    def __init__(self, folder: Path) -> None:
        command = [sys.executable, "-m", "morph_dslam", "studio", str(folder), "--port", "0", "--phone"]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

    def __enter__(self) -> Studio:
        assert self._process.stdout is not None
        found = [re.search(r"http\S+token=[\w-]+", self._process.stdout.readline()) for _ in range(2)]
        assert None not in found
        self.address, self.phone_address = (one[0] for one in found if one is not None)
        return self

    def __exit__(self, *_: object) -> None:
        self._process.send_signal(signal.SIGINT)
        self._process.communicate()

    def call(self, action: str, **arguments) -> None:
        """Call an action of a step."""
        port, token = re.findall(r":(\d+)/\?token=(.*)", self.address)[0]
        headers = {"Origin": f"http://127.0.0.1:{port}", "Cookie": f"morph_studio_{port}={token}"}
        connection = http.client.HTTPConnection("127.0.0.1", int(port))
        connection.request("POST", f"/api/{action}", json.dumps(arguments), headers)
        answer = connection.getresponse()
        content = answer.read()
        connection.close()
        if answer.status != 200:
            raise md.MorphError(content.decode())


def make_project(folder: Path) -> None:
    """The demo's model and camera, as a project."""
    folder.mkdir()
    shutil.copy(DEMO / "sheet.morph", folder / "model.morph")
    shutil.copy(DEMO / "sequence" / "camera.yaml", folder)


def exact_pairs(model: md.ReducedModel, camera: md.Camera, mu: NDArray, pose: NDArray) -> list[list[float]]:
    """Nodes spread over the model in millimetres, and their pixels (k, 5)."""
    nodes = np.linspace(0, len(model.nodes) - 1, N_POINTS).astype(int)
    seen = camera.project_recorded((model.positions(mu) @ pose[:3, :3].T + pose[:3, 3])[nodes])
    return np.column_stack([1e3 * model.nodes[nodes], seen]).tolist()


def errors_of(project: Path, model: md.ReducedModel, truth: dict[str, NDArray]) -> tuple[NDArray, float]:
    """The mean distance of the nodes in each tracked frame, mm, and the share of frames tracked since the first."""
    distances, tracked = [], []
    with h5py.File(project / "run" / "result.h5") as file:
        rows = zip(file["frame"][()], file["parameters"][()], file["camera_from_object"][()], strict=True)
        for frame, mu, pose in rows:
            is_tracked = bool(np.isfinite(mu).all())
            if tracked or is_tracked:
                tracked.append(is_tracked)
            if not is_tracked:
                continue
            k = number_in(cv2.imread(str(project / "live" / f"{frame:06d}.jpg")))
            found, true = (
                model.positions(m) @ p[:3, :3].T + p[:3, 3]
                for m, p in ((mu, pose), (truth["parameters"][k], truth["camera_from_object"][k]))
            )
            distances.append(1e3 * np.linalg.norm(found - true, axis=1).mean())
    if not distances:
        raise md.MorphError("no frame was tracked")
    return np.array(distances), float(np.mean(tracked))


def go_live(studio: Studio, computer: Page, phone: Page, project: Path, truth: dict[str, NDArray]) -> None:
    """The user's steps, until the first tracked picture is on the phone."""
    computer.send("Page.navigate", url=studio.address)
    computer.click("#step-camera")
    phone.send("Page.navigate", url=studio.phone_address)
    phone.click("#live")
    computer.wait_for("document.querySelector('#live-picture')?.dataset.frame > 5")
    computer.click("#take-frame")
    computer.wait_for("document.querySelector('#panel').dataset.ready === 'start'")
    model, camera = md.load_model(project / "model.morph"), md.load_camera(project / "camera.yaml")
    k = number_in(cv2.imread(str(project / "live" / "000000.jpg")))
    pairs = exact_pairs(model, camera, truth["parameters"][k], truth["camera_from_object"][k])
    studio.call("save_start", pairs=pairs, frame=0, at_rest=False)
    computer.evaluate("location.hash = '#track'")
    computer.send("Page.reload")
    computer.wait_for("document.querySelector('#go-live')?.disabled === false")
    computer.click("#go-live")
    phone.wait_for(f"{PICTURES}.length > 3", 180)


def measured(phone: Page, seconds: float) -> NDArray:
    """When pictures were drawn and their latency (n, 2), milliseconds, over a time."""
    found: dict[float, float] = {}
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(1.0)
        found |= dict(phone.evaluate(PICTURES))
    return np.array(sorted(found.items()))


def run(arguments: argparse.Namespace) -> None:
    if not (DEMO / "sequence").is_dir():
        raise md.MorphError(f"there is no recording in {DEMO}: run `make demo` first")
    if find_chromium() is None:
        raise md.MorphError("there is no Chromium on this machine: install it, `apt-get install chromium` say")
    images = [frame.image for frame in md.open_source(DEMO / "sequence" / "frames")]
    truth = dict(np.load(DEMO / "sequence" / "truth.npz"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        project, film = folder / "project", folder / "film.y4m"
        make_project(project)
        write_film(film, images)
        with (
            Studio(project) as studio,
            Page(folder / "computer", (1440, 900), (NO_GPU,)) as computer,
            Page(folder / "phone", (800, 420), fake_camera(film)) as phone,
        ):
            go_live(studio, computer, phone, project, truth)
            time.sleep(5.0)
            pictures = measured(phone, arguments.seconds)
            if arguments.shots is not None:
                arguments.shots.mkdir(parents=True, exist_ok=True)
                for page, shot in ((computer, "live_computer.png"), (phone, "live_phone.png")):
                    cv2.imwrite(str(arguments.shots / shot), page.screenshot())
            studio.call("stop")
        distances, share = errors_of(project, md.load_model(project / "model.morph"), truth)
    times, latency = pictures.T
    rate = 1e3 * (len(times) - 1) / (times[-1] - times[0])
    print(
        f"fps={rate:.1f} latency_median_ms={np.median(latency):.0f} latency_p95_ms={np.percentile(latency, 95):.0f} "
        f"error_mm={distances.mean():.3f} error_p95_mm={np.percentile(distances, 95):.3f} tracked={100 * share:.1f}% "
        f"frames={len(distances)}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0, help="to measure over (%(default)s)")
    parser.add_argument("--shots", type=Path, metavar="FOLDER", help="keep pictures of both pages there")
    return run_and_report_errors(run, parser.parse_args(), "nothing is kept")


if __name__ == "__main__":
    sys.exit(main())
