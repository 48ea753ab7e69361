"""What a study and the sweep agree on: any problem that offers this is solved, reduced and certified alike.

A `ParametricStudy` is the description: light, picklable, sent to worker processes. A `SweepProblem` is what
it is solved with: heavy, made once in each worker. A `Snapshot` is what one solution leaves behind.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.model import Parameter
from morph_dslam.studies.sections import ReductionSection, SamplingSection, WorkSection

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Snapshot:
    """One solution at the nodes of the model's mesh.

    Attributes
    ----------
    coordinates : (d,) parameters, SI.
    fields : by name, (n, c): "displacement" (n, 3) m and, by kind of object, "stress_top" and "stress_bottom"
        (n, 3) or "stress_solid" (n, 6) Pa and "strain" (n, 6). The names are those of the model file. A
        snapshot on disk reads them each time (`morph_dslam.studies.snapshots.StoredArrays`).
    sensitivities : derivatives (d, n, c) of the same fields, and of reactions as fields (1, 3), by the parameters;
        empty where they are unknown.
    outputs : other results by name, recorded but not reduced: a grip's motion, the reaction of a support.
    """

    coordinates: Array
    fields: dict[str, Array]
    sensitivities: dict[str, Array] = field(default_factory=dict)
    outputs: dict[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class ModelMesh:
    """The mesh that a model file holds.

    Attributes
    ----------
    nodes : (n, 3) undeformed, m.
    triangles : (t, 3) the visible surface.
    cells : volume cells (m, k) by type; empty for sheets.
    supports : nodes (k,) that supports hold, by the name of the set.
    weights : (n,) share of each node in the volume, or in a sheet's area; they sum to 1.
    """

    nodes: Array
    triangles: NDArray[np.int64]
    weights: Array
    cells: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    supports: dict[str, NDArray[np.int64]] = field(default_factory=dict)


class SweepProblem(Protocol):
    """Solves a study. ``Any`` below stands for the problem's own kind of state."""

    def first_state(self) -> Any:
        """The state that every path starts from, at `ParametricStudy.root`."""
        ...

    def pack(self, state: Any) -> dict[str, Array]:
        """Everything that must be kept of a state for a neighbour to start from it, by name."""
        ...

    def unpack(self, arrays: dict[str, Array]) -> Any:
        """The state that was packed."""
        ...

    def advance(self, start: Any, target: Array) -> Any:
        """Solve at ``target`` (d,), along the straight line from ``start``.

        Raises
        ------
        SolverError
            Naming the last coordinates that converged.
        """
        ...

    def take_snapshot(self, state: Any) -> Snapshot:
        """Fields of a state and, by implicit differentiation, their sensitivities."""
        ...


class ParametricStudy(Protocol):
    """What to solve, over which box, and how to reduce it. Hashable and picklable."""

    @property
    def name(self) -> str: ...
    @property
    def sampling(self) -> SamplingSection: ...
    @property
    def reduction(self) -> ReductionSection: ...
    @property
    def work(self) -> WorkSection: ...
    @property
    def advice(self) -> str:
        """A sentence on what to change in the study when its problem cannot be solved."""
        ...

    def model_parameters(self) -> tuple[Parameter, ...]:
        """The d parameters as the model file states them."""
        ...

    def fingerprint(self) -> str:
        """Hash of everything that a solution depends on: mechanics, mesh and the code that solves."""
        ...

    def root(self) -> Array:
        """Coordinates (d,) of the state that every path starts from."""
        ...

    def scale(self) -> Array:
        """Lengths (d,) in which distances between samples are measured."""
        ...

    def admissible(self, samples: Array) -> Array:
        """Samples (n, d) moved off states where the equations are singular."""
        ...

    def canonical(self, samples: Array) -> Array:
        """The mirror images of samples (n, d) that are solved in their place; the samples, if none."""
        ...

    def images(self, snapshot: Snapshot) -> list[Snapshot]:
        """The snapshot, and its mirror images that are solutions too."""
        ...

    def sweep_problem(self) -> SweepProblem:
        """What the study is solved with."""
        ...

    def model_mesh(self) -> ModelMesh:
        """The mesh on which snapshots are taken."""
        ...


def bounds(study: ParametricStudy) -> Array:
    """The box (d, 2) of a study, SI."""
    return np.array([[parameter.lower, parameter.upper] for parameter in study.model_parameters()])


def announce(phase: str) -> None:
    """Print the name of the phase that begins, on the stream of the progress bars and above them."""
    tqdm.write(phase, file=sys.stderr)
