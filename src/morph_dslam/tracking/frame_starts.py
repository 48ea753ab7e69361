"""Where a frame's estimate starts, and what frames have to do with each other: parameters that are kept or walk, gaps.

After a long gap the object may be anywhere, and is looked for as after a loss.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import TrackingError
from morph_dslam.model import Parameter, ReducedModel
from morph_dslam.registration.starts import shape_starts
from morph_dslam.tracking.estimator import Estimate, State
from morph_dslam.tracking.noise import Observations, RigObservations
from morph_dslam.tracking.observability import UNOBSERVABLE_SHARE
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.sequence_filter import Fitter, SequenceFilter
from morph_dslam.tracking.state import moved, pose_increment

#: A start off a bound is this share of the range inside of it.
OFF_BOUND = 0.02
#: A gap is longer than this, seconds, and than so many usual intervals: a recording may have one frame a minute.
GAP_S, GAP_INTERVALS = 0.5, 5.0
#: The usual interval is the median of so many.
INTERVALS = 31
Frame = TypeVar("Frame", Observations, RigObservations)


class ShapeSearch:
    """Hands out other starts for an estimate.

    Shapes spread over the parameter box come in turn, in an order that visits the whole box early. Starts off
    a bound are for an estimate that ran into it because of an unobservable parameter. A lever that is turned
    to the left looks as if it were turned by less than nothing, as long as its side is taken to be the right
    one: the estimate ends at the bound, where its side has no effect and so cannot be corrected. From a start
    that is turned a little, with another side, it can. Unknown loads start at zero.

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

    def spread(self, estimate: Estimate, count: int) -> list[State]:
        """The next shapes, so many, spread over the box, in the pose of an estimate; none of a rigid object."""
        if not len(self._model.study_parameters):
            return []
        rows = (self._next + np.arange(count)) % len(self._shapes)
        self._next = (self._next + count) % len(self._shapes)
        return [replace(estimate.state, parameters=self._shapes[row]) for row in rows]

    def off_bound(self, estimate: Estimate) -> list[State]:
        """Starts a little inside the box with other values of what is unobservable; none if not needed."""
        model, state = self._model, estimate.state
        d = len(model.study_parameters)
        free = _unobservable(model, estimate) & ~estimate.at_bound
        if not (estimate.at_bound[:d].any() and free[:d].any()):
            return []
        width = model.upper - model.lower
        inside = np.clip(state.parameters, model.lower + OFF_BOUND * width, model.upper - OFF_BOUND * width)
        drawn = model.lower + self._random.random((self._count, len(width))) * width
        drawn[:, d:] = model.default[d:]
        return [replace(state, parameters=np.where(free, row, inside)) for row in drawn]


def next_start(
    estimate: Estimate, before: State, model: ReducedModel, options: TrackerOptions, angles: Sequence[str]
) -> State:
    """Where the estimate of the frame after one starts.

    Parameters
    ----------
    estimate : of the one.
    before : the state in the frame before it; its own where that is not known, after a loss.
    model : of the object.
    options : of which ``start`` counts.
    angles : parameters, by name, that are the angle about an axis of revolution.
    """
    ahead = estimate
    if options.start == "constant-velocity":
        ahead = replace(estimate, state=at_constant_velocity(before, estimate.state))
    # Last, for neither a turn nor a step to the default is a velocity.
    return a_turn_back(model, with_unobservable_at_default(model, ahead), estimate, angles)


def with_unobservable_at_default(model: ReducedModel, estimate: Estimate) -> State:
    """The estimated state with unobservable parameters put back to their default.

    Where a parameter has no effect (the shape of a bend that is zero) its estimate is anywhere; starting the
    next frame from there would lead into the wrong valley as soon as it has an effect.
    """
    state = estimate.state
    return replace(state, parameters=np.where(_unobservable(model, estimate), model.default, state.parameters))


def a_turn_back(model: ReducedModel, start: State, estimate: Estimate, angles: Sequence[str]) -> State:
    """A start with ``angles`` about an axis of revolution, by name, that ended at a bound the same a turn back.

    Their range is of two turns: from its middle they may go on either way.
    """
    named = np.array([parameter.name in angles for parameter in model.parameters], dtype=bool)
    ended = estimate.at_bound & named
    turns = 2.0 * np.pi * np.sign(start.parameters)
    return replace(start, parameters=np.where(ended, start.parameters - turns, start.parameters))


def _unobservable(model: ReducedModel, estimate: Estimate) -> NDArray[np.bool_]:
    """Which parameters (d,) the images did not determine."""
    return ~(estimate.parameter_std < UNOBSERVABLE_SHARE * (model.upper - model.lower))


def new_filter(estimator: Fitter[Frame], options: TrackerOptions) -> SequenceFilter[Frame]:
    """The filter of what is one over the sequence and of what walks.

    Raises
    ------
    TrackingError
        If the model has not got such a parameter, one is to be both, or a step is not positive.
    """
    names = [parameter.name for parameter in estimator.model.parameters]
    walking = dict(options.random_walk)
    constant = "be a per-sequence parameter"
    for name, what in [(n, constant) for n in options.per_sequence] + [(n, "walk") for n in walking]:
        if name not in names:
            raise TrackingError(f"'{name}' cannot {what}: the model's parameters are " + (", ".join(names) or "none"))
    for name, step in walking.items():
        if name in options.per_sequence:
            raise TrackingError(f"'{name}' is a per-sequence parameter, so it cannot walk: leave out one of both")
        if not 0.0 < step < float("inf"):
            raise TrackingError(f"the step of the random walk of '{name}' must be a positive number")
    kept = [names.index(name) for name in options.per_sequence]
    steps = {names.index(name): step for name, step in walking.items()}
    return SequenceFilter(estimator, kept, steps)


def at_constant_velocity(before: State, last: State) -> State:
    """The state that follows two others if the change goes on.

    The turn goes on by its rotation vector: a product of rotation matrices would double in every frame by how much
    rounding has made them none.
    """
    turned = pose_increment(before.camera_from_object, last.camera_from_object)
    return moved(last, np.concatenate([last.parameters - before.parameters, turned]))


class FrameGaps:
    """Watches the times and numbers of frames."""

    def __init__(self) -> None:
        self._last: float | None = None
        self._number: int | None = None
        self._intervals: deque[float] = deque(maxlen=INTERVALS)

    def after_gap(self, timestamp: float) -> bool:
        """Whether a frame comes a long time after the one before; times that stand still or run back make no gap.

        Parameters
        ----------
        timestamp : of the next frame, seconds.
        """
        last, self._last = self._last, timestamp
        if last is None:
            return False
        interval = timestamp - last
        # The median is hardly ever asked for.
        is_gap = interval > GAP_S and bool(self._intervals) and interval > GAP_INTERVALS * np.median(self._intervals)
        self._intervals.append(interval)
        return bool(is_gap)

    def n_missing(self, number: int | None) -> int:
        """How many frames there were between the last one and the next one, of this number: lost, or dropped live.

        One without a number comes right after the last one.
        """
        if number is None:
            self.pass_over()
            return 0
        before, self._number = self._number, number
        return 0 if before is None else max(int(number) - before - 1, 0)

    def pass_over(self) -> None:
        """Count a frame that did not come, but is known of."""
        if self._number is not None:
            self._number += 1


def temporal_facts(parameters: Sequence[Parameter], options: TrackerOptions) -> dict[str, str]:
    """What the summary of a run says of this."""
    by_name = {parameter.name: parameter for parameter in parameters}
    walks = [f"{name} by {by_name[name].display(step):.4g} {by_name[name].unit}" for name, step in options.random_walk]
    said = []
    if options.per_sequence:
        said.append(f"per-sequence parameters, from all frames so far: {', '.join(options.per_sequence)}")
    if walks:
        said.append(f"random walk, standard deviation of the change from frame to frame: {', '.join(walks)}")
    # With a stated work each frame stands by itself.
    if options.use_unknown_loads and options.estimation.loads.work is None:
        said.append("unknown loads, from the frame before")
    start = "previous state; the first guess of image motion assumes constant velocity"
    if options.start == "constant-velocity":
        start = "the state that the last two lead to at constant velocity"
    return {
        "temporal_prior": "; ".join([*said, "none on the others"]) if said else "none",
        "start_of_each_frame": start,
    }
