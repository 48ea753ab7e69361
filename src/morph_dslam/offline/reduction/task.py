"""What every method of reduction is given."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import Parameter
from morph_dslam.offline.problem import ModelMesh, Snapshot, SweepProblem
from morph_dslam.offline.studies.study_sections import ReductionSection

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ReductionTask:
    """Solutions to reduce.

    Attributes
    ----------
    mesh : that of the model.
    parameters : with the box that the functions are fitted in.
    groups : snapshots to make the model from; those of one group are mirror images of one solution.
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
