"""A body of revolution that is loaded from an unknown side: the angle about its axis as one more parameter.

The undeformed body looks the same from all sides, so its registration leaves this angle open (the paper's
alpha_Z). If U(X; mu) is the displacement when the load comes from the side that the study assumed, then

    U'(X; mu, a) = R(a) U(R(-a) X; mu)

is that when everything is turned by the angle a. On a mesh of revolution R(-a) X is a node again for every
cell that the mesh is turned on, so U' is known exactly at these angles, and a trigonometric polynomial in
between.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from morph_dslam.errors import ModelFileError
from morph_dslam.model.basis_functions import fourier_basis
from morph_dslam.model.functions import Functions
from morph_dslam.model.parameters import Parameter
from morph_dslam.model.reduced_model import ReducedModel
from morph_dslam.model.separated import SeparatedField
from morph_dslam.model.tensor_functions import CPFunctions, ProductFunctions

Array = NDArray[np.float64]
#: Nodes fall on nodes when the mesh is turned on by a cell, up to this part of its size.
NODE_TOLERANCE = 1e-5
#: Harmonics of the angle are kept until they leave out less than this part of a mode.
HARMONICS_LEFT_OUT = 1e-3
MOST_HARMONICS = 12
#: Products of a function and a harmonic that are this part of the largest one, all together, are left out; how large a
#: function becomes is seen at so many states.
PRODUCTS_LEFT_OUT, SAMPLES = 2e-3, 256
#: Nodes whose modes are turned at a time.
NODES_AT_A_TIME = 2048


def with_revolution_angle(
    model: ReducedModel, direction: Array, name: str = "turn", precision: type[np.floating] = np.float64
) -> ReducedModel:
    """The model with the angle about an axis as its last parameter, from -360 to 360 degrees, default 0.

    Reactions, which belong to sets that need not turn with the mesh, are left out.

    Parameters
    ----------
    direction : (3,) roughly that of the axis, object frame; the nodes themselves say where it is exactly.
    name : of the angle.
    precision : of the modes. Single is that of a model file, and halves the memory of what has many harmonics.

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
        key: _turned(field, images, direction, key, precision)
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

    The outer ring has a node for each cell, or, of second order, two. None if there is no number of cells for which
    nodes fall on nodes.
    """
    tree, allowed = KDTree(nodes), NODE_TOLERANCE * np.linalg.norm(np.ptp(nodes, axis=0))
    arms = nodes - point
    heights = arms @ direction
    radii = np.linalg.norm(arms - heights[:, None] * direction, axis=1)
    outer = int(radii.argmax())
    ring = np.flatnonzero((np.abs(heights - heights[outer]) < allowed) & (np.abs(radii - radii[outer]) < allowed))
    for count in (len(ring), len(ring) // 2):
        images = np.empty((count, len(nodes)), dtype=np.int64)
        for k in range(count):
            back = Rotation.from_rotvec(-2.0 * np.pi * k / count * direction).as_matrix()
            distance, images[k] = tree.query(arms @ back.T + point)
            if distance.max() > allowed:
                break
        else:
            return images if count >= 3 else None
    return None


def _turned(
    field: SeparatedField, images: NDArray[np.int64], direction: Array, name: str, precision: type[np.floating]
) -> SeparatedField:
    """A field of vectors (3 components) or symmetric tensors (6) with the angle as its last parameter."""
    count = len(images)
    angles = 2.0 * np.pi * np.arange(count) / count
    turns = [_component_turn(angle, direction, field.modes.shape[2], name) for angle in angles]
    basis = fourier_basis(0.0, 2.0 * np.pi, min(MOST_HARMONICS, (count - 1) // 2))
    table = np.array([np.ravel(basis.evaluate(angle)) for angle in angles])
    # Some nodes at a time: all of them at all angles would be the largest array of a session.
    to_harmonics = np.linalg.pinv(table)
    modes = np.empty((field.n_modes, basis.size, *field.modes.shape[1:]), dtype=precision)
    for mode, harmonics in zip(field.modes, modes, strict=True):
        for begin in range(0, len(mode), NODES_AT_A_TIME):
            part = slice(begin, begin + NODES_AT_A_TIME)
            turned = np.stack([mode[image[part]] @ turn.T for image, turn in zip(images, turns, strict=True)])
            harmonics[:, part] = np.tensordot(to_harmonics, turned, axes=1)
    kept = _harmonics_needed(modes)
    basis, modes = fourier_basis(0.0, 2.0 * np.pi, kept), modes[:, : 1 + 2 * kept]
    unit = np.eye(basis.size)
    around = CPFunctions((basis,), (unit,), unit)
    needed = _products_needed(field.functions, modes)
    functions = ProductFunctions(field.functions, around).mixed(np.eye(modes.shape[0] * modes.shape[1])[:, needed])
    product, harmonic = np.divmod(needed, modes.shape[1])
    return SeparatedField(modes[product, harmonic], functions)


def _harmonics_needed(modes: NDArray[np.floating]) -> int:
    """The least number of harmonics beyond which no mode (m, 1 + 2 h, ...) has more than a small part."""
    energy = np.array([[np.sum(part**2, dtype=np.float64) for part in mode] for mode in modes])
    energy[:, 0] *= 2.0  # the mean square of a cosine is a half, that of the constant is 1
    total = energy.sum(axis=1, keepdims=True)
    beyond = np.cumsum(energy[:, ::-1], axis=1)[:, ::-1]
    beyond = np.sqrt(np.divide(beyond, total, out=np.zeros_like(beyond), where=total > 0.0)).max(axis=0)
    small = np.flatnonzero(beyond[1::2] <= HARMONICS_LEFT_OUT)
    return int(small[0]) if small.size else modes.shape[1] // 2


def _products_needed(functions: Functions, modes: NDArray[np.floating]) -> NDArray[np.int64]:
    """Which products (k,) of a function and a harmonic, in order, have more than a small part of the field.

    Without the others it differs by less than `PRODUCTS_LEFT_OUT` of the largest one, wherever and at whatever
    parameters, because no harmonic is larger than one.

    Parameters
    ----------
    modes : (m, 1 + 2 h, ...) of each product.
    """
    lower, upper = (np.where(np.isfinite(ends), ends, 0.0) for ends in functions.bounds)
    shares = np.random.default_rng(0).random((SAMPLES, functions.dimension))
    states = np.concatenate([[lower, upper], lower + shares * (upper - lower)])
    largest = np.max([np.abs(functions.rows(state)[0]) for state in states], axis=0)
    sizes = (largest[:, None] * [[max(part.max(), -part.min()) for part in mode] for mode in modes]).ravel()
    order = np.argsort(sizes)
    small = np.cumsum(sizes[order]) <= PRODUCTS_LEFT_OUT * sizes.max()
    return np.sort(order[~small])


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
