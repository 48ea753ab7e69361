"""The reduced model of one object: mesh, parameters, displacement and stress as separated fields."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from morph_dslam.errors import ParameterError
from morph_dslam.model.separated import Outside, SeparatedField
from morph_dslam.model.unknown_loads import ElasticEnergy, UnknownLoads
from morph_dslam.units import from_si

Array = NDArray[np.float64]
#: Values of the parameters in SI: all of them in order (d,), or some by name; the others have their defaults.
ParameterValues = ArrayLike | Mapping[str, float]


@dataclass(frozen=True)
class Parameter:
    """One coordinate of the parameter box.

    Attributes
    ----------
    name : of the parameter.
    quantity : what it measures, a key of `morph_dslam.units.FACTORS` ("length", "angle", "ratio" ...).
    unit : in which reports show it.
    lower : lower end of its range, SI.
    upper : upper end, SI.
    default : value of the state that nothing is known about, SI.
    description : for reports.
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
    corners : (p, c) node indices.
    weights : (p, c), the shape functions of those nodes at the points.
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


def equivalent_strain(strain: Array) -> Array:
    """sqrt(2/3 e : e) (n,) of the deviator e of strains (n, 6): xx, yy, zz, yz, xz, xy with tensor shears."""
    normal = strain[:, :3] - strain[:, :3].mean(axis=1, keepdims=True)
    squared = np.sum(normal**2, axis=1) + 2.0 * np.sum(strain[:, 3:] ** 2, axis=1)
    return np.sqrt(2.0 / 3.0 * squared)


#: Name of a reaction's field in the file: this and its name in the model, "force_SET" (N) or "moment_SET" (N m).
REACTION, FORCE, MOMENT = "reaction_", "force_", "moment_"


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
    supports : nodes (k,) that each support holds, by the name of the set.
    reactions : what supports exert, fields of one point: "force_SET" in newtons and "moment_SET" about the
        origin in newton metres, 3 components in the object frame.
    unknown_loads : tractions beside the study's loads and what they do; None where the study asks for none.
    energy : of the unknown loads, whose coefficients are then the last parameters (`with_unknown_loads`); None
        without.
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
    supports: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    reactions: dict[str, SeparatedField] = field(default_factory=dict)
    unknown_loads: UnknownLoads | None = None
    energy: ElasticEnergy | None = None
    certificate: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)

    @property
    def n_loads(self) -> int:
        """How many of the last parameters are coefficients of unknown loads."""
        return 0 if self.energy is None else self.energy.loads.count

    @property
    def study_parameters(self) -> tuple[Parameter, ...]:
        """The parameters that the study names: all but the coefficients of unknown loads."""
        return self.parameters[: len(self.parameters) - self.n_loads]

    @property
    def without_loads(self) -> ReducedModel:
        """The model with the parameters that its study names alone."""
        return self if self.energy is None else self.energy.model

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
        """Parameters of the state assumed before anything is observed (d,), SI."""
        return np.array([p.default for p in self.parameters])

    def vector(self, parameters: ParameterValues) -> Array:
        """The parameters (d,), SI, of values by name or in order.

        Raises
        ------
        ParameterError
            If a name is not one of the model's parameters, or an array has another length.
        """
        names = [p.name for p in self.parameters]
        if isinstance(parameters, Mapping):
            if unknown := [str(name) for name in parameters if name not in names]:
                raise ParameterError(
                    f"the model '{self.name}' has no parameter '{unknown[0]}'; it has {', '.join(names) or 'none'}"
                )
            return np.array([parameters.get(p.name, p.default) for p in self.parameters], dtype=np.float64)
        mu = np.asarray(parameters, dtype=np.float64)
        if mu.shape != (len(names),):
            raise ParameterError(
                f"the model '{self.name}' has {len(names)} parameters ({', '.join(names)}), "
                f"not an array of shape {mu.shape}"
            )
        return mu

    def at(self, parameters: ParameterValues, outside: Outside = "bounded") -> DeformedState:
        """The object at some parameters: its displacement, strain, stress and reactions."""
        return DeformedState(self, self.vector(parameters), outside)

    def spread_parameters(self, count: int) -> Array:
        """The default and ``count`` samples spread evenly over the box (1 + count, d); without parameters the default.

        Unknown loads stay away. The samples are multiples of powers of the generalised golden ratio g, the root of
        g^(d + 1) = g + 1, modulo 1 (Roberts, The unreasonable effectiveness of quasirandom sequences, 2018). SciPy's
        sequences are in `scipy.stats`, which takes as long to load, and as much memory, as all else that a model needs.
        """
        d = len(self.study_parameters)
        if not d:
            return self.default[None]
        samples, golden = np.repeat(self.default[None], 1 + count, axis=0), 2.0
        for _ in range(50):
            golden = (1.0 + golden) ** (1.0 / (d + 1))
        shares = (0.5 + np.outer(np.arange(1, count + 1), golden ** -np.arange(1.0, d + 1))) % 1.0
        samples[1:, :d] = self.lower[:d] + shares * (self.upper - self.lower)[:d]
        return samples

    def inside(self, parameters: ParameterValues) -> NDArray[np.bool_]:
        """Which parameters (d,) lie in their range; elsewhere see `separated.Outside`."""
        return self.displacement.inside(self.vector(parameters))

    def positions(self, parameters: ParameterValues, outside: Outside = "bounded") -> Array:
        """Deformed node positions (n, 3) in the object frame, metres."""
        return self.nodes + self.displacement.value(self.vector(parameters), outside)

    @property
    def fields(self) -> dict[str, SeparatedField]:
        """Every field under its name in the model file: "displacement", "stress_top", "strain" and so on."""
        result = {"displacement": self.displacement}
        result |= {f"stress_{place}": field for place, field in self.stresses.items()}
        result |= {} if self.strain is None else {"strain": self.strain}
        result |= {} if self.energy is None else {"traction": self.energy.traction}
        return result | {REACTION + name: field for name, field in self.reactions.items()}

    def von_mises(self, parameters: ParameterValues, place: str | None = None, outside: Outside = "bounded") -> Array:
        """Von Mises stress (n,) in pascals.

        On the faces of sheets, plane stress: sqrt(s11² - s11 s22 + s22² + 3 s12²); there the second
        Piola-Kirchhoff stress stands for the Cauchy stress turned back with the sheet; they differ by the
        order of the strain, below one per cent in paper.

        Parameters
        ----------
        parameters : SI.
        place : a key of `stresses`; the largest at each node of all places if absent.
        outside : what the field is outside the parameter box.
        """
        places = list(self.stresses) if place is None else [place]
        if not places or not self.stresses.keys() >= set(places):
            raise ParameterError(f"the model '{self.name}' has no stress {place or ''}")
        mu = self.vector(parameters)
        return np.max([von_mises(self.stresses[key].value(mu, outside)) for key in places], axis=0)

    def _interpolation(self, points: SurfacePoints | MaterialPoints) -> tuple[NDArray[np.int64], Array]:
        if isinstance(points, SurfacePoints):
            return self.triangles[points.triangles], points.weights
        return points.corners, points.weights

    def rest_positions(self, points: SurfacePoints | MaterialPoints) -> Array:
        """Undeformed positions (p, 3) of points, metres."""
        corners, weights = self._interpolation(points)
        return np.einsum("pc,pcx->px", weights, self.nodes[corners])

    def restrict(
        self,
        points: SurfacePoints | MaterialPoints,
        name: str = "displacement",
        precision: type[np.floating] = np.float64,
    ) -> SeparatedField:
        """The field called ``name`` in `fields` at these points only, its modes in this precision."""
        return self.fields[name].restrict(*self._interpolation(points), precision)


@dataclass(frozen=True)
class DeformedState:
    """A reduced model at given parameters; fields at the mesh's nodes, object frame.

    Attributes
    ----------
    model : the model.
    parameters : (d,), SI.
    outside : what fields are outside the parameter box.
    """

    model: ReducedModel
    parameters: Array
    outside: Outside = "bounded"

    def displacement(self) -> Array:
        """(n, 3), metres."""
        return self.model.displacement.value(self.parameters, self.outside)

    def positions(self) -> Array:
        """Deformed nodes (n, 3), metres."""
        return self.model.positions(self.parameters, self.outside)

    def strain(self) -> Array:
        """Green-Lagrange strain (n, 6) of a solid: xx, yy, zz, yz, xz, xy."""
        return self._field("strain", self.model.strain)

    def stress(self, place: str | None = None) -> Array:
        """Stress (n, 6) of a solid or (n, 3) on a face of a sheet, pascals (`ReducedModel.stresses`).

        Parameters
        ----------
        place : a key of `ReducedModel.stresses`; the first of them if absent.
        """
        stresses = self.model.stresses
        return self._field(f"stress_{place or ''}", stresses.get(place or next(iter(stresses), "")))

    def von_mises(self, place: str | None = None) -> Array:
        """Von Mises stress (n,), pascals; the largest at each node of all places if none is named."""
        return self.model.von_mises(self.parameters, place, self.outside)

    def reactions(self) -> dict[str, Array]:
        """What supports exert (3,): "force_SET" in newtons and "moment_SET" in newton metres."""
        fields = self.model.reactions
        return {name: field.value(self.parameters, self.outside)[0] for name, field in fields.items()}

    def _field(self, name: str, field: SeparatedField | None) -> Array:
        if field is None:
            raise ParameterError(
                f"the model '{self.model.name}' has no field '{name}'; it has {', '.join(self.model.fields)}"
            )
        return field.value(self.parameters, self.outside)


def triangle_normals(nodes: Array, triangles: NDArray[np.int64]) -> Array:
    """Normals (m, 3) of triangles (m, 3) of nodes (n, 3), as long as twice their areas."""
    a, b, c = (nodes[triangles[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def spread_over(nodes: Array, triangles: NDArray[np.int64], count: int) -> SurfacePoints:
    """``count`` points spread evenly over the triangles (m, 3) of nodes (n, 3), the same every time.

    Each stands for the same area: along the triangles, one after the other, they are equally far apart, and
    within its triangle each lies anywhere.
    """
    areas = np.linalg.norm(triangle_normals(nodes, triangles), axis=1)
    places = (np.arange(count) + 0.5) / count * areas.sum()
    # The sum may be larger than the last of the running sums by a rounding error.
    chosen = np.minimum(np.searchsorted(np.cumsum(areas), places), len(areas) - 1)
    return SurfacePoints(chosen, np.random.default_rng(0).dirichlet(np.ones(3), count))
