"""How the report's plots look, and how they get into the page."""

from __future__ import annotations

from io import BytesIO
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from morph_dslam.evaluation.report import Picture

OURS, REFERENCE, FAILED, GREY = "#0b5cad", "#b4530a", "#c1272d", "#57606a"
#: Width of the page's text, inches.
WIDTH = 10.3
#: Colours of the first modes, distinct for colour-blind readers too (Okabe and Ito 2008).
CYCLE = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")

_STYLE: dict[Any, Any] = {
    "font.size": 9.5,
    "axes.titlesize": 10,
    "axes.edgecolor": "#8c959f",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e8ec",
    "grid.linewidth": 0.7,
    "svg.hashsalt": "morph-dslam",  # the same plot is the same text, every time
}


def panels(n_panels: int, height: float, of_four: int = 2, **options) -> tuple[Figure, list[Axes]]:
    """A figure of ``n_panels`` axes in rows of ``height`` inches, three in a row, or four ``of_four`` a row.

    ``options`` are those of `Figure.subplots`.
    """
    columns = of_four if n_panels == 4 else min(n_panels, 3)
    rows = -(-n_panels // columns)
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(WIDTH, height * rows), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, **options).ravel().tolist()
    for unused in axes[n_panels:]:
        unused.remove()
    for used in axes[:n_panels]:
        used.xaxis.set_major_locator(MaxNLocator(12 // columns + 1, steps=[1, 2, 2.5, 5, 10]))
    return figure, axes[:n_panels]


def drawing(figure: Figure, caption: str) -> Picture:
    """A figure of lines and letters for the page, sharp at every size."""
    with matplotlib.rc_context(_STYLE):
        buffer = BytesIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return Picture(buffer.getvalue(), ".svg", caption)


def photograph(figure: Figure, caption: str) -> Picture:
    """A figure that holds rendered pictures for the page."""
    with matplotlib.rc_context(_STYLE):
        buffer = BytesIO()
        figure.savefig(buffer, format="png", dpi=144)
    return Picture(buffer.getvalue(), ".png", caption)
