"""Registration by landmarks: the object's pose and parameters in one frame, and how well they are known.

The shape is not assumed. PnP is solved for shapes spread over the parameter box, each is refined over pose and
parameters together, and the minima are compared, so that an ambiguity (a bend towards the camera that looks
like one away from it) is reported and not chosen by accident.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.better_fit import chance_of_better_fit
from morph_dslam.camera import Camera
from morph_dslam.errors import ArgumentError, RegistrationError, check_kind
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.landmarks import Landmarks, load_landmarks
from morph_dslam.model import ReducedModel
from morph_dslam.model.reduced_model import triangle_normals
from morph_dslam.registration.initialization import undistorted_grey
from morph_dslam.registration.landmark_binding import MOST_OF_IT, PART_OF_IT, bind_in_cameras, extent, other_unit
from morph_dslam.registration.landmark_fit import POOR_FIT, LandmarkFit, fit_landmarks, without_parameters
from morph_dslam.registration.messages import (
    Ambiguity,
    Ambiguous,
    AtBound,
    DepthAgainstLandmarks,
    DepthBehindObject,
    DepthScaleUnlikely,
    FewLandmarks,
    LandmarksTurnedAway,
    NotAtRest,
    PoorFit,
    RegistrationWarning,
    Underdetermined,
    UnusualSize,
)
from morph_dslam.registration.other_values import values_of_same_shape
from morph_dslam.registration.outline_snap import EXCLUDED, OutlineSnap, distinct_states, spread_of_turns
from morph_dslam.registration.plausible_states import MeasuredPoints
from morph_dslam.registration.registration import Registration
from morph_dslam.registration.rig_check import cameras_contradict
from morph_dslam.registration.starts import shape_starts
from morph_dslam.threads import one_thread_for_algebra
from morph_dslam.tracking.binding import DrawnSurface, nearest_surface_points
from morph_dslam.tracking.compilation import announce_compilation
from morph_dslam.tracking.depth import SCALE_STD, SIGMA_AT_1M
from morph_dslam.tracking.depth_registration import FoundByDepth, refine_by_depth, share_behind
from morph_dslam.tracking.estimator import Estimate, Estimator, State
from morph_dslam.tracking.rig import RigCamera

Array = NDArray[np.float64]
#: Standard deviation of a carefully set landmark, pixels.
CLICK_PX = 0.5
#: Standard deviation of landmarks' pixels where they are too few to show it.
UNKNOWN_PX = 2.0
#: With fewer numbers to spare, residuals show the error of landmarks to a third at best.
ENOUGH_SPARE = 6
#: Landmarks fit so much better without depth that is right with this chance at most.
DEPTH_CHANCE = 1e-4
#: A scale of the depths that differs by so many of its deviations is named.
UNLIKELY = 3.0
#: Landmarks alone may have the object so many standard deviations too near or too far.
OFF_SIGMAS = 3.0
#: Two states explain as much of the depth if the shares that belong to the object differ by less.
SAME_SHARE = 0.02
#: More of the depths on an object than this share do not lie behind it, if they belong to its pixels.
SEEN_THROUGH = 0.05
#: Parameters are one shape's if they differ by less than this share of their ranges.
SAME_SHAPE = 1e-3
#: Cosine of the angle between a face and the line of sight from which on the face is seen, and not from its edge.
SEEN = 0.2
#: Planes of faces that are nearer to a landmark than this share of the object's size may be what it is on.
ON_FACE = 0.01
#: So large a share of the landmarks has to be on sides that are not seen; single ones may be a matter of rounding.
MOST_TURNED = 0.8
#: Objects of another size, metres, are flagged: a mesh in millimetres that was taken for metres is such.
SIZES = (0.005, 10.0)


@one_thread_for_algebra
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
    depth_scale_std: float = SCALE_STD,
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
    depth_scale_std : standard deviation of what all depths are off by together, a share.

    Raises
    ------
    RegistrationError
        If there are fewer than 4 landmarks, one lies off the object or outside the image, they were set in several
        frames, or no pose and parameters explain them.
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
    cameras = [RigCamera(camera, RigidTransform.identity()), *(part for part, _ in others)]
    given = [landmarks, *(seen for _, seen in others)]
    for each in given:
        _check_one_frame(each)
    fit = fit_landmarks(model, cameras, bind_in_cameras(model, cameras, given), click_px, at_rest, near)
    alternatives = distinct_states(model, fit.best.state, [estimate.state for estimate in fit.plausible[1:]])
    placed = _Placed(fit.best, fit.covariance, fit.measured, alternatives)
    moved = fit.not_at_rest([] if near is not None else shape_starts(model)) if at_rest else None
    if depth is not None:
        placed = _by_depth(fit, camera.checked_depth(depth, "the depth"), (depth_sigma, depth_scale_std))
    elif image is not None:
        placed = _by_outline(fit, placed, undistorted_grey(camera, image))
    facts = _facts(fit, len(alternatives)) | placed.facts
    aids = "depth images" if image is not None else "depth images, the outline (--snap)"
    covariance, notes = _with_plausible_states(fit, placed, aids)
    warnings = [*_warnings(fit, placed, moved), *notes]
    for part, seen in zip(cameras, given, strict=True):
        warnings += _turned_away(model, part.seen(placed.estimate.state), seen.points)
    return Registration(
        model,
        placed.estimate.state,
        covariance,
        facts=facts,
        warnings=tuple(warnings),
        alternatives=placed.alternatives,
        depth_scale=None if placed.by_depth is None else placed.by_depth.scale,
    )


def _check_one_frame(landmarks: Landmarks) -> None:
    """Raise RegistrationError if landmarks say that they were set in several frames."""
    frames = [] if landmarks.frames is None else np.unique(landmarks.frames).tolist()
    if len(frames) > 1:
        raise RegistrationError(
            f"the landmarks were set in frames {frames[0]} and {frames[1]}, and the object may move between them: give "
            "those of one frame, or leave out the column of frames if all are of one picture"
        )


@dataclass(frozen=True)
class _Placed:
    """Where the object is, by landmarks alone or corrected by depth or outline.

    Attributes
    ----------
    estimate : with the residuals of the landmarks.
    covariance : (d + 6, d + 6) by the linear theory.
    measured : what it was found from, to ask for other plausible states; None where these were not to be asked for.
    alternatives : other states that what was measured cannot exclude.
    notes : on what corrected it.
    facts : on that too.
    is_corrected : whether something beside landmarks decided.
    behind : share of the depths on it that lie behind it.
    by_depth : what depth says of it; None without depth.
    """

    estimate: Estimate
    covariance: Array
    measured: MeasuredPoints | None
    alternatives: tuple[State, ...]
    notes: tuple[RegistrationWarning, ...] = ()
    facts: dict[str, Any] = field(default_factory=dict)
    is_corrected: bool = False
    behind: float = 0.0
    by_depth: FoundByDepth | None = None


def _precise(fit: LandmarkFit) -> Estimator:
    """An estimator without a robust loss, with the same parameters known."""
    estimator = Estimator(fit.estimator.model, fit.estimator.camera)
    estimator.box = fit.estimator.box
    return estimator


def _by_depth(fit: LandmarkFit, depth: NDArray[np.float32], deviations: tuple[float, float]) -> _Placed:
    """The object along the sight line by the frame's depth (h, w), with its deviations at 1 m and of its scale."""
    # How well the landmarks fit shows how carefully they were set. A few that happen to fit well are no more exact.
    sigma = max(fit.best.sigma_px, fit.click_px) if np.isfinite(fit.best.sigma_px) else UNKNOWN_PX
    precise = _precise(fit)
    found, *others = _of_each_tilt(fit, precise, [fit.best.state, *fit.others], sigma, depth, deviations)
    best = found.estimate
    alternatives = distinct_states(precise.model, best.state, [other.estimate.state for other in others])
    covariance = best.covariance
    if fit.is_shape_known:
        covariance = without_parameters(covariance)
        rises = [(other.estimate.state, 2.0 * (other.cost - found.cost)) for other in others]
        covariance[-6:, -6:] += spread_of_turns(precise.model, best.state, rises)
    facts = {"along_the_sight_line": "by depth", "depth_scale": asdict(found.scale)}
    behind = share_behind(precise, best.state, found.scale.corrected(depth), deviations[0])
    return _Placed(best, covariance, None, alternatives, facts=facts, is_corrected=True, behind=behind, by_depth=found)


def _of_each_tilt(
    fit: LandmarkFit,
    precise: Estimator,
    starts: Sequence[State],
    sigma: float,
    depth: NDArray[np.float32],
    deviations: tuple[float, float],
) -> list[FoundByDepth]:
    """What landmarks and depth (h, w) have together, from each state that the landmarks leave; the best first.

    Others are as good only if as much of the depth belongs to the object there, and all fits as well.
    """
    landmarks, found, why = fit.landmarks, list[FoundByDepth](), None
    off = OFF_SIGMAS * float(np.sqrt(fit.covariance[-1, -1]))
    for state in starts:
        asked = precise, landmarks.points, landmarks.pixels, state, sigma, depth, *deviations
        try:
            found.append(refine_by_depth(*asked, off=off if np.isfinite(off) else 0.0))
        except RegistrationError as error:
            why = why or error
    if not found:
        assert why is not None
        raise why
    nearest = max(one.share_near for one in found)
    found = sorted((one for one in found if one.share_near > nearest - SAME_SHARE), key=lambda one: one.cost)
    return [one for one in found if 2.0 * (one.cost - found[0].cost) < EXCLUDED]


def _by_outline(fit: LandmarkFit, placed: _Placed, grey: NDArray[np.uint8]) -> _Placed:
    """The object where its outline in the undistorted image (h, w) has it, if that agrees with the landmarks."""
    sigma = max(fit.best.sigma_px, fit.click_px) if np.isfinite(fit.best.sigma_px) else UNKNOWN_PX
    snap = OutlineSnap(_precise(fit), fit.landmarks.points, fit.landmarks.pixels, sigma, grey)
    snapped, alternatives, notes = snap.corrected(fit.best, fit.others)
    facts = {"corrected_by_outline": snapped is not None}
    if snapped is None:
        return replace(placed, alternatives=alternatives, notes=notes, facts=facts)
    estimate = snapped.estimate
    return _Placed(estimate, estimate.covariance, snapped.measured, alternatives, notes, facts, is_corrected=True)


def _with_plausible_states(
    fit: LandmarkFit, placed: _Placed, aids: str
) -> tuple[Array, tuple[RegistrationWarning, ...]]:
    """The covariance (d + 6, d + 6), as wide as other states that fit are spread, and what is to be said of these.

    ``aids`` are what would exclude them.
    """
    covariance, notes, best = placed.covariance, placed.notes, placed.estimate.state
    if placed.measured is not None:
        covariance = placed.measured.spread_of_plausible(best, placed.covariance)
        notes = (*notes, *placed.measured.notes(best, placed.covariance, covariance, aids))
    model, is_corrected = fit.estimator.model, placed.is_corrected
    return covariance, (*notes, *values_of_same_shape(model, fit.plausible, covariance, fit.click_px, is_corrected))


def _facts(fit: LandmarkFit, n_alternatives: int) -> dict[str, Any]:
    return {
        "from": "landmarks",
        "residual_rms_px": fit.rms_px,
        "sigma_px": fit.best.sigma_px,
        "n_landmarks": len(fit.best.residuals),
        "n_alternatives": n_alternatives,
    }


def _warnings(fit: LandmarkFit, placed: _Placed, moved: NotAtRest | None) -> list[RegistrationWarning]:
    """What a reader must know of the fit."""
    model, best, points = fit.estimator.model, placed.estimate, fit.landmarks.points.rest
    found: list[RegistrationWarning] = []
    bound, pixels = fit.landmarks.points, fit.landmarks.pixels
    contradiction = cameras_contradict(fit.estimator, bound, pixels, fit.best, fit.click_px)
    if contradiction is not None:
        found.append(contradiction)
    fits = _of_residuals(fit, best, moved, placed.by_depth)
    if fits is not None and not (isinstance(fits, PoorFit) and contradiction is not None):
        found.append(fits)
    by_depth = placed.by_depth
    if by_depth is not None and abs(by_depth.deviations) > UNLIKELY and not isinstance(fits, DepthAgainstLandmarks):
        found.append(DepthScaleUnlikely(100.0 * (by_depth.scale.factor - 1.0), abs(by_depth.deviations)))
    # Landmarks take up most of a depth that is shifted: that they fit says little.
    if placed.behind > SEEN_THROUGH and not isinstance(fits, DepthAgainstLandmarks):
        found.append(DepthBehindObject(100.0 * placed.behind))
    size = extent(model.nodes)
    if not SIZES[0] < size < SIZES[1]:
        found.append(UnusualSize(size))
    if placed.alternatives:
        shapes = np.array([best.state.parameters, *(state.parameters for state in placed.alternatives)])
        is_one = (np.ptp(shapes, axis=0) <= SAME_SHAPE * (model.upper - model.lower)).all()
        found.append(Ambiguous(Ambiguity.TILT if is_one else Ambiguity.SHAPES, len(placed.alternatives) + 1))
    # An unobservable parameter may lie anywhere, one at rest is where it was said to be, and the undeformed object may
    # be at an end. Only an observable one that was sought elsewhere says that the range ends too early.
    box, centre = fit.estimator.box, 0.5 * (model.lower + model.upper)
    end = np.where(best.state.parameters > centre, model.upper, model.lower)
    observable = (best.parameter_std < model.upper - model.lower) & (box.upper > box.lower) & (end != model.default)
    at_bound = zip(model.parameters, best.at_bound & observable, strict=True)
    found += [AtBound(parameter.name) for parameter, is_at_bound in at_bound if is_at_bound]
    other = other_unit(model, points, MOST_OF_IT) if extent(points) < PART_OF_IT * size else None
    return found if other is None else [*found, other]


def _of_residuals(
    fit: LandmarkFit, best: Estimate, moved: NotAtRest | None, by_depth: FoundByDepth | None
) -> RegistrationWarning | None:
    """What the residuals of the best estimate, which is that by depth where there is any, or too few landmarks, say.

    A scale of the depths that is not the likeliest counts as a residual.
    """
    numbers, unknowns, click_px = 2 * len(fit.landmarks), fit.estimator.box.n_unknowns, fit.click_px
    alone_px = fit.best.sigma_px
    if numbers <= unknowns:
        return Underdetermined(numbers, unknowns, unknowns // 2 + 3)
    if moved is not None:
        return moved
    of_scale = 0.0 if by_depth is None else (by_depth.deviations * max(click_px, np.nan_to_num(alone_px))) ** 2
    left_px = float(np.sqrt(best.sigma_px**2 + of_scale / (numbers - unknowns)))
    if by_depth is not None and np.isfinite(alone_px):
        squares, left = (float(np.sum(estimate.residuals**2)) for estimate in (fit.best, best))
        # Depth that is right moves the unknowns by no more than the landmarks' errors: F of all of them.
        chance = chance_of_better_fit(left + of_scale, squares, unknowns, numbers - unknowns, click_px)
        if chance < DEPTH_CHANCE or left_px > max(fit.poor_px, POOR_FIT * max(alone_px, click_px)):
            return DepthAgainstLandmarks(alone_px, left_px)
    # Depth determines unknowns too, so that residuals by both have more degrees of freedom than landmarks alone.
    own_px = left_px if by_depth is None else alone_px
    if own_px > fit.poor_px:
        return PoorFit(own_px, click_px)
    if numbers - unknowns < ENOUGH_SPARE:
        enough = -(-(unknowns + ENOUGH_SPARE) // 2)
        return FewLandmarks(len(fit.landmarks), max(best.sigma_px, click_px), enough)
    return None


def _turned_away(model: ReducedModel, state: State, points: Array) -> Iterator[LandmarksTurnedAway]:
    """A warning if nearly all landmarks are on faces of a closed surface that are turned away from the camera.

    A landmark on an edge or a corner is on all faces that meet there.

    Parameters
    ----------
    model : of the object.
    state : as registered.
    points : (k, 3) of the landmarks on the undeformed object, metres.
    """
    if not DrawnSurface.of(model).closed:
        return
    normals = _unit(triangle_normals(model.nodes, model.triangles))
    nodes = state.camera_from_object.apply(model.positions(state.parameters))
    towards = -nodes[model.triangles].mean(axis=1)
    seen = np.sum(_unit(triangle_normals(nodes, model.triangles)) * _unit(towards), axis=1) > SEEN
    nearest, _ = nearest_surface_points(model.nodes, model.triangles, points)
    reach = ON_FACE * float(np.linalg.norm(np.ptp(model.nodes, axis=0)))
    count = 0
    for point, own in zip(points, nearest.triangles, strict=True):
        beside = np.isin(model.triangles, model.triangles[own]).any(axis=1)
        height = np.abs(np.sum((point - model.nodes[model.triangles[:, 0]]) * normals, axis=1))
        count += not (seen & beside & (height < reach)).any()
    if count >= MOST_TURNED * len(points):
        yield LandmarksTurnedAway(count, len(points))


def _unit(vectors: Array) -> Array:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)
