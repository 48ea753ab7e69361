"""At which instants the solutions of a viscoelastic study are taken.

A viscous body answers a load in an instant, and then ever more slowly. Where cubic splines in time take the answer of
a linear body with the same relaxation times, to each amplitude and to what acts from the beginning, they mostly take
that of the nonlinear one. So the instants are chosen before anything is solved: intervals are halved until splines
through the closed forms miss no middle.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from morph_dslam.mechanics.amplitudes import Amplitude
from morph_dslam.mechanics.materials.base import Material
from morph_dslam.reduction.line_functions import interpolate_line

if TYPE_CHECKING:
    from morph_dslam.studies.solid_study import SolidStudy

Array = NDArray[np.float64]
#: Intervals that there are at least.
LEAST = 8
#: An interval is not halved below this part of the range, nor where there are so many instants.
SHORTEST, MOST = 1e-4, 400
#: Where splines are compared within each interval.
WITHIN = (0.25, 0.5, 0.75)


def time_increments(study: SolidStudy) -> Array:
    """Ends of the increments of time (n,), s, from the beginning of the range to its end.

    They are no longer than the study's step, short where a linear body answers fast, and end at corners of amplitudes:
    so any two paths have the same ones, and solutions are smooth in time.
    """
    assert study.time is not None
    instants = time_instants(study)
    corners = [time for amplitude in study.amplitudes().functions.values() for time in amplitude.times]
    inside = [time for time in corners if instants[0] < time < instants[-1]]
    marks = np.unique(np.concatenate([instants, inside]))
    counts = np.ceil(np.diff(marks) / study.time.step - 1e-9).astype(int)
    parts = [np.linspace(*ends, count + 1)[1:] for ends, count in zip(pairwise(marks), counts, strict=True)]
    return np.concatenate([marks[:1], *parts])


def time_instants(study: SolidStudy) -> Array:
    """The instants (n,), s, both ends of the time's range among them, at which a path in time has solutions."""
    assert study.time is not None
    clock = next(p for p in study.model_parameters() if p.name == study.time.parameter)
    begin, end = clock.lower, clock.upper
    answers = _Answers(begin, end, _relaxation_times(study), tuple(study.amplitudes().functions.values()))
    instants = np.linspace(begin, end, LEAST + 1)
    while len(instants) < MOST:
        spline = interpolate_line(instants, answers(instants), None)
        widths = np.diff(instants)
        between = (instants[:-1, None] + widths[:, None] * WITHIN).ravel()
        predicted = np.array([spline.evaluate(np.array([time]))[0] for time in between])
        missed = np.abs(predicted - answers(between)).max(axis=1).reshape(len(widths), -1).max(axis=1)
        halved = (missed > study.reduction.tolerance) & (widths > SHORTEST * (end - begin))
        if not halved.any():
            break
        instants = np.sort(np.concatenate([instants, (instants[:-1] + widths / 2.0)[halved]]))
    return instants


class _Answers:
    """What a linear viscous body answers from ``begin`` to ``end``, s, each over its largest change.

    Of a load that comes at the beginning, of one that grows evenly from there, and of each amplitude.
    """

    def __init__(
        self, begin: float, end: float, relaxation_times: list[float], amplitudes: tuple[Amplitude, ...]
    ) -> None:
        at_once = Amplitude((begin, end), (1.0, 1.0))
        evenly = Amplitude((begin, end), (0.0, 1.0))
        self._begin, self._relaxation_times = begin, relaxation_times
        self._amplitudes = (at_once, evenly, *amplitudes)
        corners = sorted({begin, end, *(t for a in amplitudes for t in a.times if begin < t < end)})
        fine = np.unique(np.concatenate([np.linspace(*ends, 40) for ends in pairwise(corners)]))
        changes = np.ptp(self._values(fine), axis=0)
        # A constant answers with rounding alone.
        self._sizes = np.where(changes > 1e-9 * max(changes.max(), 1e-300), changes, np.inf)

    def __call__(self, times: Array) -> Array:
        """Values (m, k) at times (m,), s."""
        return self._values(times) / self._sizes

    def _values(self, times: Array) -> Array:
        columns = [amplitude(times) for amplitude in self._amplitudes]
        for tau in self._relaxation_times:
            columns += [amplitude.relaxed(times, self._begin, tau) for amplitude in self._amplitudes]
        return np.column_stack(columns)


def _relaxation_times(study: SolidStudy) -> list[float]:
    """Those of all Prony series, s, at the defaults and at both ends of the ranges of the parameters."""
    variables, found = study.variables(), set[float]()
    for mu in (variables.defaults, *(mu for _, mu in variables.range_ends())):
        for section in study.materials.values():
            made = section.make(variables.reader(mu))
            assert isinstance(made, Material)
            found |= {float(tau) for tau in made.prony.times} if made.prony else set()
    return sorted(found)
