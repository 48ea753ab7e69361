"""What is known of the stretches that would give the model the object's dimensions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: By so much an axis may be longer or shorter than the model, against the others, and nothing is said.
TOLERANCE = 0.02
#: An axis that is off by less is never said to be, however sure that is.
LEAST_OFF = 0.01
#: A stretch of so many deviations widens what is stated; from so many on it is said that there is one. Right
#: models show up to 1.4, with landmarks that are four times as bad as stated up to 3.8.
NOTED, CLEAR = 2.0, 4.0
#: Of so many deviations to either side nothing is excluded.
LIKELY = 2.0


def keeping_the_mean(axes: NDArray[np.bool_]) -> Array:
    """Stretches (3, k) of some of the ``axes`` (3,), orthonormal, that keep their mean length."""
    own = np.eye(3)[:, axes]
    return np.asarray(own @ np.linalg.svd(np.ones((1, own.shape[1])))[2][1:].T, dtype=np.float64)


@dataclass(frozen=True)
class StretchEvidence:
    """Normal equations of stretches, of which nothing is known beforehand but that they are below one.

    Attributes
    ----------
    axes : (3,) of the object along which the points extend; the others have no length to be wrong.
    information : (3, 3), zero for the stretch of all axes. product : (3,) of it and the stretch that explains
        the frames best.
    """

    axes: NDArray[np.bool_]
    information: Array
    product: Array

    @classmethod
    def none(cls, axes: NDArray[np.bool_]) -> StretchEvidence:
        """Nothing is known yet."""
        return cls(axes, np.zeros((3, 3)), np.zeros(3))

    def joined(self, others: Sequence[StretchEvidence]) -> StretchEvidence:
        """With what others tell, whose points may extend along other axes."""
        if not others:
            return self
        axes, information, product = self.axes, self.information, self.product
        for other in others:
            axes = axes | other.axes
            information, product = information + other.information, product + other.product
        return StretchEvidence(axes, information, product)

    @cached_property
    def covariance(self) -> Array:
        """Of the stretches `keeping_the_mean` (k, k)."""
        information = self._stretches.T @ self.information @ self._stretches
        return np.asarray(np.linalg.inv(information + np.eye(len(information))), dtype=np.float64)

    @cached_property
    def estimate(self) -> Array:
        """The model's stretches (k,) against the object."""
        return self.covariance @ (self._stretches.T @ self.product)

    @cached_property
    def by_axis(self) -> Array:
        """By what share each axis (3,) is longer than in the object, against the others; 0 without length."""
        return self._to_others @ self.estimate

    @cached_property
    def deviations(self) -> Array:
        """Standard deviations of `by_axis` (3,)."""
        variances = np.sum((self._to_others @ self.covariance) * self._to_others, axis=1)
        return np.asarray(np.sqrt(variances), dtype=np.float64)

    @property
    def axis(self) -> int:
        """The one that is off most clearly."""
        return int((np.abs(self.by_axis) / np.maximum(self.deviations, 1e-300)).argmax())

    @property
    def off_by(self) -> float:
        """By what share of its length `axis` is longer or shorter, against the others."""
        return float(np.abs(self.by_axis[self.axis]))

    @property
    def sigmas(self) -> float:
        """By how many standard deviations `axis` is off."""
        return self.off_by / max(float(self.deviations[self.axis]), 1e-300)

    @property
    def is_shown(self) -> bool:
        """Whether the frames show that the object has not got the model's dimensions."""
        return self.sigmas > CLEAR and self.off_by > LEAST_OFF

    @property
    def in_words(self) -> str:
        """Which axis is off by how much, and against what."""
        others = [name for k, name in enumerate("xyz") if self.axes[k] and k != self.axis]
        against = others[0] if len(others) == 1 else "the others"
        return f"by about {100.0 * self.off_by:.0f} % along {'xyz'[self.axis]} against {against}"

    @property
    def is_excluded(self) -> bool:
        """Whether the frames exclude that an axis is longer or shorter by `TOLERANCE`."""
        return bool((np.abs(self.by_axis) + LIKELY * self.deviations < TOLERANCE).all())

    @property
    def excess(self) -> Array:
        """Covariance (3, 3) of the axes' stretches, as the frames show them.

        Zero up to `NOTED` deviations. It is as large as what the frames show, less what they would show by
        chance: the usual estimate of a variance from one sample of it. One camera cannot tell which of the
        axes is the wrong one, so all of them together are as likely off as one against the others.
        """
        if self.sigmas <= NOTED:
            return np.zeros((3, 3))
        shown = self._stretches @ self.estimate
        together = self.axes * np.linalg.norm(shown) / np.sqrt(len(self.estimate) * self.axes.sum())
        share = 1.0 - 1.0 / self.sigmas**2
        return share * (np.outer(shown, shown) + np.outer(together, together))

    @cached_property
    def _stretches(self) -> Array:
        return keeping_the_mean(self.axes)

    @cached_property
    def _to_others(self) -> Array:
        """Of a stretch, the part (3, k) of each axis against the mean of the others."""
        k = self._stretches.shape[1]
        return self._stretches * (k + 1.0) / max(k, 1)
