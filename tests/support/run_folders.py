"""A run folder with a chosen state in every frame, and truth points that follow it exactly."""

from __future__ import annotations

import h5py
import numpy as np

from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.io.camera_files import save_camera
from morph_dslam.model import SurfacePoints, save_model
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA

FRAMES = np.arange(10, 16)


def states(n_frames):
    """Parameters (f, 3) and camera_from_object (f, 4, 4) of a sheet that bends both ways and drifts."""
    phase = np.linspace(0.0, 1.0, n_frames)
    parameters = np.column_stack([0.03 * np.sin(6 * phase), 0.3 * phase, 0.1 * phase])
    poses = [
        RigidTransform(
            rotation_exp(np.array([np.pi - 0.2 * t, 0.1, 0.05 * t])), np.array([0.02 * t, 0.01, 0.62])
        ).matrix
        for t in phase
    ]
    return parameters, np.array(poses)


def write_run(folder, status=None, frames=FRAMES):
    """Write model, camera and result.h5 as `morph track` does; untracked frames have NaN states."""
    folder.mkdir(parents=True, exist_ok=True)
    model = bent_sheet_model(22, 16)
    parameters, poses = states(len(frames))
    status = ["tracked"] * len(frames) if status is None else status
    for row, word in enumerate(status):
        if word != "tracked":
            parameters[row], poses[row] = np.nan, np.nan
    save_model(folder / "model.morph", model)
    save_camera(folder / "camera.yaml", CAMERA)
    with h5py.File(folder / "result.h5", "w") as file:
        file.attrs.update({"format": "morph-dslam run", "version": 1, "reference_frame": int(frames[0])})
        file["frame"], file["timestamp"] = np.asarray(frames), np.arange(len(frames)) / 30.0
        file["camera_from_object"], file["parameters"] = poses, parameters
        file["parameter_std"], file["at_bound"] = np.zeros_like(parameters), np.zeros(parameters.shape, bool)
        file["residual_rms_px"] = np.zeros(len(frames))
        file["n_points"] = file["n_inliers"] = np.full(len(frames), 400)
        file["status"] = np.array(status, dtype=h5py.string_dtype())
        file["reason"] = np.array(
            ["" if word == "tracked" else "too few points" for word in status], dtype=h5py.string_dtype()
        )
        file["timings_ms"] = np.column_stack([np.full(len(frames), 4.0), np.full(len(frames), 9.0)])
        file["timings_ms"].attrs["names"] = ["estimation", "total"]
    return model


def exact_truth(model, n_points=60, frames=FRAMES, seed=1):
    """Truth arrays (frame, points_mm, pixels) of random surface points that move exactly as `states` says."""
    rng = np.random.default_rng(seed)
    points = SurfacePoints(rng.integers(len(model.triangles), size=n_points), rng.dirichlet(np.ones(3), n_points))
    corners = model.triangles[points.triangles]
    parameters, poses = states(len(frames))
    positions = np.array(
        [
            np.einsum("pc,pcx->px", points.weights, model.positions(mu)[corners]) @ pose[:3, :3].T + pose[:3, 3]
            for mu, pose in zip(parameters, poses, strict=True)
        ]
    )
    pixels = np.array([CAMERA.project(frame) for frame in positions])
    return {"frame": np.asarray(frames), "points_mm": 1e3 * positions, "pixels": pixels}
