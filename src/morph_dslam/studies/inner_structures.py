"""Inner structures placed in a solid: which cell each of their nodes lies in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import ParameterError, StudyError
from morph_dslam.io.text import PLAIN_NAME, PLAIN_NAME_RULE
from morph_dslam.meshing.mesh_checks import described_extent
from morph_dslam.meshing.netgen_meshing import read_surface
from morph_dslam.model import ReducedModel
from morph_dslam.model.inner_structure import InnerStructure
from morph_dslam.units import FACTORS, to_si

Array = NDArray[np.float64]
#: Shares of the solid's diagonal: below the first one a structure's unit is doubted where a larger unit leaves it
#: inside, below the second one anyway. A bead of 1 mm in an organ is below the first.
SMALL_SHARE, TINY_SHARE = 1e-2, 1e-3


def place_inner_structure(model: ReducedModel, name: str, nodes: Array, triangles: NDArray[np.int64]) -> InnerStructure:
    """A mesh inside of the undeformed solid as a structure that the model carries.

    Parameters
    ----------
    model : of the solid.
    name : of the structure.
    nodes : (p, 3) in the object frame, metres.
    triangles : (m, 3) its surface, node indices.
    """
    if not PLAIN_NAME.fullmatch(name):
        raise StudyError(f"'{name}' is no name of an inner structure: {PLAIN_NAME_RULE}")
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


def read_inner_structure(model: ReducedModel, name: str, path: str | Path, unit: str) -> InnerStructure:
    """The same from a surface file (.stl, .obj, .ply) drawn in ``unit`` in the object frame."""
    path = Path(path)
    surface = read_surface(path)
    return place_inner_structure(model, name, to_si(1.0, unit, "length") * surface.points, surface.triangles)


def described_inner(structure: InnerStructure) -> str:
    """Size and middle of a structure in the undeformed object, "16 x 16 x 16 mm around (50, 30, 20) mm"."""
    middle = ", ".join(f"{round(1e3 * value, 2) + 0.0:g}" for value in structure.rest.mean(axis=0))
    return f"{described_extent(1e3 * np.ptp(structure.rest, axis=0))} mm around ({middle}) mm"


def inner_size_note(model: ReducedModel, structure: InnerStructure, unit: str) -> str | None:
    """That a structure is hardly as small as it is in its solid; None if it may be.

    Parameters
    ----------
    model : of the solid.
    structure : that lies inside of it.
    unit : of length, that it was read in.
    """
    extent, solid = np.ptp(structure.rest, axis=0), np.ptp(model.nodes, axis=0)
    share = float(np.linalg.norm(extent) / np.linalg.norm(solid))
    if share >= SMALL_SHARE:
        return None
    # Of a structure near the origin, intermediate units leave it inside too; the largest one makes the most of it.
    larger = sorted(
        ((FACTORS["length"][name] / FACTORS["length"][unit], name) for name in FACTORS["length"]), reverse=True
    )
    fitting = next(((f, name) for f, name in larger if f > 1.0 and _is_inside(model, f * structure.rest)), None)
    if fitting is None and share >= TINY_SHARE:
        return None
    measured = f"{described_extent(1e3 * extent)} mm in a solid of {described_extent(1e3 * solid)} mm"
    if fitting is None:
        return f"'{structure.name}' measures {measured}: is --unit {unit} right?"
    factor, name = fitting
    return (
        f"'{structure.name}' measures {measured}; drawn in {name}, it would measure "
        f"{described_extent(1e3 * factor * extent)} mm and lie inside too: if so, make it again with --unit {name}"
    )


def _is_inside(model: ReducedModel, nodes: Array) -> bool:
    try:
        model.points(nodes)
    except ParameterError:
        return False
    return True
