"""The camera as the recording shows it: its intrinsics, lens and readout time, adjusted with a part of the map.

Frames spread over the recording, and points that many of them see, are adjusted together with the camera
(`camera_adjustment`), with the velocities that a rolling shutter needs from the round before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import CameraError
from morph_dslam.even_rows import evenly
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.slam.camera_adjustment import CAMERA_STEPS, Solution, Views, solve
from morph_dslam.slam.camera_terms import (
    CHECKED,
    COLUMNS,
    MATTERS,
    N_UNKNOWNS,
    TERMS,
    CameraEstimate,
    CameraTerm,
    TermEstimate,
    changed,
    prior_std,
    terms_of,
    values_of,
)
from morph_dslam.slam.pose import refine_pose
from morph_dslam.slam.rigid_map import Followed, Indices, RigidMap
from morph_dslam.slam.rolling_shutter import middle_row_pixels, velocities
from morph_dslam.threads import one_thread_for_algebra

Array = NDArray[np.float64]
#: By how much the points (p, 2, c) of a map are off in a frame, pixels, for each of c error factors in its deviation.
OffByFactors = Callable[[], Array]
#: Frames and points that are adjusted, spread over the recording and the most often seen; the fewest that say anything.
MOST_FRAMES, MOST_POINTS, LEAST_FRAMES, LEAST_POINTS = 30, 800, 8, 40
#: Keyframes alone are adjusted where there are so many.
ENOUGH_KEYFRAMES = 10
#: A point counts from so many frames on, a frame from so many of these points on; and the share of the frames chosen
#: that has to count.
LEAST_VIEWS, LEAST_SEEN, LEAST_CONNECTED = 3, 20, 0.8
#: Rounds with the velocities of the round before.
ROUNDS = 3
#: Width of the Huber cost while poses and points are fitted to another camera.
START_HUBER_PX = 20.0
#: A round that lowers the cost by less than this part is the last one.
LEAST_GAIN = 0.01


class _Recording:
    """A path and the map points that its frames saw; gives the frames that are adjusted."""

    def __init__(
        self,
        rigid_map: RigidMap,
        camera: Camera,
        path: Trajectory,
        seen: Sequence[Followed],
        off: Sequence[OffByFactors] | None,
        keyframes_only: bool = False,
    ) -> None:
        self._times, self._seen, self._off = path.timestamps, seen, off
        self._poses = path.camera_from_world.copy()
        self._positions = rigid_map.positions.copy()
        sees_enough = np.array([len(points.ids) >= LEAST_SEEN for points in seen])
        # What keyframes see was measured more exactly; without enough of them any frames have to do.
        exact = np.flatnonzero(sees_enough & np.isin(path.indices, list(rigid_map.seen_in_keyframes())))
        rows = exact if keyframes_only or len(exact) >= ENOUGH_KEYFRAMES else np.flatnonzero(sees_enough)
        self._rows, self._ids = self._chosen(rows, len(rigid_map.state))
        # Frames far apart have few points in common: then those in the middle of the recording have to do.
        while len(rows) > 2 * MOST_FRAMES and len(self._rows) < LEAST_CONNECTED * MOST_FRAMES:
            rows = rows[len(rows) // 4 : -(len(rows) // 4)]
            self._rows, self._ids = self._chosen(rows, len(rigid_map.state))
        beside = np.setdiff1d(np.union1d(self._rows - 1, self._rows + 1), self._rows)
        self._beside = beside[(beside >= 0) & (beside < len(seen))]
        used = np.union1d(self._rows, self._beside).tolist()
        self._recorded = {row: camera.distort_pixels(seen[row].pixels) for row in used}

    def _chosen(self, rows: Indices, n_points: int) -> tuple[Indices, Indices]:
        """Some of the frames, spread, and the points that most of them saw; no frame that saw few of these."""
        rows = rows[evenly(len(rows), MOST_FRAMES)]
        n_views = np.zeros(n_points, dtype=np.int64)
        for row in rows:
            n_views[self._seen[row].ids] += 1
        ids = np.argsort(-n_views, kind="stable")[:MOST_POINTS]
        ids = np.sort(ids[n_views[ids] >= LEAST_VIEWS])
        n_seen = np.array([np.isin(self._seen[row].ids, ids).sum() for row in rows], dtype=np.int64)
        return rows[n_seen >= LEAST_SEEN], ids

    @property
    def has_points(self) -> bool:
        """Whether there are enough points."""
        return len(self._ids) >= LEAST_POINTS

    @property
    def is_enough(self) -> bool:
        """Whether there are enough frames and points."""
        return len(self._rows) >= LEAST_FRAMES and self.has_points

    def views(self) -> Views:
        """The chosen frames and points as they are now."""
        local = np.full(len(self._positions), -1)
        local[self._ids] = np.arange(len(self._ids))
        chosen = [local[self._seen[row].ids] for row in self._rows]
        kept = [ids >= 0 for ids in chosen]
        return Views(
            self._poses[self._rows],
            np.nan_to_num(velocities(self._times, self._poses)[self._rows]),
            self._positions[self._ids],
            np.repeat(np.arange(len(chosen)), [int(rows.sum()) for rows in kept]),
            np.concatenate([ids[rows] for ids, rows in zip(chosen, kept, strict=True)]),
            np.concatenate([self._recorded[row][rows] for row, rows in zip(self._rows, kept, strict=True)]),
            np.concatenate([self._off_in(row)[rows] for row, rows in zip(self._rows, kept, strict=True)]),
        )

    def _off_in(self, row: int) -> Array:
        """By how much the points of a frame (p, 2, c) are off for each error factor, pixels."""
        seen = self._seen[row]
        return np.zeros((len(seen.ids), 2, 0)) if self._off is None else self._off[row]()[seen.ids]

    def take_over(self, views: Views, camera: Camera) -> None:
        """Take the adjusted poses and points, and place the frames beside them anew: velocities rest on these."""
        self._positions[self._ids], before = views.points, velocities(self._times, self._poses)
        self._poses[self._rows] = views.poses
        for row in self._beside:
            known = np.isin(self._seen[row].ids, self._ids)
            points = self._positions[self._seen[row].ids[known]]
            pixels = camera.undistort_pixels(self._recorded[row][known])
            pixels = middle_row_pixels(camera, self._poses[row], before[row], points, pixels)
            good = np.isfinite(pixels).all(axis=1)
            estimate = refine_pose(self._poses[row], points[good], pixels[good], camera.intrinsics)
            if np.isfinite(estimate.rms_px):
                self._poses[row] = estimate.camera_from_world


@one_thread_for_algebra
def estimate_camera(
    rigid_map: RigidMap,
    camera: Camera,
    path: Trajectory,
    seen: Sequence[Followed],
    terms: Sequence[CameraTerm] = CHECKED,
    off: Sequence[OffByFactors] | None = None,
) -> CameraEstimate:
    """Terms of a camera from the frames of a recording; as known before where there are too few frames or points.

    Parameters
    ----------
    rigid_map : made with ``camera``
    path : of the camera
    seen : the map points in each of its frames
    terms : to estimate; the others stay, and a fisheye has no tangential ones
    off : how what was seen in each frame is off by errors that are the same in all of them; these are estimated
        with the camera, as far as their deviations let them.
    """
    terms = terms_of(camera, terms)
    recording = _Recording(rigid_map, camera, path, seen, off)
    if not recording.is_enough:
        return _as_before(camera, terms)
    free = np.array(sorted(column for term in terms for column in COLUMNS[term]))
    try:
        solution = _start(recording.views(), camera, "radial" in terms)
        for _ in range(ROUNDS):
            recording.take_over(solution.views, changed(camera, solution.unknowns))
            views = recording.views()
            factors = np.arange(N_UNKNOWNS, N_UNKNOWNS + views.off.shape[2])
            solution = solve(views, camera, solution.unknowns, np.append(free, factors))
    except (np.linalg.LinAlgError, CameraError):
        return _as_before(camera, terms)  # what the frames have in common determines nothing, or no possible camera
    return _estimate(camera, solution, free, terms)


@dataclass(frozen=True)
class KeyframeFit:
    """By how much the points of keyframes miss, once these, the points and the camera are adjusted together.

    Attributes
    ----------
    pixels : (o, 2) where points were seen, as recorded
    misses : (o, 2) pixels
    frame_idx : (o,) in which of the keyframes
    """

    pixels: Array
    misses: Array
    frame_idx: Indices


def fit_keyframes(
    rigid_map: RigidMap, camera: Camera, estimated: Camera, path: Trajectory, seen: Sequence[Followed]
) -> KeyframeFit | None:
    """The keyframes of a map and a camera with all of its terms, adjusted together; None where points are few.

    From a camera that is far off the way down the cost is long, and what is left on it looks like a scene that moves.

    Parameters
    ----------
    rigid_map : made with ``camera``
    camera : that the map was made with
    estimated : to begin with
    path : of the camera
    seen : the map points in each of its frames
    """
    recording = _Recording(rigid_map, camera, path, seen, None, keyframes_only=True)
    if not recording.has_points:
        return None
    free = np.array(sorted(column for term in terms_of(camera, TERMS) for column in COLUMNS[term]))
    solution = solve(recording.views(), estimated, np.zeros(N_UNKNOWNS), free[:0], START_HUBER_PX)
    before = np.inf
    for _ in range(ROUNDS):
        recording.take_over(solution.views, changed(estimated, solution.unknowns))
        solution = solve(recording.views(), estimated, solution.unknowns, free)
        if solution.cost > (1.0 - LEAST_GAIN) * before:
            break
        before = solution.cost
    views = solution.views
    return KeyframeFit(views.recorded, views.residuals(estimated, solution.unknowns), views.frame_idx)


def _as_before(camera: Camera, terms: Sequence[CameraTerm]) -> CameraEstimate:
    """The given camera, all of it unobservable."""
    std, estimates = prior_std(camera), dict[CameraTerm, TermEstimate]()
    for term in terms:
        values = values_of(camera, term)
        part = std[COLUMNS[term]] * (camera.fx if term == "focal" else 1.0)
        estimates[term] = TermEstimate(values, values, tuple(part.tolist()), 0.0, np.inf, MATTERS[term])
    return CameraEstimate(camera, estimates)


def _start(views: Views, camera: Camera, with_lens: bool) -> Solution:
    """Poses and points of the given camera; of one without lens, or with the opposite one, if these fit better.

    From the wrong sign of a strong lens the way down the cost does not lead to the right one.
    """
    starts = np.zeros((3 if with_lens and camera.distortion else 1, N_UNKNOWNS + views.off.shape[2]))
    starts[:, 3:5] = -np.outer(np.arange(len(starts)), values_of(camera, "radial"))
    none_free = np.empty(0, dtype=np.int64)
    solutions = [solve(views, camera, start, none_free, START_HUBER_PX) for start in starts]
    return min(solutions, key=lambda solution: solution.cost)


def _estimate(camera: Camera, solution: Solution, free: Indices, terms: Sequence[CameraTerm]) -> CameraEstimate:
    covariance = np.zeros((N_UNKNOWNS, N_UNKNOWNS))
    covariance[np.ix_(free, free)] = solution.covariance[: len(free), : len(free)]
    half_diagonal = 0.5 * float(np.hypot(camera.width, camera.height))
    found = changed(camera, solution.unknowns)
    estimates: dict[CameraTerm, TermEstimate] = {}
    effects = _effects(camera, solution.views)
    for term in terms:
        columns, directions = COLUMNS[term], effects[term]
        part = covariance[np.ix_(columns, columns)]
        matters = MATTERS[term] * (half_diagonal if term in ("centre", "radial", "tangential") else 1.0)
        estimates[term] = TermEstimate(
            values_of(camera, term),
            values_of(found, term),
            tuple((np.sqrt(np.diag(part)) * (found.fx if term == "focal" else 1.0)).tolist()),
            float(np.linalg.norm(directions @ solution.unknowns[columns])),
            float(np.sqrt(np.trace(part @ (directions.T @ directions)))),
            matters,
        )
    return CameraEstimate(found, estimates)


def _effects(camera: Camera, views: Views) -> dict[CameraTerm, Array]:
    """By what matrix (k, unknowns of the term) a term's change moves the image: the length of what it gives counts."""
    columns, rows = np.meshgrid(np.linspace(0, camera.width - 1, 17), np.linspace(0, camera.height - 1, 13))
    rays = camera.rays(camera.undistort_pixels(np.column_stack([columns.ravel(), rows.ravel()])))
    rays = rays[np.isfinite(rays).all(axis=1)]
    steps = [step * np.eye(N_UNKNOWNS)[k] for k, step in enumerate(CAMERA_STEPS)]
    by_lens = [
        (changed(camera, steps[k]).project_recorded(rays) - camera.project_recorded(rays)).ravel() / CAMERA_STEPS[k]
        for k in (*COLUMNS["radial"], *COLUMNS["tangential"])
    ]
    radial, tangential = np.hsplit(np.column_stack(by_lens) / np.sqrt(len(rays)), 2)
    by_readout = views.derivatives(camera, np.zeros(N_UNKNOWNS))[2][:, :, 7]
    return {
        "focal": np.eye(1),
        "centre": np.eye(2),
        "radial": radial,
        "tangential": tangential,
        "readout": by_readout.reshape(-1, 1) / np.sqrt(len(by_readout)),
    }
