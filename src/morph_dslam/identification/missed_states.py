"""States whose points the model misses far more than those of others: what acts there is not what it has.

A fit that must take up a wrong load in some states passes for one that fits: the rms over all values hides them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from morph_dslam.evaluation.likeness import root_mean_square
from morph_dslam.identification.found import Misfit
from morph_dslam.identification.measured_points import MeasuredPoints

#: A state is missed where more than this part of its own change is left.
MOST_MISSED = 0.5
#: A state that changed by less than this part of what the most changed one did shows little but its error.
LEAST_CHANGE = 0.1
#: What is left there must be so many times what is left of any other, which has the error of measurement too: of a
#: state that was measured once, and of one that was repeated and is missed each time.
BEYOND_ONCE, BEYOND_REPEATED = 3.0, 1.5
#: Fewer other states tell little of that error, which the fit takes up in part.
FEWEST_OTHERS = 3


def state_figures(misfit: Misfit, points: MeasuredPoints) -> list[dict[str, Any]]:
    """Of each state, in the order of the table, plain JSON: what is known there, how far it moved, and what is missed.

    Parameters
    ----------
    misfit : of the points.
    points : as measured.
    """
    of_value, of_row, changes = np.array(points.value_states), np.array(points.states), misfit.changes
    parameters = {p.name: p for p in points.model.parameters}
    found = []
    for name in dict.fromkeys(points.value_states):
        rows, first = of_value == name, int(np.argmax(of_row == name))
        known = {parameters[k]: float(values[first]) for k, values in points.known.items()}
        found.append(
            {
                "name": name,
                "known": {f"{p.name}_{p.unit}": p.display(value) for p, value in known.items()},
                "values": int(rows.sum()),
                "rms": points.scale * root_mean_square(misfit.missed[rows]),
                "change_rms": points.scale * root_mean_square(changes[rows]),
            }
        )
    return found


def missed_state_notes(each: Mapping[str, Any]) -> list[str]:
    """Notes on the states of one measurement, of its figures, that are missed where others are not."""
    states: Sequence[Mapping[str, Any]] = each.get("states", [])
    missed = [state for state in states if state["rms"] > MOST_MISSED * state["change_rms"]]
    others = [state["rms"] for state in states if state not in missed]
    if len(others) < FEWEST_OTHERS:
        return []
    largest, least = max(others), LEAST_CHANGE * max(state["change_rms"] for state in states)
    said = []
    for alike in _by_known(states):
        beyond = (BEYOND_ONCE if len(alike) == 1 else BEYOND_REPEATED) * largest
        if all(state in missed and state["rms"] > beyond and state["change_rms"] > least for state in alike):
            said.append(_note(each, alike, largest))
    return said


def _by_known(states: Sequence[Mapping[str, Any]]) -> list[list[Mapping[str, Any]]]:
    """States of the same known values together."""
    found: dict[tuple[tuple[str, float], ...], list[Mapping[str, Any]]] = {}
    for state in states:
        found.setdefault(tuple(state["known"].items()), []).append(state)
    return list(found.values())


def _note(each: Mapping[str, Any], missed: Sequence[Mapping[str, Any]], largest: float) -> str:
    """On states of the same known values; ``largest`` is left of others at most."""
    unit, several = each["unit"], len(missed) > 1
    names = ", ".join(state["name"] for state in missed)
    rms, change = (root_mean_square(np.array([state[key] for state in missed])) for key in ("rms", "change_rms"))
    return (
        f"note: {'states' if several else 'state'} {names} of {each['name']} changed by {change:.3g} {unit} rms, and "
        f"{rms:.3g} {unit} of it is missed, of other states {largest:.3g} {unit} at most: what acts there is not what "
        "the model has, and the result is wrong with it; check density and gravity of the study, and the known values "
        "and places of these points"
    )
