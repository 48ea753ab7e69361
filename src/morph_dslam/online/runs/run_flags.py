"""What could be wrong with a run, in words."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from morph_dslam.model import Parameter
from morph_dslam.online.frame_result import (
    DIMENSIONS_OFF,
    HAS_MOVED,
    MAY_BE_ANOTHER,
    REFERENCE_WORSE,
    UNCHECKED,
    UNEXPLAINED,
)
from morph_dslam.online.uncertainty.observability import UNTOLD_SHARE, statement, untold_in_run
from morph_dslam.online.uncertainty.reference_misfit import CLEARLY_WORSE

if TYPE_CHECKING:
    from morph_dslam.online.runs.results import RunResults


def flags(run: RunResults) -> list[str]:
    """What a reader of the results must know."""
    found = []
    lost = Counter(result.status for result in run.results)["lost"]
    if lost:
        found.append(f"{lost} of {len(run)} frames were lost; their reasons are in frames.csv")
    found += _flags_of_place(run)
    failed = sum(UNEXPLAINED in result.reason for result in run.results)
    if failed:
        largest = float(np.nanmax(run.unexplained_px()))
        found.append(
            f"{UNEXPLAINED} in {failed} of {len(run)} frames: up to {largest:.1f} px are left that "
            "neighbouring points have in common; it may be a model of something else, or too stiff, or "
            "a wrong camera file"
        )
    confused = [f for f, r in zip(run.frames, run.results, strict=True) if MAY_BE_ANOTHER in r.reason]
    if confused:
        found.append(f"{MAY_BE_ANOTHER} in {len(confused)} frames, first in frame {confused[0]}")
    worse = max((result.reference_worse for result in run.results), default=1.0)
    if worse > CLEARLY_WORSE:
        found.append(
            f"{REFERENCE_WORSE}: {worse:.1f} times what it was taken to be known to, and the deviations are "
            "that much wider; check the landmarks and whether the object has the model's dimensions"
        )
    off = [result for result in run.results if result.dimensions_off]
    if off:
        found.append(
            f"{DIMENSIONS_OFF} in {len(off)} of {len(run)} frames: {off[-1].dimensions_off}, "
            "longer or shorter than the model; measure it, or see whether it is a model of something else"
        )
    last = next((result for result in reversed(run.results) if result.estimate), None)
    if last is not None and UNCHECKED in last.reason:
        found.append(
            f"{UNCHECKED}: if it is 2 % longer along one axis, it may be as much farther off; let it turn or "
            "bend more, or measure it"
        )
    found += _at_bound(run)
    return found + _untold(run)


def _at_bound(run: RunResults) -> list[str]:
    """Parameters that the images put to an end of their range."""
    found = []
    with np.errstate(invalid="ignore"):
        determined = run.parameter_std() < UNTOLD_SHARE * (run.model.upper - run.model.lower)
    at_bound, values = run.at_bound() & determined, run.parameters()
    for k, parameter in enumerate(run.model.parameters):
        upper = values[:, k] > 0.5 * (parameter.lower + parameter.upper)
        for bound, name, side in ((parameter.lower, "lower", ~upper), (parameter.upper, "upper", upper)):
            count = int((at_bound[:, k] & side).sum())
            if count:
                rests = "rests there, or is" if bound == parameter.default else "may be"
                found.append(
                    f"parameter '{parameter.name}' is at the {name} bound of its range "
                    f"({_shown(parameter, bound)}) in {count} frames: the object {rests} outside what the "
                    "model covers"
                )
    return found


def _shown(parameter: Parameter, value: float) -> str:
    unit = "" if parameter.quantity == "ratio" else f" {parameter.unit}"
    return f"{parameter.display(value):.4g}{unit}"


def _untold(run: RunResults) -> list[str]:
    """What the images do not tell; of what is one per sequence, only after the last frame."""
    parameters, estimates = run.model.parameters, [r.estimate for r in run.results if r.estimate]
    constant = {k for k, p in enumerate(parameters) if p.name in run.per_sequence}
    found = [
        statement(parameters, part, f"in {count} frames")
        for indices, (count, part) in untold_in_run(parameters, estimates).items()
        if not constant.issuperset(indices)
    ]
    for indices, (_, part) in untold_in_run(parameters, estimates[-1:]).items():
        if constant.issuperset(indices):
            found.append(statement(parameters, part, "of the whole sequence"))
    return found


def _flags_of_place(run: RunResults) -> list[str]:
    """What a reader must know of an anchored object."""
    found, hidden = [], int(run.hidden.sum())
    if hidden:
        found.append(
            f"the object was hidden in {hidden} of {len(run)} frames: its pose there is the map's, its "
            "parameters are not known"
        )
    moved = [frame for frame, r in zip(run.frames, run.results, strict=True) if HAS_MOVED in r.reason]
    if moved:
        found.append(
            f"{HAS_MOVED} in {len(moved)} frames, first in frame {moved[0]}: there its points alone tell "
            "its pose; register it again to use the map"
        )
    return found
