"""All fields of a solid at reduced solutions, as coefficients of modes that the full solutions span.

Each field has modes of its own: those of the training snapshots and of their sensitivities times the ranges
of the parameters. What the modes cannot hold of the fields sampled is measured.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from morph_dslam.mechanics.loads import with_reactions
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.reduction.galerkin import ReducedSolver
from morph_dslam.reduction.pod import compute_pod, weighted
from morph_dslam.studies.problem import Snapshot
from morph_dslam.studies.solid_sweep import snapshot_fields, support_reactions

Array = NDArray[np.float64]

#: Error allowed in all fields but the displacement, as a multiple of the tolerance.
OTHER_FIELDS = 40.0

#: Modes of a field are kept until so little is left out, as a part of the tolerance, and at most so many.
MODE_TOLERANCE, MOST_MODES = 0.1, 80


def solid_displacement(problem: SolidProblem, dofs: Array, mu: Array) -> Array:
    """Displacement (n, 3) of a state from the mesh's nodes, the change of the undeformed shape included."""
    displacement = problem.nodal_displacement(dofs)
    if problem.shape.functions:
        problem.symbols.set(mu)
        moved = problem.displacements.node_values @ problem.shape.coordinates(problem.symbols)
        displacement = displacement + moved - problem.mesh.nodes
    return displacement


def solid_snapshot(problem: SolidProblem, dofs: Array, mu: Array, reactions: Sequence[str] = ()) -> Snapshot:
    """The fields of a state at the nodes, with the reactions named."""
    fields = snapshot_fields(problem.sample(dofs, mu)) | {"displacement": solid_displacement(problem, dofs, mu)}
    outputs = support_reactions(problem, dofs, mu) if reactions else {}
    return with_reactions(Snapshot(mu, fields, outputs=outputs), reactions)


class FieldModes:
    """Orthonormal modes (k, n_points, n_components) of one field.

    Parameters
    ----------
    values : (n, n_points, n_components) vectors that the modes span. weights : (n_points,).
    n_values : how many of them, the first ones, are values of the field and no sensitivities.

    Attributes
    ----------
    largest : norm of the largest value.
    """

    def __init__(self, values: Array, weights: Array, tolerance: float, n_values: int) -> None:
        shape = values.shape[1:]
        pod = compute_pod(
            values.reshape(len(values), -1), np.repeat(weights, shape[1]), MODE_TOLERANCE * tolerance, MOST_MODES
        )
        self._pod = pod
        self.modes = pod.modes.reshape(-1, *shape)
        self.largest = float(np.linalg.norm(pod.project(values.reshape(len(values), -1)[:n_values]), axis=1).max())
        self._square, self._missed = 0.0, 0.0

    def coefficients(self, values: Array) -> Array:
        """Coefficients (k,) of a field (n_points, n_components); what is left out is added to the tally."""
        flat = values.ravel()
        found = self._pod.project(flat)
        square = float(flat @ weighted(flat, self._pod.weights))
        self._square += square
        self._missed += max(square - float(found @ found), 0.0)
        return found

    @property
    def left_out(self) -> float:
        """Relative norm of the fields so far that the modes do not hold."""
        return float(np.sqrt(self._missed / self._square)) if self._square else 0.0


def field_modes(
    snapshots: Sequence[Snapshot], name: str, weights: Array, spread: Array, tolerance: float
) -> FieldModes:
    """Modes of a field's values and of its sensitivities times the parameters' ranges ``spread`` (d,)."""
    values = [np.asarray(snapshot.fields[name], dtype=np.float64) for snapshot in snapshots]
    if name in snapshots[0].sensitivities:
        values += [
            slope * length
            for snapshot in snapshots
            for slope, length in zip(snapshot.sensitivities[name], spread, strict=True)
        ]
    points = values[0].shape[0]
    weights = weights if len(weights) == points else np.ones(points)
    return FieldModes(np.array(values), weights, tolerance, len(snapshots))


class SampledFields:
    """Coefficients of all fields at any parameters, one after another in one vector.

    Parameters
    ----------
    modes : of each field by name; names of reactions begin with "reaction_".
    tolerance : error allowed in the displacement, relative to its largest value.

    Attributes
    ----------
    parts : where the coefficients of each field are.
    """

    def __init__(
        self, solver: ReducedSolver, problem: SolidProblem, modes: dict[str, FieldModes], tolerance: float
    ) -> None:
        self._solver, self._problem, self.modes = solver, problem, modes
        self._reactions = [name.removeprefix("reaction_") for name in modes if name.startswith("reaction_")]
        self._allowed = tolerance * np.concatenate(
            [
                np.full(len(m.modes), m.largest * (1.0 if name == "displacement" else OTHER_FIELDS))
                for name, m in modes.items()
            ]
        )
        ends = np.cumsum([0, *(len(field.modes) for field in modes.values())])
        self.parts = {name: slice(a, b) for name, a, b in zip(modes, ends[:-1], ends[1:], strict=True)}

    def __call__(self, mu: Array) -> Array:
        """Coefficients of all fields (n,) at ``mu`` (d,)."""
        dofs = self._solver.lift(self._solver.solve(mu), mu)
        snapshot = solid_snapshot(self._problem, dofs, mu, self._reactions)
        return np.concatenate([field.coefficients(snapshot.fields[name]) for name, field in self.modes.items()])

    def in_allowed_units(self, mu: Array) -> Array:
        """The same in units of the error allowed in each field."""
        return self(mu) / self._allowed
