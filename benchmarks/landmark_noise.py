"""The demo's recording with landmarks that are off by half a pixel, as carefully set ones are.

The demo's own landmarks are exact. Here the same recording is tracked from noisy ones, as they are and with the
reference state refined over the sequence (`morph track --refine`). Run `make demo` first. The last line is the mean
over the seeds.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

import morph_dslam as md
from morph_dslam.extend import run_and_report_errors
from morph_dslam.extend.registration import Landmarks, load_landmarks, save_landmarks

DEMO = Path(__file__).resolve().parents[1] / "demo"
#: Standard deviation of each pixel coordinate of a landmark.
NOISE_PX = 0.5


def error(folder: Path, landmarks: Path, refine: bool) -> float:
    """Mean distance of the material points, mm."""
    sequence = DEMO / "sequence"
    md.track(
        md.TrackOptions(
            frames=sequence / "frames",
            model=DEMO / "sheet.morph",
            camera=sequence / "camera.yaml",
            landmarks=landmarks,
            output=folder,
            refine_reference=refine,
            video=False,
            overwrite=True,
        )
    )
    return float(md.evaluate(folder, sequence / "truth.npz", 0)["mean_mm"])


def run(arguments: argparse.Namespace) -> None:
    if not (DEMO / "sequence").is_dir():
        raise md.MorphError(f"there is no recording in {DEMO}: run `make demo` first")
    exact, found = load_landmarks(DEMO / "sequence" / "landmarks.csv"), []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(arguments.seeds):
            noise = NOISE_PX * np.random.default_rng(seed).standard_normal(exact.pixels.shape)
            path = Path(folder) / "landmarks.csv"
            save_landmarks(path, Landmarks(exact.points, exact.pixels + noise))
            found.append([error(Path(folder) / "run", path, refine) for refine in (False, True)])
            print("seed {}: mean_mm={:.3f} refined_mm={:.3f}".format(seed, *found[-1]), flush=True)
    print("mean_mm={:.3f} refined_mm={:.3f} seeds={}".format(*np.mean(found, axis=0), len(found)))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3, help="how many sets of landmarks (%(default)s)")
    return run_and_report_errors(run, parser.parse_args(), "nothing is kept")


if __name__ == "__main__":
    sys.exit(main())
