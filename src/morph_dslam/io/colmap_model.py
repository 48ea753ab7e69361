"""COLMAP text models: cameras.txt, images.txt, points3D.txt (colmap.github.io/format.html)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import MapError
from morph_dslam.io.colmap import PIXEL_CENTRE

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ColmapImage:
    """An image of a model.

    Attributes
    ----------
    name : its file, the number in which is the frame's. camera_from_world : (4, 4).
    point_ids : (k,) points seen, by their rows in the model. pixels : (k, 2) where, in the undistorted image.
    """

    name: str
    camera_from_world: Array
    point_ids: NDArray[np.int64]
    pixels: Array

    @property
    def number(self) -> int:
        """The last number in the file's name.

        Raises
        ------
        ValueError
            If there is none.
        """
        digits = re.findall(r"\d+", Path(self.name).stem)
        if not digits:
            raise ValueError(f"{self.name} has no number, which says which frame it is")
        return int(digits[-1])


def write_colmap_model(
    folder: Path, camera: PinholeCamera, images: Sequence[ColmapImage], points: Array
) -> None:
    """Write images of one camera, undistorted, and the points (n, 3) that they see, into a new folder."""
    folder.mkdir(parents=True, exist_ok=True)
    fx, fy, cx, cy = camera.intrinsics
    parameters = f"{fx:.6f} {fy:.6f} {cx + PIXEL_CENTRE:.6f} {cy + PIXEL_CENTRE:.6f}"
    (folder / "cameras.txt").write_text(f"1 PINHOLE {camera.width} {camera.height} {parameters}\n")
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
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [
        f"{row + 1} {x:.9f} {y:.9f} {z:.9f} 128 128 128 {np.mean(errors[row]):.4f} {' '.join(tracks[row])}"
        for row, (x, y, z) in enumerate(points)
        if tracks[row]
    ]
    (folder / "points3D.txt").write_text("\n".join(rows) + "\n")


@dataclass(frozen=True)
class ColmapModel:
    """A model that was read: images in the order of their numbers, and points (n, 3)."""

    images: list[ColmapImage]
    points: Array


def read_colmap_model(folder: Path) -> ColmapModel:
    """Read images and points of a model; pixels are those of the images as recorded.

    Raises
    ------
    MapError
        If files are missing or damaged, or hold no image or point.
    """
    for name in ("images.txt", "points3D.txt"):
        if not (folder / name).is_file():
            raise MapError(
                f"{folder} has no {name}: save the COLMAP model as text "
                "(colmap model_converter --output_type TXT)"
            )
    try:
        rows = [line.split() for line in _content(folder / "points3D.txt") if line.strip()]
        numbers = {int(row[0]): place for place, row in enumerate(rows)}
        points = np.array([row[1:4] for row in rows], dtype=float).reshape(-1, 3)
        lines = _content(folder / "images.txt")
        images = [
            _read_image(head, body, numbers) for head, body in zip(lines[::2], lines[1::2], strict=True)
        ]
        images.sort(key=lambda image: image.number)
    except (ValueError, IndexError, KeyError) as error:
        raise MapError(f"{folder} is no COLMAP text model, or damaged: {error}") from error
    if not images or not len(points):
        raise MapError(f"{folder} holds {len(images)} images and {len(points)} points: there is no map in it")
    return ColmapModel(images, points)


def _content(path: Path) -> list[str]:
    """The lines of a file that are no comments; those without observations are empty."""
    return [line for line in path.read_text().splitlines() if not line.startswith("#")]


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
