"""The study of a thin shell: mesh, thickness, material, supports, loads, and the parameters any of them may name."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from functools import partial
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.mechanics.shell_problem import ShellOptions, ShellProblem
from morph_dslam.mechanics.supports import held_still
from morph_dslam.meshing.meshes import Mesh, model_mesh_of
from morph_dslam.studies.body_study import (
    BodyStudy,
    NamedSet,
    check_effect,
    check_names,
    numbered,
    read_once,
    reader_of,
    support_content,
    with_named_sets,
)
from morph_dslam.studies.load_sizes import shell_load_doubt
from morph_dslam.studies.moving_loads import check_reach, check_widths, landing_warnings
from morph_dslam.studies.parameters import ParameterSection
from morph_dslam.studies.problem import ModelMesh, SweepProblem
from morph_dslam.studies.sections import ReductionSection, SamplingSection, Section, UnknownLoadsSection, WorkSection
from morph_dslam.studies.set_sections import SetSection, with_sets
from morph_dslam.studies.shell_sections import (
    ShellLoadSection,
    ShellMaterialSection,
    ShellSection,
    ShellSupportSection,
    SurfaceSection,
    check_symmetry,
    fibre_warnings,
    shell_mesh,
    thickness_warnings,
)
from morph_dslam.studies.shell_sweep import ShellSweep
from morph_dslam.studies.snapshots import SOLVER_VERSION
from morph_dslam.studies.solid_sections import mesh_fingerprint
from morph_dslam.studies.solid_sweep import loadable

#: Raised by whoever changes from where shells are followed: their solutions of another number are solved anew.
SHELL_VERSION = 2
#: Kinds of supports and loads that name a cell set; others name nodes.
_ON_CELLS = ("foundation", "traction", "force", "pressure", "body_force", "moving_patch", "moving_line")


class _ShellSolverSection(WorkSection):
    """``order`` of the displacements, and how the machine is used: one thread in each worker unless stated."""

    order: Literal[2, 3] = 2


class ShellStudy(BodyStudy, Section):
    """A thin elastic shell under supports and loads that depend on parameters."""

    name: str
    mesh: SurfaceSection
    shell: ShellSection
    material: ShellMaterialSection
    sets: dict[str, SetSection] = Field(default_factory=dict)
    supports: tuple[ShellSupportSection, ...] = ()
    loads: tuple[ShellLoadSection, ...] = ()
    parameters: dict[str, ParameterSection] = Field(min_length=1)
    unknown_loads: UnknownLoadsSection | None = None
    solver: _ShellSolverSection = _ShellSolverSection()
    sampling: SamplingSection = SamplingSection()
    reduction: ReductionSection = ReductionSection()

    _names = field_validator("parameters")(check_names)

    @model_validator(mode="after")
    def _check_values(self) -> ShellStudy:
        """Read every value once, so that a mistake is found before anything is solved."""
        read_once(self._parts(), self.variables())
        if any(getattr(part, "first", False) for part in (*self.supports, *self.loads)):
            raise ValueError("first is for solids: leave it out, or let a parameter say how much of a load acts")
        if self.material.density is None and any(load.kind == "gravity" for load in self.loads):
            raise ValueError("gravity needs the material's density: add it")
        return self

    @property
    def work(self) -> WorkSection:
        """One thread in each worker unless the study says otherwise: the workers fill the cores."""
        return WorkSection(workers=self.solver.workers, threads=self.solver.threads or 1)

    def shell_mesh(self) -> Mesh:
        """The mesh with the sets of the study, checked together with those that it names."""
        return with_named_sets(with_sets(shell_mesh(self.mesh), self.sets), self._sets())

    def _parts(self) -> list[tuple[str, Any]]:
        """Shell, material, supports and loads with what messages call them."""
        return [("shell", self.shell), ("material", self.material), *self._listed()]

    def _listed(self) -> list[tuple[str, Any]]:
        """Supports and loads with what messages call them."""
        return [*numbered("support", self.supports), *numbered("load", self.loads)]

    def _sets(self) -> Iterator[NamedSet]:
        """The sets that the study names."""
        for where, section in self._listed():
            if section.kind != "gravity":
                yield f"{where}: on", section.on, "cells" if section.kind in _ON_CELLS else "nodes"
        if self.unknown_loads and self.unknown_loads.on:
            yield "unknown_loads.on", self.unknown_loads.on, "cells"

    def fingerprint(self) -> str:
        """Hash of mesh, shell, material, supports, loads, parameters' names, elements and solver version."""
        content = self.model_dump(mode="json", include={"shell", "material", "supports", "loads"})
        content["elements"] = self.solver.order
        content["parameters"] = list(self.parameters)
        mesh = self.shell_mesh()
        content["mesh"] = mesh_fingerprint(mesh)
        content |= support_content(self.supports, mesh)
        content["code"] = [SOLVER_VERSION, SHELL_VERSION]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def problem(self, options: ShellOptions | None = None) -> ShellProblem:
        """The discretised shell, with the study's own elements if ``options`` name no others."""
        symbols, mesh = ParameterSymbols(self.model_parameters()), self.shell_mesh()
        check_widths(self.loads, mesh)
        check_reach(self.loads, mesh, self.variables())
        check_symmetry(self.supports, mesh)
        read = reader_of(symbols)
        material, thickness = self.material.make(read), self.shell.make(read)
        loads = [section.make(read) for section in self.loads]
        elements = options or ShellOptions(order=self.solver.order, threads=self.work.threads)

        def shell(supports: list[Any]) -> ShellProblem:
            return ShellProblem(mesh, material, thickness, supports, loads, symbols, elements)

        supports = [section.make(read) for section in self.supports]
        problem = shell(supports)
        check_effect(problem.constraints, supports)
        problem.at_rest = partial(shell, [held_still(support) for support in supports])
        return problem

    def sweep_problem(self) -> SweepProblem:
        """What the sweep solves with."""
        return loadable(ShellSweep(self.problem()), self.unknown_loads)

    @property
    def advice(self) -> str:
        """See `BodyStudy`; before it, loads that are too large for the shell by far."""
        return shell_load_doubt(self.problem()) + super().advice

    def doubts(self) -> list[str]:
        """See `BodyStudy`: a thickness that is none of a shell, fibres that turn abruptly, loads beside it."""
        mesh, variables = self.shell_mesh(), self.variables()
        found = thickness_warnings(self.shell, mesh, variables) + fibre_warnings(self.material, mesh, variables)
        return found + landing_warnings(self.loads, mesh, variables)

    def model_mesh(self) -> ModelMesh:
        """The nodes of the mesh, its cells cut into triangles, and the area of each node."""
        return model_mesh_of(self.shell_mesh())
