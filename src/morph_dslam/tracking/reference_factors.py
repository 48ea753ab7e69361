"""Errors of the reference state as independent factors, and how they move points and depths in another frame.

The points were bound to the mesh in the reference view, so an error of the object's state there moves them on the
surface. Let a pixel of the reference view move by J0 e where its state is off by e; the material point under a fixed
pixel then moves so that its pixel moves by -J0 e, in another view by -M J0 e, with M the map between the images of the
point's triangle. The depth of a point that moves on its triangle changes by the edges', and enters alike.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.tracking.covariance import BoundPart
from morph_dslam.tracking.depth import PointDepths, weighted_depths
from morph_dslam.tracking.depth_scale import CommonDepthScale
from morph_dslam.tracking.estimator import BoundPoints, Estimator, State
from morph_dslam.tracking.reference_correction import PushedDepths
from morph_dslam.tracking.reprojection import huber_weights, project_with_jacobian

Array = NDArray[np.float64]
#: A triangle seen so much flatter in the reference view than in another says nothing of the motion there.
LARGEST_STRETCH = 5.0
#: Error factors smaller than this share of the largest, in units of the unknowns, say nothing of the depths' scale.
LEAST_FACTOR = 1e-9


def error_factors_of(covariance: Array | None, scale: Array) -> Array | None:
    """As many error factors as unknowns (n, n) for a state of this covariance; None where it is not known.

    Parameters
    ----------
    covariance : (n, n) of the state.
    scale : (n,) of the unknowns, which makes them comparable.
    """
    if covariance is None or not np.isfinite(covariance).all():
        return None
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)), dtype=np.float64)


class ReferenceFactors:
    """Independent errors of the reference state, each in its deviation; the depths' scale may be one more.

    Parameters
    ----------
    estimator : of the model and the camera
    points : (p) the texture's points
    parts : the reference images that they were bound in
    scale : of the depths, if a depth camera sees the points.
    with_outline : (d + 6, 3) covariance of the reference state's error with what outlines are off by as a whole, each
        in its deviation, where frames beside an outline have found that state; None where they have not.

    Attributes
    ----------
    of_state : (d + 6, c) that they move the first part's state by; None where that is not known.
    moved : (p, 2, c) pixels, by which they move the points in the images of these; None where nothing is known.
    n_of_state : how many of the c are errors of the state.
    shares : (c,) by which each has all depths too large.
    with_outline : (c, 3) covariance with what the outline is off by, which is of variance one.
    """

    def __init__(
        self,
        estimator: Estimator,
        points: BoundPoints,
        parts: Sequence[BoundPart],
        scale: CommonDepthScale,
        with_outline: Array | None,
    ) -> None:
        self._estimator, self._points = estimator, points
        self._corners = points.corners(estimator.model)
        pixels = [estimator.camera.project(self._corners.in_camera(part.state)).reshape(-1, 3, 2) for part in parts]
        corners = np.concatenate([found[part.rows] for found, part in zip(pixels, parts, strict=True)])
        edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)  # as columns
        size = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            adjugate = np.stack([edges[:, 1, 1], -edges[:, 0, 1], -edges[:, 1, 0], edges[:, 0, 0]], axis=1)
            self._inverse_edges = (adjugate / size[:, None]).reshape(-1, 2, 2)
        self.moved, self.of_state = self._by_error_factors(parts), parts[0].error_factors
        self.shares = np.zeros(0 if self.moved is None else self.moved.shape[2])
        self.n_of_state = len(self.shares)
        self._take_scale(scale, parts)
        self.with_outline = self._shares_of_outline(with_outline)

    def _by_error_factors(self, parts: Sequence[BoundPart]) -> Array | None:
        """By what each error factor moves the points' pixels (p, 2, c) in their images; None if not known."""
        moved = []
        for part in parts:
            if part.error_factors is None:
                return None
            in_state = self._points.in_state(part.state)
            derivatives = project_with_jacobian(*in_state, self._estimator.camera.intrinsics)[1]
            moved.append(derivatives[part.rows] @ part.error_factors)
        return np.concatenate(moved)

    def _take_scale(self, scale: CommonDepthScale, parts: Sequence[BoundPart]) -> None:
        """Find by what share each error factor has all depths too large; their scale may be one more factor.

        A reference state that was found by depths is as much too far away as these are too large: what its error
        factors move the surface by along the pixels' sight lines, on average, is the scale's doing. Of a state that
        frames with such depths have found it is known how far its error is the scale's.
        """
        if not scale.std:
            return
        std = scale.std
        if scale.with_state is not None and self.of_state is not None:
            self.shares = self._shares_of_state(scale)
            std = float(np.sqrt(max(std**2 - float(self.shares @ self.shares), 0.0)))
        elif scale.in_reference and self.moved is not None:
            farther = np.concatenate([self._farther(part) for part in parts])
            mean = np.mean(farther[np.isfinite(farther).all(axis=1)], axis=0)
            self.shares = scale.std * mean / max(float(np.linalg.norm(mean)), 1e-300)
            return
        p = len(self._points)
        moved = np.zeros((p, 2, 0)) if self.moved is None else self.moved
        self.moved = np.concatenate([moved, np.zeros((p, 2, 1))], axis=2)
        self.shares = np.append(self.shares, std)
        if self.of_state is not None:
            self.of_state = np.column_stack([self.of_state, np.zeros(len(self.of_state))])

    def _shares_of_state(self, scale: CommonDepthScale) -> Array:
        """By what share each of the reference state's error factors (c,) has all depths too large.

        It is no more than the scale's deviation.
        """
        assert scale.with_state is not None
        found = self._by_factor(scale.with_state)
        return found * min(1.0, scale.std / max(float(np.linalg.norm(found)), 1e-300))

    def _shares_of_outline(self, with_outline: Array | None) -> Array:
        """Covariance (c, 3) of the error factors with what the outline is off by, which is of variance one."""
        if with_outline is None or self.of_state is None:
            return np.zeros((len(self.shares), 3))
        left, sizes, right = np.linalg.svd(self._by_factor(with_outline), full_matrices=False)
        return np.asarray((left * np.minimum(sizes, 1.0)) @ right)

    def _by_factor(self, covariance: Array) -> Array:
        """Covariance (c, ...) of each of the reference state's error factors with what the state's error has that of.

        With the factors F of the state it is the a with F a = ``covariance`` (d + 6, ...).
        """
        assert self.of_state is not None
        inverse = np.linalg.pinv(self.of_state / self._estimator.scale[:, None], rcond=LEAST_FACTOR)
        return np.asarray((inverse / self._estimator.scale) @ covariance, dtype=np.float64)

    def _farther(self, part: BoundPart) -> Array:
        """By what share each error factor has the surface at the pixels of a part's points farther away (p, c)."""
        assert self.moved is not None
        assert part.error_factors is not None
        count = len(self._points)
        ahead = weighted_depths(*self._points.in_state(part.state), np.zeros(count), np.ones(count))[1]
        along = np.einsum("pb,pbc->pc", self._per_pixel(part.state), self.moved)
        depths = self._points.in_camera(part.state)[:, 2]
        return np.asarray(((ahead @ part.error_factors - along) / depths[:, None])[part.rows])

    def _per_pixel(self, state: State) -> Array:
        """How much farther away the points' triangles are in a state, for each pixel of the reference view (p, 2)."""
        corners = self._corners.in_camera(state)[:, 2].reshape(-1, 3)
        return np.asarray(np.einsum("pa,pab->pb", corners[:, 1:] - corners[:, :1], self._inverse_edges))

    def pushed_depths(self, state: State, depths: PointDepths, moved: Array) -> PushedDepths:
        """How the error factors enter depths: by those of other places on the surface, and by the depths' scale.

        Parameters
        ----------
        state : of the frame, to linearise about.
        depths : (p,) of the points.
        moved : (p, 2, c) pixels, by which the points move there; zero of those that do not tell.
        """
        assert self.moved is not None
        by_pixel = self._per_pixel(state)
        tells = np.any(moved, axis=(1, 2), keepdims=True)[:, 0] & np.isfinite(by_pixel)
        metres = np.einsum("pb,pbc->pc", np.where(tells, by_pixel, 0.0), self.moved)
        metres += np.outer(depths.depths, self.shares)
        residuals, slopes = depths.linearised(self._points, state)
        roots = np.sqrt(huber_weights(np.abs(residuals), depths.huber_px))
        pushes = (roots * depths.weights)[:, None] * metres
        return PushedDepths(roots * residuals, roots[:, None] * slopes, pushes, metres)

    def in_view(self, state: State) -> Array:
        """How the factors move the points' pixels (p, 2, c) in the view of a state."""
        assert self.moved is not None
        return self._warped(state, self.moved)

    def warped(self, state: State, moved: Array) -> Array:
        """How pixels move (p, 2) in the view of a state where they move by ``moved`` (p, 2) in the reference view."""
        return self._warped(state, np.ascontiguousarray(moved[:, :, None]))[:, :, 0]

    def _warped(self, state: State, moved: Array) -> Array:
        pixels = self._estimator.camera.project(self._corners.in_camera(state))
        return _warped_motions(pixels, self._inverse_edges, moved)

    def by_deformation(self, state: State) -> Array:
        """By how much the factors change what the deformation moves the points' pixels by (p, 2, c)."""
        assert self.moved is not None
        at_rest = self._estimator.camera.project(state.camera_from_object.apply(self._corners.rest))
        return _warped_motions(at_rest, self._inverse_edges, self.moved) - self.in_view(state)


@njit(cache=True, nogil=True)
def _warped_motions(pixels, inverse_edges, moved):
    """Motions (p, 2, c) of pixels, by the warp E E0^-1 of the edges of each one's triangle; zero where that is large.

    Parameters
    ----------
    pixels : (3 p, 2) of the triangles' corners.
    inverse_edges : (p, 2, 2) E0^-1, of two edges as columns in the reference view.
    moved : (p, 2, c) motions there.
    """
    found, warp = np.zeros_like(moved), np.empty((2, 2))
    for j in range(len(moved)):
        for row in range(2):
            first = pixels[3 * j + 1, row] - pixels[3 * j, row]
            second = pixels[3 * j + 2, row] - pixels[3 * j, row]
            for column in range(2):
                warp[row, column] = first * inverse_edges[j, 0, column] + second * inverse_edges[j, 1, column]
        if np.isfinite(np.sum(warp)) and np.abs(warp).max() < LARGEST_STRETCH:
            for row in range(2):
                for k in range(moved.shape[2]):
                    found[j, row, k] = warp[row, 0] * moved[j, 0, k] + warp[row, 1] * moved[j, 1, k]
    return found
