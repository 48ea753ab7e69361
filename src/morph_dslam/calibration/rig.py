"""Where the cameras of a rig are, from views of one board that several cameras saw in the same frames.

Each camera is calibrated by itself. Then the cameras' poses, and the board's in each frame, are those of least squared
distances of all corners (bundle adjustment with the intrinsics held). What the intrinsics are off turns a camera by the
error of its principal point, and moves it along its axis by that of its focal length: the deviations contain both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import lil_matrix

from morph_dslam.calibration.board import CalibrationBoard
from morph_dslam.calibration.calibrate import Calibration, check_output, plot_calibration
from morph_dslam.calibration.solve import HARMLESS, OUTLIER_RATIO, solve_intrinsics
from morph_dslam.calibration.views import View, best_views, find_views, sampling_step, select_by_coverage
from morph_dslam.camera import Camera, LensModel
from morph_dslam.errors import CameraError
from morph_dslam.geometry import RigidTransform, rotation_exp, rotation_log
from morph_dslam.io.camera_files import save_rig
from morph_dslam.io.writing import writing

Array = NDArray[np.float64]
#: So many frames that two cameras share place one by the other.
FEWEST_SHARED = 3
#: A larger residual than this, pixels, says that frames of one number do not belong together.
LARGE_RMS = 1.0
#: Above this residual, pixels, the cameras' poses are of no use, and none is written.
USELESS_RMS = 10.0


@dataclass(frozen=True)
class RigCalibration:
    """The cameras of a rig.

    Attributes
    ----------
    cameras : (n) calibration of each by itself.
    camera_from_first : (n) poses; the first one is the identity.
    deviations : (n, 2) standard deviations of each pose: translation, metres, and angle, radians, along and about the
        axis that is known worst; 0 of the first.
    rms_px : root mean square residual of the corners in the frames that cameras share.
    frames : numbers of the frames used.
    left_out : numbers of frames that do not fit the others.
    """

    cameras: tuple[Calibration, ...]
    camera_from_first: tuple[RigidTransform, ...]
    deviations: Array
    rms_px: float
    frames: tuple[int, ...]
    left_out: tuple[int, ...]

    def remarks(self) -> list[str]:
        """What the user should know before relying on it."""
        said = []
        if self.left_out:
            said.append(f"frames that do not fit the others were left out: {', '.join(map(str, self.left_out))}")
        if self.rms_px > LARGE_RMS:
            said.append(self._large())
        return said

    def _large(self) -> str:
        return (
            f"the residual of {self.rms_px:.2f} pixels is large: frames of one number are to be of one instant; "
            "hold the board still, or start the cameras together"
        )

    def check(self) -> None:
        """Raise CameraError if the cameras' views of the board contradict each other."""
        if self.rms_px > USELESS_RMS:
            raise CameraError(f"the cameras' views of the board do not go together: {self._large()}")

    def table(self) -> str:
        """Where each camera is, by the one before it."""
        lines = []
        for number in range(1, len(self.cameras)):
            before, own = self.camera_from_first[number - 1 : number + 1]
            pose, (shift, turn) = own @ before.inverse, self.deviations[number]
            apart, angle = np.linalg.norm(pose.translation), np.linalg.norm(rotation_log(pose.rotation))
            lines.append(
                f"cam{number}: {1e3 * apart:.2f} mm from cam{number - 1} and turned by {np.degrees(angle):.2f} degrees "
                f"(deviations from cam0: {1e3 * shift:.2f} mm, {np.degrees(turn):.3f} degrees)"
            )
        return "\n".join(lines)

    def line(self) -> str:
        """The one line that sums it up."""
        searched = len(self.frames) + len(self.left_out)
        return f"cameras={len(self.cameras)} frames={len(self.frames)}/{searched} rms_px={self.rms_px:.3f}"


def calibrate_rig(
    sources: Sequence[Sequence[str | Path]],
    board: CalibrationBoard,
    output: str | Path | None = None,
    lens_model: LensModel = "radial-tangential",
) -> RigCalibration:
    """Calibrate several cameras that are fixed to each other.

    Parameters
    ----------
    sources : of each camera images, one folder of images, or one video or other recording. Frames with the same number,
        of a video its position, are of one instant.
    board : that they show; several cameras see it at once in some frames.
    output : the Kalibr camchain to write, and beside it a picture of each camera's residuals; None to write nothing.
    lens_model : of all cameras.

    Raises CameraError as `calibrate`, and if the board has no orientation, two images of a camera have one number or
    one has none, a camera shares too few frames with the others, or what they saw is not of the same instants. Raises
    SourceError as `calibrate`.
    """
    if not board.has_one_orientation:
        raise CameraError(
            "cameras may see this board turned by half a turn: take one with one count of corners even and the other "
            "odd, or a board of markers"
        )
    places = None if output is None else [_picture(Path(output), number) for number in range(len(sources))]
    paths = [[Path(source) for source in of_camera] for of_camera in sources]
    step, cameras, seen = max(sampling_step(of_camera) for of_camera in paths), [], []
    for number, of_camera in enumerate(paths):
        picture = None if places is None else places[number]
        found = find_views(of_camera, board, picture, step)
        best = best_views(found)
        cameras.append(Calibration(solve_intrinsics(best.views, board, best.size, lens_model), best, board, picture))
        seen.append(_by_number(_with_shape(found.views, cameras[0].solution.shape)))
    rig = solve_rig(cameras, seen)
    rig.check()
    if output is not None:
        lenses = [calibration.solution.camera for calibration in cameras]
        with writing(CameraError, Path(output)):
            save_rig(Path(output), list(zip(lenses, rig.camera_from_first, strict=True)))
            for calibration in cameras:
                assert calibration.picture is not None
                plot_calibration(calibration.picture, calibration.solution)
    return rig


def _picture(output: Path, number: int) -> Path:
    picture = check_output(output)
    return picture.with_name(f"{output.stem}_cam{number}_calibration.png")


def _with_shape(views: Sequence[View], shape: Array | None) -> Sequence[View]:
    """Views of the whole board as the first camera solved for its corners, if it did."""
    return views if shape is None else [replace(view, points=shape) for view in views]


def _by_number(views: Sequence[View]) -> dict[int, View]:
    """The views by the numbers of their frames."""
    numbered: dict[int, View] = {}
    for view in views:
        if view.number is None:
            raise CameraError(f"{view.name} has no number: name images that belong together left12.png, right12.png")
        if view.number in numbered:
            raise CameraError(f"{numbered[view.number].name} and {view.name} have one number: give a folder a camera")
        numbered[view.number] = view
    return numbered


@dataclass(frozen=True)
class _Sighting:
    """A view of camera number ``camera`` in frame number ``frame`` of those used, and the board's pose by it alone."""

    camera: int
    frame: int
    view: View
    camera_from_board: RigidTransform


def _shared(seen: Sequence[dict[int, View]]) -> set[int]:
    """Numbers of the frames that two cameras or more saw."""
    return {n for a, b in combinations(seen, 2) for n in a.keys() & b.keys()}


def solve_rig(cameras: Sequence[Calibration], seen: Sequence[dict[int, View]]) -> RigCalibration:
    """Where the cameras are to each other.

    Parameters
    ----------
    cameras : (n) calibration of each by itself.
    seen : (n) the views of each by the numbers of their frames.

    Raises
    ------
    CameraError
        If a camera shares too few frames with the others, or too few of those that fit the others.
    """
    of_cameras, given = [calibration.solution.camera for calibration in cameras], _shared(seen)
    seen = [_with_rays(camera, views) for camera, views in zip(of_cameras, seen, strict=True)]
    shared = sorted(_shared(seen))
    left_out = sorted(given.difference(shared))
    first = [next(views[n] for views in seen if n in views) for n in shared]
    if shared:
        shared = [shared[i] for i in select_by_coverage(first, cameras[0].found.size)]
    sightings = [
        _Sighting(camera, frame, seen[camera][frame], _board_pose(of_cameras[camera], seen[camera][frame]))
        for frame in shared
        for camera in range(len(seen))
        if frame in seen[camera]
    ]
    poses = _first_poses(of_cameras, sightings, len(left_out))
    while True:
        solved = _Adjustment(of_cameras, sightings, poses)
        rms = solved.rms_of_frames()
        bad = {n for n, of_frame in rms.items() if of_frame > max(OUTLIER_RATIO * np.median([*rms.values()]), HARMLESS)}
        if not bad or len(rms) - len(bad) < FEWEST_SHARED:
            break
        left_out += sorted(bad)
        sightings = [sighting for sighting in sightings if sighting.frame not in bad]
        # A camera all of whose frames are left out is nowhere.
        _first_poses(of_cameras, sightings, len(left_out))
        poses = solved.poses
    used = tuple(sorted(rms))
    deviations = np.hypot(solved.deviations(), _by_intrinsics(cameras, sightings))
    return RigCalibration(tuple(cameras), solved.poses, deviations, solved.rms, used, tuple(sorted(left_out)))


def _with_rays(camera: Camera, views: dict[int, View]) -> dict[int, View]:
    """Those of the views all of whose corners are where the camera's lens shows something."""
    return {n: view for n, view in views.items() if np.isfinite(camera.undistort_pixels(view.corners)).all()}


def _by_intrinsics(cameras: Sequence[Calibration], sightings: Sequence[_Sighting]) -> Array:
    """What the deviations of the intrinsics add to those of the poses (n, 2): metres along the axis, radians."""
    depth = np.mean([sighting.camera_from_board.translation[2] for sighting in sightings])
    focal = np.array([c.solution.focal_deviation[0] / c.solution.camera.fx for c in cameras])
    centre = np.array([max(c.solution.centre_deviation) / c.solution.camera.fx for c in cameras])
    of_pair = np.column_stack([depth * np.hypot(focal, focal[0]), np.hypot(centre, centre[0])])
    of_pair[0] = 0.0
    return np.asarray(of_pair, dtype=np.float64)


def _board_pose(camera: Camera, view: View) -> RigidTransform:
    """Where a board is, which may be bent, from one view (Terzakis and Lourakis 2020, and least squares)."""
    pixels = camera.undistort_pixels(view.corners)
    _, turn, shift = cv2.solvePnP(view.points, pixels, camera.matrix, None, flags=cv2.SOLVEPNP_SQPNP)
    turn, shift = cv2.solvePnPRefineLM(view.points, pixels, camera.matrix, None, turn, shift)  # type: ignore[call-overload]
    return RigidTransform(rotation_exp(np.ravel(turn).astype(float)), np.ravel(shift).astype(float))


def _first_poses(
    cameras: Sequence[Camera], sightings: Sequence[_Sighting], n_left_out: int
) -> tuple[RigidTransform, ...]:
    """camera_from_first, each by the camera placed before that shares most frames with it.

    Of the poses that the shared frames give, the one is taken by which their corners are off least in the median.

    Raises CameraError if one shares too few, besides those that were left out.
    """
    views = {(sighting.camera, sighting.frame): sighting for sighting in sightings}
    frames = [{frame for number, frame in views if number == camera} for camera in range(len(cameras))]
    placed = {0: RigidTransform.identity()}
    while len(placed) < len(cameras):
        pairs = [(len(frames[a] & frames[b]), a, b) for a in placed for b in range(len(cameras)) if b not in placed]
        count, a, b = max(pairs)
        if count < FEWEST_SHARED:
            besides = f", {n_left_out} more do not fit the others" if n_left_out else ""
            raise CameraError(
                f"camera {b} saw the board in {count} frames together with another one{besides}; {FEWEST_SHARED} are "
                "needed, 15 are good: hold it where two cameras see it, and give frames of one instant the same number"
            )
        both = [(views[a, frame], views[b, frame]) for frame in sorted(frames[a] & frames[b])]
        found = [by_b.camera_from_board @ by_a.camera_from_board.inverse for by_a, by_b in both]

        def off(pose: RigidTransform, both: list = both, camera: Camera = cameras[b]) -> float:
            return float(
                np.median([_distances(camera, pose @ by_a.camera_from_board, by_b.view).mean() for by_a, by_b in both])
            )

        placed[b] = min(found, key=off) @ placed[a]
    return tuple(placed[number] for number in range(len(cameras)))


def _distances(camera: Camera, camera_from_board: RigidTransform, view: View) -> Array:
    """How far a view's corners (n,) are from where a pose has them, pixels."""
    off = camera.project_recorded(camera_from_board.apply(view.points)) - view.corners
    return np.asarray(np.linalg.norm(off, axis=1), dtype=np.float64)


class _Adjustment:
    """The poses of the cameras and of the board in all frames, of least squared residuals.

    Unknowns are rotation vectors and translations (6,) of the cameras but the first, then of the board in each frame.
    """

    def __init__(
        self, cameras: Sequence[Camera], sightings: Sequence[_Sighting], poses: Sequence[RigidTransform]
    ) -> None:
        self._cameras, self._sightings = cameras, sightings
        self._frames = sorted({sighting.frame for sighting in sightings})
        of_board = {s.frame: poses[s.camera].inverse @ s.camera_from_board for s in reversed(sightings)}
        start = [*poses[1:], *(of_board[frame] for frame in self._frames)]
        unknowns = np.concatenate([[*rotation_log(pose.rotation), *pose.translation] for pose in start])
        self._ends = np.cumsum([0, *(2 * len(sighting.view.points) for sighting in sightings)])
        self._found = least_squares(self._residuals, unknowns, jac_sparsity=self._sparsity(), x_scale="jac")
        self.poses = (RigidTransform.identity(), *map(_pose, self._found.x[: 6 * (len(cameras) - 1)].reshape(-1, 6)))

    def _places(self, sighting: _Sighting) -> tuple[slice | None, slice]:
        """Of the unknowns: those of the camera, None of the first one, and of the board."""
        n, frame = len(self._cameras) - 1, self._frames.index(sighting.frame)
        of_camera = None if sighting.camera == 0 else slice(6 * sighting.camera - 6, 6 * sighting.camera)
        return of_camera, slice(6 * (n + frame), 6 * (n + frame) + 6)

    def _residuals(self, unknowns: Array) -> Array:
        rows = []
        for sighting in self._sightings:
            of_camera, of_board = self._places(sighting)
            pose = _pose(unknowns[of_board])
            pose = pose if of_camera is None else _pose(unknowns[of_camera]) @ pose
            projected = self._cameras[sighting.camera].project_recorded(pose.apply(sighting.view.points))
            rows.append((projected - sighting.view.corners).ravel())
        return np.concatenate(rows)

    def _sparsity(self) -> lil_matrix:
        pattern = lil_matrix((self._ends[-1], 6 * (len(self._cameras) - 1 + len(self._frames))), dtype=np.int8)
        for row, sighting in enumerate(self._sightings):
            for place in self._places(sighting):
                if place is not None:
                    pattern[self._ends[row] : self._ends[row + 1], place] = 1
        return pattern

    @property
    def rms(self) -> float:
        """Root mean square distance of the corners, pixels."""
        return float(np.sqrt(2.0 * (self._found.fun**2).mean()))

    def rms_of_frames(self) -> dict[int, float]:
        """The same of each frame."""
        squares = {frame: [] for frame in self._frames}
        for row, sighting in enumerate(self._sightings):
            squares[sighting.frame].append(self._found.fun[self._ends[row] : self._ends[row + 1]] ** 2)
        return {frame: float(np.sqrt(2.0 * np.concatenate(parts).mean())) for frame, parts in squares.items()}

    def deviations(self) -> Array:
        """As `RigCalibration.deviations`."""
        jacobian = self._found.jac.toarray()
        variance = (self._found.fun**2).sum() / max(jacobian.shape[0] - jacobian.shape[1], 1)
        covariance = variance * np.linalg.inv(jacobian.T @ jacobian)
        parts = [covariance[k : k + 6, k : k + 6] for k in range(0, 6 * len(self.poses) - 6, 6)]
        worst = [[np.linalg.eigvalsh(part[3:, 3:])[-1], np.linalg.eigvalsh(part[:3, :3])[-1]] for part in parts]
        return np.sqrt([[0.0, 0.0], *worst])


def _pose(unknowns: Array) -> RigidTransform:
    return RigidTransform(rotation_exp(np.ascontiguousarray(unknowns[:3])), unknowns[3:].copy())
