"""What the studies of solids and of shells share: parameters anywhere, any number of them, and no mirror images."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.materials.base import Material
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.model import Parameter
from morph_dslam.studies.affine import read_affine
from morph_dslam.studies.parameters import ParameterSection
from morph_dslam.studies.problem import Snapshot
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


#: A set of the mesh that a study names: the key there, its name, and what finds its members.
NamedSet = tuple[str, str, Callable[[str], NDArray[np.int64]]]


def check_sets(sets: Iterable[NamedSet]) -> None:
    """Raise StudyError, which begins with the key, if a set is not in the mesh, or empty."""
    for key, name, find in sets:
        try:
            members = find(name)
        except StudyError as error:
            raise StudyError(f"{key}: {error}") from error
        if not len(members):
            raise StudyError(f"{key}: the set '{name}' of the mesh is empty; name another, or fill it")


def read_once(parts: Sequence[tuple[str, Any]], parameters: Sequence[Parameter]) -> None:
    """Read every value of sections with ``make``, so that a mistake is found before anything is solved.

    Materials are checked at the defaults of the parameters. Raises ValueError saying in which of the ``parts``, named
    sections, the mistake is.
    """
    defaults = np.array([p.default for p in parameters])

    def read(value: Value, quantity: str | None) -> float:
        return read_affine(value, quantity, parameters)(defaults)

    for where, section in parts:
        try:
            made = section.make(read)
            if isinstance(made, Material):
                made.check()
        except StudyError as error:
            raise ValueError(f"{where}: {error}") from error


def reader_of(symbols: ParameterSymbols) -> Reader:
    """Reads a value of a study as an expression of the symbols."""
    values = [symbols[parameter.name] for parameter in symbols.parameters]

    def read(value: Value, quantity: str | None) -> Any:
        return read_affine(value, quantity, symbols.parameters).expression(values)

    return read


class BodyStudy:
    """Those methods of `morph_dslam.studies.problem.ParametricStudy` that solids and shells have alike."""

    if TYPE_CHECKING:
        parameters: dict[str, ParameterSection]
        model_dump_json: Callable[[], str]

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
