"""Other starts of the minimisation, against local minima: shapes spread over the box, and starts off a bound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel
from morph_dslam.registration.landmarks import shape_starts
from morph_dslam.tracking.estimator import Estimate, State
from morph_dslam.tracking.observability import UNOBSERVABLE_SHARE

#: A start off a bound is this share of the range inside of it.
OFF_BOUND = 0.02


class ShapeSearch:
    """Hands out other starts for an estimate.

    Shapes spread over the parameter box come in turn, in an order that visits the whole box early. Starts off
    a bound are for an estimate that ran into it because of an unobservable parameter. A lever that is turned
    to the left looks as if it were turned by less than nothing, as long as its side is taken to be the right
    one: the estimate ends at the bound, where its side has no effect and so cannot be corrected. From a start
    that is turned a little, with another side, it can.

    Parameters
    ----------
    model : whose shapes are tried
    count : starts of each kind a frame
    """

    def __init__(self, model: ReducedModel, count: int) -> None:
        shapes = np.array(shape_starts(model))
        order = np.random.default_rng(0).permutation(len(shapes) - 1) + 1
        self._model, self._shapes, self._count = model, shapes[np.concatenate([[0], order])], count
        self._next, self._random = 0, np.random.default_rng(0)

    def starts(self, estimate: Estimate, anywhere: bool) -> list[State]:
        """The next starts in the pose of an estimate.

        Parameters
        ----------
        estimate : starts off a bound are for
        anywhere : whether shapes spread over the box are wanted too
        """
        found = self._off_bound(estimate)
        if anywhere:
            rows = (self._next + np.arange(self._count)) % len(self._shapes)
            self._next = int(rows[-1] + 1)
            found += [replace(estimate.state, parameters=self._shapes[row]) for row in rows]
        return found

    def _off_bound(self, estimate: Estimate) -> list[State]:
        """Starts a little inside the box with other values of what is unobservable; none if not needed."""
        model, state = self._model, estimate.state
        free = _unobservable(model, estimate) & ~estimate.at_bound
        if not (estimate.at_bound.any() and free.any()):
            return []
        width = model.upper - model.lower
        inside = np.clip(state.parameters, model.lower + OFF_BOUND * width, model.upper - OFF_BOUND * width)
        drawn = model.lower + self._random.random((self._count, len(width))) * width
        return [replace(state, parameters=np.where(free, row, inside)) for row in drawn]


def with_unobservable_at_default(model: ReducedModel, estimate: Estimate) -> State:
    """The estimated state with unobservable parameters put back to their default.

    Where a parameter has no effect (the shape of a bend that is zero) its estimate is anywhere; starting the
    next frame from there would lead into the wrong valley as soon as it has an effect.
    """
    state = estimate.state
    return replace(state, parameters=np.where(_unobservable(model, estimate), model.default, state.parameters))


def _unobservable(model: ReducedModel, estimate: Estimate) -> NDArray[np.bool_]:
    """Which parameters (d,) the images did not determine."""
    return ~(estimate.parameter_std < UNOBSERVABLE_SHARE * (model.upper - model.lower))
