"""Whether landmarks would fit an object if its mesh had been read in another unit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model import ReducedModel
from morph_dslam.tracking.binding import nearest_surface_points
from morph_dslam.tracking.estimator import BoundPoints, Estimate, EstimationOptions, Estimator, State

Array = NDArray[np.float64]

#: Units that meshes come in, metres.
UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 1e-3, "inches": 0.0254}

#: Landmarks in another unit must be spread over this share of the object: on a point they lie anywhere.
LEAST_SPREAD = 0.2

#: On a sheet landmarks lie in any smaller unit: those spread over less than the first share of it, which
#: would be spread over more than the second in another one, are flagged.
PART_OF_IT, MOST_OF_IT = 0.5, 0.6


def unit_hint(model: ReducedModel, points: Array, surface_share: float, least: float = LEAST_SPREAD) -> str:
    """What to say where the landmarks (k, 3) would lie on the object if its mesh were in another unit.

    Parameters
    ----------
    surface_share : how far they may lie off it, and ``least`` : how far they must be spread, as shares of the
        object's size.
    """
    size, hint = extent(model.nodes), ""
    best = least * size
    for (meant, a), (taken, b) in permutations(UNITS.items(), 2):
        scaled = points * (b / a)
        _, distances = nearest_surface_points(model.nodes, model.triangles, scaled)
        if distances.max() <= surface_share * size and extent(scaled) > best:
            best = extent(scaled)
            hint = (
                f"; they fit if its mesh is multiplied by {a / b:.4g}: one in {meant} was taken for one in "
                f"{taken}, perhaps, so mend its unit in the study"
            )
    return hint


def flag_of_unit(model: ReducedModel, points: Array, surface_share: float) -> tuple[str, ...]:
    """A flag where landmarks (k, 3) lie on a part of the object, and all over it in another unit."""
    size, spread = extent(model.nodes), extent(points)
    hint = unit_hint(model, points, surface_share, MOST_OF_IT) if spread < PART_OF_IT * size else ""
    if not hint:
        return ()
    apart = f"{1e3 * spread:.4g} mm apart on an object of {1e3 * size:.4g} mm"
    return (f"registration doubtful: the landmarks are {apart}{hint}",)


def extent(points: Array) -> float:
    """Length of the diagonal of the box around points (n, 3)."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))


# Registration: the object's pose and parameters in the reference frame, from landmarks.
# The shape is not assumed: PnP is solved for shapes spread over the parameter box, each is refined over pose
# and parameters together, and the minima found are compared, so that an ambiguity (a bend towards the camera
# that looks like one away from it) is reported and not chosen by accident.


#: Landmarks that fit so many times worse than careful ones do are flagged.
POOR_FIT = 2.0

#: Objects of another size, metres, are flagged: a mesh in millimetres that was taken for metres is such.
SIZES = (0.005, 10.0)


#: Standard deviation of a carefully set landmark, pixels.
CLICK_PX = 0.5

#: Shares of the object's size: least extent of the landmarks, how far one may lie off the undeformed surface,
#: and how far apart different minima are (mean over the mesh, in the camera frame).
SPREAD_SHARE, SURFACE_SHARE, DISTINCT_SHARE = 0.12, 0.01, 0.02

#: Largest residual (root mean square) as a share of the image's diagonal.
RESIDUAL_SHARE = 0.005


@dataclass(frozen=True)
class LandmarkFit:
    """The object in the reference frame.

    Attributes
    ----------
    estimate : pose, parameters and their uncertainty.
    alternatives : other states that fit the landmarks about as well, best first.
    residual_rms_px : root mean square of the landmarks' residuals.
    flags : what could be wrong with it, in words.
    click_px : standard deviation that a landmark has at the least.
    """

    estimate: Estimate
    alternatives: tuple[State, ...]
    residual_rms_px: float
    flags: tuple[str, ...]
    click_px: float = 0.0

    @property
    def state(self) -> State:
        return self.estimate.state

    @property
    def covariance(self) -> Array:
        """That of the state (d + 6, d + 6), with landmarks taken to be no better than ``click_px``.

        A few landmarks that happen to fit well, or that a wrong model fits, do not say that they are exact.
        """
        sigma = self.estimate.sigma_px
        return self.estimate.covariance * max(1.0, (self.click_px / max(sigma, 1e-12)) ** 2)


def register(
    model: ReducedModel, camera: Camera, points: Array, pixels: Array, click_px: float = CLICK_PX
) -> LandmarkFit:
    """Place the object in the reference frame.

    Parameters
    ----------
    points : (k, 3) landmarks on the undeformed object, object frame, metres.
    pixels : (k, 2) where they are seen in the image as recorded, with its distortion.
    click_px : standard deviation of a carefully set landmark; minima that fit equally well within it are
        ambiguous.

    Raises
    ------
    RegistrationError
        If there are fewer than 4 landmarks, one lies off the object or outside the image, or no pose and
        parameters explain them.
    """
    bound = bind_landmarks(model, points)
    _check_pixels(camera, pixels)
    undistorted = np.ascontiguousarray(camera.undistort_pixels(pixels))
    estimator = Estimator(model, camera, EstimationOptions(huber_px=3.0, max_iterations=60))
    starts = list(_starts(model, camera, bound, undistorted))
    found = estimator.estimate_from(bound, undistorted, np.ones(len(bound)), starts)
    found = [estimate for estimate in found if np.isfinite(estimate.residuals).all()]
    if not found:
        raise RegistrationError(
            "no pose of the object explains the landmarks: check that points and pixels belong together"
        )
    best, alternatives = _distinct_minima(model, found, click_px)
    rms = float(np.sqrt(np.mean(np.sum(best.residuals**2, axis=1))))
    _check_residual(best, rms, RESIDUAL_SHARE * float(np.hypot(camera.width, camera.height)))
    states = tuple(estimate.state for estimate in alternatives)
    flags = _flags(model, best, alternatives, len(bound), click_px)
    flags += flag_of_unit(model, points, SURFACE_SHARE)
    return LandmarkFit(best, states, rms, flags, click_px)


def bind_landmarks(model: ReducedModel, points: Array) -> BoundPoints:
    """Bind landmarks to the nearest points of the undeformed surface; see `register`."""
    if len(points) < 4:
        raise RegistrationError(
            f"{len(points)} landmarks are too few to place the object: give at least 4, better "
            f"{(len(model.parameters) + 6) // 2 + 3} or more spread over it"
        )
    size, spread = extent(model.nodes), extent(points)
    surface, distances = nearest_surface_points(model.nodes, model.triangles, points)
    limit = SURFACE_SHARE * size
    worst = int(distances.argmax())
    if distances[worst] > limit:
        x, y, z = 1e3 * points[worst]
        low, high = 1e3 * model.nodes.min(axis=0), 1e3 * model.nodes.max(axis=0)
        ranges = ", ".join(f"{axis} {a:.4g}..{b:.4g}" for axis, a, b in zip("xyz", low, high, strict=True))
        raise RegistrationError(
            f"landmark {worst + 1} at ({x:g}, {y:g}, {z:g}) mm is {1e3 * distances[worst]:.1f} mm off the "
            f"object, at most {1e3 * limit:.1f} mm are allowed: landmarks are points of the "
            f"undeformed object ({ranges} mm){unit_hint(model, points, SURFACE_SHARE)}"
        )
    if spread < SPREAD_SHARE * size:
        raise RegistrationError(
            f"the landmarks are {1e3 * spread:.3g} mm apart on an object of {1e3 * size:.3g} mm: spread them "
            f"over all that is seen of it{unit_hint(model, points, SURFACE_SHARE)}"
        )
    return BoundPoints.from_surface(model, surface)


def _check_pixels(camera: Camera, pixels: Array) -> None:
    outside = ~((pixels > -0.5) & (pixels < [camera.width - 0.5, camera.height - 0.5])).all(axis=1)
    if outside.any():
        row = int(np.flatnonzero(outside)[0])
        raise RegistrationError(
            f"landmark {row + 1} has the pixel ({pixels[row, 0]:g}, {pixels[row, 1]:g}), outside the "
            f"{camera.width}x{camera.height} image: give pixels of the reference frame"
        )


def shape_starts(model: ReducedModel, largest: int = 243) -> list[Array]:
    """Parameters (d,) to start from: the default, then a coarse grid over the box.

    Each range is cut at 1/6, 1/2 and 5/6; when that makes more than ``largest`` shapes, one parameter at a
    time leaves its default.
    """
    shares = (1 / 6, 1 / 2, 5 / 6)
    lower, upper, default = model.lower, model.upper, model.default
    d = len(lower)
    if len(shares) ** d < largest + 1:
        grid = [lower + np.array(choice) * (upper - lower) for choice in product(shares, repeat=d)]
    else:
        grid = []
        for k, share in product(range(d), (shares[0], shares[-1])):
            shape = default.copy()
            shape[k] = lower[k] + share * (upper[k] - lower[k])
            grid.append(shape)
    return [default, *grid]


def _starts(model: ReducedModel, camera: Camera, bound: BoundPoints, pixels: Array) -> Iterator[State]:
    """PnP poses of every start shape.

    Too few landmarks to determine all unknowns leave the shape at its default, from which the damped
    iteration departs no more than it must.
    """
    determined = 2 * len(bound) >= len(model.parameters) + 6
    for parameters in shape_starts(model) if determined else [model.default]:
        for pose in solve_pnp(bound.rest + bound.field.value(parameters), pixels, camera):
            yield State(parameters, pose)


def solve_pnp(points: Array, pixels: Array, camera: Camera) -> list[RigidTransform]:
    """Poses (camera from object) that put points (k, 3) in front of the camera near their pixels (k, 2).

    SQPNP (Terzakis & Lourakis 2020) for any shape, and both poses of IPPE (Collins & Bartoli 2014) where the
    points lie in a plane.
    """
    centred = points - points.mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False)
    methods = [cv2.SOLVEPNP_SQPNP]
    if spread[2] < 1e-6 * spread[0]:
        methods.append(cv2.SOLVEPNP_IPPE)
    poses = []
    for method in methods:
        try:
            _, rotations, translations, _ = cv2.solvePnPGeneric(points, pixels, camera.matrix, None, flags=method)
        except cv2.error:
            continue  # a degenerate configuration for this method; the others decide
        for rotation, translation in zip(rotations, translations, strict=True):
            pose = RigidTransform(rotation_exp(rotation.ravel()), np.asarray(translation, dtype=float).ravel())
            if (pose.apply(points)[:, 2] > 0.0).all():
                poses.append(pose)
    return poses


def _distinct_minima(
    model: ReducedModel, found: list[Estimate], click_px: float
) -> tuple[Estimate, tuple[Estimate, ...]]:
    """The best minimum and the different ones that landmarks of the stated accuracy cannot exclude."""
    limit = DISTINCT_SHARE * extent(model.nodes)
    best = found[0]
    freedom = max(2 * len(best.residuals) - len(best.covariance), 1)
    variance = max(click_px**2, 2.0 * best.cost / freedom)
    # Twice the log-likelihood ratio of two minima; 9 is the three-sigma level.
    plausible = [e for e in found if 2.0 * (e.cost - best.cost) < 9.0 * variance]
    shapes = [_mesh_in_camera(model, best.state)]
    alternatives: list[Estimate] = []
    for estimate in plausible:
        shape = _mesh_in_camera(model, estimate.state)
        if all(np.linalg.norm(shape - other, axis=1).mean() > limit for other in shapes):
            alternatives.append(estimate)
            shapes.append(shape)
    return best, tuple(alternatives)


def _mesh_in_camera(model: ReducedModel, state: State) -> Array:
    return state.camera_from_object.apply(model.positions(state.parameters))


def _check_residual(best: Estimate, rms: float, limit: float) -> None:
    lengths = np.linalg.norm(best.residuals, axis=1)
    worst = int(lengths.argmax())
    if rms > limit:
        raise RegistrationError(
            f"the landmarks do not fit the object: their residual is {rms:.1f} px (root mean square, at most "
            f"{limit:.1f} px), the worst is landmark {worst + 1} with {lengths[worst]:.1f} px; check "
            "its pixel, the order of the landmarks, the camera file, and that the model reaches this shape"
        )


def _flags(
    model: ReducedModel, best: Estimate, alternatives: tuple[Estimate, ...], count: int, click_px: float
) -> tuple[str, ...]:
    flags = []
    unknowns = len(model.parameters) + 6
    if 2 * count <= unknowns:
        flags.append(
            f"registration underdetermined: {count} landmarks give {2 * count} numbers for {unknowns} "
            f"unknowns, so the shape stays near its default; add landmarks ({unknowns // 2 + 3} or more)"
        )
    elif best.sigma_px > POOR_FIT * click_px:
        flags.append(
            f"registration poor: the landmarks fit to {best.sigma_px:.1f} px, carefully set ones to "
            f"{click_px:g} px; check them, the camera file, and whether this is the model of this object"
        )
    size = extent(model.nodes)
    if not SIZES[0] < size < SIZES[1]:
        flags.append(
            f"the model is {size:.3g} m across: if that is not so, the unit of its mesh is wrong; one camera "
            "cannot tell, because an object twice as large at twice the distance looks the same"
        )
    if alternatives:
        flags.append(
            f"registration ambiguous: {len(alternatives) + 1} different shapes fit the landmarks equally "
            "well; add landmarks away from the object's outline, or take a reference frame that shows it bent"
        )
    # An undetermined parameter may lie anywhere; only a determined one tells of a limit.
    determined = best.parameter_std < model.upper - model.lower
    for parameter, at_bound in zip(model.parameters, best.at_bound & determined, strict=True):
        if at_bound:
            flags.append(f"registration: parameter '{parameter.name}' is at a bound of the model's range")
    return tuple(flags)
