"""What is known of parameters before anything is measured, as from a video."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import IdentificationError

Array = NDArray[np.float64]
#: Nothing is known better than this share of what is known worst, over the standard deviations.
LEAST_SHARE = 1e-12


@dataclass(frozen=True)
class KnownValues:
    """Parameters that are known already.

    Attributes
    ----------
    names : of k parameters.
    values : (k,) SI.
    covariance : (k, k) SI, with variances above zero.

    Raises
    ------
    IdentificationError
        If a variance is not above zero, or a number is not finite.
    """

    names: tuple[str, ...]
    values: Array
    covariance: Array

    def __post_init__(self) -> None:
        for name, value, own, row in zip(
            self.names, self.values, np.diag(self.covariance), self.covariance, strict=True
        ):
            if not (own > 0.0 and np.isfinite(value) and np.isfinite(row).all()):
                raise IdentificationError(
                    f"what is known of '{name}' before, {value:g} with variance {own:g}, needs a finite value and a "
                    "standard deviation above zero"
                )

    @classmethod
    def none(cls) -> KnownValues:
        """Nothing."""
        return cls((), np.zeros(0), np.zeros((0, 0)))

    @classmethod
    def independent(cls, known: Mapping[str, tuple[float, float]]) -> KnownValues:
        """Of values and standard deviations, SI, by name, whose errors have nothing in common."""
        values, deviations = np.array(list(known.values())).reshape(-1, 2).T
        return cls(tuple(known), values, np.diag(deviations**2))

    def of(self, names: Sequence[str]) -> KnownValues:
        """What is known of some of them."""
        rows = [row for row, name in enumerate(self.names) if name in names]
        kept = tuple(self.names[row] for row in rows)
        return KnownValues(kept, self.values[rows], self.covariance[np.ix_(rows, rows)])

    def whitening(self) -> Array:
        """W (k, k) that makes errors independent with deviations of 1: W'W is the inverse of the covariance."""
        std = np.sqrt(np.diag(self.covariance))
        variances, directions = np.linalg.eigh(self.covariance / np.outer(std, std))
        least = LEAST_SHARE * max(variances.max(initial=0.0), np.finfo(float).tiny)
        return (directions / np.sqrt(np.maximum(variances, least))).T / std
