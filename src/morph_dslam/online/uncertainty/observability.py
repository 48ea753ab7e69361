"""Which parameters the images tell, and how well: from the covariance without any prior on the parameters.

A parameter, or a combination of several, is not told where the 95 % interval is as wide as its range: then
the start, a bound or a prior decides on its value, not the images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import Parameter
from morph_dslam.online.estimation.estimator import Estimate

Array = NDArray[np.float64]

#: A standard deviation of this share of a parameter's range makes the 95 % interval as wide as the range.
UNTOLD_SHARE = 0.25
#: A parameter takes part in a combination when its share of the direction is larger.
PART = 0.2
#: Half the width of a 95 % interval in standard deviations of a Gaussian.
INTERVAL_95 = 1.96


@dataclass(frozen=True)
class Untold:
    """Parameters that the images do not tell, or not apart.

    Attributes
    ----------
    indices : of the parameters. directions : (k, d) combinations of them that are not told, of length one in
        shares of the ranges.
    """

    indices: tuple[int, ...]
    directions: Array


def untold(covariance: Array, ranges: Array) -> list[Untold]:
    """What a covariance (d, d) of parameters with these ranges (d,) leaves open.

    Parameters that hardly matter, even if all others were known, come one by one; combinations of the rest
    after them, those that share a parameter together.
    """
    d = len(ranges)
    unit = np.eye(d)
    if not np.isfinite(covariance).all():
        return [Untold((k,), unit[k : k + 1]) for k in range(d)]
    values, vectors = np.linalg.eigh(covariance / np.outer(ranges, ranges))
    information = (vectors / np.maximum(values, 1e-300)) @ vectors.T
    no_effect = np.diag(information) <= UNTOLD_SHARE**-2
    found = [Untold((int(k),), unit[k : k + 1]) for k in np.flatnonzero(no_effect)]
    rest = np.flatnonzero(~no_effect)
    if len(rest):
        found += _combinations(information[np.ix_(rest, rest)], unit[rest])
    return found


def _combinations(information: Array, axes: Array) -> list[Untold]:
    """Directions of little information (r, r), in the unknowns with these ``axes`` (r, d)."""
    values, vectors = np.linalg.eigh(information)
    directions = (vectors[:, values <= UNTOLD_SHARE**-2].T) @ axes
    groups: list[tuple[set[int], list[Array]]] = []
    for direction in directions:
        members = set(np.flatnonzero(np.abs(direction) > PART).tolist())
        joined = [group for group in groups if group[0] & members]
        groups = [group for group in groups if not group[0] & members]
        groups.append(
            (members.union(*(g[0] for g in joined)), [direction, *(v for g in joined for v in g[1])])
        )
    return [Untold(tuple(sorted(members)), np.array(rows)) for members, rows in groups]


def covariance_of_parameters(estimate: Estimate) -> Array:
    """(d, d), from the images and what is known of the pose, without a prior on the parameters."""
    d = len(estimate.state.parameters)
    measured = estimate.measured_covariance
    return (estimate.covariance if measured is None else measured)[:d, :d]


def untold_in_run(
    parameters: Sequence[Parameter], estimates: Sequence[Estimate]
) -> dict[tuple[int, ...], tuple[int, Untold]]:
    """What is not told in the frames of a run: by the parameters' indices in how many, and the last of it."""
    ranges = np.array([p.upper - p.lower for p in parameters])
    found: dict[tuple[int, ...], tuple[int, Untold]] = {}
    for estimate in estimates:
        for part in untold(covariance_of_parameters(estimate), ranges):
            found[part.indices] = (found.get(part.indices, (0, part))[0] + 1, part)
    return found


def statement(parameters: Sequence[Parameter], part: Untold, where: str) -> str:
    """A sentence on what is not told ``where``."""
    names = [f"'{parameters[k].name}'" for k in part.indices]
    if len(names) == 1:
        return f"parameter {names[0]} cannot be told from the images {where}"
    text = f"parameters {', '.join(names[:-1])} and {names[-1]} cannot be told apart from the images {where}"
    if len(part.directions) > 1:
        return text
    along = part.directions[0] * np.sign(part.directions[0][part.indices[0]])
    changes = [_change(parameters[k], along[k]) for k in part.indices]
    return f"{text}: they stay the same when {' and '.join(changes)}"


def _change(parameter: Parameter, share: float) -> str:
    size = abs(share) * 0.1 * (parameter.display(parameter.upper) - parameter.display(parameter.lower))
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    return f"'{parameter.name}' is {size:.3g}{unit} {'larger' if share > 0 else 'smaller'}"


def one_value(parameter: Parameter, value: float, deviation: float) -> dict[str, object]:
    """The figures of a parameter that is one over the sequence, in its own unit."""
    low, high = value - INTERVAL_95 * deviation, value + INTERVAL_95 * deviation
    return {
        "name": parameter.name,
        "unit": parameter.unit,
        "value": parameter.display(value),
        "standard_deviation": parameter.display(deviation),
        "interval_95": [parameter.display(low), parameter.display(high)],
        "told_by_the_images": bool(deviation < UNTOLD_SHARE * (parameter.upper - parameter.lower)),
    }


def value_line(figures: dict) -> str:
    """One line for the command line from `one_value`."""
    unit = "" if figures["unit"] == "1" else f" {figures['unit']}"
    low, high = figures["interval_95"]
    text = f"{figures['name']} = {figures['value']:.4g}{unit} over the sequence"
    if not figures["told_by_the_images"]:
        return f"{text}, but the images do not tell"
    return f"{text}, 95 % interval {low:.4g} to {high:.4g}{unit}"
