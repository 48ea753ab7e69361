"""What the studies of solids and of shells share: parameters anywhere, any number of them, and no mirror images."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.contact import RigidCylinder, RigidSphere
from morph_dslam.mechanics.materials.base import Material
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.mechanics.shell_material import ShellMaterial
from morph_dslam.mechanics.supports import Constraints, ElasticFoundation
from morph_dslam.meshing.meshes import Mesh
from morph_dslam.model import Parameter
from morph_dslam.studies.affine import NO_AMPLITUDES, Amplitudes, Variables
from morph_dslam.studies.parameters import ParameterSection
from morph_dslam.studies.problem import Snapshot
from morph_dslam.studies.sections import JOINED
from morph_dslam.studies.solid_sections import Reader, Value

Array = NDArray[np.float64]


def check_names(parameters: dict[str, ParameterSection]) -> dict[str, ParameterSection]:
    """The [parameters] of a study; ValueError if one's name cannot stand in an expression."""
    for name in parameters:
        if not name.isidentifier():
            raise ValueError(f"'{name}' is no name for a parameter: use letters, digits and underscores")
    return parameters


def numbered(kind: str, sections: Iterable[Any]) -> list[tuple[str, Any]]:
    """Sections of a list with what messages call them, as `morph_dslam.io.sections` does."""
    return [(f"{kind} {number}", section) for number, section in enumerate(sections, start=1)]


#: A set of the mesh that a study names: the key there, its name, and what it is a set of.
NamedSet = tuple[str, str, Literal["nodes", "surface", "cells"]]


def with_named_sets(mesh: Mesh, sets: Iterable[NamedSet]) -> Mesh:
    """The mesh with every set that a study names: joint ones of those listed, surfaces of the faces of node sets.

    Raises StudyError, which begins with the key, if a set is not in the mesh, or empty.
    """
    added: dict[str, dict[str, NDArray[np.int64]]] = {"nodes": {}, "surface": {}, "cells": {}}
    known = {"nodes": {*mesh.node_sets, *mesh.surfaces}, "surface": {*mesh.surfaces}, "cells": {*mesh.cell_sets, "all"}}
    for key, name, what in sets:
        names = [name] if name in known[what] | {*mesh.node_sets} else name.split(JOINED)
        find = {"nodes": mesh.set_nodes, "surface": mesh.faces_in, "cells": mesh.cells}[what]
        try:
            members = np.unique(np.concatenate([find(part) for part in names]), axis=0)
        except StudyError as error:
            raise StudyError(f"{key}: {error}") from error
        if not len(members):
            raise StudyError(f"{key}: the set '{name}' of the mesh is empty; name another, or fill it")
        if name not in known[what]:
            added[what][name] = members
    return replace(
        mesh,
        node_sets={**mesh.node_sets, **added["nodes"]},
        surfaces={**mesh.surfaces, **added["surface"]},
        cell_sets={**mesh.cell_sets, **added["cells"]},
    )


#: What cannot be at every value of its constants: a thickness is a float.
_CHECKED = (Material, ShellMaterial, RigidSphere, RigidCylinder, ElasticFoundation, float)


def read_once(parts: Sequence[tuple[str, Any]], variables: Variables) -> None:
    """Read every value of sections with ``make``, so that a mistake is found before anything is solved.

    Materials, thicknesses, radii of obstacles and foundations are checked at the defaults of the parameters and at both
    ends of the range of each that they depend on; all but elastic materials also at the combinations of these ends, for
    the relative moduli of a Prony series must not sum to 1. Raises ValueError saying in which of the ``parts``, named
    sections, the mistake is, and at which value of a parameter if that is its cause.
    """
    for where, section in parts:
        used: set[int] = set()
        try:
            made = _made(section, variables, variables.defaults, used)
        except StudyError as error:
            blamed = [k for k in sorted(used) if _is_to_blame(section, variables, k)]
            raise ValueError(f"{where}: {error}{_changed_range(variables, blamed, variables.defaults)}") from error
        if not isinstance(made, _CHECKED):
            continue
        elastic = isinstance(made, ShellMaterial) or (isinstance(made, Material) and made.prony is None)
        for at, mu in variables.range_ends(sorted(used), combined=not elastic):
            try:
                _made(section, variables, mu, set())
            except StudyError as error:
                raise ValueError(f"{where}: {error}{_changed_range(variables, at, mu)}") from error


def _made(section: Any, variables: Variables, mu: Array, used: set[int]) -> Any:
    """What a section describes at ``mu`` (d,), checked; ``used`` takes the parameters that it depends on."""

    def read(value: Value, quantity: str | None) -> float:
        found = variables.read(value, quantity)
        used.update(found.used)
        return found(mu)

    made = section.make(read)
    if isinstance(made, Material):
        made.check()
    return made


def _is_to_blame(section: Any, variables: Variables, k: int) -> bool:
    """Whether another value of a parameter makes a section possible that cannot be at the defaults.

    Such a value is an end of the range, its middle, or a mirrored end, for ranges of a wrong sign.
    """
    lower, upper, mu = variables.parameters[k].lower, variables.parameters[k].upper, variables.defaults
    for value in (upper, lower, (lower + upper) / 2.0, -lower, -upper):
        mu[k] = value
        try:
            _made(section, variables, mu, set())
        except StudyError:
            continue
        return True
    return False


def _changed_range(variables: Variables, at: list[int], mu: Array) -> str:
    """What ends the message about a section that cannot be at ``mu`` (d,), because of the parameters ``at``."""
    if not at:
        return ""
    return f" where {variables.text(mu, at)}: change {'its range' if len(at) == 1 else 'their ranges'}"


def reader_of(symbols: ParameterSymbols) -> Reader:
    """Reads a value of a study as an expression of the symbols."""
    names = [parameter.name for parameter in symbols.parameters]
    clock = names.index(symbols.clock) if symbols.amplitudes else -1
    variables = Variables(symbols.parameters, Amplitudes(clock, symbols.amplitudes))
    values = [symbols[name] for name in names]
    functions = {name: symbols[name] for name in symbols.amplitudes}

    def read(value: Value, quantity: str | None) -> Any:
        return variables.read(value, quantity).expression(values, functions)

    return read


def check_effect(constraints: Constraints, supports: Sequence[Any]) -> None:
    """Refuse a support of whose motion nothing is left, because supports listed before it decide (StudyError)."""
    if (found := constraints.without_effect()) is None:
        return
    support, components, deciding = found
    numbers = {id(part): number for number, part in enumerate(supports, start=1)}
    named = " and ".join(f"support {numbers[id(part)]} ('{part.on}')" for part in deciding)
    moved = ", ".join("xyz"[component] for component in components)
    raise StudyError(
        f"support {numbers[id(support)]}: its {moved} does nothing, because {named}, listed before it, holds {moved} "
        f"at every place of '{support.on}': write the sum of both motions in one of them, move another set against "
        "this one, or leave one of them out"
    )


def support_content(supports: Sequence[Any], mesh: Mesh) -> dict[str, str]:
    """What a fingerprint says of supports, where earlier versions solved or gave them forces otherwise.

    They gave each support all that is held at its nodes, by whichever support, and foundations nothing; and they turned
    supports by more than half a turn at once.
    """
    turns = any(support.kind == "rotation" for support in supports)
    return _reaction_content(supports, mesh) | ({"turns": "in parts"} if turns else {})


def _reaction_content(supports: Sequence[Any], mesh: Mesh) -> dict[str, str]:
    if any(support.kind == "foundation" for support in supports):
        return {"reactions": "of each support alone"}
    nodes = [mesh.set_nodes(name) for name in dict.fromkeys(support.on for support in supports)]
    shared = len(np.unique(np.concatenate(nodes))) < sum(map(len, nodes)) if nodes else False
    return {"reactions": "of each support alone"} if shared else {}


class BodyStudy:
    """Those methods of `morph_dslam.studies.problem.ParametricStudy` that solids and shells have alike."""

    if TYPE_CHECKING:
        parameters: dict[str, ParameterSection]
        model_dump_json: Callable[[], str]

    def _parts(self) -> list[tuple[str, Any]]:
        """All sections whose values may name parameters, with what messages call them."""
        raise NotImplementedError

    def doubts(self) -> list[str]:
        """Sentences on what the study asks for that is probably not meant, or not served by its elements."""
        raise NotImplementedError

    def amplitudes(self) -> Amplitudes:
        """The functions of time that terms may be multiplied by; none."""
        return NO_AMPLITUDES

    def variables(self) -> Variables:
        """What the expressions of the study may name."""
        return Variables(self.model_parameters(), self.amplitudes())

    def check_parameters_used(self, elsewhere: Sequence[str] = ()) -> None:
        """Raise StudyError if a parameter changes nothing; those named ``elsewhere`` do."""
        variables, numbers = self.variables(), set[int]()
        for _, section in self._parts():
            _made(section, variables, variables.defaults, numbers)
        used = {*elsewhere, *(variables.parameters[k].name for k in numbers)}
        if unused := [parameter.name for parameter in variables.parameters if parameter.name not in used]:
            raise StudyError(
                f"the parameter {unused[0]} is used nowhere in the study: name it in a load, a support or a material, "
                "or leave it out"
            )

    def __hash__(self) -> int:
        return hash(self.model_dump_json())

    @property
    def advice(self) -> str:
        """What to change when the body cannot be solved."""
        return (
            "Narrow the ranges of the parameters, refine the mesh, or prescribe a displacement in place of a "
            "load past its limit point"
        )

    def model_parameters(self) -> tuple[Parameter, ...]:
        """The parameters in the order of the file."""
        return tuple(section.parameter(name) for name, section in self.parameters.items())

    def root(self) -> Array:
        """The parameters' defaults."""
        return np.array([parameter.default for parameter in self.model_parameters()])

    def scale(self) -> Array:
        """The sizes of the ranges."""
        return np.array([parameter.upper - parameter.lower for parameter in self.model_parameters()])

    def admissible(self, samples: Array) -> Array:
        """All samples are."""
        return samples

    def canonical(self, samples: Array) -> Array:
        """A body has no mirror images."""
        return samples

    def images(self, snapshot: Snapshot) -> list[Snapshot]:
        """The snapshot alone."""
        return [snapshot]
