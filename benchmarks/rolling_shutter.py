"""The demo's sheet, shaken before a camera whose rows are recorded one after the other.

    python benchmarks/rolling_shutter.py [--readout SECONDS]

After half a second of rest the sheet of the demo also moves to and fro by 25 mm once a second, upright and in depth a
little slower, and turns by 4 degrees with it. It is filmed by a global and by a rolling shutter. The latter film is
tracked with the readout time in the camera file and without. Run `make demo` first. The last line has the mean errors
of the material points at the middle row's instant.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import tomllib
from pathlib import Path

import numpy as np

import morph_dslam as md
from morph_dslam.extend import run_and_report_errors

ROOT = Path(__file__).resolve().parents[1]
DEMO, SCENE = ROOT / "demo", ROOT / "examples" / "demo" / "scene.toml"
#: Amplitude, mm; frequencies along the camera's axes, 1/s; turn at the amplitude, degrees.
SHAKE_MM, SHAKE_HZ, TURN_DEG = 25.0, np.array([1.0, 0.8, 0.6]), 4.0
#: The motion grows from nothing in so long, seconds.
RISE_S = 0.5


def poses(scene: dict) -> str:
    """The demo's motion and the shake, as key frames."""
    keys, result = scene["pose"], ""
    turns = [key.get("rotation_deg", [180.0, 0.0, 0.0]) for key in keys]
    for frame in range(scene["frames"]):
        place, turn = (
            np.array([np.interp(frame, [key["frame"] for key in keys], column) for column in zip(*rows, strict=True)])
            for rows in ([key["position_mm"] for key in keys], turns)
        )
        time = frame / scene["fps"]
        shake = min(1.0, (time / RISE_S) ** 2) * np.sin(2.0 * np.pi * SHAKE_HZ * time)
        place, turn = place + SHAKE_MM * shake, turn + np.array([0.0, 0.0, TURN_DEG * shake[0]])
        shown = (", ".join(f"{value:.4f}" for value in values) for values in (place, turn))
        result += "[[pose]]\nframe = {}\nposition_mm = [{}]\nrotation_deg = [{}]\n".format(frame, *shown)
    return result


def filmed(folder: Path, readout_s: float) -> Path:
    """The recording's folder."""
    text = SCENE.read_text()
    head = text[: text.index("[[pose]]")].replace("../../demo", str(DEMO))
    camera = f"[camera]\nreadout_s = {readout_s:g}\n"
    path = folder / f"{readout_s:g}.toml"
    path.write_text(head.replace("[camera]\n", camera) + poses(tomllib.loads(text)))
    md.simulate(path, path.with_suffix(""), progress=False)
    return path.with_suffix("")


def error(film: Path, run: Path, readout_s: float) -> float:
    """Mean distance of the material points, mm, tracked with this readout time."""
    camera, lines = film / "stated.yaml", (film / "camera.yaml").read_text().splitlines()
    kept = [line for line in lines if not line.startswith("readout_s")]
    camera.write_text("\n".join([*kept, f"readout_s: {readout_s:g}", ""]))
    options = md.TrackOptions(
        frames=film / "frames",
        model=DEMO / "sheet.morph",
        camera=camera,
        landmarks=film / "landmarks.csv",
        output=run,
        video=False,
        overwrite=True,
    )
    md.track(options)
    return float(md.evaluate(run, film / "truth.npz", 0)["mean_mm"])


def run(arguments: argparse.Namespace) -> None:
    if not (DEMO / "sheet.morph").is_file():
        raise md.MorphError(f"there is no model in {DEMO}: run `make demo` first")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        at_once, by_rows = filmed(folder, 0.0), filmed(folder, arguments.readout)
        found = {
            "global_mm": error(at_once, folder / "run", 0.0),
            "rolling_mm": error(by_rows, folder / "run", arguments.readout),
            "not_stated_mm": error(by_rows, folder / "run", 0.0),
        }
    print(" ".join(f"{name}={value:.3f}" for name, value in found.items()), f"readout_s={arguments.readout:g}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--readout", type=float, default=0.03, metavar="SECONDS", help="of the film (%(default)s)")
    return run_and_report_errors(run, parser.parse_args(), "nothing is kept")


if __name__ == "__main__":
    sys.exit(main())
