"""Options as dataclasses: values are checked against the fields' types and ranges, and text becomes paths."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from numbers import Integral, Real
from os import PathLike
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from morph_dslam.errors import TrackingError

#: What types are called in messages.
_NAMES: dict[Any, str] = {
    int: "a whole number",
    float: "a number",
    bool: "True or False",
    str: "text",
    NoneType: "None",
}


@dataclass(frozen=True)
class Within:
    """The range of a number, in the ``Annotated`` type of a field.

    Attributes
    ----------
    low : the least value.
    high : the largest one.
    is_above : whether the number is above ``low``.
    """

    low: float
    high: float = float("inf")
    is_above: bool = False

    def __contains__(self, value: float) -> bool:
        return (self.low < value if self.is_above else self.low <= value) and value <= self.high

    def __str__(self) -> str:
        if self.is_above:
            return f"above {self.low:g}"
        return f"from {self.low:g} up" if self.high == float("inf") else f"from {self.low:g} to {self.high:g}"


Share = Annotated[float, Within(0.0, 1.0)]
NotNegative = Annotated[float, Within(0.0)]
Positive = Annotated[float, Within(0.0, is_above=True)]
Count = Annotated[int, Within(0)]
PositiveCount = Annotated[int, Within(1)]


class CheckedOptions:
    """Options that raise TrackingError when they are made with a value that their types do not allow."""

    def __post_init__(self) -> None:
        for name, hint in _hints(type(self)).items():
            value = getattr(self, name)
            if not _fits(hint, value):
                raise TrackingError(f"{type(self).__name__}: {name} is {value!r}; give {_described(hint)}")


class FileOptions:
    """Options whose fields of paths take text too, and a tuple of them a list or a single one."""

    def __post_init__(self) -> None:
        for name, hint in _hints(type(self)).items():
            object.__setattr__(self, name, _with_paths(hint, getattr(self, name)))


@cache
def _hints(kind: type[Any]) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _fits(hint: Any, value: object) -> bool:
    """Whether a value is of a type: a class, a literal text, a union, a tuple or a number within a range."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        kind, *ranges = args
        return _fits(kind, value) and all(value in one for one in ranges)
    if origin is Literal:
        return isinstance(value, str) and value in args
    if origin in (Union, UnionType):
        return any(_fits(one, value) for one in args)
    if origin is tuple:
        if not isinstance(value, tuple | list):
            return False
        kinds = (args[0],) * len(value) if args[-1] is Ellipsis else args
        return len(kinds) == len(value) and all(map(_fits, kinds, value))
    if hint in (int, float):
        return isinstance(value, Integral if hint is int else Real) and not isinstance(value, bool)
    return isinstance(value, (bool, np.bool_) if hint is bool else hint)


def _described(hint: Any) -> str:
    """What a type allows, for messages."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return f"{_described(args[0])} {args[1]}"
    if origin is Literal:
        return " or ".join(f"'{value}'" for value in args)
    if origin in (Union, UnionType):
        return " or ".join(map(_described, args))
    if origin is tuple:
        parts = [f"{_described(args[0])} each"] if args[-1] is Ellipsis else map(_described, args)
        return f"a tuple ({', '.join(parts)})"
    return _NAMES.get(hint) or hint.__name__


def _with_paths(hint: Any, value: Any) -> Any:
    """A value with paths where its type has them and text was given."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is tuple and value is not None:
        if args[-1] is not Ellipsis:
            return tuple(map(_with_paths, args, value))
        several = (value,) if isinstance(value, str | PathLike) else value
        return tuple(_with_paths(args[0], one) for one in several)
    is_path = hint is Path or (origin in (Union, UnionType) and Path in args and str not in args)
    return Path(value) if is_path and isinstance(value, str | PathLike) else value
