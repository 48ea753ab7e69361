"""Errors of a camera trajectory against the truth (Sturm et al. 2012): absolute and relative."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import EvaluationError
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.similarity import SimilarityTransform, fit_similarity

Array = NDArray[np.float64]

#: Poses of estimate and truth belong together if they are at most this far apart in time, seconds.
MOST_TIME_DIFFERENCE = 0.01


@dataclass(frozen=True)
class Statistics:
    """Statistics of errors, in their unit."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float

    @classmethod
    def of(cls, errors: Array) -> Statistics:
        """Of errors (n,), at least one."""
        return cls(
            float(np.sqrt(np.mean(errors**2))),
            float(errors.mean()),
            float(np.median(errors)),
            float(errors.std()),
            float(errors.min()),
            float(errors.max()),
        )


@dataclass(frozen=True)
class AbsoluteError:
    """Distances between the camera centres after the estimate was moved to the truth.

    Attributes
    ----------
    truth_from_estimate : the alignment. aligned : (n, 3) estimated centres in the truth's world, metres.
    distances : (n,) metres.
    """

    truth_from_estimate: SimilarityTransform
    aligned: Array
    distances: Array


@dataclass(frozen=True)
class RelativeError:
    """Errors of the motion over an interval: drift.

    Attributes
    ----------
    timestamps : (m,) when each motion begins, seconds.
    translations : (m,) metres. rotations : (m,) radians.
    """

    timestamps: Array
    translations: Array
    rotations: Array


def associate(first: Array, second: Array, most: float = MOST_TIME_DIFFERENCE) -> NDArray[np.int64]:
    """Pairs (n, 2) of indices of timestamps (a,) and (b,), both ascending, that are close in time.

    Each timestamp is used once; the closest pairs are made first (as the TUM benchmark's tools do).
    """
    low = np.searchsorted(second, first - most, side="left")
    high = np.searchsorted(second, first + most, side="right")
    rows = np.repeat(np.arange(len(first)), high - low)
    columns = np.concatenate([np.arange(a, b) for a, b in zip(low, high, strict=True)] or [np.arange(0)])
    order = np.argsort(np.abs(first[rows] - second[columns]), kind="stable")
    free_rows, free_columns = np.ones(len(first), dtype=bool), np.ones(len(second), dtype=bool)
    pairs = []
    for row, column in zip(rows[order], columns[order], strict=True):
        if free_rows[row] and free_columns[column]:
            free_rows[row] = free_columns[column] = False
            pairs.append((row, column))
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def match(
    estimate: Trajectory, truth: Trajectory, most: float = MOST_TIME_DIFFERENCE
) -> tuple[Trajectory, Trajectory]:
    """The poses of both trajectories (n each) that belong together in time.

    Raises
    ------
    EvaluationError
        If there are fewer than three.
    """
    pairs = associate(estimate.timestamps, truth.timestamps, most)
    if len(pairs) < 3:
        spans = [f"{t.timestamps[0]:.3f} to {t.timestamps[-1]:.3f} s" for t in (estimate, truth)]
        raise EvaluationError(
            f"only {len(pairs)} poses of estimate and truth are within {most:g} s of each other; the "
            f"estimate spans {spans[0]}, the truth {spans[1]}: give the truth of this recording, on its clock"
        )
    rows, columns = pairs.T
    return (
        Trajectory(estimate.timestamps[rows], estimate.world_from_camera[rows]),
        Trajectory(truth.timestamps[columns], truth.world_from_camera[columns]),
    )


def absolute_error(estimate: Trajectory, truth: Trajectory, with_scale: bool) -> AbsoluteError:
    """The absolute trajectory error of matched trajectories after SE(3), or ``with_scale`` Sim(3), alignment.

    Raises
    ------
    EvaluationError
        If the estimated centres coincide, so that no scale fits.
    """
    try:
        alignment = fit_similarity(estimate.positions, truth.positions, with_scale)
    except ValueError as error:
        raise EvaluationError(f"the estimate cannot be aligned with the truth: {error}") from error
    aligned = alignment.apply(estimate.positions)
    return AbsoluteError(alignment, aligned, np.linalg.norm(aligned - truth.positions, axis=1))


def relative_error(
    estimate: Trajectory, truth: Trajectory, interval: float, scale: float = 1.0
) -> RelativeError:
    """The relative pose error of matched trajectories over motions that last ``interval``.

    Motions whose time is off by more than half the usual time between poses, over gaps, are left out.

    Parameters
    ----------
    interval : seconds (frames where trajectories are stamped with frame numbers).
    scale : of the truth over the estimate; multiplies the estimate's translations.

    Raises
    ------
    EvaluationError
        If no motion is that long.
    """
    times = estimate.timestamps
    ends = np.searchsorted(times, times + interval)
    # The neighbour that is nearer in time.
    before, after = np.clip(ends - 1, 0, len(times) - 1), np.clip(ends, 0, len(times) - 1)
    goal = times + interval
    ends = np.where(np.abs(times[before] - goal) < np.abs(times[after] - goal), before, after)
    starts = np.flatnonzero(np.abs(times[ends] - goal) <= 0.5 * np.median(np.diff(times)))
    ends = ends[starts]
    if not len(starts):
        raise EvaluationError(
            f"no two poses of the estimate are {interval:g} s apart: choose another interval"
        )
    scaled = estimate.world_from_camera.copy()
    scaled[:, :3, 3] *= scale
    moved = np.linalg.inv(scaled[starts]) @ scaled[ends]
    expected = np.linalg.inv(truth.world_from_camera[starts]) @ truth.world_from_camera[ends]
    difference = np.linalg.inv(expected) @ moved
    return RelativeError(
        times[starts], np.linalg.norm(difference[:, :3, 3], axis=1), _angles(difference[:, :3, :3])
    )


def _angles(rotations: Array) -> Array:
    """Angles (n,) of rotation matrices (n, 3, 3), radians; exact near zero and near pi."""
    skew = 0.5 * (rotations - rotations.transpose(0, 2, 1))
    sine = np.sqrt(skew[:, 2, 1] ** 2 + skew[:, 0, 2] ** 2 + skew[:, 1, 0] ** 2)
    return np.arctan2(sine, 0.5 * (np.trace(rotations, axis1=1, axis2=2) - 1.0))
