"""Writing a COLMAP text model: cameras.txt, images.txt, points3D.txt (colmap.github.io/format.html)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from morph_dslam.camera import PinholeCamera
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
