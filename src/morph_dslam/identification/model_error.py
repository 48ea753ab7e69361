"""What the model's own errors, by its mesh and its reduction, do to what it predicts.

A certificate has which changes of the parameters move the surface as these errors do. They are predicted as errors of
points, and least squares turn them into errors of what is identified: points see a modulus otherwise where a stroke is
known than where it is not. Parameters that are not identified make nothing good. Errors of all states belong together.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel
from morph_dslam.model.model_errors import ModelErrors

Array = NDArray[np.float64]
Vector = Callable[[Mapping[str, float]], Array]
#: Step of a difference, of the parameters' ranges.
STEP = 1e-4


def shape_errors(
    model: ReducedModel, positions: Callable[[Vector], Array], vector: Vector, free: Collection[str]
) -> Array:
    """Errors (e, r, 3) of modelled points, m, independent of each other; as large as likely, of either sign.

    Parameters
    ----------
    model : whose errors they are; without any that are stated, e is 0.
    positions : where the model has the points (r, 3), m, if a function makes its parameters (d,) of the known ones.
    vector : such a function, with what is identified.
    free : names of the parameters that the fit may change; without any all count as such.
    """
    errors = ModelErrors.of(model)
    if errors is None:
        return np.zeros((0, *positions(vector).shape))
    if free:
        errors = errors.holding(np.array([k for k, p in enumerate(model.parameters) if p.name not in free], dtype=int))
    ranges = model.upper - model.lower
    changes: dict[bytes, Array] = {}

    def moved(share: float, k: int) -> Vector:
        def made(known: Mapping[str, float]) -> Array:
            mu = np.clip(vector(known), model.lower + STEP * ranges, model.upper - STEP * ranges)
            key = mu.tobytes()
            if key not in changes:
                changes[key] = symmetric_root(errors.at(mu, followed=False).parameters / np.outer(ranges, ranges))
            return mu + share * ranges * changes[key][:, k]

        return made

    positions(moved(0.0, 0))
    share = STEP / max(float(np.abs(list(changes.values())).max()), np.finfo(float).tiny)
    differences = [positions(moved(share, k)) - positions(moved(-share, k)) for k in range(len(ranges))]
    return np.array(differences) / (2.0 * share)


def symmetric_root(covariance: Array) -> Array:
    """Of a covariance (d, d), the symmetric root (d, d): in neighbouring states its columns are alike."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T, dtype=np.float64)
