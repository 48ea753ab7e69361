"""A solid of variable shape as the sweep sees it: its snapshots' displacements count from the mesh.

The solver's displacements count from the undeformed shape, which itself moves with the parameters. A model
file has the nodes of one mesh, so that deformed positions are these nodes plus the displacement.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.offline.mechanics.solid import SolidProblem
from morph_dslam.offline.problem import Snapshot, SweepProblem

Array = NDArray[np.float64]


class MorphedSweep:
    """Adds the change of shape to another sweep's snapshots (`morph_dslam.offline.problem.SweepProblem`)."""

    def __init__(self, sweep: SweepProblem, problem: SolidProblem) -> None:
        self._sweep, self.problem = sweep, problem

    def first_state(self) -> Any:
        return self._sweep.first_state()

    def pack(self, state: Any) -> dict[str, Array]:
        return self._sweep.pack(state)

    def unpack(self, arrays: dict[str, Array]) -> Any:
        return self._sweep.unpack(arrays)

    def advance(self, start: Any, target: Array) -> Any:
        return self._sweep.advance(start, target)

    def take_snapshot(self, state: Any) -> Snapshot:
        """The sweep's snapshot with displacements from the mesh's nodes."""
        snapshot = self._sweep.take_snapshot(state)
        shape, symbols = self.problem.shape, self.problem.symbols
        at_nodes = self.problem.displacements.node_values
        symbols.set(snapshot.coordinates)
        fields, slopes = dict(snapshot.fields), dict(snapshot.sensitivities)
        fields["displacement"] = (
            fields["displacement"] + at_nodes @ shape.coordinates(symbols) - self.problem.mesh.nodes
        )
        if "displacement" in slopes:
            changes = [at_nodes @ change for change in shape.coordinate_slopes(symbols)]
            slopes["displacement"] = slopes["displacement"] + np.array(changes)
        return replace(snapshot, fields=fields, sensitivities=slopes)
