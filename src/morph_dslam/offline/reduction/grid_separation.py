"""Fields on structured meshes with their coordinates separated too: U = sum_i X_i(x) Y_i(y) a_i H_i(mu).

The paper's sheet is separated in this way. The modes of a field, weighted with what their functions do over
the samples, are a tensor with one axis for each direction of the mesh; its canonical polyadic form (CP) gives
X, Y and a, and its first factor mixes the functions of the parameters, whatever their format.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import SeparatedField
from morph_dslam.model.compact_modes import GridModes
from morph_dslam.offline.reduction.tensor_formats import cp

Array = NDArray[np.float64]


def separate_grid(
    field: SeparatedField,
    shape: tuple[int, ...],
    samples: Array,
    tolerance: float,
    max_terms: int,
    by_component: bool = False,
) -> SeparatedField:
    """Separate the modes of a field in the directions of a structured mesh.

    Snapshots of one parameter are a field too: as modes, with a hat function each.

    Parameters
    ----------
    shape : number of nodes in each direction, the one whose index runs fastest last.
    samples : (N, d) states over which the error counts.
    tolerance : relative L2 error over nodes and samples at which terms are no longer added.
    max_terms : most terms; for each component where ``by_component``.
    by_component : separate each component by itself, with its own terms X Y H, as in the paper.

    Raises
    ------
    ValueError
        If the mesh does not have that many nodes.
    """
    n_modes, n_points, n_components = field.modes.shape
    if np.prod(shape) != n_points:
        raise ValueError(f"a grid of {shape} nodes is not a mesh of {n_points}")
    values = np.stack([field.functions.evaluate(mu)[0] for mu in samples])
    _, sizes, mixes = np.linalg.svd(values, full_matrices=False)  # without the samples norms are the same
    used = sizes > 1e-13 * sizes[0]
    sizes, mixes = sizes[used], mixes[used]
    weighted = sizes[:, None] * (mixes @ field.modes.reshape(n_modes, -1))
    # many modes of few dimensions, snapshots say, are first told by those few
    left, values, right = np.linalg.svd(weighted, full_matrices=False)
    kept = values > 0.01 * tolerance * values[0]
    weighted = (values[kept, None] * right[kept]).reshape(-1, *shape, n_components)
    groups = np.split(np.arange(n_components), n_components) if by_component else [np.arange(n_components)]
    total = float(np.linalg.norm(weighted))
    terms = []
    for group in groups:
        part = weighted[..., group]
        allowed = tolerance * total / np.sqrt(len(groups))
        if (size := float(np.linalg.norm(part))) > allowed:
            mixing, *axes, vectors = cp(part, allowed / size, max_terms).factors
            components = np.zeros((vectors.shape[1], n_components))
            components[:, group] = vectors.T
            terms.append((mixing, *(axis.T for axis in axes), components))
    mixing = np.concatenate([term[0] for term in terms], axis=1)
    *axes, components = (np.concatenate(parts) for parts in list(zip(*terms, strict=True))[1:])
    functions = field.functions.mixed((mixes.T / sizes) @ left[:, kept] @ mixing)
    return SeparatedField.from_compact(GridModes(tuple(axes), components), functions)
