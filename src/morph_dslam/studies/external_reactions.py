"""What supports exert in solutions of another program: from forces at points, or from columns of the table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.loads import reaction_names, with_reactions
from morph_dslam.model.reduced_model import FORCE, MOMENT
from morph_dslam.studies.external_table import SolutionTable
from morph_dslam.studies.problem import ModelMesh, Snapshot

Array = NDArray[np.float64]
#: Points with this share of the largest force are held; forces that sum up to so little of their sizes balance.
HELD, BALANCED = 1e-6, 1e-4
#: What the columns of one reaction are, by their number.
_COLUMNS = {3: ("force",) * 3, 6: ("force",) * 3 + ("moment",) * 3}


def columns_of(table: SolutionTable, name: str, columns: Sequence[str]) -> tuple[tuple[str, ...], dict[str, Array]]:
    """A reaction from columns Fx, Fy, Fz, and Mx, My, Mz about the origin if there are six.

    Returns
    -------
    The headers of the columns, and the force (n, 3), N, with the moment (n, 3), N m, by the names that outputs have.

    Raises
    ------
    StudyError
        If there are others than three or six, one is missing, or has no unit of force or moment.
    """
    key = f"external.reactions.{name}"
    if len(columns) not in _COLUMNS:
        raise StudyError(
            f"{key} names {len(columns)} columns: name three of the force, or six with those of the moment"
        )
    headers, values = [], []
    for column, quantity in zip(columns, _COLUMNS[len(columns)], strict=True):
        header, factor = table.column_of(column, quantity, key)
        headers.append(header)
        values.append(factor * table.column(header))
    parts = {FORCE + name: np.transpose(values[:3])} | ({MOMENT + name: np.transpose(values[3:])} if values[3:] else {})
    return tuple(headers), parts


class PointForces:
    """Forces at points that are those of one support, state by state.

    Attributes
    ----------
    name : of the support.
    data : name of the point data.
    """

    def __init__(self, name: str, data: str) -> None:
        self.name, self.data = name, data
        self._size, self._total, self._sizes = 0.0, 0.0, np.zeros(0)

    def take(self, positions: Array, forces: Array) -> dict[str, Array]:
        """Force (3,) and moment (3,) about the origin of forces (n, 3), N, at deformed positions (n, 3), m."""
        sizes, total = np.linalg.norm(forces, axis=1), forces.sum(axis=0)
        self._sizes = np.maximum(self._sizes, sizes) if len(self._sizes) else sizes
        self._size += float(sizes.sum())
        self._total += float(np.linalg.norm(total))
        return {FORCE + self.name: total, MOMENT + self.name: np.cross(positions, forces).sum(axis=0)}

    def held(self, used: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Where forces act, as indices (k,) of the nodes that are used (n,).

        Raises
        ------
        StudyError
            If the forces vanish in all states taken, or balance as those of several supports do.
        """
        key = f"external.reactions.{self.name}: the forces '{self.data}'"
        if self._size == 0.0:
            raise StudyError(f"{key} are zero in all solutions: name those of a support")
        if self._total < BALANCED * self._size:
            raise StudyError(
                f"{key} balance, so they are those of several supports: write point data of each support that are "
                "zero elsewhere, or name three columns of the table with its force"
            )
        return np.flatnonzero((self._sizes > HELD * self._sizes.max())[used])


def as_fields(mesh: ModelMesh, snapshots: Sequence[Snapshot], names: Mapping[str, object]) -> list[Snapshot]:
    """The snapshots with the reactions among their outputs as fields; StudyError if that of a name is none."""
    found = reaction_names(snapshots, float(np.linalg.norm(np.ptp(mesh.nodes, axis=0))))
    missing = next((name for name in names if FORCE + name not in found), None)
    if missing is not None:
        raise StudyError(
            f"external.reactions.{missing}: its force is zero, or rounding of the others', in all solutions"
        )
    return [replace(with_reactions(snapshot, found), outputs={}) for snapshot in snapshots]
