"""Modes kept in less space than their values at every point: by component, and on structured meshes.

A field works with the values of its modes, (n_modes, n_points, n_components). Where those have a structure
the field also knows the compact form, which the model file keeps and the compression factor counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class CompactModes(Protocol):
    """Modes in a compact form."""

    @property
    def n_floats(self) -> int:
        """Numbers stored."""
        ...

    def expand(self) -> Array:
        """The modes (n_modes, n_points, n_components) at every point."""
        ...


@dataclass(frozen=True)
class ComponentModes:
    """Modes that move one component each: all their other components are zero.

    Attributes
    ----------
    values : (n_modes, n_points), the component that is not zero.
    components : (n_modes,) which one that is.
    n_components : of the field.
    """

    values: Array
    components: NDArray[np.int64]
    n_components: int

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or self.components.shape != self.values.shape[:1]:
            raise ValueError(f"{self.components.shape} components do not fit modes {self.values.shape}")
        if self.components.min(initial=0) < 0 or self.components.max(initial=0) >= self.n_components:
            raise ValueError(f"a mode's component is not one of {self.n_components}")

    @property
    def n_floats(self) -> int:
        """The values, and the components: each is one byte of a number's four."""
        return self.values.size + -(-len(self.components) // 4)

    def expand(self) -> Array:
        modes = np.zeros((*self.values.shape, self.n_components))
        modes[np.arange(len(modes)), :, self.components] = self.values
        return modes


@dataclass(frozen=True)
class GridModes:
    """Modes on a structured mesh, separated in its directions: F_i = X_i(x) Y_i(y) a_i, and so on for Z.

    Attributes
    ----------
    axes : for each direction (n_modes, n_k), the function at its n_k positions. The node at positions
        (j, l) has the number j n_2 + l: the last direction runs fastest.
    components : (n_modes, n_components), the vector a_i.
    """

    axes: tuple[Array, ...]
    components: Array

    def __post_init__(self) -> None:
        shapes = [axis.shape for axis in (*self.axes, self.components)]
        if not self.axes or any(len(shape) != 2 or shape[0] != shapes[0][0] for shape in shapes):
            raise ValueError(f"arrays {shapes} are not the factors of the same modes")

    @property
    def n_floats(self) -> int:
        return sum(axis.size for axis in self.axes) + self.components.size

    def expand(self) -> Array:
        modes = np.ones((len(self.components), 1))
        for axis in (*self.axes, self.components):
            modes = (modes[:, :, None] * axis[:, None, :]).reshape(len(modes), -1)
        return modes.reshape(len(modes), -1, self.components.shape[1])
