"""What an outline tells of the reference state's error, which the texture's points in a frame have in common.

The points were bound to the mesh by the reference state. Where that is off by its error factors z, each of variance
one, the points alone have the object off by G z = H_t^-1 J' W M J0 F z (`systematic_errors`). Its outline refers to no
other image and has no part in this. Fitted together as if the texture had no such error, a registration by clicks would
outweigh any outline, and what the outline is then off by would pass for its noise. So z is one more unknown, with what
the registration states of it as a prior: the texture's residuals are J x + J G z, and what the points do not take for
motion of the object stays out of it, because the model's own errors look alike. The pixels of the points are corrected
by J G z, and of the reference's error that is left which neither outline nor registration tells.

An outline may err as a whole: light from one side moves the edges on that side, and a rounded edge all of them. So it
tells nothing that a shift of all of it, or one outwards, of `COMMON_PX` would explain: two more unknowns and a third.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.tracking.estimator import Estimator
from morph_dslam.tracking.levenberg_marquardt import Minimum
from morph_dslam.tracking.linearization import Linearization, inverse_of_seen
from morph_dslam.tracking.noise import Observations
from morph_dslam.tracking.state import Prior

Array = NDArray[np.float64]
#: Standard deviation of what an outline may be off by as a whole in each direction, and outwards, pixels.
COMMON_PX = 0.1


@dataclass(frozen=True)
class PushedTexture:
    """The texture's points in a frame, and how they take the reference's error for motion.

    Attributes
    ----------
    frame : the points about the state
    transfer : (d + 6, c), G: how the points alone have the object off by each error factor.
    factor : of the error factors' variance, by what frames show, as of `ReferenceMisfit`.
    """

    frame: Linearization
    transfer: Array
    factor: float


@dataclass(frozen=True)
class ReferenceCorrection:
    """The reference's error as a frame has it.

    Attributes
    ----------
    found : (c,) of the error factors, in the deviations that were stated of them.
    shift : (p, 2) pixels, by which it moves the texture's points in the frame.
    transfer : (d + 6, c) as of `PushedTexture`.
    left : (c, c), a symmetric root of the covariance that is left of them, the stated one being the identity.
    untold : (d + 6, d + 6) of the points' Hessian, what they do not tell of the object as the reference is off.
    """

    found: Array
    shift: Array
    transfer: Array
    left: Array
    untold: Array


def reference_correction(
    estimator: Estimator,
    together: Observations,
    found: Minimum,
    prior: Prior | None,
    texture: PushedTexture,
    squared_px: float,
    before: ReferenceCorrection | None,
) -> ReferenceCorrection:
    """The reference's error about the minimum of a frame's cost, to first order.

    Parameters
    ----------
    estimator : whose cost it is.
    together : the texture's points, corrected by what was found before, and then the outline's.
    found : the minimum.
    prior : what is known of the frame's pose.
    texture : the points about the minimum.
    squared_px : variance of a number of weight one, times how many points of the texture count as one.
    before : the correction so far; None for the first one.
    """
    count, state = len(texture.frame.usable), found.state
    _, hessian, gradient, residuals = estimator.evaluate(
        together.points, together.pixels, together.weights, state, together.normals, prior
    )
    jacobian, outline = estimator.jacobian(together.points, state)[count:], slice(count, None)
    across = np.einsum("pkn,pk->pn", jacobian, together.normals[outline])
    off = np.einsum("pk,pk->p", residuals[outline], together.normals[outline])
    huber = np.minimum(1.0, estimator.options.huber_px / np.maximum(np.abs(off), 1e-300))
    weights = np.where(np.isfinite(off), together.weights[outline] * huber, 0.0)
    used = weights > 0.0
    common = of_common_errors(across[used], off[used], weights[used], together.normals[outline][used], squared_px)
    so_far = np.zeros(texture.transfer.shape[1]) if before is None else before.found
    return corrected(texture, (hessian - common[0], gradient - common[1]), squared_px, estimator.scale, so_far)


def of_common_errors(
    across: Array, off: Array, weights: Array, normals: Array, squared_px: float
) -> tuple[Array, Array]:
    """What errors of a whole outline take away from the Hessian (n, n) and the gradient (n,) of its points.

    Parameters
    ----------
    across : (k, n) derivatives of its points' pixels along their normals.
    off : (k,) residuals along these, pixels.
    weights : (k,).
    normals : (k, 2) outwards.
    squared_px : variance of a number of weight one.
    """
    common = np.column_stack([np.ones(len(normals)), normals])
    weighted = weights[:, None] * common
    inverse = np.linalg.inv(weighted.T @ common + squared_px / COMMON_PX**2 * np.eye(3))
    mixed = across.T @ weighted
    return mixed @ inverse @ mixed.T, mixed @ inverse @ (weighted.T @ off)


def corrected(
    texture: PushedTexture, others: tuple[Array, Array], squared_px: float, scale: Array, before: Array
) -> ReferenceCorrection:
    """The reference's error by a frame's normal equations.

    Parameters
    ----------
    texture : the points, whose residuals a correction before has changed already.
    others : Hessian (d + 6, d + 6) and gradient (d + 6,) of all measurements, the points too, and of what else is
        known, without what the outline does not tell.
    squared_px : variance of a number of weight one, times how many points of the texture count as one.
    scale : (d + 6,) of the unknowns.
    before : (c,) the error factors that were corrected.
    """
    (hessian, gradient), frame, transfer = others, texture.frame, texture.transfer
    stated = squared_px / max(texture.factor, 1.0) * np.eye(len(before))
    pushed = frame.hessian @ transfer
    gain, by_points = inverse_of_seen(hessian, scale) @ pushed, stated + transfer.T @ pushed
    information = by_points - pushed.T @ gain
    push = transfer.T @ frame.products(frame.residuals[:, :, None])[:, 0]
    found = before - np.linalg.solve(information, push + stated @ before - gain.T @ gradient)
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    # No measurement makes the registration worse known than it was; rounding may seem to.
    shares = np.clip(stated[0, 0] / np.maximum(values, 1e-300), 0.0, 1.0) if len(values) else values
    left = (vectors * np.sqrt(shares)) @ vectors.T
    untold = pushed @ np.linalg.solve(by_points, pushed.T)
    shift = np.einsum("pkn,n->pk", frame.jacobian, transfer @ found)
    return ReferenceCorrection(found, shift, transfer, left, untold)
