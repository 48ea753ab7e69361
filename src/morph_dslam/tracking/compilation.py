"""Inner loops are compiled, which takes a while the first time that they are used: says so, and does it beforehand."""

from __future__ import annotations

import logging
from functools import cache
from pathlib import Path

import numpy as np

from morph_dslam.render.overlay import draw_overlay
from morph_dslam.render.shading import lambert, vertex_normals
from morph_dslam.tracking import reprojection

_LOG = logging.getLogger("morph_dslam")


@cache
def announce_compilation() -> None:
    """Warn in the log, once a process, if no earlier process has left the compiled loops on disk."""
    if not _is_compiled():
        _LOG.warning("compiling the inner loops, once after the installation: this takes about a minute ...")


def _is_compiled() -> bool:
    """Whether the cache has the loop that all estimates run through; also where compiling is switched off."""
    stats = getattr(reprojection.linearise, "stats", None)
    if stats is None:
        return True
    # Numba names the index of a compiled function by its first line: one of an older version does not count.
    line = reprojection.linearise.py_func.__code__.co_firstlineno
    return any(Path(stats.cache_path).glob(f"reprojection.linearise-{line}.*.nbi"))


def compile_drawing() -> None:
    """Draw a triangle, so that the first live picture takes no longer than the others."""
    image = np.zeros((240, 320, 3), dtype=np.uint8)
    nodes = np.array([[10.0, 10.0, 1.0], [30.0, 10.0, 1.0], [10.0, 30.0, 1.0]])
    triangles = np.array([[0, 2, 1]])
    light = lambert(vertex_normals(nodes, triangles), np.array([0.0, 0.0, -1.0]), 0.5)
    draw_overlay(image, nodes[:, :2], nodes[:, 2], triangles, np.zeros(3), (0.0, 1.0), label="x", brightness=light)
