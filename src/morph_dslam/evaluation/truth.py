"""Ground truth: material points measured, or rendered, in some frames of a sequence."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import EvaluationError

Array = NDArray[np.float64]

LAYOUT = (
    "frame (t,) whole numbers, points_mm (t, p, 3) in the camera frame, pixels (t, p, 2) and, if known, "
    "visible (t, p)"
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


def load_truth(path: Path) -> PointTruth:
    """Read a truth file, a NumPy archive with the arrays of `LAYOUT`.

    Raises
    ------
    EvaluationError
        If the file is missing or damaged, or an array is absent or of the wrong shape.
    """
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            missing = [name for name in ("frame", "points_mm", "pixels") if name not in archive]
            if missing:
                raise EvaluationError(f"{path} has no array {', '.join(missing)}; a truth file has {LAYOUT}")
            frames, points, pixels = archive["frame"], archive["points_mm"], archive["pixels"]
            visible = archive["visible"] if "visible" in archive else np.ones(points.shape[:2], dtype=bool)
    except FileNotFoundError as error:
        raise EvaluationError(f"there is no truth file {path}") from error
    except (OSError, ValueError, EOFError, AttributeError, TypeError, zipfile.BadZipFile) as error:
        raise EvaluationError(
            f"{path} is not a readable .npz file ({error}); a truth file has {LAYOUT}"
        ) from error
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
    return PointTruth(frames.astype(np.int64), points.astype(float) / 1000.0, pixels.astype(float), ~visible)
