"""Frames of a run that contradict each other in what is to be one value over the sequence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from morph_dslam.tracking.outcomes import PastForgotten
from morph_dslam.tracking.run_results import RunResults
from morph_dslam.tracking.sequence_filter import PATIENCE

#: So many standard deviations of both together, with all that these contain, are a contradiction. The filter begins
#: anew by what is new in each frame alone; errors of the model that change with the state may be the whole difference.
APART = 3.0


@dataclass(frozen=True)
class Contradiction:
    """Two values of one parameter.

    Attributes
    ----------
    parameter : its number in the model.
    before, after : value and standard deviation, SI, in the frame ``last`` and in the frame ``first``.
    last : number of the last frame that agreed with those before.
    first : number of the one from which on the others count.
    """

    parameter: int
    before: tuple[float, float]
    after: tuple[float, float]
    last: int
    first: int

    @property
    def deviations(self) -> float:
        """How many standard deviations of both together lie between the values."""
        return abs(self.after[0] - self.before[0]) / max(float(np.hypot(self.before[1], self.after[1])), 1e-300)


def contradictions(run: RunResults) -> list[Contradiction]:
    """Of each per-sequence parameter in which frames contradict each other, where they do so most."""
    tracked = np.flatnonzero(run.tracked)
    values, deviations = run.parameters(), run.parameter_std()
    found: dict[int, Contradiction] = {}
    for place, row in enumerate(tracked):
        if place < PATIENCE or not any(isinstance(one, PastForgotten) for one in run.results[row].warnings):
            continue
        agreed = tracked[place - PATIENCE]
        for k, parameter in enumerate(run.model.study_parameters):
            pairs = [(float(values[i, k]), float(deviations[i, k])) for i in (agreed, row)]
            one = Contradiction(k, pairs[0], pairs[1], run.frames[agreed], run.frames[row])
            if parameter.name in run.per_sequence and one.deviations > max(
                APART, found[k].deviations if k in found else 0.0
            ):
                found[k] = one
    return [found[k] for k in sorted(found)]
