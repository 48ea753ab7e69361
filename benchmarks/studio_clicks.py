"""A scripted user of the studio on the demo: clicks with noise, how long each fit takes, and the error in the end.

The user clicks the demo's landmarks one after the other in the reference frame, each pixel coordinate off by a standard
deviation of 1 px, saves them, and tracks with *snap the start to the
outline* and *refine the start*. Run `make demo` first. Times are those of the
server's answers over HTTP, without the drawing in the browser.
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

import numpy as np

import morph_dslam as md
from morph_dslam.extend import run_and_report_errors
from morph_dslam.extend.registration import load_landmarks

DEMO = Path(__file__).resolve().parents[1] / "demo"


class User:
    """Asks a studio as its page does; a context manager, as long as which the studio runs."""

    def __init__(self, folder: Path) -> None:
        command = [sys.executable, "-m", "morph_dslam", "studio", str(folder), "--port", "0"]
        self._studio = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

    def __enter__(self) -> User:
        assert self._studio.stdout is not None
        found = re.search(r":(\d+)/\?token=([\w-]+)", self._studio.stdout.readline())
        assert found is not None
        self._port, token = int(found[1]), found[2]
        self._headers = {"Origin": f"http://127.0.0.1:{self._port}", "Cookie": f"morph_studio_{self._port}={token}"}
        return self

    def __exit__(self, *_: object) -> None:
        self._studio.send_signal(signal.SIGINT)
        self._studio.communicate()

    def call(self, action: str, **arguments) -> bytes:
        """Call an action of a step."""
        connection = http.client.HTTPConnection("127.0.0.1", self._port)
        connection.request("POST", f"/api/{action}", json.dumps(arguments), self._headers)
        answer = connection.getresponse()
        content = answer.read()
        connection.close()
        if answer.status != 200:
            raise md.MorphError(content.decode())
        return content

    def has_ended(self) -> bool:
        """Whether the run has been written."""
        return json.loads(self.call("tracked_frames"))["summary"] is not None


def click_and_track(project: Path, seed: int, noise_px: float) -> tuple[list[float], float]:
    """Seconds of each fit, and the mean distance of the material points in the end, mm."""
    landmarks = load_landmarks(DEMO / "sequence" / "landmarks.csv")
    noise = noise_px * np.random.default_rng(seed).standard_normal(landmarks.pixels.shape)
    pairs = np.column_stack([1e3 * landmarks.points, landmarks.pixels + noise]).tolist()
    seconds = []
    with User(project) as user:
        for count in range(4, len(pairs) + 1):
            begin = time.perf_counter()
            user.call("fit", pairs=pairs[:count], at_rest=False, quick=True)
            seconds.append(time.perf_counter() - begin)
        user.call("save_start", pairs=pairs, frame=0, at_rest=False)
        user.call("track", refine=True, snap=True)
        while not user.has_ended():
            time.sleep(0.5)
    return seconds[1:], float(md.evaluate(project / "run", DEMO / "sequence" / "truth.npz", 0)["mean_mm"])


def run(arguments: argparse.Namespace) -> None:
    if not (DEMO / "sequence").is_dir():
        raise md.MorphError(f"there is no recording in {DEMO}: run `make demo` first")
    times, errors = [], []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(arguments.seeds):
            project = Path(folder) / f"project{seed}"
            project.mkdir()
            shutil.copy(DEMO / "sheet.morph", project / "model.morph")
            shutil.copy(DEMO / "sequence" / "camera.yaml", project)
            shutil.copytree(DEMO / "sequence" / "frames", project / "frames")
            (project / "studio.json").write_text(json.dumps({"recording": "frames"}))
            seconds, error = click_and_track(project, seed, arguments.noise)
            times += seconds
            errors.append(error)
            print(f"seed {seed}: mean_mm={error:.3f}", flush=True)
    milliseconds = 1e3 * np.array(times)
    print(
        f"noise_px={arguments.noise:g} fit_median_ms={np.median(milliseconds):.1f} "
        f"fit_largest_ms={milliseconds.max():.1f} refined_mm={np.mean(errors):.3f} largest_mm={max(errors):.3f} "
        f"seeds={len(errors)}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3, help="how many sets of clicks (%(default)s)")
    parser.add_argument("--noise", type=float, default=1.0, metavar="PX", help="of a pixel coordinate (%(default)s)")
    return run_and_report_errors(run, parser.parse_args(), "nothing is kept")


if __name__ == "__main__":
    sys.exit(main())
