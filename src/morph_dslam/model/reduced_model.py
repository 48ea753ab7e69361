"""The reduced model of one object: mesh, parameters, displacement and stress as separated fields."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from morph_dslam.errors import ParameterError, StudyError
from morph_dslam.model.parameters import Parameter
from morph_dslam.model.separated import Outside, SeparatedField, check_outside
from morph_dslam.model.unknown_loads import ElasticEnergy, UnknownLoads
from morph_dslam.units import read_quantity

Array = NDArray[np.float64]
#: Values of the parameters: all of them in order (d,), SI, or some by name, SI or texts such as "20 mN"; the others
#: have their defaults.
ParameterValues = ArrayLike | Mapping[str, float | str]
#: Meshes are the same if their nodes differ by less than this share of their coordinates: files round.
SAME_PLACE = 1e-5


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
    places : (p, 3) where they lie in the undeformed shape, metres: a model that has them elsewhere refuses them. None
        where only one model can be meant.
    """

    corners: NDArray[np.int64]
    weights: Array
    places: Array | None = None

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


Points = SurfacePoints | MaterialPoints


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
    provenance : versions, study text, mesh hash, the study's parameter of time, plain JSON.
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

    def __repr__(self) -> str:
        ranges = ", ".join(f"{p.name} {p.range_text}" for p in self.study_parameters) or "rigid"
        loads = f", {self.n_loads} unknown loads" if self.n_loads else ""
        return f"<ReducedModel '{self.name}': {len(self.nodes)} nodes, {ranges}{loads}>"

    @property
    def n_loads(self) -> int:
        """How many of the last parameters are coefficients of unknown loads."""
        return 0 if self.energy is None else self.energy.loads.count

    @property
    def study_parameters(self) -> tuple[Parameter, ...]:
        """The parameters that the study names: all but the coefficients of unknown loads."""
        return self.parameters[: len(self.parameters) - self.n_loads]

    @property
    def clocks(self) -> tuple[int, ...]:
        """Numbers of the parameters that may be the time of the material: the study's ``[time]``, or all of seconds."""
        named = self.provenance.get("time_parameter")
        measured = [(k, p) for k, p in enumerate(self.study_parameters) if p.quantity == "time"]
        return tuple(k for k, p in measured if named in (None, p.name))

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
            If a name is not one of the model's parameters, a text is no value of one, or an array has another length.
        """
        names = [p.name for p in self.parameters]
        if isinstance(parameters, Mapping):
            if unknown := [str(name) for name in parameters if name not in names]:
                raise ParameterError(
                    f"the model '{self.name}' has no parameter '{unknown[0]}'; it has {', '.join(names) or 'none'}"
                )
            return np.array([_si(p, parameters.get(p.name, p.default)) for p in self.parameters], dtype=np.float64)
        try:
            mu = np.asarray(parameters, dtype=np.float64)
        except (TypeError, ValueError):
            raise ParameterError(
                f"{parameters!r} is neither an array of parameters nor a table of them by name"
            ) from None
        if mu.shape != (len(names),):
            raise ParameterError(
                f"the model '{self.name}' has {len(names)} parameters ({', '.join(names)}), "
                f"not an array of shape {mu.shape}"
            )
        return mu

    def at(self, parameters: ParameterValues, outside: Outside | None = None) -> DeformedState:
        """The object at some parameters: its displacement, strain, stress and reactions.

        Parameters
        ----------
        parameters : values by name, SI or texts with a unit such as "20 mN", the others at their defaults; or all in
            order (d,), SI.
        outside : what fields are where a parameter is outside of its range (`SeparatedField`): "bounded", those of the
            nearest state in it, or "linear", continued by tangents; by default it is refused.

        Raises
        ------
        ParameterError
            If there is no such parameter, a value is not finite, not readable, or outside of its range, or ``outside``
            is another word.
        """
        mu = self.vector(parameters)
        for p, value in zip(self.parameters, mu, strict=True):
            if not np.isfinite(value):
                raise ParameterError(f"{p.name} = {value} is not a finite number")
        if outside is None:
            # A periodic parameter is in its range whatever its value.
            for p, value, inside in zip(self.parameters, mu, self.displacement.inside(mu), strict=True):
                if not inside and not p.in_range(value):
                    raise ParameterError(
                        f"{p.name} = {p.text(value)} is outside of its range, {p.range_text} (numbers are SI); "
                        'outside="bounded" takes the nearest state in it'
                    )
        return DeformedState(self, mu, outside or "bounded")

    def points(self, positions: ArrayLike, reach: float = 0.0) -> MaterialPoints:
        """Points of the object, inside or on its surface, by their positions in the undeformed shape.

        Parameters
        ----------
        positions : (p, 3), or (3,) for one point, object frame, metres.
        reach : points outside by at most about this, metres, are drawn to the object. The faces of the mesh are not
            quite those of a curved object.

        Raises
        ------
        ParameterError
            If a point lies farther outside of the solid, or off the surface of a sheet.
        """
        # SciPy takes as long to load as all else that a model needs.
        from morph_dslam.model.point_location import material_points

        places = np.atleast_2d(np.asarray(positions, dtype=np.float64))
        if places.ndim != 2 or places.shape[1] != 3:
            raise ParameterError(f"points are positions (p, 3) in metres, not an array of shape {places.shape}")
        if not np.isfinite(places).all():
            raise ParameterError("points are positions (p, 3) in metres; some of these are not finite")
        return material_points(self.nodes, self.cells or {"tri3": self.triangles}, places, reach)

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
        """Deformed node positions (n, 3) in the object frame, metres.

        Parameters
        ----------
        parameters : SI, by name or in order.
        outside : what holds outside of the ranges (`inside` says of which); "bounded", unless stated, takes each value
            at the nearest end of its range.

        Raises
        ------
        ParameterError
            As `vector`, or if a value is not a number (NaN).
        """
        mu = self.vector(parameters)
        if len(missing := np.flatnonzero(np.isnan(mu))):
            name = self.parameters[missing[0]].name
            raise ParameterError(f"the parameter '{name}' is not a number (NaN): give it a value")
        return self.nodes + self.displacement.value(mu, outside)

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
        return DeformedState(self, self.vector(parameters), outside).von_mises(place)

    def _interpolation(self, points: Points) -> tuple[NDArray[np.int64], Array]:
        if isinstance(points, SurfacePoints):
            return self.triangles[points.triangles], points.weights
        if points.places is not None:
            self._check_places(points, points.places)
        return points.corners, points.weights

    def _check_places(self, points: MaterialPoints, places: Array) -> None:
        """Raise ParameterError if the points lie elsewhere in this mesh: they are another model's."""
        if points.corners.max(initial=0) < len(self.nodes):
            nodes = self.nodes[points.corners]
            here = np.einsum("pc,pcx->px", points.weights, nodes)
            if np.abs(here - places).max(initial=0.0) <= SAME_PLACE * np.abs(nodes).max(initial=0.0):
                return
        raise ParameterError(
            f"these points were found in a model with another mesh than '{self.name}': find them in this one, with its "
            "method points(positions)"
        )

    def rest_positions(self, points: Points) -> Array:
        """Undeformed positions (p, 3) of points, metres; ParameterError if they are another model's."""
        corners, weights = self._interpolation(points)
        return np.einsum("pc,pcx->px", weights, self.nodes[corners])

    def restrict(
        self, points: Points, name: str = "displacement", precision: type[np.floating] = np.float64
    ) -> SeparatedField:
        """The field called ``name`` in `fields` at these points only, its modes in this precision.

        Raises
        ------
        ParameterError
            If the model has no such field, or the points were found in a model with another mesh.
        """
        return self.field(name).restrict(*self._interpolation(points), precision)

    def field(self, name: str) -> SeparatedField:
        """The field called ``name`` in `fields`.

        Raises
        ------
        ParameterError
            If the model has none of this name.
        """
        fields = self.fields
        if name not in fields:
            raise ParameterError(f"the model '{self.name}' has no field '{name}'; it has {', '.join(fields)}")
        return fields[name]


@dataclass(frozen=True)
class DeformedState:
    """A reduced model at given parameters; object frame.

    Fields are given at the mesh's nodes, or at points of `ReducedModel.points`: n is the number of either. Points that
    were found in a model with another mesh are refused (ParameterError).

    Attributes
    ----------
    model : the model.
    parameters : (d,), SI.
    outside : what fields are outside the parameter box.
    """

    model: ReducedModel
    parameters: Array
    outside: Outside = "bounded"

    def __post_init__(self) -> None:
        check_outside(self.outside)

    def displacement(self, points: Points | None = None) -> Array:
        """(n, 3), metres."""
        return self._value("displacement", points)

    def positions(self, points: Points | None = None) -> Array:
        """Where the nodes or points are (n, 3), metres."""
        rest = self.model.nodes if points is None else self.model.rest_positions(points)
        return rest + self.displacement(points)

    def strain(self, points: Points | None = None) -> Array:
        """Green-Lagrange strain (n, 6) of a solid: xx, yy, zz, yz, xz, xy."""
        return self._value("strain", points)

    def stress(self, place: str | None = None, points: Points | None = None) -> Array:
        """Stress of a solid (n, 6), xx, yy, zz, yz, xz, xy, or on a face of a sheet (n, 3), pascals.

        Of its axes see `ReducedModel.stresses`.

        Parameters
        ----------
        place : "solid" for solids, "top" or "bottom" for sheets; "solid" or "top" if absent.
        points : at which; all nodes if absent.
        """
        return self._value(f"stress_{self._places(place)[0]}", points)

    def von_mises(self, place: str | None = None, points: Points | None = None) -> Array:
        """Von Mises stress (n,), pascals; the largest of all places if none is named (`ReducedModel.von_mises`)."""
        return np.max([von_mises(self.stress(key, points)) for key in self._places(place)], axis=0)

    def derivatives(self, name: str = "displacement", points: Points | None = None) -> Array:
        """Derivatives (d, n, k) of a field with k components by each parameter, SI.

        Parameters
        ----------
        name : a key of `ReducedModel.fields`: "displacement", "strain", "stress_solid" and so on.
        points : at which; all nodes if absent.
        """
        return self._field(name, points).value_and_sensitivities(self.parameters, self.outside)[1]

    def reactions(self) -> dict[str, Array]:
        """What supports exert (3,): "force_SET" in newtons and "moment_SET" in newton metres."""
        fields = self.model.reactions
        return {name: field.value(self.parameters, self.outside)[0] for name, field in fields.items()}

    def _places(self, place: str | None) -> list[str]:
        """The places of the stress that are asked for; ParameterError if the model has none, or not this one.

        The top comes first, whatever the order in the model: a file has none of its own.
        """
        places = sorted(self.model.stresses, key=lambda name: name != "top")
        if not places:
            raise ParameterError(f"the model '{self.model.name}' has no stress; it has {', '.join(self.model.fields)}")
        if place is not None and place not in places:
            raise ParameterError(f"the model '{self.model.name}' has no stress '{place}'; it has {', '.join(places)}")
        return places if place is None else [place]

    def _field(self, name: str, points: Points | None) -> SeparatedField:
        return self.model.field(name) if points is None else self.model.restrict(points, name)

    def _value(self, name: str, points: Points | None) -> Array:
        return self._field(name, points).value(self.parameters, self.outside)


def _si(parameter: Parameter, value: float | str) -> float:
    """A value given by name, as a number in SI or as a text with its unit."""
    try:
        return read_quantity(value, parameter.quantity) if isinstance(value, str) else float(value)
    except StudyError as error:
        raise ParameterError(f"{parameter.name}: {error}") from None
    except (TypeError, ValueError):
        raise ParameterError(f"{parameter.name} = {value!r} is not a number") from None


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
