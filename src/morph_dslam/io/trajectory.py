"""Camera trajectories: files of TUM, COLMAP (images.txt), KITTI and EuRoC, and 7-Scenes folders of poses."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from morph_dslam.errors import TrajectoryError
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.camera_files import load_body_from_sensor
from morph_dslam.io.text import read_text

Array = NDArray[np.float64]
#: Larger values are not meant: timestamps in nanoseconds are smaller.
LARGEST = 1e20
#: Quaternions and matrices are written with few digits; more than this off, they are no rotations.
ROTATION_TOLERANCE = 0.02
#: Columns that only EuRoC's poses of a body have, by their names in the first line.
EUROC_COLUMNS = ("p_RS_R_x", "q_RS_w")
#: 7-Scenes were recorded at 30 frames a second and carry no timestamps.
SEVEN_SCENES_FPS = 30.0


@dataclass(frozen=True)
class Trajectory:
    """Camera poses over time.

    Attributes
    ----------
    timestamps : (n,) ascending, seconds; frame numbers where the file has no times
    world_from_camera : (n, 4, 4), translations in metres, or in the map's unit where it has no scale
    indices : (n,) frame numbers; 0, 1, ... where they are not known
    is_numbered : whether the timestamps are frame numbers, of a file of a kind that has no times
    """

    timestamps: Array
    world_from_camera: Array
    indices: NDArray[np.int64] = None  # type: ignore[assignment]
    is_numbered: bool = False

    def __post_init__(self) -> None:
        if self.indices is None:
            object.__setattr__(self, "indices", np.arange(len(self.timestamps)))

    def __len__(self) -> int:
        return len(self.timestamps)

    @property
    def camera_from_world(self) -> Array:
        """The inverse poses (n, 4, 4)."""
        return np.linalg.inv(self.world_from_camera).astype(np.float64)

    @property
    def positions(self) -> Array:
        """Camera centres (n, 3) in the world."""
        return self.world_from_camera[:, :3, 3]

    @property
    def length(self) -> float:
        """Length of the path through the camera centres."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())


def load_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory.

    Parameters
    ----------
    path : a TUM file (timestamp tx ty tz qx qy qz qw), a KITTI file (twelve numbers a line, stamped with the
        line's number from 0), COLMAP's images.txt (stamped with the last number in each image's name), EuRoC's
        data.csv of the body in its recording, whose `cam0/sensor.yaml` gives the camera's poses, or a folder of
        7-Scenes with `frame-000000.pose.txt` (stamped with the frame's number / 30)

    Raises TrajectoryError if it is missing, empty, or of none of these kinds, a line is no pose, or EuRoC's camera is
    not found, and CameraError if it does not say where it is on the body.
    """
    path = Path(path)
    if path.is_dir():
        return _make(path, _seven_scenes_rows(path))
    lines = read_text(path, "trajectory", TrajectoryError).splitlines()
    if path.name == "images.txt" or any(line.startswith("# Image list") for line in lines[:5]):
        return _make(path, _colmap_rows(path, lines), is_numbered=True)
    if lines and all(name in lines[0] for name in EUROC_COLUMNS):
        return _make(path, _euroc_rows(path, lines))
    first = next((line for line in lines if line.strip() and not line.lstrip().startswith("#")), "")
    return _make(path, _table_rows(path, lines), is_numbered=len(first.replace(",", " ").split()) == 12)


def other_conventions(world_from_camera: Array) -> dict[str, Array]:
    """What poses (n, 4, 4) are if they were written by another convention, by what to say of them: "they ..."."""
    backwards, turned = np.diag([1.0, -1.0, -1.0, 1.0]), world_from_camera.copy()
    w_last = np.roll(Rotation.from_matrix(world_from_camera[:, :3, :3]).as_quat(), -1, axis=1)
    turned[:, :3, :3] = Rotation.from_quat(w_last).as_matrix()
    return {
        "are inverted, camera from world: save them as world from camera": np.linalg.inv(world_from_camera).astype(
            np.float64
        ),
        "have the axes of OpenGL (x right, y up, z backwards): multiply their rotations by diag(1, -1, -1) from the "
        "right": world_from_camera @ backwards,
        "have quaternions that begin with qw: write qx qy qz qw": turned,
    }


def save_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write a TUM file that `load_trajectory` and other programs read."""
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    rows = zip(trajectory.timestamps, trajectory.positions, trajectory.world_from_camera[:, :3, :3], strict=True)
    for timestamp, position, rotation in rows:
        quaternion = Rotation.from_matrix(rotation).as_quat(canonical=True)
        lines.append(" ".join([f"{timestamp:.6f}", *(f"{x:.9g}" for x in (*position, *quaternion))]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _make(path: Path, rows: Iterator[tuple[float, Array]], is_numbered: bool = False) -> Trajectory:
    """The trajectory of timed matrices (4, 4), in the order of time."""
    timed = sorted(rows, key=lambda row: row[0])
    if not timed:
        raise TrajectoryError(f"{path} holds no camera poses")
    timestamps, poses = zip(*timed, strict=True)
    return Trajectory(np.array(timestamps), np.array(poses), is_numbered=is_numbered)


def _table_rows(path: Path, lines: list[str]) -> Iterator[tuple[float, Array]]:
    """Poses of a TUM or a KITTI file."""
    row = 0
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        where = f"{path}, line {number}"
        values = _numbers(line.replace(",", " ").split(), where)
        if len(values) == 8:
            yield values[0], _pose(values[4:], values[1:4], where)
        elif len(values) == 12:
            yield float(row), _rigid(values.reshape(3, 4), where)
        else:
            raise TrajectoryError(
                f"{where} has {len(values)} numbers: a TUM file has timestamp tx ty tz qx qy qz qw, a KITTI file twelve"
            )
        row += 1


def _euroc_rows(path: Path, lines: list[str]) -> Iterator[tuple[float, Array]]:
    """Poses of cam0 by those of the body, or of a sensor on it: nanoseconds, position, quaternion with w first."""
    sensor, camera = path.with_name("sensor.yaml"), path.resolve().parents[1] / "cam0" / "sensor.yaml"
    if not camera.is_file():
        raise TrajectoryError(
            f"{path} holds poses of EuRoC's body, and there is no {camera}, which says where the camera is on it: "
            "leave the file in its folder in mav0 of the recording, or copy cam0/sensor.yaml to there"
        )
    sensor_from_camera = load_body_from_sensor(camera)
    if sensor.is_file():
        sensor_from_camera = load_body_from_sensor(sensor).inverse @ sensor_from_camera
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#"):
            continue
        where, words = f"{path}, line {number}", line.split(",")
        if len(words) < 8:
            raise TrajectoryError(f"{where} has {len(words)} values: a pose is a time, three of place and four of turn")
        values = _numbers(words[:8], where)
        yield values[0] / 1e9, _pose(np.roll(values[4:], -1), values[1:4], where) @ sensor_from_camera.matrix


def _colmap_rows(path: Path, lines: list[str]) -> Iterator[tuple[float, Array]]:
    """Poses of COLMAP's images.txt, which holds camera_from_world, w first, in every other line."""
    is_image = True
    for number, line in enumerate(lines, start=1):
        if line.startswith("#"):
            continue
        if is_image and not line.strip():
            continue
        if is_image:
            where, words = f"{path}, line {number}", line.split(maxsplit=9)
            if len(words) != 10:
                raise TrajectoryError(f"{where}: an image is ID QW QX QY QZ TX TY TZ CAMERA NAME")
            digits = re.findall(r"\d+", Path(words[9]).stem)
            if not digits:
                raise TrajectoryError(f"{where}: {words[9]} has no number, which says which frame it is")
            values = _numbers(words[1:8], where)
            camera_from_world = _pose(np.roll(values[:4], -1), values[4:], where)
            yield float(digits[-1]), RigidTransform.from_matrix(camera_from_world).inverse.matrix
        is_image = not is_image


def _seven_scenes_rows(folder: Path) -> Iterator[tuple[float, Array]]:
    for path in sorted(folder.glob("frame-*.pose.txt")):
        number = int(re.findall(r"\d+", path.name)[-1])
        values = _numbers(read_text(path, "pose", TrajectoryError).split(), str(path))
        if len(values) != 16:
            raise TrajectoryError(f"{path} has {len(values)} numbers: a pose has 4 x 4")
        yield number / SEVEN_SCENES_FPS, _rigid(values.reshape(4, 4)[:3], str(path))


def _numbers(words: list[str], where: str) -> Array:
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise TrajectoryError(f"{where}: {error}") from error
    if not (np.abs(values) < LARGEST).all():
        raise TrajectoryError(f"{where} holds a value that is not finite, or larger than {LARGEST:g}")
    return values


def _pose(quaternion: Array, translation: Array, where: str) -> Array:
    """The matrix (4, 4) of a quaternion, w last, and a translation."""
    if abs(np.linalg.norm(quaternion) - 1.0) > ROTATION_TOLERANCE:
        raise TrajectoryError(f"{where}: the quaternion's norm is {np.linalg.norm(quaternion):.3g}, not 1")
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    pose[:3, 3] = translation
    return pose


def _rigid(matrix: Array, where: str) -> Array:
    """The pose (4, 4) of a matrix (3, 4), its rotation made orthonormal."""
    u, singular, vt = np.linalg.svd(matrix[:, :3])
    if np.abs(singular - 1.0).max() > ROTATION_TOLERANCE or np.linalg.det(u @ vt) < 0.0:
        raise TrajectoryError(f"{where}: the first three columns are not a rotation")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = u @ vt, matrix[:, 3]
    return pose
