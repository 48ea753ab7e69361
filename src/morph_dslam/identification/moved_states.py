"""Whether points that are to be aligned show one rigid motion, or one of each state.

A stand that gives way under the load, or a camera that was moved, moves the points of a state as a body. One motion of
all states leaves that to the parameters, which take it up: a yielding stand passes for a soft body.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.better_fit import chance_of_better_fit
from morph_dslam.identification.found import Misfit
from morph_dslam.identification.measured_points import MeasuredPoints
from morph_dslam.identification.scatter import scaled_directions

Array = NDArray[np.float64]
#: Points that moved as one body fit better by other motions, as much as is said of, with this chance at most.
CHANCE = 1e-4
#: Errors below this share of the largest coordinate are rounding.
ROUNDING = 1e-6


def moved_states(misfit: Misfit, points: MeasuredPoints) -> dict[str, Any] | None:
    """That points show more than one rigid motion, plain JSON; None where they do not, or are not aligned.

    The statistic is F of the further motions, given the error that the points show with them, or that of the model if
    it is larger. It is asked of motions in proportion to known parameters, and of one of each state beyond these. What
    known parameters that are off in each state explain is none of it.

    Parameters
    ----------
    misfit : of the points.
    points : as measured.

    Returns
    -------
    ``rms`` of what is missed with motions that differ from state to state, in the unit of reports, and ``with_load``,
    whether motions in proportion to known parameters are enough.
    """
    names = np.array(points.value_states)
    states = list(dict.fromkeys(points.value_states))
    if not points.aligned or len(states) < 2:
        return None
    loose = points.loose(misfit.predicted)
    in_state = [np.where((names == state)[:, None], 1.0, 0.0) for state in states]
    slopes = points.slopes_by_given(misfit.at)
    null = np.hstack([loose, misfit.slopes, *(slopes * rows for rows in in_state)])
    in_proportion = np.hstack([np.zeros((len(names), 0)), *(loose * given[:, None] for given in points.given_values)])
    of_each = np.hstack([loose * rows for rows in in_state])
    least = max(misfit.model_rms, ROUNDING * float(np.abs(points.values).max()))
    # Each of two questions has half the chance.
    by_each, rms = _chance(misfit.missed, np.hstack([null, in_proportion]), of_each, least)
    if by_each < CHANCE / 2.0:
        return {"rms": points.scale * rms, "with_load": False}
    by_load, rms = _chance(misfit.missed, null, in_proportion, least)
    return {"rms": points.scale * rms, "with_load": True} if by_load < CHANCE / 2.0 else None


def moved_state_notes(each: Mapping[str, Any]) -> list[str]:
    """The note on one measurement, of its figures, whose points show more than one rigid motion."""
    found = each.get("states_moved")
    if found is None:
        return []
    unit, how = each["unit"], "motions that grow with the load" if found["with_load"] else "a motion of each state"
    return [
        f"note: {each['name']} fit better with {how} ({found['rms']:.3g} {unit} rms are missed then, {each['rms']:.3g} "
        f"{unit} with one motion of all): the stand or the camera moved between states, or the body has other shapes "
        "than the model, and the result is wrong with it; if it moved, give each state a file of its own"
    ]


def _chance(missed: Array, null: Array, more: Array, least: float) -> tuple[float, float]:
    """By which independent errors (n,), or such of the ``least`` size, fit so much better by ``more`` columns (n, q).

    With what is missed then, root mean square.
    """
    before, after = (scaled_directions(columns) for columns in (null, np.hstack([null, more])))
    q, freedom = after.shape[1] - before.shape[1], len(missed) - after.shape[1]
    left, least_left = (float(np.sum((missed - b @ (b.T @ missed)) ** 2)) for b in (before, after))
    if q < 1 or freedom < 1:
        return 1.0, 0.0
    return chance_of_better_fit(left, least_left, q, freedom, least), float(np.sqrt(least_left / len(missed)))
