"""The camera as the recording shows it: its intrinsics, lens and readout time as unknowns of bundle adjustment.

Poses, points and camera are adjusted together with a prior on the camera (Triggs et al., Bundle Adjustment - A Modern
Synthesis, 2000); poses and points are eliminated. Residuals of one point in many images are alike, as are those of one
image: deviations are those of clusters of residuals by point and by image (Cameron and Miller, A Practitioner's Guide
to Cluster-Robust Inference, 2015), not of independent pixels. Errors of known size that are alike in all images are
further unknowns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from morph_dslam.camera import LONGEST_READOUT_S, Camera
from morph_dslam.errors import CameraError
from morph_dslam.geometry import cross_matrix
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.slam.local_map import HUBER_RATIO, LEAST_HUBER_PX, MOST_HUBER_PX
from morph_dslam.slam.pose import refine_pose
from morph_dslam.slam.rigid_map import Followed, Indices, RigidMap
from morph_dslam.slam.rolling_shutter import after, middle_row_pixels, row_times, velocities
from morph_dslam.threads import one_thread_for_algebra

Array = NDArray[np.float64]
#: By how much the points (p, 2, c) of a map are off in a frame, pixels, for each of c error factors in its deviation.
OffByFactors = Callable[[], Array]
#: What can be estimated of a camera.
CameraTerm = Literal["focal", "centre", "radial", "tangential", "readout"]
TERMS: tuple[CameraTerm, ...] = get_args(CameraTerm)
#: What a check estimates: tangential terms that matter are rare, and hide a principal point that is wrong.
CHECKED: tuple[CameraTerm, ...] = ("focal", "centre", "radial", "readout")
#: Unknowns of each term: logarithm of the focal length, principal point in pixels, k1 and k2, p1 and p2, seconds.
COLUMNS: dict[CameraTerm, list[int]] = {
    "focal": [0], "centre": [1, 2], "radial": [3, 4], "tangential": [5, 6], "readout": [7],
}  # fmt: skip
N_UNKNOWNS = 8
#: Standard deviations of the unknowns before anything is measured, the principal point's in image widths.
#: Elements of a lens are centred so well that p1 and p2 of a calibration are seldom above two thousandths.
PRIOR_STD = np.array([0.3, 0.1, 0.1, 0.3, 0.3, 0.002, 0.002, 0.03])
#: Frames and points that are adjusted, spread over the recording and the most often seen; the fewest that say anything.
MOST_FRAMES, MOST_POINTS, LEAST_FRAMES, LEAST_POINTS = 30, 800, 8, 40
#: Keyframes alone are adjusted where there are so many.
ENOUGH_KEYFRAMES = 10
#: A point counts from so many frames on, a frame from so many of these points on; and the share of the frames chosen
#: that has to count.
LEAST_VIEWS, LEAST_SEEN, LEAST_CONNECTED = 3, 20, 0.8
#: Rounds with the velocities of the round before; iterations in each, which end with a gain below this part.
ROUNDS, ITERATIONS, LEAST_GAIN = 3, 15, 1e-4
#: All images together count for so many independent points where they tell of error factors.
EFFECTIVE_POINTS = 30.0
#: Width of the Huber cost while poses and points are fitted to another camera.
START_HUBER_PX = 20.0
#: Steps of the numerical derivatives: of a point, in depths, and of the camera's unknowns.
POINT_STEP, CAMERA_STEPS = 1e-5, np.array([1e-6, 1e-3, 1e-3, 1e-6, 1e-6, 1e-6, 1e-6])
#: A departure is named if it exceeds so many standard deviations and matters: as a part of the focal length; of half
#: the image's diagonal, for the principal point and for the lens (root mean square over the image); in pixels that
#: the points move by, for the readout time.
SIGNIFICANT = 3.0
MATTERS: dict[CameraTerm, float] = {"focal": 0.03, "centre": 0.03, "radial": 0.02, "tangential": 0.02, "readout": 0.5}
#: A term is unobservable if two deviations exceed so many times what matters.
UNOBSERVABLE = 3.0


@dataclass(frozen=True)
class TermEstimate:
    """One term of a camera as a recording shows it.

    Attributes
    ----------
    given, estimated, std : of its values: fx in pixels, (cx, cy) in pixels, (k1, k2), (p1, p2), seconds
    departure, departure_std : between both, as a part of the focal length, in pixels of the principal point, in pixels
        of the lens (root mean square over the image), in pixels that points move by while the image is read out
    matters : from where on a departure matters, in the same unit
    """

    given: tuple[float, ...]
    estimated: tuple[float, ...]
    std: tuple[float, ...]
    departure: float
    departure_std: float
    matters: float

    def facts(self) -> dict[str, list[float] | bool]:
        """Of the summary."""
        values = {name: list(getattr(self, name)) for name in ("given", "estimated", "std")}
        return values | {"is_wrong": self.is_wrong, "is_observable": self.is_observable}

    @property
    def is_refuted(self) -> bool:
        """Whether the recording contradicts the given value, by much or by little."""
        return self.departure > SIGNIFICANT * self.departure_std

    @property
    def is_wrong(self) -> bool:
        """Whether the given value is refuted, and matters."""
        return self.is_refuted and self.departure > self.matters

    @property
    def is_observable(self) -> bool:
        """Whether the recording would show a value that is wrong by much."""
        return 2.0 * self.departure_std < UNOBSERVABLE * self.matters


@dataclass(frozen=True)
class CameraEstimate:
    """A camera as a recording shows it.

    Attributes
    ----------
    camera : with the terms that were free as estimated
    terms : those that were free
    """

    camera: Camera
    terms: dict[CameraTerm, TermEstimate]


def changed(camera: Camera, unknowns: Array) -> Camera:
    """The camera with its unknowns (8,) changed by so much."""
    factor, distortion = float(np.exp(unknowns[0])), camera.distortion
    if unknowns[3:7].any():
        given = distortion or (0.0,) * 4
        distortion = (*(value + float(change) for value, change in zip(given, unknowns[3:7], strict=False)), *given[4:])
    readout = float(np.clip(camera.readout_s + unknowns[7], -LONGEST_READOUT_S, LONGEST_READOUT_S))
    return replace(
        camera,
        fx=factor * camera.fx,
        fy=factor * camera.fy,
        cx=camera.cx + float(unknowns[1]),
        cy=camera.cy + float(unknowns[2]),
        distortion=distortion,
        readout_s=readout,
    )


def terms_of(camera: Camera, terms: Sequence[CameraTerm] = TERMS) -> list[CameraTerm]:
    """Those of the terms that a camera has: a fisheye has no tangential ones."""
    return [term for term in terms if term != "tangential" or camera.lens_model == "radial-tangential"]


def with_terms_of(camera: Camera, other: Camera, terms: Sequence[CameraTerm]) -> Camera:
    """The camera with some terms of another one."""
    fields = {"focal": ("fx", "fy"), "centre": ("cx", "cy"), "readout": ("readout_s",)}
    result = replace(camera, **{name: getattr(other, name) for term in terms for name in fields.get(term, ())})
    return replace(result, distortion=_lens_of(camera.distortion, other.distortion, terms))


def _lens_of(own: tuple[float, ...], other: tuple[float, ...], terms: Sequence[CameraTerm]) -> tuple[float, ...]:
    """Coefficients with some terms of another lens; a lens without coefficients has zeros."""
    count = max(len(own), len(other), 4)
    pairs = zip(*(lens + (0.0,) * (count - len(lens)) for lens in (own, other)), strict=True)
    mixed = tuple(theirs if _term_of(k) in terms else mine for k, (mine, theirs) in enumerate(pairs))
    same = (lens for lens in (own, other) if mixed == lens + (0.0,) * (count - len(lens)))
    return next(same, mixed)


def _term_of(coefficient: int) -> CameraTerm:
    """The term that a coefficient of a radial-tangential lens belongs to."""
    return "tangential" if coefficient in (2, 3) else "radial"


@dataclass
class _Views:
    """Chosen frames, what they saw, and where they and the points are.

    Attributes
    ----------
    poses : (f, 4, 4) camera_from_world.
    twists : (f, 6) per second; zero where unknown.
    points : (p, 3).
    frame_idx, point_idx : (o,), each pair once.
    recorded : (o, 2) pixels.
    off : (o, 2, c) by how much ``recorded`` is off, pixels, for each of c error factors, in their deviations.
    """

    poses: Array
    twists: Array
    points: Array
    frame_idx: Indices
    point_idx: Indices
    recorded: Array
    off: Array

    def local(self) -> Array:
        """Points (o, 3) in the axes of their cameras at the middle rows' instants."""
        poses = self.poses[self.frame_idx]
        return np.einsum("oij,oj->oi", poses[:, :3, :3], self.points[self.point_idx]) + poses[:, :3, 3]

    def residuals(self, given: Camera, unknowns: Array) -> Array:
        """(o, 2) pixels, of a camera changed by so much (8 + c,); of a point that it cannot see far off."""
        camera = changed(given, unknowns)
        seconds = camera.readout_s * row_times(self.recorded[:, 1], camera)
        seen = after(self.local(), self.twists[self.frame_idx], seconds)
        off = camera.project_recorded(seen) - self.recorded + self.off @ unknowns[N_UNKNOWNS:]
        return np.nan_to_num(off, nan=1e3)

    def moved(self, pose_steps: Array, point_steps: Array) -> _Views:
        """With twists of the poses (f, 6) and shifts of the points (p, 3)."""
        poses = self.poses.copy()
        poses[:, :3] = Rotation.from_rotvec(pose_steps[:, :3]).as_matrix() @ poses[:, :3]
        poses[:, :3, 3] += pose_steps[:, 3:]
        return replace(self, poses=poses, points=self.points + point_steps)

    def derivatives(self, given: Camera, unknowns: Array) -> tuple[Array, Array, Array]:
        """Of the residuals by pose twists (o, 2, 6), points (o, 2, 3) and unknowns (o, 2, 8 + c)."""
        camera, twists, local = changed(given, unknowns), self.twists[self.frame_idx], self.local()
        times = row_times(self.recorded[:, 1], camera)
        seen = after(local, twists, camera.readout_s * times)
        steps = POINT_STEP * seen[:, 2:]
        by_seen = np.stack(
            [
                (camera.project_recorded(seen + steps * axis) - camera.project_recorded(seen - steps * axis))
                / (2.0 * steps)
                for axis in np.eye(3)
            ],
            axis=2,
        )
        by_local = by_seen @ Rotation.from_rotvec(twists[:, :3] * (camera.readout_s * times)[:, None]).as_matrix()
        by_pose = np.concatenate([-by_local @ cross_matrix(local), by_local], axis=2)
        by_point = by_local @ self.poses[self.frame_idx][:, :3, :3]
        by_camera = np.empty((len(local), 2, N_UNKNOWNS))
        for column, step in enumerate(CAMERA_STEPS):
            change = step * np.eye(len(unknowns))[column]
            upper, lower = changed(given, unknowns + change), changed(given, unknowns - change)
            by_camera[:, :, column] = (upper.project_recorded(seen) - lower.project_recorded(seen)) / (2.0 * step)
        velocity = np.cross(twists[:, :3], seen) + twists[:, 3:]
        by_camera[:, :, 7] = np.einsum("oij,oj->oi", by_seen, velocity) * times[:, None]
        by_unknowns = np.concatenate([by_camera, self.off], axis=2)
        return np.nan_to_num(by_pose), np.nan_to_num(by_point), np.nan_to_num(by_unknowns)


class _Normal:
    """Normal equations of poses and camera after the points are eliminated.

    Parameters
    ----------
    views : with f frames and p points
    residuals : (o, 2) and their ``weights`` (o,).
    derivatives : as of `_Views.derivatives`, of the camera's s free unknowns only
    information : (s,) of the prior; ``offsets`` (s,) how far the unknowns are from it
    damping : as a part of the diagonal
    """

    def __init__(
        self,
        views: _Views,
        residuals: Array,
        weights: Array,
        derivatives: tuple[Array, Array, Array],
        information: Array,
        offsets: Array,
        damping: float,
    ) -> None:
        self._views, self._residuals, self._weights, self._derivatives = views, residuals, weights, derivatives
        (by_pose, by_point, by_camera), n_frames, n_points = derivatives, len(views.poses), len(views.points)
        frame, point, n = views.frame_idx, views.point_idx, 6 * n_frames
        self._n, size = n, n + by_camera.shape[2]
        scaled = weights[:, None, None] * by_pose, weights[:, None, None] * by_point
        blocks, poses = np.zeros((n_frames, 6, 6)), np.zeros((n_frames, 6, by_camera.shape[2]))
        np.add.at(blocks, frame, by_pose.transpose(0, 2, 1) @ scaled[0])
        np.add.at(poses, frame, scaled[0].transpose(0, 2, 1) @ by_camera)
        matrix = np.zeros((size, size))
        for f in range(n_frames):
            matrix[6 * f : 6 * f + 6, 6 * f : 6 * f + 6] = blocks[f]
        matrix[:n, n:] = poses.reshape(n, -1)
        matrix[n:, :n] = matrix[:n, n:].T
        matrix[n:, n:] = np.einsum("o,oki,okj->ij", weights, by_camera, by_camera) + np.diag(information)
        right = np.zeros(size)
        np.add.at(right[:n].reshape(-1, 6), frame, -np.einsum("oki,ok->oi", scaled[0], residuals))
        right[n:] = -np.einsum("o,oki,ok->i", weights, by_camera, residuals) - information * offsets
        of_points, point_right = np.zeros((n_points, 3, 3)), np.zeros((n_points, 3))
        np.add.at(of_points, point, by_point.transpose(0, 2, 1) @ scaled[1])
        np.add.at(point_right, point, -np.einsum("oki,ok->oi", scaled[1], residuals))
        cross = np.zeros((n_frames, 6, n_points, 3))
        cross[frame, :, point] = by_pose.transpose(0, 2, 1) @ scaled[1]
        camera_cross = np.zeros((n_points, by_camera.shape[2], 3))
        np.add.at(camera_cross, point, by_camera.transpose(0, 2, 1) @ scaled[1])
        cross = np.concatenate([cross.reshape(n, -1), camera_cross.transpose(1, 0, 2).reshape(size - n, 3 * n_points)])
        # A ridge as part of the mean keeps the scale, which nothing determines, where it is.
        of_points += damping * of_points * np.eye(3) + 1e-9 * of_points.trace(axis1=1, axis2=2).mean() * np.eye(3)
        self._inverse, self._cross, self._point_right = np.linalg.inv(of_points), cross, point_right
        carried = (cross.reshape(size, n_points, 1, 3) @ self._inverse).reshape(size, -1)
        reduced = matrix + np.diag((damping + 1e-9) * np.diag(matrix)) - carried @ cross.T
        right = right - carried @ point_right.ravel()
        # The first pose is held.
        reduced[:6], reduced[:, :6], right[:6] = 0.0, 0.0, 0.0
        reduced[range(6), range(6)] = 1.0
        self._reduced, self._right = reduced, right

    def step(self) -> tuple[Array, Array, Array]:
        """Twists of the poses (f, 6), shifts of the points (p, 3), change of the camera's unknowns (s,)."""
        step = np.linalg.solve(self._reduced, self._right)
        rest = self._point_right - (self._cross.T @ step).reshape(-1, 3)
        return step[: self._n].reshape(-1, 6), np.einsum("pij,pj->pi", self._inverse, rest), step[self._n :]

    def covariance(self, information: Array, prior_std: Array) -> Array:
        """Of the unknowns (s, s), by clusters of residuals, and by a prior (s,) of such deviations and information."""
        views, (by_pose, by_point, by_camera) = self._views, self._derivatives
        size, n = len(self._reduced), self._n
        inverse = np.linalg.solve(self._reduced, np.eye(size)[:, n:])
        of_points = self._inverse @ (self._cross.T @ inverse).reshape(len(self._inverse), 3, size - n)
        influence = by_pose @ inverse[:n].reshape(len(views.poses), 6, size - n)[views.frame_idx]
        influence = influence + by_camera @ inverse[n:] - by_point @ of_points[views.point_idx]
        scores = np.einsum("o,oki,ok->oi", self._weights, influence, self._residuals)
        result = inverse[n:].T @ np.diag((information * prior_std) ** 2) @ inverse[n:]
        n_residuals, n_unknowns = 2 * len(scores), 3 * len(views.points) + size
        for groups in (views.frame_idx, views.point_idx):
            sums = np.zeros((groups.max() + 1, size - n))
            np.add.at(sums, groups, scores)
            result += sums.T @ sums * n_residuals / max(n_residuals - n_unknowns, 1)
        return result


@dataclass(frozen=True)
class _Solution:
    """Views, the unknowns (8 + c,), the covariance (s, s) of those that were free, and the cost, px^2."""

    views: _Views
    unknowns: Array
    covariance: Array
    cost: float


def _solve(views: _Views, given: Camera, unknowns: Array, free: Indices, huber_px: float | None = None) -> _Solution:
    """Levenberg-Marquardt on the Huber cost, of the width that fits the errors by default, and the prior."""
    errors = np.linalg.norm(views.residuals(given, unknowns), axis=1)
    usual = float(np.median(errors))
    width = huber_px or min(max(HUBER_RATIO * usual, LEAST_HUBER_PX), MOST_HUBER_PX)
    # The median length of two normal deviations is 1.18 of their standard deviation.
    variance = max(usual / 1.18, 0.1) ** 2
    prior_std = np.append(_prior_std(given), np.ones(len(unknowns) - N_UNKNOWNS))
    information = variance / prior_std[free] ** 2
    # What residuals have in common in all images tells less of the factors than as many independent ones would.
    information[free >= N_UNKNOWNS] *= max(len(views.recorded) / EFFECTIVE_POINTS, 1.0)

    def cost(views: _Views, unknowns: Array) -> float:
        errors = np.linalg.norm(views.residuals(given, unknowns), axis=1)
        terms = np.where(errors < width, 0.5 * errors**2, width * (errors - 0.5 * width))
        return float(terms.sum() + 0.5 * information @ unknowns[free] ** 2)

    def normal(damping: float) -> _Normal:
        residuals = views.residuals(given, unknowns)
        weights = np.minimum(1.0, width / np.maximum(np.linalg.norm(residuals, axis=1), 1e-12))
        by_pose, by_point, by_camera = views.derivatives(given, unknowns)
        derivatives = by_pose, by_point, by_camera[:, :, free]
        return _Normal(views, residuals, weights, derivatives, information, unknowns[free], damping)

    damping, before = 1e-4, cost(views, unknowns)
    for _ in range(ITERATIONS):
        pose_steps, point_steps, step = normal(damping).step()
        new_views, new_unknowns = views.moved(pose_steps, point_steps), unknowns.copy()
        new_unknowns[free] += step
        now = cost(new_views, new_unknowns)
        if not now < before:
            damping *= 10.0
            continue
        gain, views, unknowns, before = (before - now) / before, new_views, new_unknowns, now
        damping = max(0.1 * damping, 1e-9)
        if gain < LEAST_GAIN:
            break
    return _Solution(views, unknowns, normal(0.0).covariance(information, prior_std[free]), before)


class _Recording:
    """A path and the map points that its frames saw; gives the frames that are adjusted."""

    def __init__(
        self,
        rigid_map: RigidMap,
        camera: Camera,
        path: Trajectory,
        seen: Sequence[Followed],
        off: Sequence[OffByFactors] | None,
    ) -> None:
        self._camera, self._times, self._seen, self._off = camera, path.timestamps, seen, off
        self._poses = path.camera_from_world.copy()
        self._positions = rigid_map.positions.copy()
        sees_enough = np.array([len(points.ids) >= LEAST_SEEN for points in seen])
        # What keyframes see was measured more exactly; without enough of them any frames have to do.
        exact = np.flatnonzero(sees_enough & np.isin(path.indices, list(rigid_map.seen_in_keyframes())))
        rows = exact if len(exact) >= ENOUGH_KEYFRAMES else np.flatnonzero(sees_enough)
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
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MOST_FRAMES)).astype(int))]
        n_views = np.zeros(n_points, dtype=np.int64)
        for row in rows:
            n_views[self._seen[row].ids] += 1
        ids = np.argsort(-n_views, kind="stable")[:MOST_POINTS]
        ids = np.sort(ids[n_views[ids] >= LEAST_VIEWS])
        n_seen = np.array([np.isin(self._seen[row].ids, ids).sum() for row in rows], dtype=np.int64)
        return rows[n_seen >= LEAST_SEEN], ids

    @property
    def is_enough(self) -> bool:
        """Whether there are enough frames and points."""
        return len(self._rows) >= LEAST_FRAMES and len(self._ids) >= LEAST_POINTS

    def views(self) -> _Views:
        """The chosen frames and points as they are now."""
        local = np.full(len(self._positions), -1)
        local[self._ids] = np.arange(len(self._ids))
        chosen = [local[self._seen[row].ids] for row in self._rows]
        kept = [ids >= 0 for ids in chosen]
        return _Views(
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

    def take_over(self, views: _Views, camera: Camera) -> None:
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
            solution = _solve(views, camera, solution.unknowns, np.append(free, factors))
    except (np.linalg.LinAlgError, CameraError):
        return _as_before(camera, terms)  # what the frames have in common determines nothing, or no possible camera
    return _estimate(camera, solution, free, terms)


def _prior_std(camera: Camera) -> Array:
    """Standard deviations (6,) of the unknowns before anything is measured."""
    return PRIOR_STD * np.where(np.isin(np.arange(N_UNKNOWNS), COLUMNS["centre"]), camera.width, 1.0)


def _as_before(camera: Camera, terms: Sequence[CameraTerm]) -> CameraEstimate:
    """The given camera, all of it unobservable."""
    std, estimates = _prior_std(camera), dict[CameraTerm, TermEstimate]()
    for term in terms:
        values = _values(camera, term)
        part = std[COLUMNS[term]] * (camera.fx if term == "focal" else 1.0)
        estimates[term] = TermEstimate(values, values, tuple(part.tolist()), 0.0, np.inf, MATTERS[term])
    return CameraEstimate(camera, estimates)


def _start(views: _Views, camera: Camera, with_lens: bool) -> _Solution:
    """Poses and points of the given camera; of one without lens, or with the opposite one, if these fit better.

    From the wrong sign of a strong lens the way down the cost does not lead to the right one.
    """
    starts = np.zeros((3 if with_lens and camera.distortion else 1, N_UNKNOWNS + views.off.shape[2]))
    starts[:, 3:5] = -np.outer(np.arange(len(starts)), _values(camera, "radial"))
    none_free = np.empty(0, dtype=np.int64)
    solutions = [_solve(views, camera, start, none_free, START_HUBER_PX) for start in starts]
    return min(solutions, key=lambda solution: solution.cost)


def _estimate(camera: Camera, solution: _Solution, free: Indices, terms: Sequence[CameraTerm]) -> CameraEstimate:
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
            _values(camera, term),
            _values(found, term),
            tuple((np.sqrt(np.diag(part)) * (found.fx if term == "focal" else 1.0)).tolist()),
            float(np.linalg.norm(directions @ solution.unknowns[columns])),
            float(np.sqrt(np.trace(part @ (directions.T @ directions)))),
            matters,
        )
    return CameraEstimate(found, estimates)


def _values(camera: Camera, term: CameraTerm) -> tuple[float, ...]:
    k1, k2, p1, p2, *_ = camera.distortion or (0.0,) * 4
    values: dict[CameraTerm, tuple[float, ...]] = {
        "focal": (camera.fx,),
        "centre": (camera.cx, camera.cy),
        "radial": (k1, k2),
        "tangential": (p1, p2),
        "readout": (camera.readout_s,),
    }
    return values[term]


def _effects(camera: Camera, views: _Views) -> dict[CameraTerm, Array]:
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
