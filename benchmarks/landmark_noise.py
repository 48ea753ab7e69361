"""The demo's recording with landmarks that are off by half a pixel or more, as set ones are.

The demo's own landmarks are exact. Here the same recording is tracked from noisy ones: as they are, with the reference
state refined over the sequence (`morph track --refine`), and corrected by the outline in their frame (`--snap`). Run
`make demo` first. The last line is the mean over the seeds.
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
#: What is done to the landmarks, by the name of its figure.
WAYS: dict[str, dict[str, bool]] = {
    "mean_mm": {},
    "refined_mm": {"refine_reference": True},
    "snapped_mm": {"snap": True},
}


def error(folder: Path, landmarks: Path, way: dict[str, bool]) -> float:
    """Mean distance of the material points, mm."""
    sequence = DEMO / "sequence"
    md.track(
        md.TrackOptions(
            frames=sequence / "frames",
            model=DEMO / "sheet.morph",
            camera=sequence / "camera.yaml",
            landmarks=landmarks,
            output=folder,
            video=False,
            overwrite=True,
            **way,
        )
    )
    return float(md.evaluate(folder, sequence / "truth.npz", 0)["mean_mm"])


def run(arguments: argparse.Namespace) -> None:
    if not (DEMO / "sequence").is_dir():
        raise md.MorphError(f"there is no recording in {DEMO}: run `make demo` first")
    exact, found = load_landmarks(DEMO / "sequence" / "landmarks.csv"), []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(arguments.seeds):
            noise = arguments.noise * np.random.default_rng(seed).standard_normal(exact.pixels.shape)
            path = Path(folder) / "landmarks.csv"
            save_landmarks(path, Landmarks(exact.points, exact.pixels + noise))
            found.append([error(Path(folder) / "run", path, way) for way in WAYS.values()])
            print(f"seed {seed}: {line(found[-1])}", flush=True)
    print(f"{line(np.mean(found, axis=0).tolist())} noise_px={arguments.noise:g} seeds={len(found)}")


def line(figures: list[float]) -> str:
    """The figures of all ways."""
    return " ".join(f"{name}={figure:.3f}" for name, figure in zip(WAYS, figures, strict=True))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3, help="how many sets of landmarks (%(default)s)")
    parser.add_argument("--noise", type=float, default=0.5, metavar="PX", help="of a pixel coordinate (%(default)s)")
    return run_and_report_errors(run, parser.parse_args(), "nothing is kept")


if __name__ == "__main__":
    sys.exit(main())
