"""Whether the parts of a reduced model fit together; asked before a model is written and after it is read."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.reduced_model import Parameter, ReducedModel
from morph_dslam.model.separated import SeparatedField
from morph_dslam.units import FACTORS

#: Ranges of functions may differ from the parameters' by this share of the range: rounding.
_ROUNDING = 1e-9


def check_model(model: ReducedModel) -> None:
    """Raise ValueError, which says what does not fit, if a part of the model contradicts another."""
    check_parameters(model.parameters)
    n_nodes = len(model.nodes)
    if model.nodes.shape != (n_nodes, 3) or n_nodes == 0 or not np.isfinite(model.nodes).all():
        raise ValueError("its nodes are not finite points")
    _check_indices("triangles", model.triangles, 3, n_nodes)
    for name, connectivity in model.cells.items():
        matched = re.fullmatch(r"[a-z]+(\d+)", name)
        if matched is None:
            raise ValueError(f"'{name}' is not a type of cell")
        _check_indices(f"{name} cells", connectivity, int(matched[1]), n_nodes)
    for name, field in model.fields.items():
        n_points = 1 if name.startswith("reaction_") else n_nodes
        n_components = {"stress": (3, 6), "strain": (6,)}.get(name.split("_")[0], (3,))
        _check_field(name, field, n_points, n_components, model)


def check_parameters(parameters: tuple[Parameter, ...]) -> None:
    """Raise ValueError where names are not distinct, units not known or a default not in its range."""
    names = [p.name for p in parameters]
    if not names or "" in names or len(set(names)) != len(names):
        raise ValueError(f"its parameters' names are missing or not distinct: {names}")
    for p in parameters:
        if p.unit not in FACTORS.get(p.quantity, {}):
            raise ValueError(f"parameter '{p.name}' is a {p.quantity} in '{p.unit}'")
        bounds = (p.lower, p.default, p.upper)
        if not (np.isfinite(bounds).all() and p.lower < p.upper and p.lower <= p.default <= p.upper):
            raise ValueError(f"parameter '{p.name}' has the lower end, default and upper end {bounds}")


def _check_indices(name: str, connectivity: NDArray[np.integer], size: int, n_nodes: int) -> None:
    if connectivity.ndim != 2 or connectivity.shape[1] != size:
        raise ValueError(f"its {name} do not have {size} nodes each")
    if connectivity.min(initial=0) < 0 or connectivity.max(initial=0) >= n_nodes:
        raise ValueError(f"its {name} name nodes that do not exist")


def _check_field(
    name: str, field: SeparatedField, n_points: int, n_components: tuple[int, ...], model: ReducedModel
) -> None:
    functions, shape = field.functions, field.modes.shape
    if len(shape) != 3 or shape[1] != n_points or shape[2] not in n_components:
        raise ValueError(f"field '{name}' has modes of shape {shape} on {n_points} points")
    if (functions.n_functions, functions.dimension) != (shape[0], len(model.parameters)):
        raise ValueError(
            f"field '{name}' has {functions.n_functions} functions of {functions.dimension} parameters, "
            f"but {shape[0]} modes and {len(model.parameters)} parameters"
        )
    lower, upper = functions.bounds
    slack = _ROUNDING * (model.upper - model.lower)
    if (lower > model.lower + slack).any() or (upper < model.upper - slack).any():
        raise ValueError(f"the functions of field '{name}' do not cover the ranges of the parameters")
    if not np.isfinite(field.modes).all():
        raise ValueError(f"field '{name}' holds values that are not finite")
