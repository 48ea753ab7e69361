"""Truth points against their own pixels: both are in one file, and the camera that joins them is the run's.

This tells another unit, other axes and another frame from an error of the run, because no estimate of the pose or the
shape is in it. Of the run only the distance of the object counts, for the unit: points in another unit have the same
pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.picture_axes import picture_changes
from morph_dslam.evaluation.points import PointTruth, first_to_bind_in
from morph_dslam.evaluation.run_folder import Run

Array = NDArray[np.float64]
#: Distances that differ by more than this factor are in another unit, wherever the points are.
OTHER_UNIT = 100.0
#: What makes millimetres of centimetres, inches, decimetres and metres, and their inverses.
UNITS = (10.0, 25.4, 100.0, 1000.0, 1 / 10.0, 1 / 25.4, 1 / 100.0, 1 / 1000.0)
#: Distances of truth and run agree within this factor once the unit does.
SAME_DISTANCE = 1.15
#: Points and pixels fit together up to this share of the picture's diagonal: lenses and calibrations differ.
FITS = 0.01
#: No sensor beside the camera is this share of the diagonal off: the points are in another frame.
ELSEWHERE = 0.5
#: A change is named if it leaves less than this share of the gap and of the points' spread in the picture. Fewer points
#: may fit by chance.
CLEARLY, FEWEST = 0.2, 4
WHAT_IT_IS = "points_mm are in the camera frame, in mm: x to the right, y down, z away from the camera"


def check_truth(run: Run, truth: PointTruth, bind_frame: int | None = None) -> list[str]:
    """Refuse truth that cannot be right in the frame that binds it.

    Parameters
    ----------
    run : that it is compared with.
    truth : as it was given.
    bind_frame : as it was given; where absent, that of `first_to_bind_in`.

    Returns
    -------
    Notes of what is probably wrong.

    Raises
    ------
    EvaluationError
        If the points are in another unit, have other axes or lie elsewhere, or the pixels are those of another picture.
    """
    frame = first_to_bind_in(run, truth) if bind_frame is None else bind_frame
    row, rows = run.row(frame), np.flatnonzero(truth.frames == frame)
    if row is None or not run.tracked[row] or not rows.size:
        return []  # it binds nothing, which `bind_truth` says
    points, pixels, hidden = truth.points[rows[0]], truth.pixels[rows[0]], truth.hidden[rows[0]]
    measured = np.isfinite(points).all(axis=1) & ~hidden
    both = measured & np.isfinite(pixels).all(axis=1)
    notes, gap = [], np.inf
    if both.any():
        gap = _median_gap(run.camera, points[both], pixels[both])
        notes = _check_axes(run.camera, points[both], pixels[both], f"in frame {frame}")
    if measured.any():
        object_distance = float(np.median(np.linalg.norm(run.camera_points(row), axis=1)))
        distance = float(np.median(np.linalg.norm(points[measured], axis=1)))
        _check_unit(distance, object_distance, gap <= _tolerance(run.camera), f"in frame {frame}")
    return notes


def _check_unit(distance: float, object_distance: float, fits: bool, where: str) -> None:
    """Refuse a ``distance`` of the points from the camera that is the run's ``object_distance`` in another unit, m."""
    ratio = object_distance / max(distance, 1e-12)
    units = [factor for factor in UNITS if fits and 1.0 / SAME_DISTANCE < ratio / factor < SAME_DISTANCE]
    if not units and 1.0 / OTHER_UNIT < ratio < OTHER_UNIT:
        return
    by = f" (times {units[0]:.4g})" if units else ""
    raise EvaluationError(
        f"the truth's points are {1e3 * distance:.3g} mm from the camera {where}, and the run has the object at "
        f"{1e3 * object_distance:.3g} mm: give points_mm in mm{by}, in the camera frame; if they are, the model's mesh "
        "or the run's map is in another unit"
    )


def _tolerance(camera: Camera) -> float:
    """Pixels, see `FITS`."""
    return FITS * float(np.hypot(camera.width, camera.height))


def _median_gap(camera: Camera, points: Array, pixels: Array) -> float:
    """Median distance, pixels, between projected points (p, 3) and pixels (p, 2); infinite where most are not seen."""
    gaps = np.linalg.norm(camera.project_recorded(points) - pixels, axis=1)
    return float(np.median(np.where(np.isfinite(gaps), gaps, np.inf)))


def _check_axes(camera: Camera, points: Array, pixels: Array, where: str) -> list[str]:
    """Refuse points (p, 3), metres, that cannot be at their pixels (p, 2); a note where they differ by much."""
    gap, n_behind = _median_gap(camera, points, pixels), int((points[:, 2] <= 0.0).sum())
    if gap <= _tolerance(camera):
        return []
    what = f"{where} the truth's points, projected by the run's camera, lie {gap:.3g} px (median) from their pixels"
    if 2 * n_behind > len(points):
        what = f"{where} {n_behind} of {len(points)} truth points are not in front of the camera (z <= 0)"
    if explained := _explanations(camera, points, pixels, gap):
        changes = " or if ".join(explained)
        raise EvaluationError(f"{what}, and fit them if {changes}: correct the file; {WHAT_IT_IS}")
    if gap > ELSEWHERE * np.hypot(camera.width, camera.height):
        raise EvaluationError(
            f"{what}: points and pixels do not belong together in this camera. Give both of this camera; {WHAT_IT_IS}"
        )
    return [
        f"{what}: they do not belong together in this camera. A sensor that is not aligned with it, another lens or "
        "another focal length does this, and the error as it is contains it"
    ]


def _explanations(camera: Camera, points: Array, pixels: Array, gap: float) -> list[str]:
    """The changes of axes or picture, in words, with which points and pixels fit together."""
    if len(points) < FEWEST:
        return []

    def explains(points: Array, pixels: Array) -> bool:
        # The lesser spread: a line of points does not show what is mirrored across it.
        spread = np.linalg.svd(pixels - pixels.mean(axis=0), compute_uv=False)[-1] / np.sqrt(len(pixels))
        return _median_gap(camera, points, pixels) < CLEARLY * min(gap, float(spread))

    found = [words for words, signs in _mirrored().items() if explains(points * signs, pixels)]
    changes: dict[str, Callable[[Array], Array]] = picture_changes(camera)
    return found + [f"the pixels {words}" for words, change in changes.items() if explains(points, change(pixels))]


def _mirrored() -> dict[str, Array]:
    """Signs (3,) of coordinates, by what they change in words; OpenGL's camera looks against z, with y up."""
    changes = {}
    for signs in product((1.0, -1.0), repeat=3):
        axes = [axis for axis, sign in zip("xyz", signs, strict=True) if sign < 0.0]
        if axes:
            changes[f"{', '.join(axes)} of points_mm {'is' if len(axes) == 1 else 'are'} negated"] = np.array(signs)
    return changes
