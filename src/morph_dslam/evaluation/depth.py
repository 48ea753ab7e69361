"""Distance from a depth sensor's points to the estimated surface: the paper's error."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.camera import Camera
from morph_dslam.errors import EvaluationError, SourceError
from morph_dslam.evaluation.points import millimetres
from morph_dslam.evaluation.run_folder import Run
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.sources import open_source
from morph_dslam.sources.frames import DepthScale, FrameStream, has_depth, has_registered_depth, read_depth
from morph_dslam.sources.recorded import depth_on_another_clock, numbered_images
from morph_dslam.surface_distances import distances_to_surface

Array = NDArray[np.float64]


DepthImage = NDArray[np.float32]


def read_depths(
    path: Path, frames: Sequence[int], values_per_metre: float | None = None
) -> Iterator[tuple[int, DepthImage]]:
    """Frame numbers among ``frames`` that have depth, each with its image (h, w): metres, NaN where unknown.

    Parameters
    ----------
    path : a ``depth.h5`` of `morph simulate`; a folder of numbered 16-bit images; or a recording whose depth belongs
        to its colour pixels, as in the layout of TUM RGB-D.
    values_per_metre : of the depth images; a recording has its layout's without it, and a folder of numbered images
        needs it.

    Raises
    ------
    EvaluationError
        While iterating, if the path holds no such depth, or an image cannot be read.
    """
    wanted = sorted(frames)
    try:
        if path.is_file():
            if values_per_metre is not None:
                raise EvaluationError(
                    f"--depth-per-metre is for a folder of depth images, and {path} is a file, whose depths "
                    "are metres: leave it out"
                )
            yield from _from_file(path, wanted)
        elif not path.is_dir():
            raise EvaluationError(f"there are no depth images at {path}")
        elif values_per_metre is not None and not _is_recording_with_depth(open_source(path)):
            yield from _from_folder(path, wanted, values_per_metre)
        else:
            yield from _from_recording(path, wanted, values_per_metre)
    except SourceError as error:
        raise EvaluationError(f"the depth images cannot be read: {error}") from error


def _from_file(path: Path, frames: Sequence[int]) -> Iterator[tuple[int, DepthImage]]:
    """Of dataset ``depth_m`` (t, h, w), which is 0 where the object is not seen."""
    try:
        with h5py.File(path, "r") as file:
            dataset = file["depth_m"]
            assert isinstance(dataset, h5py.Dataset)
            for frame in frames:
                if 0 <= frame < len(dataset):
                    depth = np.asarray(dataset[frame], dtype=np.float32)
                    yield frame, np.where(depth > 0.0, depth, np.float32(np.nan))
    except (OSError, KeyError, RuntimeError, AssertionError) as error:
        raise EvaluationError(
            f"{path} is not a depth.h5 of `morph simulate`, or damaged ({error}): simulate again"
        ) from error


def _from_folder(folder: Path, frames: Sequence[int], scale: float) -> Iterator[tuple[int, DepthImage]]:
    if not scale > 0.0:
        raise EvaluationError(f"depth images cannot have {scale:g} values a metre: give 1000 for millimetres")
    images = numbered_images(folder)
    for frame in frames:
        if frame in images:
            yield frame, read_depth(images[frame], f"frame {frame}", DepthScale(scale))


def _is_recording_with_depth(source: FrameStream) -> bool:
    """Whether a recording has depth images, though perhaps of no frame."""
    return has_depth(source) or depth_on_another_clock(source, source.name) is not None


def _from_recording(path: Path, frames: Sequence[int], scale: float | None) -> Iterator[tuple[int, DepthImage]]:
    source = open_source(path)
    if doubt := depth_on_another_clock(source, path):
        raise EvaluationError(doubt)
    if has_depth(source) and not has_registered_depth(source):
        raise EvaluationError(
            f"the depth images of {path} are not registered to the colour camera, so that their pixels show "
            "other points: register them first (docs/sources.md)"
        )
    if not has_depth(source):
        raise EvaluationError(
            f"{path} is no recording with depth; if it is a folder of depth images, say how many of their "
            "values make a metre with --depth-per-metre (1000 for millimetres)"
        )
    for frame in open_source(path, depth_per_metre=scale):
        if frame.depth is not None and frame.index in frames:
            yield frame.index, frame.depth


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
    frames : (e,) frames compared.
    distances : by frame, (p,) of sensor points to the surface.
    nodes : by frame, (p,) the mesh node nearest to each point.
    gate : larger distances are left out.
    left_out : (e,) share of sensor points left out.
    base_frame : undeformed, or None.
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


def sensor_points(depth: NDArray[np.floating], mask: NDArray[np.bool_], camera: Camera) -> Array:
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


def surface_mask(nodes: Array, triangles: NDArray[np.int64], camera: Camera) -> NDArray[np.bool_]:
    """Pixels (h, w) that the surface covers, its rim left out."""
    buffers = rasterise(camera.project(nodes), nodes[:, 2], triangles, camera.height, camera.width)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * RIM_PX + 1,) * 2)
    return cv2.erode(buffers.covered.astype(np.uint8), disc).astype(bool)


def depth_error(
    run: Run, depths: Iterable[tuple[int, NDArray[np.floating]]], base_frame: int | None = None
) -> DepthError:
    """Compare every tracked frame that has depth with the run.

    Parameters
    ----------
    depths : frame numbers, each with its image (h, w) as the run's camera sees it, see `read_depths`.
    base_frame : a frame in which the object is not deformed.
    """
    camera, triangles = run.camera, run.model.triangles
    surface_nodes = np.unique(triangles)
    gate = LARGEST_DISTANCE * float(np.linalg.norm(np.ptp(run.model.nodes, axis=0)))
    frames, distances, nearest, left_out = [], [], [], []
    for frame, depth in depths:
        row = run.row(frame)
        if row is None or not run.tracked[row]:
            continue
        if depth.shape != (camera.height, camera.width):
            raise EvaluationError(
                f"the depth image of frame {frame} is {depth.shape[1]}x{depth.shape[0]} pixels, the run's "
                f"camera {camera.width}x{camera.height}: register the depth to the colour camera"
            )
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
        _, closest = KDTree(surface[surface_nodes], balanced_tree=False).query(points[kept])
        nearest.append(surface_nodes[closest])
    found = DepthError(np.array(frames), distances, nearest, gate, np.array(left_out), base_frame)
    _check(found)
    return found


def _check(error: DepthError) -> None:
    frames, base_frame = error.frames, error.base_frame
    if not any(len(distance) for distance in error.distances):
        raise EvaluationError(
            "the depth images show nothing of the estimated surface in any tracked frame: are their numbers those "
            "of the run's frames, and their depths in the unit given?"
        )
    if base_frame is not None and base_frame not in frames:
        raise EvaluationError(
            f"the base frame {base_frame} was not tracked or has no depth; compared were {frames[0]} to {frames[-1]}"
        )
    if not len(error.compared):
        raise EvaluationError(
            f"the depth images show nothing of the estimated surface in any tracked frame but the base frame "
            f"{base_frame}: all else they show is more than {1e3 * error.gate:.3g} mm from it"
        )


def _figures(distances: Array) -> dict[str, float]:
    return {**(millimetres(distances) if len(distances) else {}), "n_points": len(distances)}


def summarise_depth(error: DepthError) -> dict[str, Any]:
    """The figures of ``depth_evaluation.json``, millimetres, plain JSON."""
    return {
        **_figures(error.compared),
        "base_frame": error.base_frame,
        "base": None if error.base is None else _figures(error.base),
        "left_out_beyond_mm": 1e3 * error.gate,
        "left_out_percent": 100.0 * float(error.left_out.mean()),
        "frames_compared": error.frames.tolist(),
        "per_frame": {
            str(frame): {**_figures(distance), "left_out_percent": 100.0 * float(share)}
            for frame, distance, share in zip(error.frames, error.distances, error.left_out, strict=True)
        },
    }
