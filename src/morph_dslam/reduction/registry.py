"""The methods of reduction by their names in study files.

A method is a function from a `ReductionTask` to a `ReducedModel` with all fields that the solutions hold; what
it says of itself goes under "reduction" into the model's certificate, and the build adds the held-out errors.
Every method, the built-in ones too, becomes known by `register_reduction`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

from morph_dslam.errors import ArgumentError, StudyError

if TYPE_CHECKING:
    from morph_dslam.model import ReducedModel
    from morph_dslam.reduction.task import ReductionTask

Reduce = Callable[["ReductionTask"], "ReducedModel"]
#: For a number of parameters, the names of formats and of bases that a method has, its default first.
OfferedFunctions = Callable[[int], tuple[tuple[str, ...], tuple[str, ...]]]
#: Modules that register the built-in methods, by name.
_BUILT_IN = {
    "galerkin": "morph_dslam.reduction.galerkin_method",
    "reduced_basis": "morph_dslam.reduction.galerkin_method",
    "pod": "morph_dslam.reduction.pod_method",
    "sparse_pgd": "morph_dslam.reduction.sparse_pgd",
}


@dataclass(frozen=True)
class ReductionMethod:
    """A method of reduction.

    Attributes
    ----------
    name : as ``[reduction] method`` names it.
    reduce : makes a reduced model from a `ReductionTask`.
    equations : whether it needs the equations of a solid without memory.
    adaptive : whether samples are chosen by the Galerkin model's estimated error, unless the study says otherwise.
    greedy : whether adaptive sampling solves one sample at a time, and begins with as few as can be.
    bisects : whether it interpolates samples of a single parameter wherever they lie, so that they are chosen by
        bisection, unless the study says otherwise.
    functions : formats and bases that a study may ask for; any, if None.
    """

    name: str
    reduce: Reduce
    equations: bool = False
    adaptive: bool = False
    greedy: bool = False
    bisects: bool = False
    functions: OfferedFunctions | None = None


_methods: dict[str, ReductionMethod] = {}


def register_reduction(name: str, reduce: Reduce, **properties: Any) -> None:
    """Make a method of reduction known to study files, or replace one of your own.

    Parameters
    ----------
    name : as ``[reduction] method`` names it.
    reduce : makes a reduced model from a `ReductionTask`.
    properties : other attributes of `ReductionMethod`.

    Raises
    ------
    ArgumentError
        If a built-in method has this name.
    """
    if name in _BUILT_IN and getattr(reduce, "__module__", None) != _BUILT_IN[name]:
        raise ArgumentError(f"'{name}' is a built-in method of reduction: register yours by another name")
    _methods[name] = ReductionMethod(name, reduce, **properties)


def reduction_methods() -> dict[str, ReductionMethod]:
    """All methods known, by name."""
    for module in dict.fromkeys(_BUILT_IN.values()):
        import_module(module)
    return _methods


def reduction_method(name: str) -> ReductionMethod:
    """The method of this name.

    Raises
    ------
    StudyError
        If there is none; the names known are listed.
    """
    known = reduction_methods()
    if name not in known:
        raise StudyError(f"'{name}' is no method of reduction; known are {', '.join(sorted(known))}")
    return known[name]
