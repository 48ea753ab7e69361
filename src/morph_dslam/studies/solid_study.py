"""The study of a solid: mesh, materials, supports, loads, contacts, and the parameters that any of them may name."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.contact import RigidObstacle
from morph_dslam.mechanics.coupled_solid import CoupledSolid
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.mechanics.solid import SolidOptions, SolidProblem
from morph_dslam.mechanics.solid_materials import has_pressure
from morph_dslam.mechanics.supports import held_still
from morph_dslam.meshing.meshes import Mesh, model_mesh_of
from morph_dslam.model import Parameter
from morph_dslam.studies.affine import NO_AMPLITUDES, Amplitudes, Variables
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
from morph_dslam.studies.load_sizes import load_doubt
from morph_dslam.studies.material_sections import MaterialSection
from morph_dslam.studies.moving_loads import check_reach, check_widths, landing_warnings
from morph_dslam.studies.parameters import ParameterSection, TimeSection
from morph_dslam.studies.problem import ModelMesh, SweepProblem
from morph_dslam.studies.sections import (
    JOINED,
    ReductionSection,
    SamplingSection,
    Section,
    UnknownLoadsSection,
    WorkSection,
)
from morph_dslam.studies.set_sections import SetSection, coarse_set_warnings, with_sets
from morph_dslam.studies.shape_sections import ShapeSection, read_shape, shape_fields, shape_fingerprints
from morph_dslam.studies.snapshots import SOLVER_VERSION
from morph_dslam.studies.solid_sections import (
    ContactSection,
    CouplingSection,
    LoadSection,
    MeshSection,
    SupportSection,
    Value,
    make_mesh,
    mesh_fingerprint,
)
from morph_dslam.studies.solid_sweep import SolidSweep, loadable
from morph_dslam.studies.time_sampling import time_increments
from morph_dslam.studies.viscous_sweep import ViscousSweep

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: `SolidOptions.mixed` by the name of a formulation.
MIXED = {"automatic": None, "displacement": False, "mixed": True}
#: More increments of time than these in a solve are a mistake in the unit of a step.
MOST_INCREMENTS = 100_000
#: So many times farther than other parameters the time is run through: from one moment of a path to the next.
SAME_PATH = 1e6
#: Kinds of supports, loads, contacts and shapes that name a surface, and those that name cells; others name nodes.
_ON_SURFACES = (
    "foundation", "traction", "force", "pressure", "moving_patch", "moving_line", "thickness",
    "plane", "sphere", "cylinder", "mesh", "surface",
)  # fmt: skip
_ON_CELLS = ("body_force",)


class _SolidSolverSection(WorkSection):
    """Elements and how the machine is used.

    ``order`` is that of the displacements, if absent first on meshes of hex8 cells alone and second on others.
    ``formulation`` "automatic" gives these hexahedra enhanced strains, and nearly incompressible materials of other
    cells pressures of their own, as "mixed" does to all; "displacement" is neither.
    One worker with all cores as threads needs the least memory; for small meshes more workers with one thread
    each are faster.
    """

    workers: int | None = Field(default=1, ge=1)
    order: Literal[1, 2] | None = None
    formulation: Literal["automatic", "displacement", "mixed"] = "automatic"


def _check_pressures(problem: SolidProblem) -> None:
    """Raise StudyError if a material that has pressures would not have them at an end of a parameter's range."""
    symbols = problem.symbols
    for material in (region.material for region in problem.regions if region.pressures):
        for blamed, mu in Variables(symbols.parameters).range_ends():
            symbols.set(mu)
            if not has_pressure(material):
                name = symbols.parameters[blamed[0]].name
                raise StudyError(
                    f"mixed elements cannot take {material.name} where {symbols.text(mu)}: its volumetric modulus, "
                    f"Lame's lambda, must be positive there: change the range of {name}, "
                    'or set solver.formulation = "displacement"'
                )
    symbols.set(symbols.default)


class SolidStudy(BodyStudy, Section):
    """A hyperelastic solid under supports and loads that depend on parameters."""

    name: str
    mesh: MeshSection
    sets: dict[str, SetSection] = Field(default_factory=dict)
    materials: dict[str, MaterialSection] = Field(min_length=1)
    supports: tuple[SupportSection, ...] = ()
    loads: tuple[LoadSection, ...] = ()
    couplings: tuple[CouplingSection, ...] = ()
    contacts: tuple[ContactSection, ...] = ()
    shape: tuple[ShapeSection, ...] = ()
    parameters: dict[str, ParameterSection] = Field(min_length=1)
    time: TimeSection | None = None
    unknown_loads: UnknownLoadsSection | None = None
    solver: _SolidSolverSection = _SolidSolverSection()
    sampling: SamplingSection = SamplingSection()
    reduction: ReductionSection = ReductionSection()

    _names = field_validator("parameters")(check_names)

    @model_validator(mode="after")
    def _check_values(self) -> SolidStudy:
        """Read every value once, so that a mistake is found before anything is solved."""
        parameters = self.model_parameters()
        self._check_amplitudes()
        read_once(self._parts(), self.variables())
        if len({material.on for material in self.materials.values()}) < len(self.materials):
            raise ValueError("two materials are on the same cell set: give each its own")
        self._check_time(parameters)
        self._check_weight()
        if self.unknown_loads and self.couplings:
            raise ValueError("[unknown_loads] is for solids without [[couplings]]: leave out one of both")
        if self.unknown_loads and self.time:
            raise ValueError("[unknown_loads] is for elastic solids, not for viscoelastic ones: leave it out")
        return self

    def amplitudes(self) -> Amplitudes:
        """See `BodyStudy`."""
        if self.time is None or not self.time.amplitudes:
            return NO_AMPLITUDES
        clock = list(self.parameters).index(self.time.parameter)
        return Amplitudes(clock, {name: section.make() for name, section in self.time.amplitudes.items()})

    def _check_amplitudes(self) -> None:
        """They follow the time, and are no parameters."""
        if self.time is None or not self.time.amplitudes:
            return
        if self.time.parameter not in self.parameters:
            raise ValueError(f"time.parameter: '{self.time.parameter}' is no parameter that measures time")
        if twice := self.parameters.keys() & self.time.amplitudes.keys():
            raise ValueError(f"time.amplitudes: '{min(twice)}' is a parameter too: give the amplitude another name")

    def _symbols(self) -> ParameterSymbols:
        """The parameters and amplitudes as the mechanics takes them."""
        clock = self.time.parameter if self.time else ""
        return ParameterSymbols(self.model_parameters(), clock, self.amplitudes().functions)

    def _check_weight(self) -> None:
        """Gravity acts on densities; one that was forgotten would be a load that is not there."""
        if not any(load.kind == "gravity" for load in self.loads):
            return
        weightless = [name for name, material in self.materials.items() if "density" not in material.constants]
        if weightless:
            raise ValueError(
                f"gravity needs densities, and the material {weightless[0]} has none: add density, which is "
                '"0 kg/m3" if it shall have no weight'
            )

    def _check_time(self, parameters: tuple[Parameter, ...]) -> None:
        """Viscous materials need a clock that starts at the lower end of its range."""
        viscous = [name for name, material in self.materials.items() if "prony" in material.constants]
        if self.time is None:
            if viscous:
                raise ValueError(
                    f"the material {viscous[0]} is viscoelastic: say in [time] which parameter is the time"
                )
            return
        clock = next((p for p in parameters if p.name == self.time.parameter), None)
        if clock is None or clock.quantity != "time":
            raise ValueError(f"time.parameter: '{self.time.parameter}' is no parameter that measures time")
        if not viscous:
            raise ValueError("[time] is for viscoelastic materials, and none has a prony series")
        if clock.default != clock.lower:
            raise ValueError(f"parameters.{clock.name}: {self._why_no_clock(clock.name)}")
        # A solve follows time from the lower end of its range, whatever the sample.
        increments = (clock.upper - clock.lower) / self.time.step
        if increments > MOST_INCREMENTS:
            raise ValueError(
                f"time.step: {self.time.step:g} s makes {increments:.3g} increments over the range of {clock.name}, "
                f"and {MOST_INCREMENTS} are the most: take a longer step, or a shorter range"
            )
        if self.time.rest is not None:
            self._check_rest(parameters, parameters.index(clock))

    def _why_no_clock(self, name: str) -> str:
        """Why a parameter whose default is not the lower end of its range cannot be the time."""
        if self.parameters[name].default is not None:
            return "time starts at the lower end; leave out the default"
        return "time starts at the lower end of its range, which cannot be below 0 s: begin it at 0 s or later"

    def _check_rest(self, parameters: tuple[Parameter, ...], clock: int) -> None:
        """What rests before the time begins must be there, and cannot change meanwhile."""
        assert self.time is not None
        first, begin, rest = self._applied_first(), parameters[clock].lower, self.time.rest or 0.0
        variables = self.variables()
        if not first:
            raise ValueError("time.rest: nothing rests; say of a load or support that it is first = true")

        def read(value: Value, quantity: str | None) -> float:
            found = variables.read(value, quantity)
            if found.slopes[clock] or any(product.index == clock for product in found.products):
                raise ValueError(
                    f"'{value}' names the time, but rests before the time begins: leave out first = true, or multiply "
                    "by an amplitude, which keeps its first value until its first time"
                )
            for product in found.products:
                if not product.amplitude.is_constant(begin - rest, begin):
                    raise ValueError(
                        f"'{value}' rests before the time begins, and the amplitude {product.name} changes meanwhile: "
                        f"let its times begin at {begin:g} s or later, or leave out first = true"
                    )
            return 0.0

        for section in first:
            section.make(read)

    def _parts(self) -> list[tuple[str, Any]]:
        """Materials, supports, loads, couplings, contacts and shapes with what messages call them."""
        return [(f"materials.{name}", section) for name, section in self.materials.items()] + self._listed()

    def _listed(self) -> list[tuple[str, Any]]:
        """The same without the materials."""
        groups = {
            "support": self.supports,
            "load": self.loads,
            "coupling": self.couplings,
            "contact": self.contacts,
            "shape": self.shape,
        }
        return [part for kind, sections in groups.items() for part in numbered(kind, sections)]

    def check_parameters_used(self, elsewhere: Sequence[str] = ()) -> None:
        """See `BodyStudy`; the time needs not be named."""
        super().check_parameters_used([*elsewhere, self.time.parameter] if self.time else elsewhere)

    @property
    def advice(self) -> str:
        """See `BodyStudy`; before it, loads that are too large for the materials by far."""
        return self.load_doubt() + super().advice

    def load_doubt(self) -> str:
        """A sentence, and a space, on a load that is too large for the materials by far; else ""."""
        materials = self.materials.values()
        return load_doubt(self.loads, self.couplings, materials, self.solid_mesh(), self.variables())

    # -- what the sweep asks (`morph_dslam.studies.problem.ParametricStudy`) ---------------------------

    @property
    def work(self) -> WorkSection:
        """Workers and threads."""
        return self.solver

    def solid_mesh(self) -> Mesh:
        """The mesh with the sets of the study, checked together with those that it names."""
        return with_named_sets(with_sets(make_mesh(self.mesh), self.sets), self._sets())

    def _sets(self, unknown: bool = True) -> Iterator[NamedSet]:
        """The sets that the study names, without that of ``unknown`` loads where it shall be left out."""
        for name, material in self.materials.items():
            yield f"materials.{name}.on", material.on, "cells"
        for where, section in self._listed():
            kind = getattr(section, "kind", "coupling")
            what = "surface" if kind in _ON_SURFACES else "cells" if kind in _ON_CELLS else "nodes"
            for key in ("on", "against", "kept"):
                if name := getattr(section, key, None):
                    yield f"{where}: {key}", name, what
        if self.unknown_loads and unknown:
            yield "unknown_loads.on", self.unknown_loads.on, "surface"

    def fingerprint(self) -> str:
        """Hash of mesh, shape, mechanics, parameters' names, elements and solver version."""
        content: dict[str, Any] = self.model_dump(mode="json", include={"materials", "supports", "loads"})
        for part in (*content["supports"], *content["loads"]):
            part |= {"first": True} if part.pop("first", False) else {}
        content["functions"] = [material.source for material in self.materials.values()]
        content["elements"] = self.solver.order, self.solver.formulation
        content["parameters"] = list(self.parameters)
        content["root"] = self.root().tolist() if self.time else None
        content["time"] = self.time.model_dump(exclude_none=True, exclude_defaults=True) if self.time else None
        # Earlier versions kept solutions that remembered the defaults of Prony series and of rests, or were followed in
        # even increments.
        content |= {"memory": "of its own parameters", "increments": "as a linear body answers"} if self.time else {}
        mesh = self.solid_mesh()
        content["mesh"] = mesh_fingerprint(self._solved(mesh))
        content["code"] = SOLVER_VERSION
        content |= support_content(self.supports, mesh) | mended_content(self, mesh)
        content |= {"shape": shape_fingerprints(self.shape, mesh)} if self.shape else {}
        content |= self.model_dump(mode="json", include={"couplings"}) if self.couplings else {}
        content |= self.model_dump(mode="json", include={"contacts"}) if self.contacts else {}
        for section in content.get("contacts", ()):
            if section["kind"] != "surface":
                # Earlier versions kept solutions with an obstacle behind a wall, or that gave way where confined.
                content["passages"], content["penalty"] = "refused", "stiff where confined"
            if section["kind"] == "mesh":
                section["file"] = hashlib.sha256(Path(section["file"]).read_bytes()).hexdigest()
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def _solved(self, mesh: Mesh) -> Mesh:
        """The mesh with the sets that solutions may depend on: its own, and those of the study that mechanics names.

        Others, and the surface of unknown loads, change no solution, so that whoever adds them keeps what is solved.
        """
        named = {name for _, name, _ in self._sets(unknown=False)}
        named |= {part.centre for part in self.supports if part.kind == "rotation" and isinstance(part.centre, str)}
        own = make_mesh(self.mesh)

        def kept(sets: Mapping[str, Indices], among: Iterable[str]) -> dict[str, Indices]:
            return {name: members for name, members in sets.items() if name in {*named, *among}}

        return replace(
            mesh,
            node_sets=kept(mesh.node_sets, own.node_sets),
            cell_sets=kept(mesh.cell_sets, own.cell_sets),
            surfaces=kept(mesh.surfaces, {*own.surfaces} - own.found),
        )

    def scale(self) -> Array:
        """See `BodyStudy`; moments of one path in time are nearer to each other than to those of any other."""
        scale = super().scale()
        if self.time is not None:
            scale[list(self.parameters).index(self.time.parameter)] *= SAME_PATH
        return scale

    def problem(self, options: SolidOptions | None = None) -> SolidProblem:
        """The discretised solid, with the study's own elements if ``options`` name no others."""
        symbols, mesh = self._symbols(), self.solid_mesh()
        check_widths(self.loads, mesh)
        check_reach(self.loads, mesh, self.variables())
        reader = reader_of(symbols)
        own = SolidOptions(order=self.solver.order, mixed=MIXED[self.solver.formulation], threads=self.solver.threads)
        materials = {section.on: section.make(reader) for section in self.materials.values()}
        shape = shape_fields(self.shape, mesh, symbols)
        contacts = [section.make(reader) for section in self.contacts]
        time = symbols[self.time.parameter] if self.time else None

        def solid(supports: list[Any], loads: list[Any], couplings: list[Any]) -> SolidProblem:
            make = partial(CoupledSolid, couplings) if couplings else SolidProblem
            elements = options or own
            return make(mesh, materials, supports, loads, symbols, elements, shape, time=time, contacts=contacts)

        def made(sections: Iterable[Any]) -> list[tuple[Any, bool]]:
            return [(section.make(reader), section.first) for section in sections]

        supports, loads, couplings = made(self.supports), made(self.loads), made(self.couplings)
        problem = solid(*([part for part, _ in parts] for parts in (supports, loads, couplings)))
        check_effect(problem.constraints, [part for part, _ in supports])
        _check_pressures(problem)
        if self._applied_first():
            problem.applied_first = partial(
                solid,
                [part if first else held_still(part) for part, first in supports],
                [part for part, first in loads if first],
                [part if first else part.unloaded() for part, first in couplings],
            )
        return problem

    def obstacles(self) -> tuple[ParameterSymbols, list[tuple[RigidObstacle, Indices]]]:
        """What its contacts keep the solid out of, with the nodes that they name, and the symbols of its place."""
        symbols, mesh = self._symbols(), self.solid_mesh()
        rigid = [section.make(reader_of(symbols)) for section in self.contacts if section.kind != "surface"]
        return symbols, [(body, mesh.set_nodes(body.on)) for body in rigid]

    def held_components(self) -> dict[str, NDArray[np.bool_]]:
        """By set, (n, 3) whether its supports prescribe the component of a node's displacement."""
        mesh, held = self.solid_mesh(), {}
        reader = reader_of(self._symbols())
        for section in (part for part in self.supports if part.kind != "foundation"):
            of_set = held.setdefault(section.on, np.zeros((mesh.n_nodes, 3), dtype=bool))
            of_set[mesh.set_nodes(section.on)] |= np.array(section.make(reader).components)
        return held

    def _applied_first(self) -> list[Any]:
        """Supports, loads and couplings that act before the others."""
        return [section for section in (*self.supports, *self.loads, *self.couplings) if section.first]

    def sweep_problem(self) -> SweepProblem:
        """What the sweep solves with."""
        if self.time is None:
            return loadable(SolidSweep(self.problem()), self.unknown_loads)
        clock = list(self.parameters).index(self.time.parameter)
        return ViscousSweep(self.problem(), clock, time_increments(self), self.time.rest or 0.0)

    def doubts(self) -> list[str]:
        """See `BodyStudy`: sets that cover little of their ball, loads that fall beside their surface."""
        mesh, parameters = self.solid_mesh(), self.model_parameters()
        named = {part for _, name, what in self._sets() if what != "cells" for part in name.split(JOINED)}
        coarse = coarse_set_warnings(mesh, {name: part for name, part in self.sets.items() if name in named})
        moves = any(load.kind in ("moving_patch", "moving_line") for load in self.loads)
        shape = read_shape(self.shape, mesh, parameters) if moves else ()
        return coarse + landing_warnings(self.loads, mesh, self.variables(), shape)

    def model_mesh(self) -> ModelMesh:
        """The nodes of the mesh, its outer surface, its cells, the volume of each node, and what supports hold."""
        mesh = self.solid_mesh()
        held = [part.on for part in (*self.supports, *(part for part in self.couplings if part.held))]
        return replace(model_mesh_of(mesh), supports={name: mesh.set_nodes(name) for name in held})


def mended_content(study: SolidStudy, mesh: Mesh) -> dict[str, str]:
    """What a fingerprint says where earlier versions solved otherwise, or kept wrong derivatives.

    They counted contact on coupled sets and on held faces in part, let a pressure on a face inside act either way,
    and gave pressures to materials whose volumetric modulus is negative.
    """
    mended: dict[str, str] = {}
    nothing = np.zeros((mesh.n_nodes, 3), dtype=bool)
    held = np.any([nothing, *study.held_components().values()], axis=0) if study.contacts else nothing
    if study.contacts and (study.couplings or any(held[mesh.set_nodes(part.on)].all() for part in study.contacts)):
        mended["contact"] = "counted wherever it acts"
    pressed = [load.on for load in study.loads if load.kind == "pressure"]
    outer = set(map(tuple, mesh.boundary_faces().tolist())) if pressed else set()
    if any(not outer.issuperset(map(tuple, mesh.surface(name).tolist())) for name in pressed):
        mended["faces inside"] = "on their own side"
    if study.solver.formulation == "mixed":
        laws = [section.make(reader_of(study._symbols())) for section in study.materials.values()]
        if any(law.volumetric_modulus is not None and not has_pressure(law) for law in laws):
            mended["pressures"] = "where positive"
    return mended
