"""Where else to start: shapes spread over the parameter box, against local minima."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from morph_dslam.geometry import RigidTransform
from morph_dslam.model import ReducedModel
from morph_dslam.online.estimation.estimator import Estimate, State
from morph_dslam.online.start.registration import shape_starts
from morph_dslam.online.uncertainty.observability import UNTOLD_SHARE


class ShapeSearch:
    """Hands out start shapes in turn, ``count`` a frame, in an order that visits the whole box early."""

    def __init__(self, model: ReducedModel, count: int) -> None:
        shapes = np.array(shape_starts(model))
        order = np.random.default_rng(0).permutation(len(shapes) - 1) + 1
        self._shapes = shapes[np.concatenate([[0], order])]
        self._count = count
        self._next = 0

    def next_starts(self, pose: RigidTransform) -> list[State]:
        """The next shapes, all in ``pose``."""
        rows = (self._next + np.arange(self._count)) % len(self._shapes)
        self._next = int(rows[-1] + 1)
        return [State(self._shapes[row], pose) for row in rows]


def with_undetermined_at_default(model: ReducedModel, estimate: Estimate) -> State:
    """The estimated state with parameters that the images did not determine put back to their default.

    Where a parameter has no effect (the shape of a bend that is zero) its estimate is anywhere; starting the
    next frame from there would lead into the wrong valley as soon as it has an effect.
    """
    state = estimate.state
    undetermined = ~(estimate.parameter_std < UNTOLD_SHARE * (model.upper - model.lower))
    return replace(state, parameters=np.where(undetermined, model.default, state.parameters))
