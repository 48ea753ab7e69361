"""The fields that snapshots hold, and the reduced model that separated fields make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel, SeparatedField
from morph_dslam.offline.problem import Snapshot
from morph_dslam.offline.reactions import REACTION
from morph_dslam.offline.reduction.task import ReductionTask

Array = NDArray[np.float64]

STRESS = "stress_"


def field_names(snapshots: Sequence[Snapshot]) -> list[str]:
    """The names of all fields, as the model file has them."""
    return list(snapshots[0].fields)


class FieldRows:
    """One field of all snapshots as rows (n_snapshots, n_points * n_components), gathered when sliced.

    It stands for the array where that may not fit in memory (`morph_dslam.offline.reduction.pod`).
    """

    def __init__(self, snapshots: Sequence[Snapshot], name: str) -> None:
        self._snapshots, self._name = snapshots, name
        self.field_shape = snapshots[0].fields[name].shape
        self.shape = len(snapshots), int(np.prod(self.field_shape))

    def __getitem__(self, rows: slice) -> Array:
        values = [snapshot.fields[self._name].ravel() for snapshot in self._snapshots[rows]]
        return np.array(values, dtype=np.float64)


def field_values(snapshots: Sequence[Snapshot], name: str) -> Array:
    """The values (n_snapshots, n_points, n_components) of one field in all snapshots."""
    return np.array([snapshot.fields[name] for snapshot in snapshots], dtype=np.float64)


def model_of(
    task: ReductionTask, fields: Mapping[str, SeparatedField], summary: dict[str, Any]
) -> ReducedModel:
    """The reduced model of separated fields by name, with what the method says of itself."""
    return ReducedModel(
        name=task.name,
        nodes=task.mesh.nodes,
        triangles=task.mesh.triangles,
        cells=task.mesh.cells,
        parameters=task.parameters,
        displacement=fields["displacement"],
        stresses=_without_prefix(fields, STRESS),
        strain=fields.get("strain"),
        reactions=_without_prefix(fields, REACTION),
        certificate={"reduction": summary},
    )


def _without_prefix(fields: Mapping[str, SeparatedField], prefix: str) -> dict[str, SeparatedField]:
    """The fields whose names start with ``prefix``, under the rest of their names."""
    return {name.removeprefix(prefix): field for name, field in fields.items() if name.startswith(prefix)}
