"""COLMAP text models: cameras.txt, images.txt, points3D.txt (colmap.github.io/format.html).

Images as a trajectory are read by `io.trajectory`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from morph_dslam.camera import Camera
from morph_dslam.errors import CameraError, MapError
from morph_dslam.io.text import read_text

Array = NDArray[np.float64]
#: Where each of COLMAP's models keeps its values; fx and fy are one value in those that begin with f.
MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
}
#: COLMAP puts pixel (0, 0) at the corner of the first pixel, we put it at its centre.
PIXEL_CENTRE = 0.5


def read_cameras(path: Path) -> dict[str, dict]:
    """The cameras of a cameras.txt by their ids, as the keys of our camera files.

    Raises CameraError if the file cannot be read, has no camera, or one of an unknown model or with wrong values.
    """
    cameras = {}
    for number, line in enumerate(read_text(path, "camera file", CameraError).splitlines(), start=1):
        if line.strip() and not line.startswith("#"):
            words = line.split()
            cameras[words[0]] = _camera(words, f"{path}, line {number}")
    if not cameras:
        raise CameraError(f"{path} holds no camera: a line is ID MODEL WIDTH HEIGHT PARAMETERS")
    return cameras


def _camera(words: list[str], where: str) -> dict:
    if len(words) < 4:
        raise CameraError(f"{where}: a camera is ID MODEL WIDTH HEIGHT PARAMETERS")
    model = words[1]
    if model not in MODELS:
        raise CameraError(f"{where}: unknown camera model '{model}'; known are {', '.join(MODELS)}")
    names = MODELS[model]
    try:
        width, height = int(words[2]), int(words[3])
        values = dict(zip(names, [float(word) for word in words[4:]], strict=True))
    except ValueError as error:
        raise CameraError(f"{where}: {model} has width, height, then {', '.join(names)}, all numbers") from error
    focal = values["f"] if "f" in values else values["fx"]
    camera = {"width": width, "height": height, "fx": focal, "fy": values.get("fy", focal)}
    centre = {name: values[name] - PIXEL_CENTRE for name in ("cx", "cy")}
    return camera | centre | _lens(model, values)


def _lens(model: str, values: dict[str, float]) -> dict:
    if model.endswith("FISHEYE"):
        return {"lens": "fisheye", "distortion": [values.get(f"k{i}", 0.0) for i in range(1, 5)]}
    order = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    coefficients = [values.get(name, 0.0) for name in order]
    if not any(coefficients):
        return {}
    return {"distortion": coefficients if model == "FULL_OPENCV" else coefficients[:4]}


@dataclass(frozen=True)
class ColmapImage:
    """An image of a model.

    Attributes
    ----------
    name : its file, the number in which is the frame's
    camera_from_world : (4, 4)
    point_ids : (k,) points seen, by their rows in the model
    pixels : (k, 2) where, in the undistorted image
    """

    name: str
    camera_from_world: Array
    point_ids: NDArray[np.int64]
    pixels: Array

    @property
    def number(self) -> int:
        """The last number in the file's name."""
        digits = re.findall(r"\d+", Path(self.name).stem)
        if not digits:
            raise ValueError(f"{self.name} has no number, which says which frame it is")
        return int(digits[-1])


def write_colmap_model(folder: Path, camera: Camera, images: Sequence[ColmapImage], points: Array) -> None:
    """Write images of one camera, undistorted, and the points (n, 3) that they see, into a new folder."""
    folder.mkdir(parents=True, exist_ok=True)
    fx, fy, cx, cy = camera.intrinsics
    parameters = f"{fx:.6f} {fy:.6f} {cx + PIXEL_CENTRE:.6f} {cy + PIXEL_CENTRE:.6f}"
    (folder / "cameras.txt").write_text(f"1 PINHOLE {camera.width} {camera.height} {parameters}\n", encoding="utf-8")
    lines, tracks, errors = [], [[] for _ in points], [[] for _ in points]
    for number, image in enumerate(images, start=1):
        pose = image.camera_from_world
        w_first = np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True), 1)
        values = " ".join(f"{value:.9f}" for value in (*w_first, *pose[:3, 3]))
        lines.append(f"{number} {values} 1 {image.name}")
        seen = zip(image.pixels + PIXEL_CENTRE, image.point_ids + 1, strict=True)
        lines.append(" ".join(f"{x:.3f} {y:.3f} {point}" for (x, y), point in seen))
        local = points[image.point_ids] @ pose[:3, :3].T + pose[:3, 3]
        misses = np.linalg.norm(camera.project(local) - image.pixels, axis=1)
        for row, (point, miss) in enumerate(zip(image.point_ids.tolist(), misses.tolist(), strict=True)):
            tracks[point].append(f"{number} {row}")
            errors[point].append(miss)
    (folder / "images.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    rows = [
        f"{row + 1} {x:.9f} {y:.9f} {z:.9f} 128 128 128 {np.mean(errors[row]):.4f} {' '.join(tracks[row])}"
        for row, (x, y, z) in enumerate(points)
        if tracks[row]
    ]
    (folder / "points3D.txt").write_text("\n".join(rows) + "\n", encoding="utf-8")


@dataclass(frozen=True)
class ColmapModel:
    """A model that was read: images in the order of their numbers, and points (n, 3)."""

    images: list[ColmapImage]
    points: Array


def read_colmap_model(folder: Path) -> ColmapModel:
    """Read images and points of a model; pixels are those of the images as recorded.

    Raises MapError if files are missing or damaged, or hold no image or point.
    """
    for name in ("images.txt", "points3D.txt"):
        if not (folder / name).is_file():
            raise MapError(
                f"{folder} has no {name}: save the COLMAP model as text (colmap model_converter --output_type TXT)"
            )
    try:
        rows = [line.split() for line in _content(folder / "points3D.txt") if line.strip()]
        numbers = {int(row[0]): place for place, row in enumerate(rows)}
        points = np.array([row[1:4] for row in rows], dtype=float).reshape(-1, 3)
        lines = _content(folder / "images.txt")
        images = [_read_image(head, body, numbers) for head, body in zip(lines[::2], lines[1::2], strict=True)]
        images.sort(key=lambda image: image.number)
    except (ValueError, IndexError, KeyError) as error:
        raise MapError(f"{folder} is no COLMAP text model, or damaged: {error}") from error
    if not images or not len(points):
        raise MapError(f"{folder} holds {len(images)} images and {len(points)} points: there is no map in it")
    return ColmapModel(images, points)


def _content(path: Path) -> list[str]:
    """The lines of a file that are no comments; those without observations are empty."""
    return [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]


def _read_image(head: str, body: str, numbers: dict[int, int]) -> ColmapImage:
    words = head.split(maxsplit=9)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(np.roll(np.array(words[1:5], dtype=float), -1)).as_matrix()
    pose[:3, 3] = np.array(words[5:8], dtype=float)
    seen = np.array(body.split(), dtype=float).reshape(-1, 3)
    # Keypoints that are no point of the model have the number -1.
    seen = seen[seen[:, 2] >= 0]
    ids = np.array([numbers[int(number)] for number in seen[:, 2]], dtype=np.int64)
    return ColmapImage(words[9], pose, ids, seen[:, :2] - PIXEL_CENTRE)
