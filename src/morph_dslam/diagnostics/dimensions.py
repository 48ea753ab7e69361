"""What is known of the stretches that would give the model the object's dimensions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from morph_dslam.diagnostics.reference_misfit import FLOOR_PX
from morph_dslam.tracking.covariance import BoundPart
from morph_dslam.tracking.state import BoundPoints, State

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


# What the frames tell of an object that has not got the model's dimensions.
# The reference state takes most of a wrong length up: a sheet that is narrower than its model passes for a
# turned one. Let a stretch s of the undeformed model along its axes move the points' pixels by S0 s in the
# reference view and by S s in a frame. The reference state is then off by e = J0^+ S0 s, the points are bound
# off by what that leaves, S0 s - J0 e, and the frame's residuals are (1 - J H^-1 J' W) (S s - M (S0 s - J0
# e)), with J, W and M as in `systematic_errors`. In the reference view that is zero, so it tells nothing; in
# a frame that looks otherwise the residuals have a known pattern X s. What an error of the reference state
# leaves has one too, C a, with error factors a that stay the same in all frames. Their variance is one where
# the reference is as well known as was stated, and more where the frames show that with s left free: bad
# landmarks are no stretch.
# Both are found together by weighted least squares over the frames, a matched filter; what the frames tell of
# s is the normal equations with a eliminated. Points err alike over wide parts of the object, so that a frame
# counts as `NUMBERS` independent numbers, none better than `FLOOR_PX`; and frames err alike, so that all of
# them together count as no more than `AS_BEST` like the one that tells most.
# A change of size alone stays invisible to one camera, and is left out: the stretches keep the mean length.


#: Axes along which the points extend less than this share of the largest extent have no length to be wrong.
FLAT = 0.01

#: Of the variance of the error factors; a few bring it near its end.
ROUNDS = 4

#: As so many independent numbers the residuals of a frame count; and all frames as so many like the best.
NUMBERS, AS_BEST = 20.0, 4.0


class DimensionCheck:
    """Predicts what stretches leave in frames, and takes in what the frames show.

    Parameters
    ----------
    points : (p) bound in the reference view. parts : its pictures.
    jacobian : (p, 2, d + 6) of their pixels there. scale : (d + 6,) of the unknowns.

    Attributes
    ----------
    stretches : (3, k) of the object's axes, orthonormal, that keep the mean length.
    evidence : what the frames so far tell of stretches.
    """

    def __init__(self, points: BoundPoints, parts: Sequence[BoundPart], jacobian: Array, scale: Array) -> None:
        self._rest = points.rest
        extent = np.ptp(points.rest, axis=0)
        self._axes = extent > FLAT * extent.max()
        self.stretches = keeping_the_mean(self._axes)
        left = []
        for part in parts:
            moved = self._by_stretch(part.state, jacobian)[part.rows]
            rows = jacobian[part.rows].reshape(-1, len(scale)) * scale
            taken = np.linalg.lstsq(rows, moved.reshape(-1, 3), rcond=1e-9)[0]
            left.append(moved - (rows @ taken).reshape(moved.shape))
        self._bound_off = np.concatenate(left)
        self._information, self._product, self._best = np.zeros((0, 0)), np.zeros(0), 0.0
        self.evidence = StretchEvidence.none(self._axes)

    def _by_stretch(self, state: State, jacobian: Array) -> Array:
        """Motion (p, 2, 3) of the pixels by a stretch of each axis."""
        by_axis = jacobian[:, :, -3:].reshape(-1, 3) @ state.camera_from_object.rotation
        return by_axis.reshape(-1, 2, 3) * self._rest[:, None]

    def moved(self, state: State, jacobian: Array, warps: Array) -> Array:
        """By what a stretch of each axis moves the pixels (p, 2, 3) in a frame from where they are bound.

        ``warps`` (p, 2, 2) between the images of the points' triangles there and in the reference view.
        """
        return self._by_stretch(state, jacobian) - warps @ self._bound_off

    def learn(self, residuals: Array, left: Array, weights: Array) -> None:
        """Take in a frame.

        Parameters
        ----------
        residuals : (p, 2) of the points, pixels. weights : (p,) of them, zero for those that do not count.
        left : (p, 2, k + c) what the k stretches and the c error factors would leave in the residuals, when
            the points alone decide on the state.
        """
        k, total = self.stretches.shape[1], 2.0 * float(weights.sum())
        if not k or not total:
            return
        each, rows, shown = np.repeat(weights, 2), left.reshape(-1, left.shape[2]), residuals.ravel()
        weighted = rows * each[:, None]
        share = NUMBERS / total / (float(each @ shown**2) / total + FLOOR_PX**2)
        information, product = share * (weighted.T @ rows), share * (weighted.T @ shown)
        if len(self._information):
            information, product = information + self._information, product + self._product
        self._best = max(self._best, float(np.trace((share * weighted[:, :k]).T @ rows[:, :k])))
        sure = float(np.trace(information[:k, :k]))
        fade = min(AS_BEST * self._best / sure, 1.0) if sure > 0.0 else 1.0
        self._information, self._product = fade * information, fade * product
        self.evidence = self._without_causes(k)

    def _without_causes(self, k: int) -> StretchEvidence:
        """What the normal equations tell of the first ``k`` unknowns, whatever the error_factors are."""
        own, shared, others = self._information[:k, :k], self._information[:k, k:], self._information[k:, k:]
        own_product, product = self._product[:k], self._product[k:]
        from_own = np.linalg.solve(own + np.eye(k), np.column_stack([shared, own_product]))
        larger = _variance(others - shared.T @ from_own[:, :-1], product - shared.T @ from_own[:, -1])
        error_factors = others + np.eye(len(others)) / larger
        taken = shared @ np.linalg.solve(error_factors, np.column_stack([shared.T, product]))
        told, product = own - taken[:, :-1], own_product - taken[:, -1]
        stretches = self.stretches
        return StretchEvidence(self._axes, stretches @ told @ stretches.T, stretches @ product)


def _variance(information: Array, product: Array) -> float:
    """Of error factors that were taken to have unit variance, at least that: frames may show more.

    The fixed point of MacKay (1992), Neural Computation 4, 415: their mean square over those that are told.
    """
    told, vectors = np.linalg.eigh(information)
    told, along, variance = np.maximum(told, 0.0), vectors.T @ product, 1.0
    for _ in range(ROUNDS):
        sum_of_squares = float(np.sum((along / (told + 1.0 / variance)) ** 2))
        n_told = float(np.sum(told / (told + 1.0 / variance)))
        variance = max(sum_of_squares / max(n_told, 1e-3), 1.0)
    return variance
