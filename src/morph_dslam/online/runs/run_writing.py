"""The run folder of a tracked sequence, recorded or live: all files but the video."""

from __future__ import annotations

import platform
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np

from morph_dslam import __version__
from morph_dslam.io.calibration import load_camera, save_camera
from morph_dslam.model import save_model
from morph_dslam.model.inner_structure import CarriedStructure
from morph_dslam.online.estimation.temporal import temporal_facts
from morph_dslam.online.runs.inner_positions import write_inner_positions
from morph_dslam.online.runs.plots import write_plots
from morph_dslam.online.runs.results import RunResults, write_csv, write_hdf5, write_summary
from morph_dslam.online.start.placement import Placement
from morph_dslam.online.tracker_options import TrackerOptions


@dataclass(frozen=True)
class RunInputs:
    """What a run was made from.

    Attributes
    ----------
    model, camera : files that the run folder gets copies of. named : other inputs by name, for the summary.
    """

    model: Path
    camera: Path
    named: dict[str, str]


def write_run(
    folder: Path,
    run: RunResults,
    inputs: RunInputs,
    placement: Placement,
    inner: Sequence[CarriedStructure],
    tracker: TrackerOptions,
    extra: dict[str, Any],
) -> dict[str, Any]:
    """Write tables, summary, plots and copies of the inputs; returns the summary.

    Parameters
    ----------
    inner : structures inside of the object. tracker : what was tracked with. extra : for the summary.
    """
    write_hdf5(folder / "result.h5", run)
    write_inner_positions(folder / "result.h5", run, inner)
    write_csv(folder / "frames.csv", run)
    if placement.per_sequence:  # the model has the angle that the placement leaves open
        save_model(folder / "model.morph", placement.model)
    else:
        _copy(inputs.model, folder / "model.morph")
    if inputs.camera.is_file():
        _copy(inputs.camera, folder / "camera.yaml")
    else:  # one of several cameras in a file, camchain.yaml#cam0
        save_camera(folder / "camera.yaml", load_camera(inputs.camera))
    given = {"model": str(inputs.model), "camera": str(inputs.camera)} | inputs.named
    common = temporal_facts(run.model.parameters, tracker) | {
        "new_reference_views": {
            "allowed": tracker.new_views,
            "made": sum(result.made_view for result in run.results),
            "frames_compared_with_them": sum(result.view > 0 for result in run.results),
        },
        "registration": placement.facts,
        "flags": list(placement.flags),
        "inputs": given,
        "versions": _versions(),
    }
    summary = write_summary(folder / "summary.json", run, common | extra)
    write_plots(folder / "plots", run)
    return summary


def _copy(source: Path, target: Path) -> None:
    if source.resolve() != target.resolve():
        shutil.copyfile(source, target)


def _versions() -> dict[str, Any]:
    return {
        "morph-dslam": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "numba": numba.__version__,
        "opencv_threads": cv2.getNumThreads(),
    }
