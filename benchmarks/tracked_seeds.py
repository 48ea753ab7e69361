"""Tracking the boot seal in rendered recordings that differ in everything but the seal, and how honest it is.

    python benchmarks/tracked_seeds.py [--seeds N] [--first N] [--pose map|free]

Scenes are those of registration_seeds.py, filmed on while the lever turns to 51 degrees and back, with an
unknown side. Each has its own scan, registration and tracking, as in examples/boot_seal/track.py. Recordings
and maps are kept in output/tracked_seeds, so that a second run costs registration and tracking only.

A line for each seed says how far all nodes of the solid are off while it is deformed, the lever (mean) and
its side (largest after 60 deformed frames), and below how many stated standard deviations 95 % of their
errors are. In one recording the errors are nearly the same in all frames; the last line is of all together.
"""

from __future__ import annotations

import argparse
import csv
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

import numpy as np
from numpy.typing import NDArray

from morph_dslam import TrackerOptions, TrackOptions, track
from morph_dslam.extend.registration import run_registration
from registration_seeds import MODEL, PATH, mapped, scene_text
from support import keep_sequence

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(MODEL.parents[1]))
import track as seal  # noqa: E402 the example, which compares runs of the seal with their truth

OUTPUT = HERE / "output" / "tracked_seeds"
#: The camera goes on about the seal after the scan.
LONGER = (*PATH, (215, -12.0, 286.0, 200.0), (289, 14.0, 300.0, 240.0))
LEVER = ((160, 0.0), (220, 51.0), (285, 1.0))


def recorded(seed: int) -> Path:
    """The folder of a seed with its recording, rendered once."""
    folder = OUTPUT / f"{seed:02}"
    folder.mkdir(parents=True, exist_ok=True)
    turned = [f"[[parameters]]\nframe = {frame}\nlever = {angle}\n" for frame, angle in LEVER]
    scene, text = folder / "scene.toml", "\n".join([scene_text(seed, LONGER), *turned])
    if not scene.is_file() or scene.read_text() != text:
        scene.write_text(text)
    keep_sequence(scene, MODEL, folder / "recording", progress=False)
    (folder / "recording" / "depth.h5").unlink(missing_ok=True)
    return folder


def normalised(found: seal.Errors, run: Path, deformed: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Errors (f, 2) of the lever and of its side over their stated deviations, in the deformed frames."""
    with (run / "frames.csv").open() as file:
        rows = {int(row["frame"]): row for row in csv.DictReader(file)}
    stated = [[float(rows[n][f"{name}_std_deg"]) for name in ("lever", "turn")] for n in found.frames]
    errors = np.degrees(np.abs(np.column_stack([found.lever, found.side])))
    return (errors / np.array(stated))[deformed]


def tracked(seed: int, pose: str) -> NDArray[np.float64]:
    """Normalised errors (f, 2) of a seed; prints its line."""
    folder = recorded(seed)
    mapped(folder, False, last=seal.FROZEN_AT)
    camera, registration = folder / "recording" / "camera.yaml", folder / "registration"
    registered = run_registration(folder / "scan" / "map.h5", MODEL, camera, registration, overwrite=True)
    summary = track(
        TrackOptions(
            frames=folder / "recording" / "frames",
            model=MODEL,
            camera=camera,
            registration=registration / "registration.json",
            first=registered.frame,
            output=folder / "run",
            tracker=TrackerOptions(pose=pose),  # type: ignore[arg-type]
            video=False,
            overwrite=True,
        )
    )
    found = seal.errors(folder / "run", folder / "recording", MODEL)
    deformed = seal.deformed_frames(found, folder / "recording")
    ratios = normalised(found, folder / "run", deformed)
    lever, side = np.percentile(ratios, 95, axis=0)
    line = seal.result_line(found, summary, folder / "recording")
    print(f"seed {seed}: {line} sigma95_lever={lever:.2f} sigma95_side={side:.2f}", flush=True)
    return ratios


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5, help="how many (%(default)s)")
    parser.add_argument("--first", type=int, default=31, help="the first one (%(default)s)")
    parser.add_argument("--pose", choices=("map", "free"), default="map", help="as of morph track (map)")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    together = np.concatenate([tracked(seed, arguments.pose) for seed in seeds])
    lever, side = np.percentile(together, 95, axis=0)
    print(f"pose={arguments.pose} sigma95_lever={lever:.2f} sigma95_side={side:.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
