"""How far what was tracked in the recordings of `rendered_anchored_rig` is from their truth."""

import h5py
import numpy as np

from morph_dslam.evaluation.run_folder import load_run
from morph_dslam.geometry import RigidTransform
from morph_dslam.model import load_model


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
