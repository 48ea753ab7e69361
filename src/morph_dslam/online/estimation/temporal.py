"""What frames have to do with each other, by choice: parameters that are kept, that walk, and the start."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

from morph_dslam.errors import TrackingError
from morph_dslam.geometry import RigidTransform
from morph_dslam.model import Parameter
from morph_dslam.online.estimation.estimator import State
from morph_dslam.online.estimation.sequence_filter import Fitter, SequenceFilter
from morph_dslam.online.tracker_options import TrackerOptions
from morph_dslam.online.uncertainty.measurement_noise import Measured, RigMeasured

Frame = TypeVar("Frame", Measured, RigMeasured)


def new_filter(estimator: Fitter[Frame], options: TrackerOptions) -> SequenceFilter[Frame]:
    """The filter of what is one over the sequence and of what walks.

    Raises
    ------
    TrackingError
        If the model has not got such a parameter, one is to be both, or a step is not positive.
    """
    names = [parameter.name for parameter in estimator.model.parameters]
    walking = dict(options.random_walk)
    for name, what in [(n, "be one over the sequence") for n in options.per_sequence] + [
        (n, "walk") for n in walking
    ]:
        if name not in names:
            raise TrackingError(f"'{name}' cannot {what}: the model's parameters are " + ", ".join(names))
    for name, step in walking.items():
        if name in options.per_sequence:
            raise TrackingError(
                f"'{name}' is one over the sequence, so it cannot walk: leave out one of both"
            )
        if not 0.0 < step < float("inf"):
            raise TrackingError(f"the step of the random walk of '{name}' must be a positive number")
    kept = [names.index(name) for name in options.per_sequence]
    steps = {names.index(name): step for name, step in walking.items()}
    return SequenceFilter(estimator, kept, options.filter, steps)


def at_constant_velocity(before: State, last: State) -> State:
    """The state that follows two others if the change goes on."""
    change = last.camera_from_object @ before.camera_from_object.inverse
    pose = change @ last.camera_from_object
    return State(2.0 * last.parameters - before.parameters, RigidTransform(pose.rotation, pose.translation))


def temporal_facts(parameters: Sequence[Parameter], options: TrackerOptions) -> dict[str, str]:
    """What the summary of a run says of this."""
    by_name = {parameter.name: parameter for parameter in parameters}
    walks = [
        f"{name} by {by_name[name].display(step):.4g} {by_name[name].unit}"
        for name, step in options.random_walk
    ]
    said = []
    if options.per_sequence:
        said.append(f"one over the sequence, from all frames so far: {', '.join(options.per_sequence)}")
    if walks:
        said.append(f"random walk, standard deviation of the change from frame to frame: {', '.join(walks)}")
    start = "previous state; the first guess of image motion assumes constant velocity"
    if options.start == "constant-velocity":
        start = "the state that the last two lead to at constant velocity"
    return {
        "temporal_prior": "; ".join([*said, "none on the others"]) if said else "none",
        "start_of_each_frame": start,
    }
