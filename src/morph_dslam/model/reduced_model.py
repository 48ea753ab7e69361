"""Points that stand for a surface: spread over a triangle mesh as its area asks for."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from morph_dslam.errors import ModelFileError
from morph_dslam.model.basis_functions import fourier_basis
from morph_dslam.model.separated import Outside, SeparatedField
from morph_dslam.model.tensor_functions import CPFunctions, ProductFunctions
from morph_dslam.units import from_si

Array = NDArray[np.float64]


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


# The reduced model of one object: mesh, parameters, displacement and stress as separated fields.


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


# A body of revolution that is loaded from an unknown side: the angle about its axis as one more parameter.
# The undeformed body looks the same from all sides, so its registration leaves this angle open (the paper's
# alpha_Z). If U(X; mu) is the displacement when the load comes from the side that the study assumed, then
#     U'(X; mu, a) = R(a) U(R(-a) X; mu)
# is that when everything is turned by the angle a. On a mesh of revolution R(-a) X is a node again for every
# cell that the mesh is turned on, so U' is known exactly at these angles, and a trigonometric polynomial in
# between.


#: Nodes fall on nodes when the mesh is turned on by a cell, up to this part of its size.
NODE_TOLERANCE = 1e-5

#: Harmonics of the angle are kept until they leave out less than this part of a mode.
HARMONICS_LEFT_OUT = 1e-3

MOST_HARMONICS = 12


def with_revolution_angle(model: ReducedModel, direction: Array, name: str = "turn") -> ReducedModel:
    """The model with the angle about an axis as its last parameter, from -360 to 360 degrees, default 0.

    Reactions, which belong to sets that need not turn with the mesh, are left out.

    Parameters
    ----------
    direction : (3,) roughly that of the axis, object frame; the nodes themselves say where it is exactly.

    Raises
    ------
    ModelFileError
        If the mesh is not one of revolution about this axis, or has a parameter of this name.
    """
    if name in [parameter.name for parameter in model.parameters]:
        raise ModelFileError(f"the model '{model.name}' has a parameter '{name}' of its own already")
    point, direction = _axis_of(model.nodes, np.asarray(direction))
    images = _node_images(model.nodes, point, direction)
    if images is None:
        raise ModelFileError(
            f"the mesh of '{model.name}' does not fall on itself when it is turned about its axis by a cell: "
            "mesh it as a body of revolution, with a whole number of equal cells around"
        )
    angle = Parameter(
        name, "angle", "deg", -2.0 * np.pi, 2.0 * np.pi, 0.0, "angle about the axis from which it is loaded"
    )
    fields = {
        key: _turned(field, images, direction, key)
        for key, field in model.fields.items()
        if field.modes.shape[1] == len(model.nodes)
    }
    return replace(
        model,
        parameters=(*model.parameters, angle),
        displacement=fields["displacement"],
        stresses={place: fields[f"stress_{place}"] for place in model.stresses},
        strain=fields.get("strain"),
        reactions={},
    )


def _axis_of(nodes: Array, direction: Array) -> tuple[Array, Array]:
    """A point on the axis and its direction: the axis of the nodes' inertia that is nearest in direction."""
    centre = nodes.mean(axis=0)
    _, principal = np.linalg.eigh(np.cov((nodes - centre).T))
    best = principal[:, np.abs(principal.T @ direction).argmax()]
    return centre, best * np.sign(best @ direction)


def _node_images(nodes: Array, point: Array, direction: Array) -> NDArray[np.int64] | None:
    """Which node (n_cells, n) is where each node comes from when the mesh is turned on by k cells of n_cells.

    None if there is no number of cells for which nodes fall on nodes.
    """
    tree, allowed = KDTree(nodes), NODE_TOLERANCE * np.linalg.norm(np.ptp(nodes, axis=0))
    arms = nodes - point
    heights = arms @ direction
    radii = np.linalg.norm(arms - heights[:, None] * direction, axis=1)
    outer = int(radii.argmax())
    ring = np.flatnonzero((np.abs(heights - heights[outer]) < allowed) & (np.abs(radii - radii[outer]) < allowed))
    count = len(ring)
    if count < 3:
        return None
    images = np.empty((count, len(nodes)), dtype=np.int64)
    for k in range(count):
        back = Rotation.from_rotvec(-2.0 * np.pi * k / count * direction).as_matrix()
        distance, images[k] = tree.query(arms @ back.T + point)
        if distance.max() > allowed:
            return None
    return images


def _turned(field: SeparatedField, images: NDArray[np.int64], direction: Array, name: str) -> SeparatedField:
    """A field of vectors (3 components) or symmetric tensors (6) with the angle as its last parameter."""
    count = len(images)
    angles = 2.0 * np.pi * np.arange(count) / count
    turns = [_component_turn(angle, direction, field.modes.shape[2], name) for angle in angles]
    basis = fourier_basis(0.0, 2.0 * np.pi, min(MOST_HARMONICS, (count - 1) // 2))
    table = np.array([np.ravel(basis.evaluate(angle)) for angle in angles])
    # One mode at a time: all of them at all angles would be the largest array of a session.
    to_harmonics = np.linalg.pinv(table)
    modes = np.empty((field.n_modes, basis.size, *field.modes.shape[1:]))
    for mode, harmonics in zip(field.modes, modes, strict=True):
        turned = np.stack([mode[image] @ turn.T for image, turn in zip(images, turns, strict=True)])
        harmonics[:] = np.tensordot(to_harmonics, turned, axes=1)
    kept = _harmonics_needed(modes)
    basis, modes = fourier_basis(0.0, 2.0 * np.pi, kept), modes[:, : 1 + 2 * kept]
    unit = np.eye(basis.size)
    around = CPFunctions((basis,), (unit,), unit)
    functions = ProductFunctions(field.functions, around)
    return SeparatedField(np.ascontiguousarray(modes).reshape(-1, *field.modes.shape[1:]), functions)


def _harmonics_needed(modes: Array) -> int:
    """The least number of harmonics beyond which no mode (m, 1 + 2 h, ...) has more than a small part."""
    energy = np.sum(modes.reshape(*modes.shape[:2], -1) ** 2, axis=2)
    energy[:, 0] *= 2.0  # the mean square of a cosine is a half, that of the constant is 1
    total = energy.sum(axis=1, keepdims=True)
    beyond = np.sqrt(np.cumsum(energy[:, ::-1], axis=1)[:, ::-1] / total).max(axis=0)
    small = np.flatnonzero(beyond[1::2] <= HARMONICS_LEFT_OUT)
    return int(small[0]) if small.size else modes.shape[1] // 2


#: Pairs of axes of the components of a symmetric tensor: xx, yy, zz, yz, xz, xy.
_PAIRS = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))


def _component_turn(angle: float, direction: Array, n_components: int, name: str) -> Array:
    """The matrix (c, c) that turns the components of a vector or a symmetric tensor."""
    rotation = Rotation.from_rotvec(angle * direction).as_matrix()
    if n_components == 3:
        return rotation
    if n_components != 6:
        raise ModelFileError(f"field '{name}' has {n_components} components, which cannot be turned")
    matrix = np.zeros((6, 6))
    for row, (i, j) in enumerate(_PAIRS):
        for column, (p, q) in enumerate(_PAIRS):
            matrix[row, column] = rotation[i, p] * rotation[j, q]
            if p != q:
                matrix[row, column] += rotation[i, q] * rotation[j, p]
    return matrix
