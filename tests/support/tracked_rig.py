"""Objects placed as a run places them, and how far what was tracked is from the truth of `rendered_anchored_rig`."""

from contextlib import ExitStack
from pathlib import Path

import h5py
import numpy as np

import morph_dslam as md
from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.geometry import RigidTransform
from morph_dslam.model import load_model
from morph_dslam.tracking.track import prepare


def placed_objects(**options):
    """The objects of a run in their reference frames; nothing is written."""
    with ExitStack() as stack:
        return prepare(md.TrackOptions(output=Path("run"), **options), stack)[2]


def exact_nodes(folder, truth, name, frame):
    model, of_object = load_model(folder / f"{name}.morph"), truth[name]
    pose = RigidTransform.from_matrix(of_object["camera_from_object"][frame])
    return pose.apply(model.positions(of_object["parameters"][frame]))


def errors(folder, truth, name, run_folder):
    """Mean distance of all nodes from the truth in each frame, metres."""
    run = load_run(run_folder)
    assert set(run.status) == {"tracked"}
    return np.array(
        [
            np.linalg.norm(run.camera_points(row) - exact_nodes(folder, truth, name, frame), axis=1).mean()
            for row, frame in enumerate(run.frames)
        ]
    )


def column(run_folder, name):
    with h5py.File(run_folder / "result.h5") as file:
        values = file[name]
        return values.asstr()[()] if values.dtype.kind == "O" else values[:]
