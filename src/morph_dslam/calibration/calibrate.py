"""The calibration of a camera from a board: a camera file, a picture of the residuals, and a report."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from morph_dslam.calibration.board import CalibrationBoard
from morph_dslam.calibration.solve import FEWEST_VIEWS, Solution, solve_intrinsics
from morph_dslam.calibration.views import View, Views, collect_views
from morph_dslam.camera import LensModel
from morph_dslam.errors import CameraError
from morph_dslam.io.camera_doubts import camera_doubts
from morph_dslam.io.camera_files import save_camera
from morph_dslam.io.writing import writing

DPI = 110
#: Residuals are drawn this many times their length.
MAGNIFIED = 100.0


def plot_calibration(path: Path, solution: Solution) -> None:
    """Corners and magnified residuals in the image, their scatter, and each view's residual."""
    figure = Figure(figsize=(11.0, 7.2), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=[1.7, 1.0])
    _draw_image(figure.add_subplot(grid[:, 0]), solution)
    _draw_scatter(figure.add_subplot(grid[0, 1]), solution)
    _draw_views(figure.add_subplot(grid[1, 1]), solution)
    figure.savefig(path, dpi=DPI)


def _draw_image(axes: Axes, solution: Solution) -> None:
    camera = solution.camera
    corners = np.concatenate([view.corners for view in solution.views])
    residuals = np.concatenate(solution.residuals)
    axes.plot(*corners.T, ".", color="#8fb3d9", markersize=3.0, zorder=1)
    axes.quiver(
        *corners.T, *residuals.T, angles="xy", scale_units="xy", scale=1.0 / MAGNIFIED, width=1.5e-3, color="#b4530a"
    )
    axes.plot(camera.cx, camera.cy, "+", color="#1b1f24", markersize=10.0)
    axes.set_xlim(-0.5, camera.width - 0.5)
    axes.set_ylim(camera.height - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_title(f"corners of {len(solution.views)} views, residuals x {MAGNIFIED:g}", fontsize=10)
    axes.set_xlabel("u [px]")
    axes.set_ylabel("v [px]")


def _draw_scatter(axes: Axes, solution: Solution) -> None:
    residuals = np.concatenate(solution.residuals)
    axes.plot(*residuals.T, ".", color="#b4530a", markersize=2.0)
    reach = 1.05 * max(float(np.abs(residuals).max()), 1e-3)
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)
    axes.axhline(0.0, color="#8c959f", linewidth=0.6)
    axes.axvline(0.0, color="#8c959f", linewidth=0.6)
    axes.set_aspect("equal")
    axes.set_title(f"residuals [px], rms {solution.rms:.3f} px", fontsize=10)


def _draw_views(axes: Axes, solution: Solution) -> None:
    rms = solution.view_rms
    axes.barh(np.arange(len(rms)), rms, color="#8fb3d9")
    axes.axvline(solution.rms, color="#1b1f24", linewidth=0.8, linestyle="--")
    names = [f"{v.name}, {np.rad2deg(t):.0f}°" for v, t in zip(solution.views, solution.tilts, strict=True)]
    axes.set_yticks(np.arange(len(rms)), names, fontsize=max(4.0, min(8.0, 160.0 / len(rms))))
    axes.invert_yaxis()
    axes.set_title("rms [px] of each view, and its tilt", fontsize=10)


#: The image is divided into so many cells each way to see how much of it the corners cover.
CELLS = 10
LEAST_COVERAGE = 0.5
#: A larger residual than this, pixels, says that something is wrong.
LARGE_RMS = 0.7
#: A board bent by more than this part of its length is worth a remark.
BENT = 0.005
#: Principal points by parts of the views of one camera are this close, as a part of the width: real ones up to 0.01.
MOST_APART = 0.02


def _of_two_cameras(solution: Solution, board: CalibrationBoard) -> Iterator[str]:
    """What to tell if views whose names begin differently, left01.jpg and right01.jpg say, give different cameras."""
    groups: dict[str, list[View]] = {}
    for view in solution.views:
        groups.setdefault(re.split(r"\d", view.name)[0], []).append(view)
    if len(groups) < 2 or min(map(len, groups.values())) < FEWEST_VIEWS:
        return
    size = (solution.camera.width, solution.camera.height)
    try:
        cameras = [solve_intrinsics(views, board, size, solution.camera.lens_model).camera for views in groups.values()]
    except CameraError:
        return  # a group alone does not determine its camera
    centres = np.array([camera.intrinsics[2:] for camera in cameras])
    apart = float(np.linalg.norm(centres[:, None] - centres, axis=2).max())
    if apart > MOST_APART * size[0]:
        names = " and ".join(f"'{name}...'" for name in groups)
        yield f"the views {names} give principal points up to {apart:.0f} px apart: calibrate each camera by itself"


@dataclass(frozen=True)
class Calibration:
    """What was solved, from what, and the picture of its residuals, where one was written."""

    solution: Solution
    found: Views
    board: CalibrationBoard
    picture: Path | None = None

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
        yield from camera_doubts(solution.camera)
        yield from _of_two_cameras(solution, self.board)
        if solution.flatness > BENT * self.board.length:
            yield f"the board is bent: its corners are up to {1e3 * solution.flatness:.1f} mm off its plane"

    def table(self) -> str:
        """The residual and the tilt of each view."""
        width = max(len(view.name) for view in self.solution.views)
        rows = zip(self.solution.views, self.solution.view_rms, self.solution.tilts, strict=True)
        lines = [f"{view.name:<{width}}  {rms:6.3f}  {np.rad2deg(tilt):8.1f}" for view, rms, tilt in rows]
        return "\n".join([f"{'view':<{width}}  rms_px  tilt_deg", *lines])

    def line(self) -> str:
        """The one line that sums it up."""
        camera, (of_fx, _), (of_cx, of_cy) = (
            self.solution.camera,
            self.solution.focal_deviation,
            self.solution.centre_deviation,
        )
        return (
            f"fx={camera.fx:.2f} fy={camera.fy:.2f} cx={camera.cx:.2f} cy={camera.cy:.2f} "
            f"sd_fx={of_fx:.2f} sd_cx={of_cx:.2f} sd_cy={of_cy:.2f} rms_px={self.solution.rms:.3f} "
            f"views={len(self.solution.views)}/{self.found.n_searched} coverage={100 * self.coverage:.0f}%"
        )


def calibrate(
    sources: Sequence[str | Path],
    board: CalibrationBoard,
    output: str | Path | None = None,
    lens_model: LensModel = "radial-tangential",
) -> Calibration:
    """Calibrate a camera; its intrinsics and distortion are the ``solution.camera`` of the result.

    Parameters
    ----------
    sources : images, one folder of images, or one video or other recording.
    board : that they show.
    output : the camera file to write, and beside it a picture of the residuals; None to write nothing.
    lens_model : of the camera.

    Raises CameraError if the board is found in too few images, images differ in size, the views do not determine the
    focal length, or the camera file cannot be written. Raises SourceError if an image or a video cannot be read.
    """
    picture = None if output is None else check_output(Path(output))
    found = collect_views([Path(source) for source in sources], board, ignored=picture)
    calibration = Calibration(solve_intrinsics(found.views, board, found.size, lens_model), found, board, picture)
    if output is not None and picture is not None:
        with writing(CameraError):
            save_camera(Path(output), calibration.solution.camera)
            plot_calibration(picture, calibration.solution)
    return calibration


def check_output(output: Path) -> Path:
    """Where the picture of a calibration goes, by its camera file, which is checked."""
    if output.suffix not in (".yaml", ".yml"):
        raise CameraError(f"cannot write {output}: a camera file has the ending .yaml")
    if not output.parent.is_dir():
        raise CameraError(f"cannot write {output}: there is no folder {output.parent}")
    return output.with_name(f"{output.stem}_calibration.png")
