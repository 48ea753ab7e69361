"""Points that were bound in one reference picture, and how the object's state there may be off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.estimation.state import State

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BoundPart:
    """Points that were bound in one reference picture.

    Attributes
    ----------
    rows : of the points. state : of the object in the picture.
    causes : (d + 6, c) how ``state`` is off by c causes, the same for all parts, in their standard
        deviations; None where nothing is known of its error.
    """

    rows: slice
    state: State
    causes: Array | None


def causes_of(covariance: Array | None, scale: Array) -> Array | None:
    """As many causes as unknowns (n, n) for a state of this covariance; None where it is not known.

    ``scale`` (n,) of the unknowns makes them comparable.
    """
    if covariance is None or not np.isfinite(covariance).all():
        return None
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)), dtype=np.float64)
