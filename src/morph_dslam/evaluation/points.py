"""Material error: points measured, or rendered, in some frames of a sequence, against where a run has them."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.run_folder import Run, frames_in_words
from morph_dslam.model import SurfacePoints
from morph_dslam.render.picking import nearest_on_outline, pick_surface

Array = NDArray[np.float64]
LAYOUT = (
    "frame (t,) whole numbers, points_mm (t, p, 3) in the camera frame, pixels (t, p, 2) and, if known, visible (t, p)"
)


@dataclass(frozen=True)
class PointTruth:
    """Column j is the same material point in every frame.

    Attributes
    ----------
    frames : (t,) frame numbers.
    points : (t, p, 3) in the camera frame, metres; NaN where a point was not measured.
    pixels : (t, p, 2) where the points are in the images, as recorded (with lens distortion).
    hidden : (t, p) which of them something else hides there; where the file does not say, none.
    """

    frames: NDArray[np.int64]
    points: Array
    pixels: Array
    hidden: NDArray[np.bool_]


def load_truth(path: str | Path) -> PointTruth:
    """Read a truth file, a NumPy archive with the arrays of `LAYOUT`; a point that is not finite was not measured.

    Raises
    ------
    EvaluationError
        If the file is missing or damaged, or an array is absent or of the wrong shape.
    """
    try:
        with Path(path).open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            missing = [name for name in ("frame", "points_mm", "pixels") if name not in archive]
            if missing:
                raise EvaluationError(f"{path} has no array {', '.join(missing)}; a truth file has {LAYOUT}")
            frames, points, pixels = archive["frame"], archive["points_mm"], archive["pixels"]
            visible = archive["visible"] if "visible" in archive else np.ones(points.shape[:2], dtype=bool)
    except FileNotFoundError as error:
        raise EvaluationError(f"there is no truth file {path}") from error
    except (OSError, ValueError, EOFError, AttributeError, TypeError, zipfile.BadZipFile) as error:
        raise EvaluationError(f"{path} is not a readable .npz file ({error}); a truth file has {LAYOUT}") from error
    fits = (
        frames.ndim == 1
        and points.ndim == 3
        and points.shape[::2] == (len(frames), 3)
        and pixels.shape == (*points.shape[:2], 2)
        and points.size > 0
        and frames.dtype.kind in "iu"
        and points.dtype.kind == pixels.dtype.kind == "f"
        and visible.shape == points.shape[:2]
        and visible.dtype.kind == "b"
    )
    if not fits:
        raise EvaluationError(
            f"{path}: frame {frames.dtype}{frames.shape}, points_mm {points.dtype}{points.shape}, "
            f"pixels {pixels.dtype}{pixels.shape} "
            f"do not fit together; a truth file has {LAYOUT}"
        )
    if len(np.unique(frames)) != len(frames):
        raise EvaluationError(f"{path}: a frame number occurs twice")
    points = np.where(np.isfinite(points), points, np.nan).astype(float) / 1000.0
    return PointTruth(frames.astype(np.int64), points, pixels.astype(float), ~visible)


#: A truth point whose pixel misses the estimated surface by no more than this is bound to its outline.
OUTLINE_TOLERANCE_PX = 5.0


@dataclass(frozen=True)
class Binding:
    """Truth points on the mesh.

    Attributes
    ----------
    frame : the frame whose pixels bound them.
    columns : (b,) which truth points.
    points : where they are on the mesh, length b.
    n_outline : how many of them missed the surface by at most `OUTLINE_TOLERANCE_PX`.
    unbound : (u,) the other truth points, which cannot be compared: those that missed it by more, and
        ``n_unseen`` that are hidden or not measured in ``frame``.
    """

    frame: int
    columns: NDArray[np.int64]
    points: SurfacePoints
    n_outline: int
    unbound: NDArray[np.int64]
    n_unseen: int


@dataclass(frozen=True)
class MaterialError:
    """Errors in metres.

    Attributes
    ----------
    frames : (e,) the frames compared.
    vectors : (e, b, 3) estimate minus truth in the camera frame, NaN where a point was not measured.
    measured : (e, b, 3) the truth points.
    sight : (e, b, 3) unit directions from the camera to the truth points.
    untracked : truth frames that the run has but did not track.
    outside : truth frames that it does not have.
    """

    binding: Binding
    frames: NDArray[np.int64]
    vectors: Array
    measured: Array
    sight: Array
    untracked: tuple[int, ...]
    outside: tuple[int, ...]

    @property
    def distances(self) -> Array:
        """Length (e, b) of the error, metres."""
        return np.linalg.norm(self.vectors, axis=2)

    @property
    def along_sight(self) -> Array:
        """Signed error (e, b) along the sight line, metres; positive is too far away."""
        return np.einsum("ebx,ebx->eb", self.vectors, self.sight)

    @property
    def across_sight(self) -> Array:
        """Length (e, b) of the error across the sight line, metres."""
        return np.linalg.norm(self.vectors - self.along_sight[..., None] * self.sight, axis=2)


def bind_pixels(run: Run, row: int, recorded: Array, nodes: Array | None = None) -> tuple[SurfacePoints, int]:
    """The surface points that pixels (p, 2) of the recorded image show, in the state estimated there.

    Parameters
    ----------
    run : that was tracked.
    row : of the frame.
    recorded : (p, 2) pixels.
    nodes : (n, 3) as the image shows them, camera frame, metres; by default as the state has them.

    Returns
    -------
    points : length p; triangle -1 where a pixel misses the surface by more than `OUTLINE_TOLERANCE_PX`.
    n_outline : how many missed it by less, and are bound to its outline.
    """
    pixels = run.camera.undistort_pixels(recorded)
    nodes, triangles = run.camera_points(row) if nodes is None else nodes, run.model.triangles
    points = pick_surface(nodes, triangles, run.camera.rays(pixels))
    missed = np.flatnonzero((points.triangles < 0) & np.isfinite(pixels).all(axis=1))
    if not missed.size:
        return points, 0
    outline, distance = nearest_on_outline(nodes, run.camera.project(nodes), triangles, pixels[missed])
    close = distance <= OUTLINE_TOLERANCE_PX
    points.triangles[missed[close]] = outline.triangles[close]
    points.weights[missed[close]] = outline.weights[close]
    return points, int(close.sum())


def first_to_bind_in(run: Run, truth: PointTruth) -> int:
    """The first frame of the truth in which the run tracked the object and pixels of visible points were measured.

    Raises
    ------
    EvaluationError
        If there is none.
    """
    measured = (np.isfinite(truth.pixels).all(axis=2) & ~truth.hidden).any(axis=1)
    tracked = np.isin(truth.frames, run.frames[run.tracked])
    if not (measured & tracked).any():
        frames = frames_in_words(truth.frames[measured])
        raise EvaluationError(
            f"the run tracked none of the frames in which the truth has pixels ({frames}): give the truth of its frames"
        )
    return int(truth.frames[measured & tracked].min())


def bind_truth(run: Run, truth: PointTruth, frame: int) -> Binding:
    """Bind truth points to the mesh by their pixels in ``frame``, in the state estimated there."""
    in_truth = np.flatnonzero(truth.frames == frame)
    if not in_truth.size:
        raise EvaluationError(f"the truth has no frame {frame} to bind in; it has {frames_in_words(truth.frames)}")
    row = run.row(frame)
    if row is None:
        raise EvaluationError(f"the run has no frame {frame} to bind in; it has {run.frames[0]} to {run.frames[-1]}")
    if not run.tracked[row]:
        raise EvaluationError(f"frame {frame} was not tracked ({run.reasons[row]}): bind in another frame")
    recorded = truth.pixels[in_truth[0]]
    # The pixel of a hidden point belongs to whatever hides it, the front of the object itself for instance.
    columns = np.flatnonzero(np.isfinite(recorded).all(axis=1) & ~truth.hidden[in_truth[0]])
    points, n_outline = bind_pixels(run, row, recorded[columns])
    bound = points.triangles >= 0
    if not bound.any():
        raise EvaluationError(f"in frame {frame} no truth pixel falls on the estimated surface")
    unbound = np.setdiff1d(np.arange(recorded.shape[0]), columns[bound])
    n_unseen = len(recorded) - len(columns)
    return Binding(frame, columns[bound], points.take(bound), n_outline, unbound, n_unseen)


def material_error(run: Run, truth: PointTruth, bind_frame: int | None = None) -> MaterialError:
    """Compare every truth frame except the binding one, by default that of `first_to_bind_in`, with the run."""
    bind_frame = first_to_bind_in(run, truth) if bind_frame is None else bind_frame
    binding = bind_truth(run, truth, bind_frame)
    corners, weights = run.model.triangles[binding.points.triangles], binding.points.weights
    frames, vectors, truths, sight, untracked, outside = [], [], [], [], [], []
    for index, frame in enumerate(truth.frames.tolist()):
        row = run.row(frame)
        if frame == bind_frame:
            continue
        if row is None:
            outside.append(frame)
        elif not run.tracked[row]:
            untracked.append(frame)
        else:
            measured = truth.points[index, binding.columns]
            predicted = np.einsum("bc,bcx->bx", weights, run.camera_points(row)[corners])
            frames.append(frame)
            vectors.append(predicted - measured)
            truths.append(measured)
            sight.append(measured / np.linalg.norm(measured, axis=1, keepdims=True))
    if not frames or not np.isfinite(vectors).any():
        raise EvaluationError(
            f"no truth frame besides {bind_frame} can be compared: "
            f"not tracked {frames_in_words(untracked)}, outside the run {frames_in_words(outside)}"
        )
    return MaterialError(
        binding,
        np.array(frames),
        np.array(vectors),
        np.array(truths),
        np.array(sight),
        tuple(untracked),
        tuple(outside),
    )


def millimetres(distances: Array) -> dict[str, float]:
    """Mean, median, 95th percentile and largest of distances in metres, at least one of them not NaN."""
    values = 1e3 * distances
    return {
        "mean_mm": float(np.nanmean(values)),
        "median_mm": float(np.nanmedian(values)),
        "p95_mm": float(np.nanpercentile(values, 95)),
        "max_mm": float(np.nanmax(values)),
    }


def _figures(error: MaterialError, rows: slice) -> dict[str, float]:
    return {
        **millimetres(error.distances[rows]),
        "mean_along_sight_mm": float(1e3 * np.nanmean(np.abs(error.along_sight[rows]))),
        "mean_across_sight_mm": float(1e3 * np.nanmean(error.across_sight[rows])),
    }


def summarise(error: MaterialError) -> dict[str, Any]:
    """The figures of `evaluation.json`, millimetres, plain JSON."""
    measured = np.isfinite(error.distances)
    per_frame = {
        str(frame): _figures(error, slice(i, i + 1))
        for i, frame in enumerate(error.frames.tolist())
        if measured[i].any()
    }
    return {
        **_figures(error, slice(None)),
        "bind_frame": error.binding.frame,
        "n_points": len(error.binding.columns) + len(error.binding.unbound),
        "n_points_bound": len(error.binding.columns),
        "n_points_bound_at_outline": error.binding.n_outline,
        "outline_tolerance_px": OUTLINE_TOLERANCE_PX,
        "points_not_bound": error.binding.unbound.tolist(),
        "n_points_unseen": error.binding.n_unseen,
        "n_comparisons": int(measured.sum()),
        "n_comparisons_without_measurement": int((~measured).sum()),
        "frames_compared": error.frames.tolist(),
        "truth_frames_not_tracked": list(error.untracked),
        "truth_frames_outside_the_run": list(error.outside),
        "per_frame": per_frame,
    }
