"""Directions of fibres and material axes: constant, turned by an angle, or one for each cell of a mesh."""

from __future__ import annotations

from typing import Any

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.offline.materials.base import Constant

#: (x, y, z) of any length, a vector coefficient function, or the name of a field that a mesh will give.
Direction = Any


def unit_direction(direction: Direction, law: str) -> Any:
    """The direction as a unit vector coefficient function.

    Raises
    ------
    StudyError : the direction is zero, is not a vector, or is a name that nobody has given a field for.
    """
    if isinstance(direction, str):
        raise StudyError(
            f"{law} needs the field of directions '{direction}', but the mesh gives none of that name"
        )
    if not isinstance(direction, ngs.CoefficientFunction):
        vector = np.asarray(direction, dtype=float)
        if vector.shape != (3,) or not np.linalg.norm(vector) > 0.0 or not np.all(np.isfinite(vector)):
            raise StudyError(f"{law}: the direction {direction} must be three numbers, not all of them zero")
        return ngs.CF(tuple(vector / np.linalg.norm(vector)))
    return direction / ngs.Norm(direction)


def turned_direction(angle: Constant, start: tuple[float, ...], towards: tuple[float, ...]) -> Any:
    """cos(angle) start + sin(angle) towards, both made orthonormal first; the angle (rad) may be a parameter.

    Raises
    ------
    StudyError : the two directions are zero or parallel.
    """
    a, b = np.asarray(start, dtype=float), np.asarray(towards, dtype=float)
    if a.shape != (3,) or b.shape != (3,) or not np.linalg.norm(np.cross(a, b)) > 1e-9 * (a @ a + b @ b):
        raise StudyError(f"a fibre angle turns from {start} towards {towards}: two directions that differ")
    a = a / np.linalg.norm(a)
    b = b - (a @ b) * a
    b = b / np.linalg.norm(b)
    return ngs.cos(ngs.CF(angle)) * ngs.CF(tuple(a)) + ngs.sin(ngs.CF(angle)) * ngs.CF(tuple(b))


def cell_directions(mesh: ngs.Mesh, directions: NDArray[np.float64]) -> ngs.GridFunction:
    """A field that is constant in each cell, from directions (n_cells, 3) in the mesh's own order of cells.

    Raises
    ------
    StudyError : there is not one direction, other than zero, for each cell.
    """
    directions = np.asarray(directions, dtype=float)
    if directions.shape != (mesh.ne, 3):
        raise StudyError(
            f"fibre directions must be an array ({mesh.ne}, 3), one for each cell, "
            f"but it is {directions.shape}"
        )
    lengths = np.linalg.norm(directions, axis=1)
    if not np.all(lengths > 0.0):
        raise StudyError(f"the fibre direction of cell {int(np.argmin(lengths))} is zero")
    field = ngs.GridFunction(ngs.L2(mesh, order=0) ** 3)
    for component, values in zip(field.components, (directions / lengths[:, None]).T, strict=True):
        component.vec.FV().NumPy()[:] = values
    return field
