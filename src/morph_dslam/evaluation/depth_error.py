"""Surface error: how far a depth sensor's points are from the estimated surface, as the paper measures it.

A depth image shows where the surface is, not which point of the material is where: a shape that slides along
itself passes here, and only `material_error` sees it. What the sensor itself gets wrong is measured in a base
frame, where the object is not deformed, and stands beside the figures; it is not taken off them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.camera import PinholeCamera
from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.depth_truth import DepthImage, read_depths
from morph_dslam.evaluation.run_folder import Run
from morph_dslam.evaluation.surface_distance import distances_to_surface
from morph_dslam.render.rasteriser import rasterise

Array = NDArray[np.float64]

#: Depth within this many pixels of the estimated outline may belong to what is behind the object.
RIM_PX = 4
#: Sensor points farther from the surface than this part of the object's size are of something else, a hand
#: before it say; how many they are is reported.
LARGEST_DISTANCE = 0.1
#: Points compared in a frame, spread evenly over those seen.
MOST_POINTS = 4000


@dataclass(frozen=True)
class DepthError:
    """Distances in metres.

    Attributes
    ----------
    frames : (e,) frames compared. distances : by frame, (p,) of sensor points to the surface.
    nodes : by frame, (p,) the mesh node nearest to each point. gate : larger distances are left out.
    left_out : (e,) share of sensor points left out. base_frame : undeformed, or None.
    """

    frames: NDArray[np.int64]
    distances: list[Array]
    nodes: list[NDArray[np.int64]]
    gate: float
    left_out: Array
    base_frame: int | None

    @property
    def compared(self) -> Array:
        """Distances (n,) of all frames except the base frame, of all frames if there is no other."""
        rows = [row for row, frame in enumerate(self.frames) if frame != self.base_frame]
        return np.concatenate([self.distances[row] for row in rows or range(len(self.frames))])

    @property
    def base(self) -> Array | None:
        """Distances in the base frame."""
        rows = np.flatnonzero(self.frames == self.base_frame)
        return self.distances[rows[0]] if rows.size else None

    def node_means(self, n_nodes: int) -> Array:
        """Mean distance (n_nodes,) of the points nearest to each mesh node, NaN where there are none."""
        nodes, distances = np.concatenate(self.nodes), np.concatenate(self.distances)
        count = np.bincount(nodes, minlength=n_nodes)
        total = np.bincount(nodes, weights=distances, minlength=n_nodes)
        return np.divide(total, count, out=np.full(n_nodes, np.nan), where=count > 0)


def sensor_points(depth: DepthImage, mask: NDArray[np.bool_], camera: PinholeCamera) -> Array:
    """Points (p, 3) in the camera frame, metres, of pixels that have depth (h, w), evenly spread.

    ``mask`` (h, w) is of the undistorted image, ``depth`` of the image as recorded.
    """
    rows, columns = np.nonzero(np.isfinite(depth))
    pixels = camera.undistort_pixels(np.column_stack([columns, rows]).astype(np.float64))
    # A pixel that the lens does not map (NaN) becomes one outside of the image.
    column, row = np.nan_to_num(np.rint(pixels), nan=-1.0).astype(np.int64).T
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    kept = np.flatnonzero(inside)
    kept = kept[mask[row[kept], column[kept]]]
    kept = kept[:: max(1, int(np.ceil(len(kept) / MOST_POINTS)))]
    return camera.rays(pixels[kept]) * depth[rows[kept], columns[kept], None].astype(np.float64)


def surface_mask(nodes: Array, triangles: NDArray[np.int64], camera: PinholeCamera) -> NDArray[np.bool_]:
    """Pixels (h, w) that the surface covers, its rim left out."""
    buffers = rasterise(camera.project(nodes), nodes[:, 2], triangles, camera.height, camera.width)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * RIM_PX + 1,) * 2)
    return cv2.erode(buffers.covered.astype(np.uint8), disc).astype(bool)


def depth_error(
    run: Run, path: Path, base_frame: int | None = None, values_per_metre: float | None = None
) -> DepthError:
    """Compare every tracked frame that has depth with the run.

    Parameters
    ----------
    path, values_per_metre : see `read_depths`; the depth images are as the run's camera sees them.
    base_frame : a frame in which the object is not deformed.

    Raises
    ------
    EvaluationError
        If no tracked frame has depth on the object, the base frame is not among those that have, or the
        images are of another size.
    """
    camera, triangles = run.camera, run.model.triangles
    surface_nodes = np.unique(triangles)
    gate = LARGEST_DISTANCE * float(np.linalg.norm(np.ptp(run.model.nodes, axis=0)))
    tracked = run.frames[run.tracked].tolist()
    frames, distances, nearest, left_out = [], [], [], []
    for frame, depth in read_depths(path, tracked, values_per_metre):
        if depth.shape != (camera.height, camera.width):
            raise EvaluationError(
                f"the depth image of frame {frame} is {depth.shape[1]}x{depth.shape[0]} pixels, the run's "
                f"camera {camera.width}x{camera.height}: register the depth to the colour camera"
            )
        row = run.row(frame)
        assert row is not None
        surface = run.camera_points(row)
        points = sensor_points(depth, surface_mask(surface, triangles, camera), camera)
        if not len(points):
            continue
        distance = distances_to_surface(points, surface, triangles)
        kept = distance <= gate
        left_out.append(1.0 - kept.mean())
        frames.append(frame)
        distances.append(distance[kept])
        # A new tree in each frame: one that is not balanced is made faster.
        _, found = KDTree(surface[surface_nodes], balanced_tree=False).query(points[kept])
        nearest.append(surface_nodes[found])
    _check(frames, distances, base_frame, path)
    return DepthError(np.array(frames), distances, nearest, gate, np.array(left_out), base_frame)


def _check(frames: list[int], distances: list[Array], base_frame: int | None, path: Path) -> None:
    if not any(len(distance) for distance in distances):
        raise EvaluationError(
            f"{path} has no depth on the estimated surface in any tracked frame: are its numbers those of "
            "the run's frames, and its depths in the unit given?"
        )
    if base_frame is not None and base_frame not in frames:
        raise EvaluationError(
            f"the base frame {base_frame} was not tracked or has no depth; compared were {frames[0]} to "
            f"{frames[-1]}"
        )


def _millimetres(distances: Array) -> dict[str, float]:
    values = 1e3 * distances
    if not len(values):
        return {"n_points": 0}
    return {
        "mean_mm": float(values.mean()),
        "median_mm": float(np.median(values)),
        "p95_mm": float(np.percentile(values, 95)),
        "max_mm": float(values.max()),
        "n_points": len(values),
    }


def summarise_depth(error: DepthError) -> dict[str, Any]:
    """The figures of ``depth_evaluation.json``, millimetres, plain JSON."""
    return {
        **_millimetres(error.compared),
        "base_frame": error.base_frame,
        "base": None if error.base is None else _millimetres(error.base),
        "left_out_beyond_mm": 1e3 * error.gate,
        "left_out_percent": 100.0 * float(error.left_out.mean()),
        "frames_compared": error.frames.tolist(),
        "per_frame": {
            str(frame): {**_millimetres(distance), "left_out_percent": 100.0 * float(share)}
            for frame, distance, share in zip(error.frames, error.distances, error.left_out, strict=True)
        },
    }
