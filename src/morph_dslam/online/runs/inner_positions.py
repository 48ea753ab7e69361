"""Where inner structures are in every frame of a run, and how well that is known."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.discrepancy import Discrepancy
from morph_dslam.model.inner_structure import CarriedStructure
from morph_dslam.online.estimation.estimator import Estimate
from morph_dslam.online.runs.results import RunResults

Array = NDArray[np.float64]


def centre_and_std(
    structure: CarriedStructure, estimate: Estimate, discrepancy: Discrepancy | None = None
) -> tuple[Array, Array]:
    """Centre of a structure (3,) in the camera frame and its standard deviations (3,), metres.

    With c = R p(mu) + t and the pose's increment on the left, the derivatives by parameters, rotation vector
    and translation are R dp/dmu, -[R p]x and 1; the covariance is carried through them to first order. It
    is that of the images' noise: it holds neither the model's error nor that of the registration. The centre
    is moved by ``discrepancy`` too.
    """
    state = estimate.state
    centre, sensitivities = structure.centre_and_sensitivities(state.parameters)
    if discrepancy is not None:
        centre = centre + discrepancy.displacement(structure.rest).mean(axis=0)
    rotation = state.camera_from_object.rotation
    arm = rotation @ centre
    turning = np.array([[0.0, arm[2], -arm[1]], [-arm[2], 0.0, arm[0]], [arm[1], -arm[0], 0.0]])
    jacobian = np.hstack([rotation @ sensitivities.T, turning, np.eye(3)])
    if not np.isfinite(estimate.covariance).all():
        return arm + state.camera_from_object.translation, np.full(3, np.inf)
    variance = np.einsum("xi,ij,xj->x", jacobian, estimate.covariance, jacobian)
    return arm + state.camera_from_object.translation, np.sqrt(np.maximum(variance, 0.0))


def write_inner_positions(path: Path, run: RunResults, structures: Sequence[CarriedStructure]) -> None:
    """Add ``inner/NAME/centre`` and ``centre_std`` (f, 3), metres, NaN where lost, to ``result.h5``."""
    lost = (np.full(3, np.nan), np.full(3, np.nan))
    with h5py.File(path, "a") as file:
        for structure in structures:
            rows = [
                lost
                if result.estimate is None
                else centre_and_std(structure, result.estimate, result.discrepancy)
                for result in run.results
            ]
            group = file.create_group(f"inner/{structure.name}")
            group["centre"], group["centre_std"] = (np.array(column) for column in zip(*rows, strict=True))
