"""What every method of reduction is given, and functions of one parameter by the names that study files use."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.basis_functions import (
    Basis,
    chebyshev_basis,
    cubic_spline_basis,
    fourier_basis,
    hat_basis,
    kriging_basis,
    p_spline_basis,
)
from morph_dslam.model.reduced_model import REACTION
from morph_dslam.studies.problem import ModelMesh, Snapshot, SweepProblem
from morph_dslam.studies.sections import BasisName, ReductionSection

Array = NDArray[np.float64]
STRESS = "stress_"


@dataclass(frozen=True)
class ReductionTask:
    """Solutions to reduce.

    Attributes
    ----------
    mesh : that of the model.
    parameters : with the box that the functions are fitted in.
    groups : training snapshots; those of one group are mirror images of one solution.
    options : the study's [reduction].
    name : the study's name.
    problem : makes what the study is solved with; None for solutions of another program.
    files : where the solutions are kept with the solver's states, one for each group; as of ``problem``.
    """

    mesh: ModelMesh
    parameters: tuple[Parameter, ...]
    groups: list[list[Snapshot]]
    options: ReductionSection
    name: str = ""
    problem: Callable[[], SweepProblem] | None = None
    files: tuple[Path, ...] = ()

    @property
    def box(self) -> Array:
        """Lower and upper ends (d, 2) of the parameters, SI."""
        return np.array([[parameter.lower, parameter.upper] for parameter in self.parameters])

    @cached_property
    def snapshots(self) -> list[Snapshot]:
        """The training snapshots of all groups, one after another."""
        return [snapshot for group in self.groups for snapshot in group]

    @cached_property
    def samples(self) -> Array:
        """Parameters (n, d) of the snapshots, SI."""
        return np.array([snapshot.coordinates for snapshot in self.snapshots])

    @cached_property
    def labels(self) -> NDArray[np.int64]:
        """The group (n,) that each snapshot belongs to: mirror images are left out of a fit together."""
        return np.repeat(np.arange(len(self.groups)), [len(group) for group in self.groups])

    @property
    def field_names(self) -> list[str]:
        """The names of all fields, as the model file has them; "displacement" is always among them."""
        return list(self.snapshots[0].fields)

    def values(self, name: str) -> Array:
        """The values (n, n_points, n_components) of a field in all snapshots."""
        return np.array([snapshot.fields[name] for snapshot in self.snapshots], dtype=np.float64)

    def weights(self, n_points: int) -> Array:
        """Weights (n_points,) of a field's points: the nodes' shares of the volume; 1 for other points."""
        return self.mesh.weights if n_points == len(self.mesh.weights) else np.ones(n_points)

    def model(self, fields: Mapping[str, SeparatedField], summary: dict[str, Any]) -> ReducedModel:
        """The reduced model of separated fields by name, with what the method says of itself.

        Raises
        ------
        StudyError
            If the displacement is not among the fields.
        """
        if "displacement" not in fields:
            raise StudyError(
                f"the fields of a reduced model are {', '.join(fields) or 'none'}: give those of task.field_names, "
                "'displacement' among them"
            )
        return ReducedModel(
            name=self.name,
            nodes=self.mesh.nodes,
            triangles=self.mesh.triangles,
            cells=self.mesh.cells,
            supports=self.mesh.supports,
            parameters=self.parameters,
            displacement=fields["displacement"],
            stresses=_without_prefix(fields, STRESS),
            strain=fields.get("strain"),
            reactions=_without_prefix(fields, REACTION),
            certificate={"reduction": summary},
        )


def _without_prefix(fields: Mapping[str, SeparatedField], prefix: str) -> dict[str, SeparatedField]:
    """The fields whose names start with ``prefix``, under the rest of their names."""
    return {name.removeprefix(prefix): field for name, field in fields.items() if name.startswith(prefix)}


#: Correlation length of kriging over the size of the range.
CORRELATION = 0.5


def is_periodic(parameter: Parameter) -> bool:
    """Whether the parameter is an angle that covers one full turn."""
    return parameter.quantity == "angle" and bool(np.isclose(parameter.upper - parameter.lower, 2.0 * np.pi, rtol=1e-9))


def parameter_basis(name: BasisName, parameter: Parameter, size: int) -> Basis:
    """About ``size`` functions on a parameter's range.

    Splines have at least four functions; Fourier functions come in pairs beside the constant. Where "fourier"
    is asked for, parameters that are no full turn have Chebyshev polynomials.
    """
    lower, upper = parameter.lower, parameter.upper
    nodes = np.linspace(lower, upper, max(size, 2 if name == "hat" else 4))
    if name == "fourier" and is_periodic(parameter):
        return fourier_basis(lower, upper, max(size // 2, 1))
    if name == "cubic_spline":
        return cubic_spline_basis(nodes)
    if name == "p_spline":
        return p_spline_basis(lower, upper, len(nodes))
    if name == "kriging":
        return kriging_basis(lower, upper, nodes, CORRELATION * (upper - lower))
    if name == "hat":
        return hat_basis(nodes)
    return chebyshev_basis(lower, upper, max(size, 1) - 1)


def parameter_bases(name: BasisName, parameters: tuple[Parameter, ...], sizes: tuple[int, ...]) -> tuple[Basis, ...]:
    """A basis for each parameter (`parameter_basis`)."""
    if name == "fourier" and not any(is_periodic(parameter) for parameter in parameters):
        raise StudyError(
            'reduction.basis = "fourier" is for angles whose range is a full turn (360 deg), and this '
            'study has none: use "chebyshev"'
        )
    return tuple(parameter_basis(name, p, size) for p, size in zip(parameters, sizes, strict=True))
