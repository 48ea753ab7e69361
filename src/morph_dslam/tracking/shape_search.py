"""Where else to start: shapes spread over the parameter box, against local minima."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.geometry import RigidTransform
from morph_dslam.model import ReducedModel
from morph_dslam.registration.landmarks import shape_starts
from morph_dslam.tracking.estimator import Estimate, State
from morph_dslam.tracking.observability import UNTOLD_SHARE

#: A start off a bound is this share of the range inside of it.
OFF_BOUND = 0.02


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


class BoundSearch:
    """Hands out starts off a bound that an estimate may have run into because of what the images do not tell.

    A lever that is turned to the left looks, as long as its side is taken to be the right one, as if it were
    turned by less than nothing: the estimate ends at the bound, where its side has no effect and so cannot be
    corrected, however far the lever turns. From a start that is turned a little, with other values of what is
    unobservable, it can.
    """

    def __init__(self, model: ReducedModel, count: int) -> None:
        self._model, self._count, self._random = model, count, np.random.default_rng(0)

    def next_starts(self, estimate: Estimate) -> list[State]:
        """The next starts from an estimate; none where it is at no bound, or all parameters are told."""
        model, state = self._model, estimate.state
        unobservable = _untold(model, estimate) & ~estimate.at_bound
        if not (estimate.at_bound.any() and unobservable.any()):
            return []
        width = model.upper - model.lower
        inside = np.clip(state.parameters, model.lower + OFF_BOUND * width, model.upper - OFF_BOUND * width)
        starts = []
        for _ in range(self._count):
            anywhere = model.lower + self._random.random(len(width)) * width
            parameters = np.where(unobservable, anywhere, inside)
            starts.append(State(parameters, state.camera_from_object))
        return starts


def with_undetermined_at_default(model: ReducedModel, estimate: Estimate) -> State:
    """The estimated state with parameters that the images did not determine put back to their default.

    Where a parameter has no effect (the shape of a bend that is zero) its estimate is anywhere; starting the
    next frame from there would lead into the wrong valley as soon as it has an effect.
    """
    state = estimate.state
    return replace(state, parameters=np.where(_untold(model, estimate), model.default, state.parameters))


def _untold(model: ReducedModel, estimate: Estimate) -> NDArray[np.bool_]:
    """Which parameters (d,) the images did not determine."""
    return ~(estimate.parameter_std < UNTOLD_SHARE * (model.upper - model.lower))
