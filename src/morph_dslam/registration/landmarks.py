"""Registration by landmarks: the object's pose and parameters in one frame, and how well they are known.

The shape is not assumed. PnP is solved for shapes spread over the parameter box, each is refined over pose and
parameters together, and the minima are compared, so that an ambiguity (a bend towards the camera that looks
like one away from it) is reported and not chosen by accident.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import ArgumentError, RegistrationError, RegistrationFailure, check_kind
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.landmarks import Landmarks, load_landmarks
from morph_dslam.model import ReducedModel, SurfacePoints
from morph_dslam.registration.initialization import undistorted_grey
from morph_dslam.registration.landmark_sides import turned_away
from morph_dslam.registration.messages import (
    UNITS,
    Ambiguity,
    Ambiguous,
    AtBound,
    DepthAgainstLandmarks,
    FewLandmarks,
    NotAtRest,
    PoorFit,
    RegistrationWarning,
    Underdetermined,
    UnusualSize,
    WrongUnit,
)
from morph_dslam.registration.other_values import as_set, plausible_minima, values_of_same_shape
from morph_dslam.registration.outline_snap import OutlineSnap, distinct_states
from morph_dslam.registration.plausible_states import MeasuredPoints
from morph_dslam.registration.registration import Registration
from morph_dslam.registration.rest_check import MOVED_SHARE, not_at_rest
from morph_dslam.registration.rig_check import cameras_contradict
from morph_dslam.registration.starts import pose_starts, shape_starts
from morph_dslam.tracking.binding import nearest_surface_points
from morph_dslam.tracking.compilation import announce_compilation
from morph_dslam.tracking.depth import SIGMA_AT_1M
from morph_dslam.tracking.depth_registration import refine_by_depth
from morph_dslam.tracking.estimator import BoundPoints, Estimate, EstimationOptions, Estimator, State
from morph_dslam.tracking.rig import PointsEstimator, RigCamera

Array = NDArray[np.float64]
#: Standard deviation of a carefully set landmark, pixels. Those that fit so many times worse, and worse than this share
#: of the image's diagonal, are flagged; deviations are as wide as the fit asks for anyway.
CLICK_PX, POOR_FIT, POOR_SHARE = 0.5, 2.0, 1.0 / 800.0
#: Standard deviation of landmarks' pixels where they are too few to show it, and the least that is believed.
UNKNOWN_PX, LEAST_PX = 2.0, 0.1
#: So many landmarks show whether one of them is wrong: three fit in some pose anyway.
FEWEST_FOR_FIT = 4
#: Shares of the object's size: least extent of the landmarks, and how far one may lie off the undeformed surface.
SPREAD_SHARE, SURFACE_SHARE = 0.12, 0.01
#: Largest residual (root mean square) as a share of the image's diagonal.
RESIDUAL_SHARE = 0.005
#: Both of hints about an object whose edges give its place in the end: they need not be exact, but no mistakes.
HINT_RESIDUAL_SHARE, HINT_SURFACE_SHARE = 0.02, 0.05
#: With fewer numbers to spare, residuals show the error of landmarks to a third at best.
ENOUGH_SPARE = 6
#: Objects of another size, metres, are flagged: a mesh in millimetres that was taken for metres is such.
SIZES = (0.005, 10.0)
#: Landmarks in another unit must be spread over this share of the object: on a point they lie anywhere.
LEAST_SPREAD = 0.2
#: On a sheet landmarks lie in any smaller unit: those spread over less than the first share of it, which
#: would be spread over more than the second in another one, are flagged.
PART_OF_IT, MOST_OF_IT = 0.5, 0.6


def register_landmarks(
    model: ReducedModel,
    camera: Camera,
    landmarks: Landmarks | str | Path,
    click_px: float = CLICK_PX,
    depth: NDArray[np.float32] | None = None,
    depth_sigma: float = SIGMA_AT_1M,
    at_rest: bool = False,
    near: State | None = None,
    image: NDArray[np.uint8] | None = None,
    others: Sequence[tuple[RigCamera, Landmarks]] = (),
) -> Registration:
    """The object in the frame in which the landmarks were set.

    Parameters
    ----------
    model : of the object.
    camera : that took the frame.
    landmarks : points of the undeformed object and their pixels in the frame, or the file that has them.
    click_px : standard deviation of a carefully set landmark; minima that fit equally well within it are
        ambiguous.
    depth : (h, w) of the frame, metres, NaN where unknown; None without a depth camera.
    depth_sigma : standard deviation of a pixel's depth at 1 m, metres.
    at_rest : whether the object is known to be undeformed in the frame, its parameters at their defaults.
    near : a state close by, from fewer landmarks say, that alone is started from. That is quick, and finds neither a
        minimum elsewhere nor an ambiguity.
    image : the frame as recorded, (h, w, 3) or (h, w), in which the object's outline corrects the landmarks
        (`outline_snap`); None to rely on them alone. Depth decides instead where there is any.
    others : further cameras fixed to ``camera``, each (``RigCamera`` of `morph_dslam.extend.registration`) with the
        landmarks in what it saw at the same instant. All count together; depth and image correct those of one camera.

    Raises
    ------
    RegistrationError
        If there are fewer than 4 landmarks, one lies off the object or outside the image, or no pose and
        parameters explain them.
    ArgumentError
        If model, camera or landmarks are of another kind, or depth or image is given beside others.
    CameraError
        If image or depth is not of the camera's size, or of another type.
    """
    check_kind(model, ReducedModel, "model", "the model that load_model reads from the file")
    check_kind(camera, Camera, "camera", "the camera that load_camera reads from the file, or Camera(...)")
    check_kind(
        landmarks,
        (Landmarks, str, Path),
        "landmarks",
        "Landmarks(points, pixels) of morph_dslam.extend.registration, or the path of a file that has them",
    )
    if others and not (depth is None and image is None):
        raise ArgumentError("depth and image correct the landmarks of one camera: leave out these, or others")
    announce_compilation()
    if not isinstance(landmarks, Landmarks):
        landmarks = load_landmarks(Path(landmarks))
    cameras, given = [RigCamera(camera, RigidTransform.identity())], [landmarks]
    for part, seen in others:
        cameras.append(part)
        given.append(seen)
    bound, pixels, of_points = _joined(model, cameras, given)
    names = _names(of_points)
    estimator = _estimator(model, cameras, of_points, at_rest)
    shapes = shape_starts(model)
    if at_rest or 2 * len(bound) < len(model.parameters) + 6:
        # Too few landmarks leave the shape at its default; the damped iteration departs no more than it must.
        shapes = [model.default]
    starts = list(pose_starts(shapes, estimator, bound, pixels)) if near is None else [near]
    found = _estimates(estimator, bound, pixels, starts)
    if at_rest:
        found = [_of_pose_alone(estimator, bound, pixels, estimate) for estimate in found]
    plausible = plausible_minima(found, click_px)
    best = plausible[0]
    alternatives = distinct_states(model, best.state, [estimate.state for estimate in plausible[1:]])
    rms, diagonal = _rms(best), float(np.hypot(camera.width, camera.height))
    _check_residual(estimator, bound, pixels, best, names)
    facts = {
        "from": "landmarks",
        "residual_rms_px": rms,
        "sigma_px": best.sigma_px,
        "n_landmarks": len(best.residuals),
        "n_alternatives": len(alternatives),
    }
    poor_px = max(POOR_FIT * click_px, POOR_SHARE * diagonal)
    moved = None
    if at_rest:
        further = pose_starts(shape_starts(model) if near is None else [], estimator, bound, pixels)
        least_share = 0.0 if best.sigma_px > poor_px else MOVED_SHARE
        moved = not_at_rest(estimator, bound, pixels, best, further, click_px, least_share)
    # A few landmarks that happen to fit well, or that a wrong model fits, are not exact for that.
    covariance = best.covariance * as_set(best, click_px)
    variance, normals = max(click_px, best.sigma_px) ** 2, np.zeros_like(pixels)
    measured = MeasuredPoints(estimator, bound, pixels, np.ones(len(bound)), normals, variance)
    notes: tuple[RegistrationWarning, ...] = ()
    precise = Estimator(model, camera)
    precise.box = estimator.box
    if depth is not None:
        depth = camera.checked_depth(depth, "the depth")
        # How well the landmarks fit shows how carefully they were set, where they are enough to show it.
        sigma = max(best.sigma_px, LEAST_PX) if np.isfinite(best.sigma_px) else UNKNOWN_PX
        best = refine_by_depth(precise, bound, pixels, best.state, sigma, depth, depth_sigma)
        facts["along_the_sight_line"], covariance, measured = "by depth", best.covariance, None
        if at_rest:
            covariance = _without_parameters(covariance)
    elif image is not None:
        sigma = max(best.sigma_px, click_px) if np.isfinite(best.sigma_px) else UNKNOWN_PX
        snap = OutlineSnap(precise, bound, pixels, sigma, undistorted_grey(camera, image))
        snapped, alternatives, notes = snap.corrected(best, alternatives)
        facts["corrected_by_outline"] = snapped is not None
        if snapped is not None:
            best, covariance, measured = snapped.estimate, snapped.estimate.covariance, snapped.measured
    if measured is not None:
        linear, covariance = covariance, measured.spread_of_plausible(best.state, covariance)
        aids = "depth images" if image is not None else "depth images, the outline (--snap)"
        notes = (*notes, *measured.notes(best.state, linear, covariance, aids))
    is_corrected = depth is not None or facts.get("corrected_by_outline", False)
    notes = (*notes, *values_of_same_shape(model, plausible, covariance, click_px, is_corrected))
    alone_px = facts["sigma_px"] if depth is not None else np.nan
    warnings = _warnings(model, best, len(alternatives), bound.rest, click_px, poor_px, moved, alone_px)
    if contradiction := cameras_contradict(estimator, bound, pixels, best, click_px):
        warnings = (contradiction, *(warning for warning in warnings if not isinstance(warning, PoorFit)))
    warnings = (*warnings, *notes)
    for part, seen in zip(cameras, given, strict=True):
        warnings = (*warnings, *turned_away(model, part.seen(best.state), seen.points))
    return Registration(model, best.state, covariance, facts=facts, warnings=warnings, alternatives=alternatives)


def bind_landmarks(model: ReducedModel, points: Array) -> BoundPoints:
    """Bind landmarks (k, 3) to the nearest points of the undeformed surface; see `register_landmarks`."""
    if len(points) < FEWEST_FOR_FIT:
        raise RegistrationError(
            f"{len(points)} landmarks are too few to register the object: give at least {FEWEST_FOR_FIT}, better "
            f"{(len(model.parameters) + 6) // 2 + 3} or more spread over it"
        )
    surface = on_surface(model, points)
    check_spread(model, points)
    return BoundPoints.from_surface(model, surface)


def _joined(
    model: ReducedModel, cameras: Sequence[RigCamera], given: Sequence[Landmarks]
) -> tuple[BoundPoints, Array, NDArray[np.int64]]:
    """The landmarks of all cameras, those of the first one first.

    Returns
    -------
    points : k of them, bound.
    pixels : (k, 2) undistorted.
    of_points : (k,) number of the camera that saw each.
    """
    bound = bind_landmarks(model, given[0].points)
    check_pixels(cameras[0].camera, given[0])
    pixels = [cameras[0].camera.undistort_pixels(given[0].pixels)]
    for number, (part, seen) in enumerate(zip(cameras[1:], given[1:], strict=True), start=1):
        try:
            bound = bound.joined(BoundPoints.from_surface(model, on_surface(model, seen.points)))
            check_pixels(part.camera, seen)
        except RegistrationError as error:
            raise RegistrationError(f"camera {number}: {error}") from error
        pixels.append(part.camera.undistort_pixels(seen.pixels))
    of_points = np.repeat(np.arange(len(cameras)), [len(part) for part in pixels])
    return bound, np.ascontiguousarray(np.concatenate(pixels)), of_points


def _names(of_points: NDArray[np.int64]) -> list[str]:
    """What messages call landmarks (k,) of these cameras: their place in their file."""
    places = [int(np.count_nonzero(of_points[:row] == number)) + 1 for row, number in enumerate(of_points)]
    return [
        f"{place} of camera {number}" if number else f"{place}" for place, number in zip(places, of_points, strict=True)
    ]


def check_at_rest(
    model: ReducedModel, camera: Camera, surface: SurfacePoints, pixels: Array, numbers: NDArray[np.int64]
) -> None:
    """Refuse landmarks of one frame that contradict each other grossly: as hints they need not fit closely.

    Parameters
    ----------
    model : of the object.
    camera : that took the frame.
    surface : the landmarks on the undeformed object, `FEWEST_FOR_FIT` or more.
    pixels : (k, 2) where they were seen, without the lens's distortion.
    numbers : (k,) theirs in the messages.
    """
    bound = BoundPoints.from_surface(model, surface)
    cameras, of_points = [RigCamera(camera, RigidTransform.identity())], np.zeros(len(bound), dtype=np.int64)
    estimator = _estimator(model, cameras, of_points, at_rest=True)
    best = _estimates(estimator, bound, pixels, list(pose_starts([model.default], estimator, bound, pixels)))[0]
    _check_residual(estimator, bound, pixels, best, [str(number) for number in numbers], HINT_RESIDUAL_SHARE)


def on_surface(model: ReducedModel, points: Array, share: float = SURFACE_SHARE) -> SurfacePoints:
    """The points of the undeformed surface nearest to landmarks (k, 3).

    Raises RegistrationError if one is off it by more than a share of the object's size.
    """
    size = _extent(model.nodes)
    surface, distances = nearest_surface_points(model.nodes, model.triangles, points)
    limit = share * size
    worst = int(distances.argmax())
    if distances[worst] > limit:
        x, y, z = 1e3 * points[worst]
        low, high = 1e3 * model.nodes.min(axis=0), 1e3 * model.nodes.max(axis=0)
        ranges = ", ".join(f"{axis} {a:.4g}..{b:.4g}" for axis, a, b in zip("xyz", low, high, strict=True))
        raise RegistrationError(
            f"landmark {worst + 1} at ({x:g}, {y:g}, {z:g}) mm is {1e3 * distances[worst]:.1f} mm off the "
            f"object, at most {1e3 * limit:.1f} mm are allowed: landmarks are points of the "
            f"undeformed object ({ranges} mm){_unit_hint(model, points)}"
        )
    return surface


def check_spread(model: ReducedModel, points: Array) -> None:
    """Refuse landmarks (k, 3) that are all in one corner of the object."""
    size, spread = _extent(model.nodes), _extent(points)
    if spread < SPREAD_SHARE * size:
        raise RegistrationError(
            f"the landmarks are {1e3 * spread:.3g} mm apart on an object of {1e3 * size:.3g} mm: spread them "
            f"over all that is seen of it{_unit_hint(model, points)}"
        )


def _other_unit(model: ReducedModel, points: Array, least: float) -> WrongUnit | None:
    """In which unit of the mesh landmarks (k, 3) would lie on the object, spread over this share of it."""
    size, found = _extent(model.nodes), None
    best = least * size
    for (meant, a), (taken, b) in permutations(UNITS.items(), 2):
        scaled = points * (b / a)
        _, distances = nearest_surface_points(model.nodes, model.triangles, scaled)
        if distances.max() <= SURFACE_SHARE * size and _extent(scaled) > best:
            best = _extent(scaled)
            found = WrongUnit(_extent(points), size, a / b, meant, taken)
    return found


def _unit_hint(model: ReducedModel, points: Array) -> str:
    found = _other_unit(model, points, LEAST_SPREAD)
    return "" if found is None else found.hint


def _extent(points: Array) -> float:
    """Length of the diagonal of the box around points (n, 3)."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))


def check_pixels(camera: Camera, landmarks: Landmarks) -> None:
    """Refuse landmarks whose pixels are not in the image."""
    pixels = landmarks.pixels
    outside = ~((pixels > -0.5) & (pixels < [camera.width - 0.5, camera.height - 0.5])).all(axis=1)
    if outside.any():
        row = int(np.flatnonzero(outside)[0])
        frame = "the reference frame" if landmarks.frames is None else f"frame {landmarks.frames[row]}"
        raise RegistrationError(
            f"landmark {row + 1} has the pixel ({pixels[row, 0]:g}, {pixels[row, 1]:g}), outside the "
            f"{camera.width}x{camera.height} image: give pixels of {frame}"
        )


def _estimator(
    model: ReducedModel, cameras: Sequence[RigCamera], of_points: NDArray[np.int64], at_rest: bool
) -> PointsEstimator:
    estimator = PointsEstimator(model, cameras, of_points, EstimationOptions(huber_px=3.0, max_iterations=60))
    if at_rest:
        estimator.box = replace(estimator.box, lower=model.default, upper=model.default)
    return estimator


def _estimates(estimator: Estimator, bound: BoundPoints, pixels: Array, starts: list[State]) -> list[Estimate]:
    """What explains landmarks, the best first; raises RegistrationError if nothing does."""
    found = estimator.estimate_from(bound, pixels, np.ones(len(bound)), starts)
    found = [estimate for estimate in found if np.isfinite(estimate.residuals).all()]
    if not found:
        raise RegistrationError(
            "no pose of the object explains the landmarks: check that points and pixels belong together",
            RegistrationFailure.LANDMARKS_DO_NOT_FIT,
        )
    return found


def _of_pose_alone(estimator: Estimator, bound: BoundPoints, pixels: Array, found: Estimate) -> Estimate:
    """An estimate whose parameters were known, with the covariance of the pose alone."""
    d, covariance = len(estimator.model.parameters), np.zeros_like(found.covariance)
    _, hessian, _, _ = estimator.evaluate(bound, pixels, np.ones(len(bound)), found.state)
    freedom = max(2 * len(bound) - 6, 1)
    variance = max(2.0 * found.cost / freedom, LEAST_PX**2)
    scale = estimator.scale[d:]
    covariance[d:, d:] = variance * np.outer(scale, scale) * np.linalg.pinv(hessian[d:, d:] * np.outer(scale, scale))
    return replace(found, covariance=covariance, at_bound=np.zeros(d, dtype=bool), sigma_px=float(np.sqrt(variance)))


def _without_parameters(covariance: Array) -> Array:
    """A covariance (d + 6, d + 6) of a state whose parameters are known."""
    known, d = np.zeros_like(covariance), len(covariance) - 6
    known[d:, d:] = covariance[d:, d:]
    return known


def _rms(estimate: Estimate) -> float:
    """Root mean square of the landmarks' residuals, pixels."""
    return float(np.sqrt(np.mean(np.sum(estimate.residuals**2, axis=1))))


def _check_residual(
    estimator: PointsEstimator,
    bound: BoundPoints,
    pixels: Array,
    best: Estimate,
    names: Sequence[str],
    share: float = RESIDUAL_SHARE,
) -> None:
    """Refuse landmarks (k,), which have these names, if they do not fit to a share of the image's diagonal."""
    camera = estimator.camera
    rms, limit = _rms(best), share * float(np.hypot(camera.width, camera.height))
    if rms <= limit:
        return
    if contradiction := cameras_contradict(estimator, bound, pixels, best, limit, is_far=True):
        raise RegistrationError(str(contradiction), RegistrationFailure.LANDMARKS_DO_NOT_FIT)
    is_shape_known = np.array_equal(estimator.box.lower, estimator.box.upper)
    wrong = _contradicted(estimator, bound, pixels, limit) if is_shape_known else None
    if wrong is not None:
        row, away, agreeing = wrong
        raise RegistrationError(
            f"landmark {names[row]} is {away:.1f} px from where the other {len(bound) - 1} have it, which fit the "
            f"object to {agreeing:.1f} px (at most {limit:.1f} px): check its point and its pixel",
            RegistrationFailure.LANDMARKS_DO_NOT_FIT,
        )
    lengths = np.linalg.norm(best.residuals, axis=1)
    worst = int(lengths.argmax())
    shape = "the object has its mesh's shape there" if is_shape_known else "the model reaches this shape"
    more = "; five or more show which of them is wrong" if is_shape_known and len(bound) == FEWEST_FOR_FIT else ""
    raise RegistrationError(
        f"the landmarks do not fit the object: their residual is {rms:.1f} px (root mean square, at most "
        f"{limit:.1f} px), the worst is landmark {names[worst]} with {lengths[worst]:.1f} px; check "
        f"its pixel, the order of the landmarks, the camera file, and that {shape}{more}",
        RegistrationFailure.LANDMARKS_DO_NOT_FIT,
    )


def _contradicted(
    estimator: PointsEstimator, bound: BoundPoints, pixels: Array, limit: float
) -> tuple[int, float, float] | None:
    """The landmark without which the others fit an object of known shape to the limit; None if there is none.

    Returns
    -------
    Its row, how far it is from where the others have it, and how they fit, pixels.
    """
    if len(bound) <= FEWEST_FOR_FIT:
        return None
    found = []
    for row in range(len(bound)):
        others = np.delete(np.arange(len(bound)), row)
        kept, seen = bound.take(others), np.ascontiguousarray(pixels[others])
        fewer = estimator.taking(others)
        starts = list(pose_starts([estimator.model.default], fewer, kept, seen))
        for estimate in fewer.estimate_from(kept, seen, np.ones(len(kept)), starts)[:1]:
            there = estimator.pixels(bound, estimate.state)[row]
            found.append((_rms(estimate), row, float(np.linalg.norm(pixels[row] - there))))
    agreeing, row, away = min(found, default=(np.inf, 0, 0.0))
    return (row, away, agreeing) if agreeing <= limit else None


def _warnings(
    model: ReducedModel,
    best: Estimate,
    n_alternatives: int,
    points: Array,
    click_px: float,
    poor_px: float,
    moved: NotAtRest | None,
    alone_px: float,
) -> tuple[RegistrationWarning, ...]:
    """What a reader must know; ``alone_px`` is how the landmarks fit without depth, NaN where there is none."""
    warnings: list[RegistrationWarning] = []
    numbers, unknowns, size = 2 * len(points), len(model.parameters) + 6, _extent(model.nodes)
    if numbers <= unknowns:
        warnings.append(Underdetermined(numbers, unknowns, unknowns // 2 + 3))
    elif moved is not None:
        warnings.append(moved)
    elif np.isfinite(alone_px) and best.sigma_px > max(poor_px, POOR_FIT * max(alone_px, click_px)):
        warnings.append(DepthAgainstLandmarks(alone_px, best.sigma_px))
    elif best.sigma_px > poor_px:
        warnings.append(PoorFit(best.sigma_px, click_px))
    elif numbers - unknowns < ENOUGH_SPARE:
        enough = -(-(unknowns + ENOUGH_SPARE) // 2)
        warnings.append(FewLandmarks(len(points), max(best.sigma_px, click_px), enough))
    if not SIZES[0] < size < SIZES[1]:
        warnings.append(UnusualSize(size))
    if n_alternatives:
        warnings.append(Ambiguous(Ambiguity.SHAPES, n_alternatives + 1))
    # An unobservable parameter may lie anywhere; only an observable one says that the range ends too early.
    observable = best.parameter_std < model.upper - model.lower
    at_bound = zip(model.parameters, best.at_bound & observable, strict=True)
    warnings += [AtBound(parameter.name) for parameter, is_at_bound in at_bound if is_at_bound]
    other = _other_unit(model, points, MOST_OF_IT) if _extent(points) < PART_OF_IT * size else None
    return tuple(warnings if other is None else [*warnings, other])
