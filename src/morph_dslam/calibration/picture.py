"""A picture of a calibration: what of the image the board covered, and the residuals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from morph_dslam.calibration.solve import Solution

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
    residuals = solution.residuals.reshape(-1, 2)
    axes.plot(*corners.T, ".", color="#8fb3d9", markersize=3.0, zorder=1)
    axes.quiver(
        *corners.T,
        *residuals.T,
        angles="xy",
        scale_units="xy",
        scale=1.0 / MAGNIFIED,
        width=1.5e-3,
        color="#b4530a",
    )
    axes.plot(camera.cx, camera.cy, "+", color="#1b1f24", markersize=10.0)
    axes.set_xlim(-0.5, camera.width - 0.5)
    axes.set_ylim(camera.height - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_title(f"corners of {len(solution.views)} views, residuals x {MAGNIFIED:g}", fontsize=10)
    axes.set_xlabel("u [px]")
    axes.set_ylabel("v [px]")


def _draw_scatter(axes: Axes, solution: Solution) -> None:
    residuals = solution.residuals.reshape(-1, 2)
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
