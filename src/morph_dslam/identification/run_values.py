"""What a run of a video found for its whole sequence, as known before."""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import IdentificationError
from morph_dslam.evaluation.run_folder import Run
from morph_dslam.identification.identify import AT_THE_END
from morph_dslam.identification.prior import KnownValues
from morph_dslam.io.text import read_text
from morph_dslam.model import Parameter

Array = NDArray[np.float64]


def values_of_run(
    folder: str | Path, run: Run, names: Collection[str], measured: bool
) -> tuple[KnownValues, list[str]]:
    """What a run found of the parameters to identify, and notes on what does not count.

    Parameters
    ----------
    folder : of the run.
    run : read from it.
    names : of the parameters to identify.
    measured : whether points or forces were measured too. Else the values are the run's own.

    Raises
    ------
    IdentificationError
        If the run's `summary.json` cannot be read. If nothing else was measured, and the run found a parameter at an
        end of its range, or frames of it contradict each other in one.
    """
    folder = Path(folder)
    found = _one_over_the_sequence(folder / "summary.json")
    of_model = {parameter.name: parameter for parameter in run.model.parameters}
    apart = [each["name"] for each in found if each["name"] in names and not each.get("is_one_value", True)]
    if apart and not measured:
        raise IdentificationError(
            f"frames of the run contradict each other in {', '.join(apart)}, which is not one value there (see the "
            "run's notes), and nothing else was measured: give points or forces, or track with a model that holds"
        )
    if apart:
        return KnownValues.none(), [
            f"note: what the run found for its whole sequence does not count: frames contradict each other in "
            f"{', '.join(apart)}"
        ]
    taken = [each for each in found if each["name"] in names and each["name"] in of_model and each["observable"]]
    ends = [text for each in found if taken and (text := _at_the_end(of_model.get(each["name"]), each["value"]))]
    if ends and not measured:
        raise IdentificationError(
            f"the run found {' and '.join(ends)}, where its deviations do not hold, and nothing else was measured: "
            "build the model with a wider range, or give points or forces"
        )
    if ends:
        return KnownValues.none(), [
            f"note: what the run found for its whole sequence does not count: {' and '.join(ends)}"
        ]
    scale = np.array([of_model[each["name"]].display(1.0) for each in taken])
    values, std = (np.array([each[key] for each in taken]) / scale for key in ("value", "standard_deviation"))
    kept = tuple(each["name"] for each in taken)
    covariance = _covariance(run, kept)
    if covariance is None:  # k times the variances is never less than a covariance, whatever it is
        covariance = (len(kept) if measured else 1) * np.diag(std**2)
    return KnownValues(kept, values, covariance), []


def _one_over_the_sequence(summary: Path) -> list[dict[str, Any]]:
    """What a summary says of the parameters that are one over the sequence."""
    try:
        content = json.loads(read_text(summary, "summary of the run", IdentificationError))
    except ValueError as error:
        raise IdentificationError(f"{summary} is damaged ({error}): track again") from error
    found = content.get("one_over_the_sequence") if isinstance(content, dict) else None
    if not isinstance(found, list):
        raise IdentificationError(
            f"{summary} does not say what is one over the sequence, as `morph track` writes it: track again"
        )
    return found


def _covariance(run: Run, names: Sequence[str]) -> Array | None:
    """(k, k), SI, of parameters in the last tracked frame; None of a run that has not kept any."""
    if run.covariances is None or not run.tracked.any():
        return None
    every = [parameter.name for parameter in run.model.parameters]
    rows = [every.index(name) for name in names]
    return run.covariances[np.flatnonzero(run.tracked)[-1]][np.ix_(rows, rows)]


def _at_the_end(parameter: Parameter | None, value: float) -> str | None:
    """In words, that a value in the parameter's unit is at an end of its range; None if it is not."""
    if parameter is None:
        return None
    low, high = parameter.display(parameter.lower), parameter.display(parameter.upper)
    below, above = value - low, high - value
    if min(below, above) >= AT_THE_END * (high - low):
        return None
    return (
        f"{parameter.name} at the end of its range, {parameter.text([parameter.lower, parameter.upper][above < below])}"
    )
