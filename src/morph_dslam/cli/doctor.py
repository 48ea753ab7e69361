"""`morph doctor`: what this computer brings, and a self-test from a study to a tracked block."""

from __future__ import annotations

import argparse
import io
import os
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

HELP = "check this computer: versions, cores, cameras, videos, extras, and a self-test"
KEPT = "nothing was written"
PACKAGES = (
    "numpy",
    "scipy",
    "numba",
    "ngsolve",
    "opencv-python-headless",
    "h5py",
    "meshio",
    "trimesh",
    "fast-simplification",
)
#: What an extra of the package brings, by a module of it.
EXTRAS = {
    "studio": ("starlette", "the studio in the browser"),
    "stream": ("websockets", "results by WebSocket"),
    "rerun": ("rerun", "results in the viewer rerun"),
    "ros": ("rosbags", "ROS bags"),
    "pardiso": ("pypardiso", "MKL's linear solver, faster than NGSolve's"),
    "demo": ("skimage", "photographs of the examples' scenes"),
}
#: The self-test's error must be below this, mm; of a block 80 mm long.
LARGEST_ERROR_MM = 0.5
STUDY = {
    "name": "self-test",
    "mesh": {"generator": "block", "size": ["40 mm", "40 mm", "80 mm"], "divisions": [2, 2, 4], "cells": "hex8"},
    "materials": {"rubber": {"law": "neo_hookean", "young": "3 MPa", "poisson": 0.45}},
    "supports": [
        {"kind": "fixed", "on": "z_min"},
        {"kind": "rotation", "on": "z_max", "axis": [0, 1, 0], "angle": "bend"},
    ],
    "parameters": {"bend": {"range": ["-25 deg", "25 deg"]}},
    "solver": {"threads": 1},
    "sampling": {"scheme": "even", "training": 9, "held_out": 4, "refined": 0},
}
SCENE = """
model = "block.morph"
image_format = "png"
frames = 6
camera = { width = 480, height = 360, fx = 430.0, fy = 430.0, cx = 239.5, cy = 179.5 }
[surface]
texture = "print.png"
[[parameters]]
frame = 0
bend = 2.0
[[parameters]]
frame = 5
bend = 16.0
[[pose]]
frame = 0
position_mm = [-10, 45, 200]
rotation_deg = [110, 0, 25]
"""


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("--quick", action="store_true", help="leave out the self-test")


def run(arguments: argparse.Namespace) -> None:
    from morph_dslam.errors import MorphError

    checks: list[Callable[[], Iterator[tuple[str, str]]]] = [_versions, _computer, _videos, _extras]
    failed = []
    for check in checks if arguments.quick else [*checks, _self_test]:
        for name, found in check():
            print(f"{name:24s}{found}", flush=True)
            failed += [name] if found.startswith("FAILED") else []
    if failed:
        raise MorphError(f"failed: {', '.join(failed)}; the lines above say what to do")


def _versions() -> Iterator[tuple[str, str]]:
    from importlib.metadata import PackageNotFoundError, version

    from morph_dslam._version import __version__

    yield "morph-dslam", __version__
    yield "Python", f"{platform.python_version()} on {platform.platform(terse=True)}"
    for package in PACKAGES:
        try:
            yield package, version(package)
        except PackageNotFoundError:
            yield package, "FAILED: not installed; run `pip install .` in the project's folder"


def _computer() -> Iterator[tuple[str, str]]:
    cores = len(os.sched_getaffinity(0))
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    yield "cores, memory", f"{cores}, {memory:.0f} GiB"
    cameras = sorted(path.name for path in Path("/dev").glob("video*"))
    yield "cameras", ", ".join(cameras) or "none found in /dev; recordings do without"


def _videos() -> Iterator[tuple[str, str]]:
    import cv2
    import numpy as np

    with TemporaryDirectory() as folder:
        path = str(Path(folder) / "try.mp4")
        writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (64, 48))
        for level in (50, 200):
            writer.write(np.full((48, 64, 3), level, dtype=np.uint8))
        writer.release()
        read, frame = cv2.VideoCapture(path).read()
    right = read and abs(float(frame.mean()) - 50.0) < 10.0
    yield "MP4 videos", "written and read" if right else "FAILED: install opencv-python-headless from PyPI again"


def _extras() -> Iterator[tuple[str, str]]:
    from morph_dslam.errors import how_to_install

    for extra, (module, brings) in EXTRAS.items():
        missing = f"not installed: {how_to_install(extra)}"
        yield f"extra {extra}", f"{'installed' if find_spec(module) else missing} ({brings})"


def _self_test() -> Iterator[tuple[str, str]]:
    import numpy as np

    begin = time.monotonic()
    with TemporaryDirectory() as folder, redirect_stderr(io.StringIO()):
        errors, milliseconds = _tracked_block(Path(folder))
    seconds, largest = time.monotonic() - begin, max(errors)
    figures = f"a block built, filmed and tracked in {seconds:.0f} s, {np.median(milliseconds):.1f} ms a frame"
    right = largest < LARGEST_ERROR_MM
    yield (
        "self-test",
        f"{figures}, {largest:.3f} mm off at most" if right else f"FAILED: {figures}, {largest:.3f} mm off",
    )


def _tracked_block(folder: Path) -> tuple[list[float], list[float]]:
    """Errors, mm, and times, ms, of the frames of a block that bends."""
    import cv2
    import numpy as np

    import morph_dslam as md

    grey = np.random.default_rng(0).integers(0, 256, (256, 256), dtype=np.uint8)
    cv2.imwrite(str(folder / "print.png"), cv2.GaussianBlur(grey, (0, 0), 2.0, dst=None))
    md.build(md.make_study(STUDY), folder / "block.morph")
    (folder / "scene.toml").write_text(SCENE, encoding="utf-8")
    sequence: Any = md.SimulatedSequence(folder / "scene.toml")
    tracker = md.Tracker(
        sequence.model, sequence.camera, md.register_landmarks(sequence.model, sequence.camera, sequence.landmarks)
    )
    errors, milliseconds = [], []
    for frame, parameters in zip(sequence, sequence.parameters, strict=True):
        result = tracker.track(frame)
        if not result.tracked:
            return [float("inf")], [0.0]
        missed = result.displacement() - sequence.model.displacement.value(parameters)
        errors.append(1e3 * float(np.linalg.norm(missed, axis=1).max()))
        milliseconds.append(result.total_ms)
    return errors, milliseconds
