"""The discrepancy in the reference view, from a whole sequence.

Every followed point is bound to the mesh by the pixel in which the reference view shows it. Where the object
departs from the model there, the points are bound beside their places, and no shape of another frame explains
all of them. So the discrepancies of the reference view and of keyframes are sought together (a bundle
adjustment of a surface that hardly stretches): that of the reference moves the points along the surface until
they are in their pixels again. Those of the keyframes are eliminated by Schur complements.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from morph_dslam.model.discrepancy import Discrepancy
from morph_dslam.online.estimation.discrepancy import (
    DiscrepancyFit,
    Quadratic,
    as_displacements,
    weighted_gram,
)
from morph_dslam.online.estimation.estimator import BoundPoints, Estimator, State
from morph_dslam.online.measuring.binding import bind_pixels, view_of
from morph_dslam.online.measuring.outline import Outline
from morph_dslam.online.reference.reference_refinement import Keyframe
from morph_dslam.online.uncertainty.measurement_noise import Measured

Array = NDArray[np.float64]

#: Gauss-Newton steps: after five the displacements change by less than a tenth of a millimetre.
STEPS = 5


@dataclass(frozen=True)
class Reference:
    """The reference view and what is known of it.

    Attributes
    ----------
    state : of the model in it. pixels : (p, 2) of the followed points.
    landmarks, landmark_pixels : (k) points and where they are seen (k, 2), undistorted.
    landmark_px : their standard deviation.
    """

    state: State
    pixels: Array
    landmarks: BoundPoints
    landmark_pixels: Array
    landmark_px: float


def refine_discrepancy(
    fit: DiscrepancyFit,
    estimator: Estimator,
    reference: Reference,
    keyframes: Sequence[Keyframe],
    outline: Outline | None = None,
) -> Discrepancy:
    """The discrepancy in the reference view that explains landmarks and keyframes best.

    Parameters
    ----------
    fit : of the same model. outline : of the object, if the keyframes saw it.
    """
    adjustment = _Adjustment(fit, estimator, reference, keyframes, outline)
    for _ in range(STEPS):
        adjustment.step()
    return Discrepancy(fit.basis, adjustment.values)


@dataclass
class _Frame:
    """A keyframe.

    Attributes
    ----------
    measured : in it. state : of the model. positions : (p, 3) of the points and shape : (s, 3) of the samples
        of the surface in that state, camera frame.
    sliding : (p, 3, 3) how the points move as the reference's discrepancy slides them along the surface.
    influence : (p, m) of the centres on the points. values : (m, 3) the discrepancy.
    """

    measured: Measured
    state: State
    positions: Array
    shape: Array
    sliding: Array
    influence: Array
    values: Array


class _Adjustment:
    def __init__(
        self,
        fit: DiscrepancyFit,
        estimator: Estimator,
        reference: Reference,
        keyframes: Sequence[Keyframe],
        outline: Outline | None,
    ) -> None:
        self._fit, self._reference, self._estimator = fit, reference, estimator
        model, camera = estimator.model, estimator.camera
        surface, self._met = bind_pixels(
            model, camera, view_of(model, camera, reference.state), reference.pixels
        )
        self._points = BoundPoints.from_surface(model, surface)
        self.values = np.zeros((len(fit.basis.centres), 3))
        self._along = self._moves_along_surface()
        self._frames = [self._frame(keyframe, outline) for keyframe in keyframes]

    def _moves_along_surface(self) -> Array:
        """By how much a displacement slides the points (p, 2, 3) along two edges of their triangles.

        They stay in their pixels: P (E b + R u) = 0 for projection P, edges E and displacement u.
        """
        state, camera = self._reference.state, self._estimator.camera
        projection = camera.projection_jacobian(self._points.in_camera(state))
        rotated = projection @ state.camera_from_object.rotation
        return np.asarray(-np.linalg.solve(projection @ self._edges(state), rotated), dtype=np.float64)

    def _edges(self, state: State) -> Array:
        """Two edges (p, 3, 2) of the points' triangles in the camera frame."""
        model = self._estimator.model
        nodes = view_of(model, self._estimator.camera, state).nodes
        corners = nodes[model.triangles[self._points.surface.triangles]]
        return np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)

    def _frame(self, keyframe: Keyframe, outline: Outline | None) -> _Frame:
        points, pixels, weights, normals = keyframe.measured(self._points, self._met, outline)
        state = self._estimator.estimate(points, pixels, weights, keyframe.state, normals).state
        sliding = np.zeros((len(points), 3, 3))
        sliding[: len(self._points)] = self._edges(state) @ self._along
        measured = Measured(points, pixels, weights, normals, np.zeros((0, 0)))
        influence, values = self._fit.basis.influence(points.rest), np.zeros_like(self.values)
        shape = self._fit.shape(state)
        return _Frame(measured, state, points.in_camera(state), shape, sliding, influence, values)

    def step(self) -> None:
        """One Gauss-Newton step of all discrepancies."""
        total, frames = self._of_reference(), []
        for frame in self._frames:
            own, shared, coupling = self._costs(frame)
            solved = cho_solve(cho_factor(own.hessian), np.column_stack([coupling, own.gradient]))
            schur = Quadratic(coupling.T @ solved[:, :-1], coupling.T @ solved[:, -1])
            total = Quadratic(
                total.hessian + shared.hessian - schur.hessian,
                total.gradient + shared.gradient - schur.gradient,
            )
            frames.append(solved)
        step = -cho_solve(cho_factor(total.hessian), total.gradient)
        self.values = self.values + as_displacements(step)
        for frame, solved in zip(self._frames, frames, strict=True):
            frame.values = frame.values - as_displacements(solved[:, -1] + solved[:, :-1] @ step)

    def _of_reference(self) -> Quadratic:
        """What is known of the reference view's discrepancy by itself: the prior and the landmarks."""
        state, known, camera = self._reference.state, self._reference, self._estimator.camera
        rotation = state.camera_from_object.rotation
        influence = self._fit.basis.influence(known.landmarks.rest)
        there = known.landmarks.in_camera(state) + influence @ self.values @ rotation.T
        landmarks = Quadratic.of_residuals(
            camera.projection_jacobian(there) @ rotation,
            camera.project(there) - known.landmark_pixels,
            np.full(len(there), known.landmark_px**-2),
            influence,
        )
        return landmarks + self._fit.prior(self._fit.shape(state), rotation, self.values)

    def _costs(self, frame: _Frame) -> tuple[Quadratic, Quadratic, Array]:
        """A keyframe's cost by its own discrepancy and by the reference's, and the mixed derivatives."""
        rotation, influence = frame.state.camera_from_object.rotation, frame.influence
        slid = np.einsum("pxa,pa->px", frame.sliding, influence @ self.values)
        there = frame.positions + slid + influence @ frame.values @ rotation.T
        derivatives, residuals, weights = self._fit.seen(frame.measured, there)
        own, shared = derivatives @ rotation, derivatives @ frame.sliding
        prior = self._fit.prior(frame.shape, rotation, frame.values)
        coupling = weighted_gram(np.einsum("p,pka,pkb->pab", weights, own, shared), influence)
        by_own, by_shared = (
            Quadratic.of_residuals(rows, residuals, weights, influence) for rows in (own, shared)
        )
        return by_own + prior, by_shared, coupling
