"""What an outline and depths tell of the reference state's error, which the texture's points of a frame have in common.

The points were bound to the mesh by the reference state. Where that is off by its error factors z, each of variance
one, the points alone have the object off by G z = H_t^-1 J' W M J0 F z (`systematic_errors`). Its outline refers to no
other image and has no part in this. Fitted together as if the texture had no such error, a registration by clicks would
outweigh any outline, and what the outline is then off by would pass for its noise. So z is one more unknown, with what
the registration states of it as a prior: the texture's residuals are J x + J G z, and what the points do not take for
motion of the object stays out of it, because the model's own errors look alike. The pixels of the points are corrected
by J G z, and of the reference's error that is left which neither outline nor registration tells.

The prior is what the registration states, and not more by what frames seem to show: a model that is off would widen it.
The pose that a map gives in a frame has the same z, as it rests on the same registration, and tells nothing of it.
Texture and outline disagree by the model's error, too, where it cannot take the object's shape. That is none that z
makes good: an outline that counts then pulls the points from where they fit. `CorrectionCheck` looks whether it does.

An outline may err as a whole: light from one side moves the edges on that side, and a rounded edge all of them. So it
tells nothing that a shift of all of it, or one outwards, would explain: two more unknowns and a third. Their deviation
is `OutlineBalance.common_px`. A reference state that frames beside an outline have found is off with them, and the
outline of further frames, which they have displaced as much, tells nothing of that part: z = R w + A b, with b the
three, w what else makes z, A the covariance of z and b, and R R' = I - A A'.

Depths tell of z in the same way, and have residuals J_d x + D z: a point that lies elsewhere on the surface has another
depth there, and all depths may be too large by one factor. That is one more error factor; where depths have placed the
reference, too, it is known by how far z has that too far away (`SystematicErrors`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.special
from numpy.typing import NDArray

from morph_dslam.tracking.covariance import symmetric_root
from morph_dslam.tracking.depth import PointDepths
from morph_dslam.tracking.estimator import Estimator
from morph_dslam.tracking.levenberg_marquardt import Minimum
from morph_dslam.tracking.linearization import Linearization, inverse_of_seen
from morph_dslam.tracking.noise import Observations
from morph_dslam.tracking.outline_weight import mean_square
from morph_dslam.tracking.reference_misfit import FLOOR_PX, REFUTED
from morph_dslam.tracking.reprojection import huber_weights

Array = NDArray[np.float64]
#: A correction, which is to first order, may be off by this share of itself.
SECOND_ORDER = 0.1
#: Probability that a Gaussian number is farther off than `REFUTED` deviations.
CHANCE = 2.0 * float(scipy.special.ndtr(-REFUTED))


@dataclass(frozen=True)
class PushedDepths:
    """The depths of the texture's points in a frame, times the roots of Huber's weights, and the error factors in them.

    Attributes
    ----------
    residuals : (p,) pixels, zero of points without depth.
    slopes : (p, d + 6) of these by the unknowns.
    pushes : (p, c) of these by the error factors.
    metres : (p, c) by which each error factor has the measured depths too large.
    """

    residuals: Array
    slopes: Array
    pushes: Array
    metres: Array


@dataclass(frozen=True)
class PushedTexture:
    """The texture's points in a frame, and how they take the reference's error for motion.

    Attributes
    ----------
    frame : the points about the state
    transfer : (d + 6, c), G: how the points alone have the object off by each error factor.
    depths : of the points; None where no depth camera saw them.
    with_outline : (c, 3) covariance of the error factors with what the outline is off by as a whole, each in its
        deviation; None where they have nothing in common.
    """

    frame: Linearization
    transfer: Array
    depths: PushedDepths | None = None
    with_outline: Array | None = None


@dataclass(frozen=True)
class ReferenceCorrection:
    """The reference's error as a frame has it.

    Attributes
    ----------
    found : (c,) of the error factors, in the deviations that were stated of them.
    shift : (p, 2) pixels, by which it moves the texture's points in the frame.
    transfer : (d + 6, c) as of `PushedTexture`.
    left : (c, c), a symmetric root of the covariance that is left of them, the stated one being the identity.
    information_lost : (d + 6, d + 6) of the points' Hessian, what the unknown error of the reference takes from it.
    causes : (c + 3,) of what makes ``found``, in deviations: w and b.
    with_outline : (c, 3) covariance with b of the independent causes of what is left, of which ``left`` is the root.
    nearer : (p,) metres, by which it moves the depths of the texture's points; None where there are none.
    """

    found: Array
    shift: Array
    transfer: Array
    left: Array
    information_lost: Array
    causes: Array
    with_outline: Array
    nearer: Array | None = None

    def of_depths(self, depths: PointDepths) -> PointDepths:
        """Measured depths as they are corrected; those of points beyond the texture's stay."""
        if self.nearer is None:
            return depths
        shift = np.zeros_like(depths.depths)
        shift[: len(self.nearer)] = self.nearer
        return replace(depths, depths=depths.depths - shift)

    @property
    def made_good(self) -> Array:
        """A symmetric root (c, c) of the covariance that the corrections have, I less the one that is left."""
        return symmetric_root(np.eye(len(self.left)) - self.left @ self.left)

    def left_by_cause(self) -> tuple[Array, Array]:
        """What is left of the error factors by what they are, and by the noise of what corrects; P and (P - P^2)^1/2.

        P (c, c) is the covariance that is left. Corrected by (I - P) (z + n), with n of covariance
        P (I - P)^-1, they are off by P z and by what n leaves. Several cameras have z in common but for the scales of
        their depths, and each has an n of its own.
        """
        values, vectors = np.linalg.eigh(self.left @ self.left)
        shares = np.clip(values, 0.0, 1.0)
        of_noise = np.sqrt(shares * (1.0 - shares))
        return (vectors * shares) @ vectors.T, (vectors * of_noise) @ vectors.T


class CorrectionCheck:
    """Whether texture and outline disagree by the reference's error, as the frames of a sequence show it.

    If it is, the points fit beside the outline as well as alone, once they are corrected. The sum of their squares then
    rises by what the state may be off by their noise, chi-squared of as many numbers as there are unknowns, and by what
    the correction lacks of second order. And the error factors are off by no more than was stated of them, chi-squared
    of as many numbers. What is as unlikely as `REFUTED` deviations is another error's: the model's, or clutter's that
    the outline was mistaken for. The registration's error is the same in all frames and clutter passes. So the frames
    vote, and the correction is given up for good as soon as most are against it.

    Attributes
    ----------
    is_refuted : whether something else sets texture and outline apart.
    """

    def __init__(self) -> None:
        self.is_refuted, self._ahead = False, 0

    def learn(
        self,
        alone: Array,
        beside: Array,
        shift: Array,
        weights: Array,
        redundancy: float,
        n_unknowns: int,
        found: Array,
    ) -> bool:
        """Take in a frame; whether the registration may be off by what the frame shows.

        Parameters
        ----------
        alone : (p, 2) residuals of the points by themselves, pixels.
        beside : (p, 2) of the corrected points beside the outline.
        shift : (p, 2) pixels, by which they were corrected.
        weights : (p,) of the points.
        redundancy : how many of the points count as one, because their windows overlap.
        n_unknowns : of the state.
        found : (c,) of the error factors, in the deviations that were stated of them.
        """
        # Where a picture is compared with itself, nearly nothing is left.
        noise = max(mean_square(alone, weights, n_unknowns), FLOOR_PX**2)
        squares = beside**2 - alone**2 - (SECOND_ORDER * shift) ** 2
        rise = float(weights @ np.sum(squares, axis=1)) / (redundancy * noise)
        of_noise, of_stated = (float(scipy.special.chdtri(n, CHANCE)) for n in (n_unknowns, len(found)))
        is_possible = float(found @ found) < of_stated
        self._ahead += 1 if is_possible and rise < of_noise else -1
        self.is_refuted = self.is_refuted or self._ahead < 0
        return is_possible


def reference_correction(
    estimator: Estimator,
    together: Observations,
    found: Minimum,
    texture: PushedTexture,
    squared_px: float,
    before: ReferenceCorrection | None,
    common_px: float,
) -> ReferenceCorrection:
    """The reference's error about the minimum of a frame's cost, to first order.

    Parameters
    ----------
    estimator : whose cost it is.
    together : the texture's points, corrected by what was found before, and then the outline's.
    found : the minimum.
    texture : the points about the minimum.
    squared_px : variance of a number of weight one, times how many points of the texture count as one.
    before : the correction so far; None for the first one.
    common_px : as in `of_whole_outline`.
    """
    count, state = len(texture.frame.usable), found.state
    _, hessian, gradient, residuals = estimator.evaluated(together, state)
    jacobian, outline = estimator.jacobian(together.points, state)[count:], slice(count, None)
    across = np.einsum("pkn,pk->pn", jacobian, together.normals[outline])
    off = np.einsum("pk,pk->p", residuals[outline], together.normals[outline])
    huber = huber_weights(np.abs(off), estimator.options.huber_px)
    weights = np.where(np.isfinite(off), together.weights[outline] * huber, 0.0)
    used = weights > 0.0
    normals = together.normals[outline][used]
    whole = of_whole_outline(across[used], off[used], weights[used], normals, common_px)
    so_far = np.zeros(texture.transfer.shape[1] + 3) if before is None else before.causes
    return corrected(texture, (hessian, gradient), whole, squared_px, estimator.scale, so_far)


def of_whole_outline(
    across: Array, off: Array, weights: Array, normals: Array, common_px: float
) -> tuple[Array, Array, Array]:
    """How the three errors b of a whole outline, each in its deviation, enter the normal equations of its points.

    Parameters
    ----------
    across : (k, n) derivatives of its points' pixels along their normals.
    off : (k,) residuals along these, pixels.
    weights : (k,).
    normals : (k, 2) outwards.
    common_px : standard deviation of what the outline may be off by as a whole outwards, and in each direction, pixels.

    Returns
    -------
    Their part of the Hessian beside the n unknowns (n, 3) and by themselves (3, 3), and of the gradient (3,).
    """
    common = common_px * np.column_stack([np.ones(len(normals)), normals])
    weighted = weights[:, None] * common
    return across.T @ weighted, weighted.T @ common, weighted.T @ off


def corrected(
    texture: PushedTexture,
    others: tuple[Array, Array],
    whole: tuple[Array, Array, Array],
    squared_px: float,
    scale: Array,
    before: Array,
) -> ReferenceCorrection:
    """The reference's error by a frame's normal equations.

    Parameters
    ----------
    texture : the points, whose residuals a correction before has changed already.
    others : Hessian (d + 6, d + 6) and gradient (d + 6,) of all measurements, the points too, and of what else is
        known.
    whole : of the outline among them, as of `of_whole_outline`.
    squared_px : variance of a number of weight one, times how many points of the texture count as one.
    scale : (d + 6,) of the unknowns.
    before : (c + 3,) the causes by which the points were corrected.
    """
    (hessian, gradient), (by_whole, of_whole, push_of_whole), frame = others, whole, texture.frame
    transfer, count = texture.transfer, texture.transfer.shape[1]
    pushed = frame.hessian @ transfer
    by_points, push = transfer.T @ pushed, transfer.T @ frame.products(frame.residuals[:, :, None])[:, 0]
    if (depths := texture.depths) is not None:
        pushed = pushed + depths.slopes.T @ depths.pushes
        by_points, push = by_points + depths.pushes.T @ depths.pushes, push + depths.pushes.T @ depths.residuals
    information_lost = pushed @ np.linalg.solve(squared_px * np.eye(count) + by_points, pushed.T)
    # By the causes w and b, which are independent.
    shared = np.zeros((count, 3)) if texture.with_outline is None else texture.with_outline
    by_cause, undone = np.hstack([symmetric_root(np.eye(count) - shared @ shared.T), shared]), before[count:]
    pushed, push = pushed @ by_cause, by_cause.T @ push
    information = squared_px * np.eye(count + 3) + by_cause.T @ by_points @ by_cause
    pushed[:, count:] += by_whole
    information[count:, count:] += of_whole
    # The outline was not corrected by what was found of b before.
    push[count:] += push_of_whole + of_whole @ undone
    gain = inverse_of_seen(hessian, scale) @ pushed
    information -= pushed.T @ gain
    slope = push + squared_px * before - gain.T @ (gradient + by_whole @ undone)
    causes = before - np.linalg.solve(information, slope)
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    # No measurement makes the registration worse known than it was; rounding may seem to.
    shares = np.clip(squared_px / np.maximum(values, 1e-300), 0.0, 1.0)
    of_causes = (vectors * shares) @ vectors.T
    found, left = by_cause @ causes, symmetric_root(by_cause @ of_causes @ by_cause.T)
    with_outline = np.linalg.pinv(left, hermitian=True) @ by_cause @ of_causes[:, count:]
    shift = np.einsum("pkn,n->pk", frame.jacobian, transfer @ found)
    nearer = None if depths is None else depths.metres @ found
    return ReferenceCorrection(found, shift, transfer, left, information_lost, causes, with_outline, nearer)
