"""Functions of several formats one after another, for fields whose components have modes of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from morph_dslam.model.compact_modes import ComponentModes
from morph_dslam.model.functions import Functions
from morph_dslam.model.separated import SeparatedField

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StackedFunctions(Functions):
    """The functions of all ``parts`` in order, or linear combinations of them.

    Attributes
    ----------
    parts : functions of the same parameters, each in a format of its own.
    mixing : (functions of all parts, n_functions), or None where they stand as they are.
    """

    parts: tuple[Functions, ...]
    mixing: Array | None = None

    def __post_init__(self) -> None:
        boxes = np.array([part.bounds for part in self.parts])
        if not self.parts or (boxes != boxes[0]).any():
            raise ValueError("stacked functions need the same ranges of the parameters")
        if self.mixing is not None and len(self.mixing) != self._n_stacked:
            raise ValueError(f"{self._n_stacked} functions are mixed by a matrix {self.mixing.shape}")

    @property
    def _n_stacked(self) -> int:
        return sum(part.n_functions for part in self.parts)

    @property
    def n_functions(self) -> int:
        return self._n_stacked if self.mixing is None else self.mixing.shape[1]

    @property
    def n_floats(self) -> int:
        return sum(part.n_floats for part in self.parts) + (0 if self.mixing is None else self.mixing.size)

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        return self.parts[0].bounds

    def _compiled(self, mu: Array) -> Array:
        rows = np.concatenate([part.rows(mu) for part in self.parts], axis=1)
        return rows if self.mixing is None else rows @ self.mixing

    def partial(self, mu: ArrayLike, orders: tuple[int, ...]) -> Array:
        values = np.concatenate([part.partial(mu, orders) for part in self.parts])
        return values if self.mixing is None else values @ self.mixing

    def mixed(self, matrix: Array) -> Self:
        return replace(self, mixing=matrix if self.mixing is None else self.mixing @ matrix)


def stack_components(fields: Sequence[SeparatedField]) -> SeparatedField:
    """One field whose components are ``fields`` of one component each, with modes and functions of their own.

    Each may have another number of modes and another format. The file keeps no zeros for it.

    Raises
    ------
    ValueError
        If a field has more than one component, or other points or ranges than the first.
    """
    shapes = [field.modes.shape[1:] for field in fields]
    if any(shape != (shapes[0][0], 1) for shape in shapes):
        raise ValueError(f"fields of shapes {shapes} are not components at the same points")
    components = np.repeat(np.arange(len(fields)), [field.n_modes for field in fields])
    values = np.concatenate([field.modes[:, :, 0] for field in fields])
    compact = ComponentModes(values, components, len(fields))
    return SeparatedField.from_compact(compact, StackedFunctions(tuple(f.functions for f in fields)))
