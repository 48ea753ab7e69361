"""The paper's figure of separated modes, and the error against the number of modes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from cantilever import HEIGHT, LENGTH, Cantilever
from matplotlib.figure import Figure

from morph_dslam.extend.reduction import PgdSolution

N_SHOWN = 5
SLICE = 0.6  # position of the load that is cut out of the response surface, in lengths


def draw_modes(beam: Cantilever, solution: PgdSolution, path: Path) -> None:
    """(a) vertical modes in space, (b) modes in the load's position, (c) the response surface and a slice."""
    figure = Figure(figsize=(11.5, 7.2), layout="constrained")
    halves = figure.add_gridspec(1, 2, width_ratios=(1.0, 1.1))
    left, right = (figure.add_subfigure(halves[0, i]) for i in (0, 1))
    _draw_space(left, beam, solution)
    parts = right.add_gridspec(2, 1, height_ratios=(1.0, 1.5))
    upper, lower = (right.add_subfigure(parts[i, 0]) for i in (0, 1))
    _draw_positions(upper, beam, solution)
    _draw_response(lower, beam, solution)
    figure.savefig(path, dpi=110)


def _draw_space(figure, beam: Cantilever, solution: PgdSolution) -> None:
    figure.suptitle("(a) modes in space, vertical component (height enlarged)", fontsize=10)
    axes = figure.subplots(N_SHOWN, 1, sharex=True)
    for i, ax in enumerate(axes):
        mode = beam.vertical @ solution.modes[i]
        largest = np.abs(mode).max()
        picture = ax.tripcolor(
            *beam.vertices.T,
            mode / largest,
            triangles=beam.triangles,
            shading="gouraud",
            cmap="RdBu_r",
            vmin=-1.0,
            vmax=1.0,
        )
        ax.set_xlim(0.0, LENGTH)
        ax.set_title(f"$F_{i + 1}$, largest {largest:.1e} m", fontsize=9)
        ax.set_yticks([0.0, HEIGHT])
        ax.set_ylabel("Y, m", labelpad=-6)
    axes[-1].set_xlabel("X, m")
    figure.colorbar(picture, ax=axes, shrink=0.5, label="relative to its largest value")


def _draw_positions(figure, beam: Cantilever, solution: PgdSolution) -> None:
    figure.suptitle("(b) modes in the position of the load", fontsize=10)
    ax = figure.subplots()
    values = solution.functions.bases[0].evaluate(beam.positions) @ solution.functions.factors[0]
    for i in range(N_SHOWN):
        ax.plot(beam.positions, values[:, i], label=f"$G_{i + 1}$", linewidth=1.4)
    ax.set_xlabel("s, m")
    ax.set_xlim(0.0, LENGTH)
    ax.grid(alpha=0.3)
    ax.legend(ncols=N_SHOWN, fontsize=8, loc="upper left")


def _draw_response(figure, beam: Cantilever, solution: PgdSolution) -> None:
    figure.suptitle("(c) vertical displacement of the upper face, and the slice at $s_0$", fontsize=10)
    ax = figure.subplots(subplot_kw={"projection": "3d"})
    functions = solution.functions.bases[0].evaluate(beam.positions) @ solution.functions.factors[0]
    surface = 1e6 * (functions @ (beam.vertical @ solution.modes.T)[beam.top].T)
    x = beam.vertices[beam.top, 0]
    ax.plot_surface(*np.meshgrid(x, beam.positions), surface, cmap="viridis", alpha=0.75, rcount=60, ccount=60)
    values, _ = solution.functions.evaluate([SLICE * LENGTH])
    slice_ = 1e6 * (beam.vertical @ (values @ solution.modes))[beam.top]
    ax.plot(x, np.full(len(x), SLICE * LENGTH), slice_, color="#b4530a", linewidth=2.5, zorder=5)
    ax.set_xlabel("X, m")
    ax.set_ylabel("s, m")
    ax.set_zlabel("$U_Y$, µm", labelpad=9)
    ax.set_box_aspect((1.0, 1.0, 0.7), zoom=1.0)
    ax.view_init(elev=24, azim=-60)


def draw_errors(counts: tuple[int, ...], results: dict[str, list[float]], path: Path) -> None:
    """Error against the number of modes beside the least possible one."""
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    ax = figure.subplots()
    for key, best, colour, label in (
        ("energy", "best_energy", "#1f5c99", "energy norm"),
        ("l2", "best_l2", "#b4530a", "L2 norm"),
    ):
        ax.semilogy(counts, results[key], "o-", color=colour, label=f"PGD, {label}")
        ax.semilogy(counts, results[best], "k:", linewidth=2.0, label=f"optimum (SVD), {label}")
    ax.semilogy(counts, results["dual"], "x", color="#1b1f24", markersize=9, label="dual residual of PGD")
    ax.set_xlabel("number of modes")
    ax.set_ylabel("relative error")
    ax.set_xticks(counts)
    ax.grid(alpha=0.3, which="both")
    ax.legend(fontsize=8)
    figure.savefig(path, dpi=110)
