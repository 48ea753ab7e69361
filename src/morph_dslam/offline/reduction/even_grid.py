"""Recognising samples that are all points of a full, evenly spaced grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Least points along a parameter that cubic splines can interpolate.
LEAST = 4


@dataclass(frozen=True)
class EvenGrid:
    """Where samples lie on a full grid.

    Attributes
    ----------
    counts : points along each parameter. order : (n,) the samples in the grid's order, the last parameter
        running fastest.
    """

    counts: tuple[int, ...]
    order: NDArray[np.int64]

    @staticmethod
    def of(samples: Array, box: Array) -> EvenGrid | None:
        """The grid of samples (n, d) over a box (d, 2); None if there is none or it is too coarse."""
        unit = (samples - box[:, 0]) / np.diff(box, axis=1)[:, 0]
        counts = tuple(len(np.unique(np.round(column, 9))) for column in unit.T)
        if min(counts) < LEAST or int(np.prod([float(n) for n in counts])) != len(samples):
            return None
        steps = np.array(counts) - 1.0
        places = np.rint(unit * steps).astype(np.int64)
        if np.abs(unit * steps - places).max() > 1e-6 or places.min() < 0 or np.any(places > steps):
            return None
        flat = np.asarray(np.ravel_multi_index(tuple(places.T), counts))
        order = np.argsort(flat)
        return EvenGrid(counts, order) if np.array_equal(flat[order], np.arange(len(flat))) else None

    def tensor(self, values: Array) -> Array:
        """Values (n, m) at the samples as a tensor (m, n_1, ..., n_d) over the grid."""
        return np.moveaxis(values[self.order].reshape(*self.counts, -1), -1, 0)
