"""Mistakes in camera paths that their comparison shows: conventions of poses, clocks, units."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.clock_offset import aligned_error, clock_offset
from morph_dslam.geometry import fit_similarity, rotation_log
from morph_dslam.io.trajectory import Trajectory, other_conventions
from morph_dslam.slam.run_notes import LONGEST_INTERVAL_S
from morph_dslam.sources.recorded import DEPTH_SCALE

Array = NDArray[np.float64]
#: Another convention is meant if with it turns differ by so many times less, and by more than so many degrees without.
CLEARLY, LEAST_DEG = 3.0, 1.0
#: Turns are compared over this part of the path.
SPAN = 0.1
#: Fewer pairs than this part of the shorter path are worth a word.
FEW_PAIRS = 0.5
#: Metric paths are alike in size up to this factor.
ALIKE = 1.25
#: Axes that differ by less may be a matter of calibration, degrees. Levers and small turns of the axes are not worth a
#: word below this error, metres.
CALIBRATED_DEG, LEAST_ERROR_M = 3.0, 0.002
#: Differences of turns that are rounding, degrees; the least part of the largest singular value that tells.
ROUNDING_DEG, LEAST_SINGULAR = 1e-6, 1e-2
#: A path that spreads by less stands still, metres: the rest is rounding.
STILL_M = 1e-9
#: A scale must explain this part of the variance of a true path that spreads less than the estimate is off.
EXPLAINED = 0.5


def pose_notes(estimate: Trajectory, truth: Trajectory) -> Iterator[str]:
    """What is wrong with the poses of matched paths, if those of one are of another convention or another body.

    What only turns the axes of every pose alike is named after what a convention explains. With that, the truth may be
    of a point beside the camera's centre.
    """
    given = _turn_difference(estimate, truth)
    text, own, true = _best_convention(estimate, truth)
    after = _turn_difference(own, true)
    if not given > max(CLEARLY * after, LEAST_DEG):
        text, own, true, after = "", estimate, truth, given
    axes = _axes_of_body(own, true)
    angle, turned = float(np.degrees(Rotation.from_matrix(axes).magnitude())), _turned(own, axes)
    if angle > CALIBRATED_DEG and after > max(CLEARLY * _turn_difference(turned, true), LEAST_DEG):
        named = ", ".join(f"{value:.4g}" for value in np.degrees(rotation_log(axes)))
        text = (
            f"the axes of the truth's poses differ from those of the camera (x right, y down, z forward) by a constant "
            f"turn of {angle:.1f} degrees, rotation vector {named} in camera axes: it is the path of another body that "
            "the camera sits on, or has other axes. Multiply its rotations by the inverse turn from the right"
        )
        own, after = turned, _turn_difference(turned, true)
    elif not text:
        yield from _small_turn_notes(own, turned, true, axes)
    if text:
        yield f"{text}; the turns of the paths then differ by {after:.2g} degrees, not by {given:.2g}"
    yield from _lever_notes(own, true)


def _small_turn_notes(own: Trajectory, turned: Trajectory, true: Trajectory, axes: Array) -> Iterator[str]:
    """That a constant turn (3, 3) of the axes makes most of the error of motions.

    A camera that goes along an axis that is off by a degree is off by a sixtieth of its way, however little it turns.
    The axes are found by the turns alone, so that motions that agree with them are a second witness.
    """
    before, after = _motion_error(own, true), _motion_error(turned, true)
    if before > max(CLEARLY * after, LEAST_ERROR_M):
        named = ", ".join(f"{value:.4g}" for value in np.degrees(rotation_log(axes)))
        yield (
            "the axes of the truth's poses differ from those of the camera by a constant turn with the rotation vector "
            f"{named} degrees in camera axes, as of another body or camera, of rectified images or a principal point "
            f"that is off: with the turn undone, motions over a tenth of the path differ by {1e3 * after:.2g} mm, not "
            f"by {1e3 * before:.2g}"
        )


def _motion_error(estimate: Trajectory, truth: Trajectory) -> float:
    """Root mean square difference of the ways over `SPAN` in the paths' own axes, metres, of paths made alike in size.

    Infinite where there is no size.
    """
    try:
        scale = fit_similarity(estimate.positions, truth.positions, with_scale=True).scale
    except ValueError:
        return np.inf
    own, true = (_ways(path) for path in (estimate, truth))
    return float(np.sqrt(np.mean(np.sum((scale * own - true) ** 2, axis=1))))


def _ways(path: Trajectory) -> Array:
    """Ways (m, 3) over `SPAN` of a path, in the axes of the pose that each begins with."""
    step = max(1, int(SPAN * len(path)))
    moved = path.positions[step:] - path.positions[:-step]
    return np.einsum("kji,kj->ki", path.world_from_camera[:-step, :3, :3], moved)


def _best_convention(estimate: Trajectory, truth: Trajectory) -> tuple[str, Trajectory, Trajectory]:
    """What another convention of one path would be said to be, and both paths with it, which turn most alike.

    Turns about one axis may not tell conventions apart; then the positions do, and else the truth's is meant.
    """
    ways = [
        (f"the poses of the truth {text}", estimate, Trajectory(truth.timestamps, poses))
        for text, poses in other_conventions(truth.world_from_camera).items()
    ] + [
        (f"the poses of the estimate {text}", Trajectory(estimate.timestamps, poses), truth)
        for text, poses in other_conventions(estimate.world_from_camera).items()
    ]
    turns = np.array([_turn_difference(own, true) for _, own, true in ways])
    alike = np.flatnonzero(turns <= CLEARLY * turns.min() + ROUNDING_DEG)
    errors = np.array([aligned_error(ways[row][1].positions, ways[row][2].positions) for row in alike])
    return ways[alike[np.flatnonzero(errors <= CLEARLY * errors.min())[0]]]


def _axes_of_body(estimate: Trajectory, truth: Trajectory) -> Array:
    """The turn (3, 3) camera_from_body for which the body's turns are most like the camera's.

    A turn seen in other axes has its rotation vector in these axes. Turns about one axis alone leave it open: none.
    """
    own, true = (
        Rotation.from_matrix(_turns(path.world_from_camera[:, :3, :3])).as_rotvec() for path in (estimate, truth)
    )
    u, sizes, vt = np.linalg.svd(own.T @ true)
    is_known = sizes[1] > LEAST_SINGULAR * sizes[0]
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt if is_known else np.eye(3)


def _turned(path: Trajectory, axes: Array) -> Trajectory:
    """A path with the axes of its poses turned (3, 3)."""
    poses = path.world_from_camera.copy()
    poses[:, :3, :3] = poses[:, :3, :3] @ axes
    return Trajectory(path.timestamps, poses)


def _lever_notes(estimate: Trajectory, truth: Trajectory) -> Iterator[str]:
    """That the truth is of a point beside the camera's centre, if that explains most of the difference.

    With axes that agree, truth + R lever = scale world_turn estimate + shift is linear in lever, scale and shift.
    """
    rotations = truth.world_from_camera[:, :3, :3]
    turn = Rotation.from_matrix(rotations @ estimate.world_from_camera[:, :3, :3].transpose(0, 2, 1)).mean()
    moved = turn.apply(estimate.positions - estimate.positions.mean(axis=0))
    moved /= max(float(np.abs(moved).max()), 1e-12)
    n = len(rotations)
    columns = [-rotations.reshape(-1, 3), moved.reshape(-1, 1), np.tile(np.eye(3), (n, 1))]
    values, _, rank, _ = np.linalg.lstsq(np.hstack(columns), truth.positions.ravel(), rcond=LEAST_SINGULAR)
    if rank < len(values):  # the path does not turn enough to tell
        return
    left = np.hstack(columns) @ values - truth.positions.ravel()
    after, before = float(np.sqrt(left @ left / n)), aligned_error(estimate.positions, truth.positions)
    if before > max(CLEARLY * after, LEAST_ERROR_M) and float(values[3]) > 0.0:
        lever = ", ".join(f"{value:.0f}" for value in 1e3 * values[:3])
        yield (
            f"the camera's centre is ({lever}) mm from the point whose path the truth is, in the truth's axes; with it "
            f"the positions differ by {1e3 * after:.2g} mm, not by {1e3 * before:.2g}"
        )


def clock_notes(estimate: Trajectory, truth: Trajectory) -> Iterator[str]:
    """That the clocks of whole paths differ by a constant, where that explains most of the error."""
    found = clock_offset(estimate, truth)
    if found is not None:
        offset, before, after = found
        yield (
            f"the clocks differ by a constant: with {offset:+.3f} s on the times of the estimate the positions differ "
            f"by {1e3 * after:.3g} mm, not by {1e3 * before:.3g} (root mean square, at the best scale). The figures "
            "are those of the times as they are: correct these"
        )


def pair_notes(n_pairs: int, estimate: Trajectory, truth: Trajectory) -> Iterator[str]:
    """What a reader must know if few poses of the whole paths belong together in time."""
    if n_pairs < FEW_PAIRS * min(len(estimate), len(truth)):
        yield (
            f"only {n_pairs} of {len(estimate)} poses have a true one at their time, and the errors are theirs: "
            f"{clock_advice(estimate, truth)}"
        )


def check_numbers(n_pairs: int, estimate: Trajectory, truth: Trajectory) -> None:
    """Refuse paths of which one has frame numbers, the other times, where few of these are alike by chance."""
    if truth.is_numbered == estimate.is_numbered or n_pairs >= FEW_PAIRS * min(len(estimate), len(truth)):
        return
    raise EvaluationError(
        f"only {n_pairs} of {len(estimate)} poses have a true one at their time: {clock_advice(estimate, truth)}"
    )


def clock_advice(estimate: Trajectory, truth: Trajectory) -> str:
    """What to do if few poses of the paths belong together in time."""
    if truth.is_numbered != estimate.is_numbered:
        numbered = "truth" if truth.is_numbered else "estimate"
        return (
            f"the {numbered} has frame numbers, as KITTI's and COLMAP's files do, and no times: compare it with a run "
            "folder, whose frames.csv has both, or save it in TUM's format with times in seconds"
        )
    whole = [bool((path.timestamps % 1.0 == 0.0).all()) for path in (estimate, truth)]
    if whole[0] != whole[1]:
        numbered, path = ("estimate", estimate) if whole[0] else ("truth", truth)
        if len(path) > 1 and np.median(np.diff(path.timestamps)) > LONGEST_INTERVAL_S:
            return f"the {numbered} is stamped with nanoseconds or microseconds probably: stamp it with seconds"
        return f"the {numbered} is stamped with whole numbers, of frames probably: stamp it with seconds"
    return "give the truth of this recording, on its clock"


def _extent(path: Trajectory) -> float:
    """Root mean square distance of the centres from their middle, metres."""
    return float(np.sqrt(np.sum(np.var(path.positions, axis=0))))


def no_scale(estimate: Trajectory, truth: Trajectory, is_metric: bool) -> str:
    """Why matched paths give no scale, truth over estimate; empty where they do.

    A similarity shrinks any estimate to a point, and so fits any to a truth that stands still. A true path that jitters
    is no different: the errors of the estimate are larger, and no scale makes one of the other.

    Parameters
    ----------
    estimate, truth : n poses each.
    is_metric : whether the estimate's lengths are metres, so that its error without a scale means something.
    """
    own, true = _extent(estimate), _extent(truth)
    if min(own, true) < STILL_M:
        return f"the {'true' if true < STILL_M else 'estimated'} path stands still, and a still path has no scale"
    off = aligned_error(estimate.positions, truth.positions, with_scale=False) if is_metric else 0.0
    if true < off and aligned_error(estimate.positions, truth.positions) ** 2 > (1.0 - EXPLAINED) * true**2:
        return (
            f"the true path spreads by {1e3 * true:.2g} mm about its middle, less than the estimate is off "
            f"({1e3 * off:.2g} mm), and has no scale"
        )
    return ""


def size_notes(scale: float, rigid_rmse: float, similar_rmse: float, truth: Trajectory) -> Iterator[str]:
    """What is wrong with the unit of a metric path.

    Parameters
    ----------
    scale : of the similarity, truth over estimate
    rigid_rmse, similar_rmse : of the positions after the rigid motion, and after the similarity
    truth : the true path. One that hardly moves says nothing of units: drifts are alike, whatever their size.
    """
    if not 1.0 / ALIKE < scale < ALIKE and similar_rmse < 0.5 * rigid_rmse and _extent(truth) > LEAST_ERROR_M:
        yield (
            f"the true path is {scale:.4g} times as large as the estimated one: in a metric map correct {DEPTH_SCALE}, "
            "the baseline of the stereo pair, or the unit of the poses that it was made with"
        )


def _turns(rotations: Array) -> Array:
    """Turns (m, 3, 3) over `SPAN` of a series of rotations (n, 3, 3), by their own axes."""
    step = max(1, int(SPAN * len(rotations)))
    return rotations[:-step].transpose(0, 2, 1) @ rotations[step:]


def _turn_difference(first: Trajectory, second: Trajectory) -> float:
    """Root mean square difference between the turns of two paths, degrees."""
    own, true = (_turns(path.world_from_camera[:, :3, :3]) for path in (first, second))
    angles = Rotation.from_matrix(own.transpose(0, 2, 1) @ true).magnitude()
    return float(np.degrees(np.sqrt(np.mean(angles**2))))
