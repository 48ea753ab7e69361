"""States of a model that the report shows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.evaluation.model_summary import describe_point
from morph_dslam.model import ReducedModel

Array = NDArray[np.float64]

#: Pictures of states at most.
MOST_STATES = 6
#: What captions say of the parameters that are not varied.
HALF_WAY_OUT = "other parameters half way from their defaults to the farther ends of their ranges"


def far_ends(model: ReducedModel) -> Array:
    """The end of each parameter's range (d,) that is farther from its default, the upper one if both are."""
    above, below = model.upper - model.default, model.default - model.lower
    return np.where(above >= below, model.upper, model.lower)


def half_way_out(model: ReducedModel) -> Array:
    """The state (d,) half way from the defaults to the far ends: defaults are often states of rest."""
    return (model.default + far_ends(model)) / 2.0


def states_to_show(model: ReducedModel) -> tuple[list[Array], list[str]]:
    """States, and a line for each: three along a single parameter; else the default and each far end."""
    if len(model.parameters) == 1:
        states = list(np.linspace(model.lower, model.upper, 3))
        return states, [describe_point(model.parameters, mu) for mu in states]
    states, captions, ends = [model.default], ["default"], far_ends(model)
    for k, parameter in enumerate(model.parameters[: MOST_STATES - 1]):
        mu = half_way_out(model)
        mu[k] = ends[k]
        states.append(mu)
        captions.append(describe_point([parameter], [mu[k]]))
    return states, captions
