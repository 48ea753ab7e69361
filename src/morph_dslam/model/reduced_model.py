"""The reduced model of one object: mesh, parameters, displacement and stress as separated fields."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from morph_dslam.model.separated import Outside, SeparatedField
from morph_dslam.units import from_si

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Parameter:
    """One coordinate of the parameter box; all values in SI, ``unit`` is for reports.

    ``quantity`` is a key of `morph_dslam.units.FACTORS` (length, angle, ratio, stress, force ...).
    """

    name: str
    quantity: str
    unit: str
    lower: float
    upper: float
    default: float
    description: str = ""

    def display(self, value: float) -> float:
        """``value`` (SI) in ``unit``."""
        return from_si(value, self.unit, self.quantity)


@dataclass(frozen=True)
class SurfacePoints:
    """Points on the surface mesh, by triangle and barycentric weights.

    Attributes
    ----------
    triangles : (p,) index into `ReducedModel.triangles`.
    weights : (p, 3) barycentric weights of the triangle's corners.
    """

    triangles: NDArray[np.int64]
    weights: Array

    def __len__(self) -> int:
        return len(self.triangles)

    def take(self, selection: NDArray) -> SurfacePoints:
        """The points chosen by indices or a mask."""
        return SurfacePoints(self.triangles[selection], self.weights[selection])


@dataclass(frozen=True)
class MaterialPoints:
    """Any points of the object, by nodes and interpolation weights; inside of volume cells for instance.

    Attributes
    ----------
    corners : (p, c) node indices. weights : (p, c), the shape functions of those nodes at the points.
    """

    corners: NDArray[np.int64]
    weights: Array

    def __len__(self) -> int:
        return len(self.corners)


def von_mises(stress: Array) -> Array:
    """Von Mises stress (...) of (..., 3) plane (11, 22, 12) or (..., 6) components (normal ones first)."""
    if stress.shape[-1] == 3:
        s11, s22, s12 = np.moveaxis(stress, -1, 0)
        return np.sqrt(s11**2 - s11 * s22 + s22**2 + 3.0 * s12**2)
    x, y, z, *shears = np.moveaxis(stress, -1, 0)
    normal = ((x - y) ** 2 + (y - z) ** 2 + (z - x) ** 2) / 2.0
    return np.sqrt(normal + 3.0 * sum(shear**2 for shear in shears))


@dataclass(frozen=True)
class ReducedModel:
    """What a `.morph` file holds.

    Attributes
    ----------
    name : the study's name.
    nodes : (n, 3) undeformed positions in the object frame, metres.
    triangles : (m, 3) the visible surface, node indices.
    parameters : the d coordinates of the box.
    displacement : separated field with 3 components, metres.
    stresses : for sheets the second Piola-Kirchhoff stress by face ("top", "bottom"), 3 components
        (11, 22, 12) in the material's axes; for solids the Cauchy stress under "solid", 6 components
        (xx, yy, zz, yz, xz, xy) in the object frame; pascals. Empty where none was computed.
    cells : volume cells (k, c) by type ("hex8", "tet10"), nodes in VTK's order; empty for sheets.
    strain : Green-Lagrange strain of a solid, 6 components as of the stress (tensor shears), or None.
    reactions : what supports exert, fields of one point: "force_SET" in newtons and "moment_SET" about the
        origin in newton metres, 3 components in the object frame.
    certificate : held-out errors and how they were measured, plain JSON.
    provenance : versions, study text, mesh hash, plain JSON.
    """

    name: str
    nodes: Array
    triangles: NDArray[np.int64]
    parameters: tuple[Parameter, ...]
    displacement: SeparatedField
    stresses: dict[str, SeparatedField] = field(default_factory=dict)
    cells: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    strain: SeparatedField | None = None
    reactions: dict[str, SeparatedField] = field(default_factory=dict)
    certificate: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)

    @property
    def lower(self) -> Array:
        """Lower bounds of the parameters (d,), SI."""
        return np.array([p.lower for p in self.parameters])

    @property
    def upper(self) -> Array:
        """Upper bounds of the parameters (d,), SI."""
        return np.array([p.upper for p in self.parameters])

    @property
    def default(self) -> Array:
        """Parameters of the state assumed before anything is seen (d,), SI."""
        return np.array([p.default for p in self.parameters])

    def inside(self, mu: ArrayLike) -> NDArray[np.bool_]:
        """Which parameters (d,) of ``mu`` (d,) lie in their range; elsewhere see `separated.Outside`."""
        return self.displacement.inside(mu)

    def positions(self, mu: ArrayLike, outside: Outside = "bounded") -> Array:
        """Deformed node positions (n, 3) in the object frame, metres."""
        return self.nodes + self.displacement.value(mu, outside)

    @property
    def fields(self) -> dict[str, SeparatedField]:
        """Every field under its name in the model file: "displacement", "stress_top", "strain" and so on."""
        result = {"displacement": self.displacement}
        result |= {f"stress_{place}": field for place, field in self.stresses.items()}
        result |= {} if self.strain is None else {"strain": self.strain}
        return result | {f"reaction_{name}": field for name, field in self.reactions.items()}

    def von_mises(self, mu: ArrayLike, place: str, outside: Outside = "bounded") -> Array:
        """Von Mises stress (n,) in pascals at ``place``, a key of `stresses`.

        On the faces of sheets, plane stress: sqrt(s11² - s11 s22 + s22² + 3 s12²); there the second
        Piola-Kirchhoff stress stands for the Cauchy stress turned back with the sheet; they differ by the
        order of the strain, below one per cent in paper.
        """
        return von_mises(self.stresses[place].value(mu, outside))

    def _interpolation(self, points: SurfacePoints | MaterialPoints) -> tuple[NDArray[np.int64], Array]:
        if isinstance(points, SurfacePoints):
            return self.triangles[points.triangles], points.weights
        return points.corners, points.weights

    def rest_positions(self, points: SurfacePoints | MaterialPoints) -> Array:
        """Undeformed positions (p, 3) of points, metres."""
        corners, weights = self._interpolation(points)
        return np.einsum("pc,pcx->px", weights, self.nodes[corners])

    def restrict(self, points: SurfacePoints | MaterialPoints, name: str = "displacement") -> SeparatedField:
        """The field called ``name`` in `fields` at these points only."""
        return self.fields[name].restrict(*self._interpolation(points))
