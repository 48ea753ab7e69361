"""Inner structures placed in a solid: which cell each of their nodes lies in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import ParameterError, StudyError
from morph_dslam.meshing.netgen_meshing import read_surface
from morph_dslam.model import ReducedModel
from morph_dslam.model.inner_structure import InnerStructure
from morph_dslam.units import to_si

Array = NDArray[np.float64]


def place_inner_structure(model: ReducedModel, name: str, nodes: Array, triangles: NDArray[np.int64]) -> InnerStructure:
    """A mesh inside of the undeformed solid as a structure that the model carries.

    Parameters
    ----------
    model : of the solid.
    name : of the structure.
    nodes : (p, 3) in the object frame, metres.
    triangles : (m, 3) its surface, node indices.
    """
    if not model.cells:
        raise StudyError(f"'{model.name}' is the model of a surface: it has no inside for '{name}'")
    try:
        points = model.points(nodes)
    except ParameterError as error:
        low, high = (
            ", ".join(f"{1e3 * value:.1f}" for value in corner)
            for corner in (model.nodes.min(axis=0), model.nodes.max(axis=0))
        )
        raise StudyError(
            f"the inner structure '{name}' does not fit into '{model.name}': {error}; the solid reaches from "
            f"({low}) to ({high}) mm. Is the unit right, and is it drawn in the object's frame?"
        ) from error
    # Shape functions reproduce the positions to rounding; what is kept is what the model says.
    rest, points = model.rest_positions(points), replace(points, places=None)  # the structure has them itself
    return InnerStructure(name, rest, triangles.astype(np.int64), points)


def read_inner_structure(model: ReducedModel, name: str, path: Path, unit: str) -> InnerStructure:
    """The same from a surface file (.stl, .obj, .ply) drawn in ``unit`` in the object frame."""
    surface = read_surface(path)
    return place_inner_structure(model, name, to_si(1.0, unit, "length") * surface.points, surface.triangles)
