"""The calibration of a camera from a board: a camera file, a picture, and a report."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from morph_dslam.calibration.board import Board
from morph_dslam.calibration.picture import plot_calibration
from morph_dslam.calibration.solve import Solution, solve_intrinsics
from morph_dslam.calibration.views import Views, collect_views
from morph_dslam.errors import CameraError
from morph_dslam.io.calibration import save_camera
from morph_dslam.lens import LensModel

#: The image is divided into so many cells each way to see how much of it the corners cover.
CELLS = 10
LEAST_COVERAGE = 0.5

#: A larger residual than this, pixels, says that something is wrong.
LARGE_RMS = 0.7

#: A board bent by more than this part of its length is worth a remark.
BENT = 0.005


@dataclass(frozen=True)
class Calibration:
    """What was solved, and from what."""

    solution: Solution
    found: Views
    board: Board

    @property
    def coverage(self) -> float:
        """The part of the image, in cells, in which corners were seen."""
        corners = np.concatenate([view.corners for view in self.solution.views])
        cells = np.floor(CELLS * corners / np.array(self.found.size)).astype(int)
        return len(np.unique(np.clip(cells, 0, CELLS - 1), axis=0)) / CELLS**2

    def remarks(self) -> Iterator[str]:
        """What the user should know before relying on it."""
        solution = self.solution
        if solution.left_out:
            yield f"left out, because they do not fit the others: {', '.join(solution.left_out)}"
        if self.coverage < LEAST_COVERAGE:
            yield (
                f"the corners cover {100 * self.coverage:.0f} % of the image only; the distortion elsewhere "
                "is extrapolated: show the board near the edges and corners of the image too"
            )
        if solution.rms > LARGE_RMS:
            yield (
                f"the residual of {solution.rms:.2f} pixels is large: are the images sharp and the board "
                "flat, and is the lens a fisheye (--lens fisheye)?"
            )
        length = self.board.square * max(self.board.columns, self.board.rows)
        if solution.flatness > BENT * length:
            yield f"the board is bent: its corners are up to {1e3 * solution.flatness:.1f} mm off its plane"

    def table(self) -> str:
        """The residual and the tilt of each view."""
        width = max(len(view.name) for view in self.solution.views)
        rows = zip(self.solution.views, self.solution.view_rms, self.solution.tilts, strict=True)
        lines = [f"{view.name:<{width}}  {rms:6.3f}  {np.rad2deg(tilt):8.1f}" for view, rms, tilt in rows]
        return "\n".join([f"{'view':<{width}}  rms_px  tilt_deg", *lines])

    def line(self) -> str:
        """The one line that sums it up."""
        camera, (deviation, _) = self.solution.camera, self.solution.focal_deviation
        return (
            f"fx={camera.fx:.2f} fy={camera.fy:.2f} cx={camera.cx:.2f} cy={camera.cy:.2f} "
            f"sd_fx={deviation:.2f} rms_px={self.solution.rms:.3f} "
            f"views={len(self.solution.views)}/{self.found.n_searched} coverage={100 * self.coverage:.0f}%"
        )


def calibrate(
    sources: Sequence[Path], board: Board, output: Path, lens_model: LensModel = "radial-tangential"
) -> Calibration:
    """Calibrate a camera and write the camera file and, beside it, a picture (`picture_path`).

    Parameters
    ----------
    sources : images, one folder of images, or one video or other recording. output : the camera file.

    Raises
    ------
    CameraError
        If the board is found in too few images, images differ in size, the views do not determine the focal
        length, or the camera file cannot be written.
    SourceError
        If an image or a video cannot be read.
    """
    if output.suffix not in (".yaml", ".yml"):
        raise CameraError(f"cannot write {output}: a camera file has the ending .yaml")
    if not output.parent.is_dir():
        raise CameraError(f"cannot write {output}: there is no folder {output.parent}")
    picture = picture_path(output)
    found = collect_views(sources, board, ignored=picture)
    calibration = Calibration(solve_intrinsics(found.views, board, found.size, lens_model), found, board)
    try:
        save_camera(output, calibration.solution.camera)
        plot_calibration(picture, calibration.solution)
    except OSError as error:
        raise CameraError(f"cannot write {error.filename}: {error.strerror}") from error
    return calibration


def picture_path(output: Path) -> Path:
    """Where the picture of a calibration goes, by its camera file."""
    return output.with_name(f"{output.stem}_calibration.png")
