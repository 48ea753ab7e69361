"""Which parameters are observable, and how well: from the covariance without any prior on the parameters.

A parameter, or a combination of several, is unobservable where the 95 % interval is as wide as its range: then
the start, a bound or a prior decides on its value, not the images. A field F(X, mu) has to first order the
covariance S C S' at each point, with its sensitivities S = dF/dmu and the parameters' covariance C.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.geometry import cross_matrix
from morph_dslam.model import Parameter, ReducedModel
from morph_dslam.model.discrepancy import Discrepancy
from morph_dslam.model.reduced_model import von_mises
from morph_dslam.model.separated import SeparatedField
from morph_dslam.tracking.estimator import BOUND_SHARE, Estimate
from morph_dslam.tracking.state import State

Array = NDArray[np.float64]
#: A standard deviation of this share of a parameter's range makes the 95 % interval as wide as the range.
UNOBSERVABLE_SHARE = 0.25
#: A parameter takes part in a combination when its share of the direction is larger.
PART = 0.2
#: Half the width of a 95 % interval in standard deviations of a Gaussian.
INTERVAL_95 = 1.96


@dataclass(frozen=True)
class Unobservable:
    """Unobservable parameters, or an unobservable combination of several.

    Attributes
    ----------
    indices : of the parameters
    directions : (k, d) unobservable combinations of them, of length one in shares of the ranges.
    """

    indices: tuple[int, ...]
    directions: Array


def unobservable(covariance: Array, ranges: Array) -> list[Unobservable]:
    """What a covariance (d, d) of parameters with these ranges (d,) leaves open.

    Parameters that hardly matter, even if all others were known, come one by one; combinations of the rest
    after them, those that share a parameter together.
    """
    d = len(ranges)
    unit = np.eye(d)
    if not np.isfinite(covariance).all():
        return [Unobservable((k,), unit[k : k + 1]) for k in range(d)]
    values, vectors = np.linalg.eigh(covariance / np.outer(ranges, ranges))
    information = (vectors / np.maximum(values, 1e-300)) @ vectors.T
    no_effect = np.diag(information) <= UNOBSERVABLE_SHARE**-2
    found = [Unobservable((int(k),), unit[k : k + 1]) for k in np.flatnonzero(no_effect)]
    rest = np.flatnonzero(~no_effect)
    if len(rest):
        found += _combinations(information[np.ix_(rest, rest)], unit[rest])
    return found


def _combinations(information: Array, axes: Array) -> list[Unobservable]:
    """Directions of little information (r, r), in the unknowns with these ``axes`` (r, d)."""
    values, vectors = np.linalg.eigh(information)
    directions = (vectors[:, values <= UNOBSERVABLE_SHARE**-2].T) @ axes
    groups: list[tuple[set[int], list[Array]]] = []
    for direction in directions:
        members = set(np.flatnonzero(np.abs(direction) > PART).tolist())
        joined = [group for group in groups if group[0] & members]
        groups = [group for group in groups if not group[0] & members]
        groups.append((members.union(*(g[0] for g in joined)), [direction, *(v for g in joined for v in g[1])]))
    return [Unobservable(tuple(sorted(members)), np.array(rows)) for members, rows in groups]


def covariance_of_parameters(estimate: Estimate) -> Array:
    """(d, d), from the images and what is known of the pose, without a prior on the parameters."""
    d = len(estimate.state.parameters)
    measured = estimate.measured_covariance
    covariance = (estimate.image_covariance if measured is None else measured)[:d, :d]
    return covariance if estimate.flat is None else covariance + np.diag(estimate.flat)


def beyond_first_order(
    value: Callable[[Array], Array], slopes: Array, mu: Array, covariance: Array, model: ReducedModel
) -> Array:
    """What the first derivatives miss of a field along unobservable directions, for one standard deviation.

    Where a deviation is a good part of a range, the field is curved within it: at its turning point the derivatives say
    that nothing changes. Squares of the rows are added to the variances that the derivatives give.

    Parameters
    ----------
    value : the field (...) at parameters (d,).
    slopes : (d, ...) its derivatives at ``mu``.
    mu : (d,) parameters.
    covariance : (d, d) of them, finite.
    model : with the ranges, which no step leaves.

    Returns
    -------
    (m, ...) of each unobservable principal direction the larger of both sides; m is 0 where all is observable.
    """
    low, high = np.minimum(model.lower, mu), np.maximum(model.upper, mu)
    ranges = model.upper - model.lower
    values, vectors = np.linalg.eigh(covariance / np.outer(ranges, ranges))
    found, here = np.zeros((0, *slopes.shape[1:])), None
    for k in np.flatnonzero(values >= UNOBSERVABLE_SHARE**2):
        here = value(mu) if here is None else here
        along = np.sqrt(values[k]) * vectors[:, k] * ranges
        # Shortened as a whole: one parameter cut by itself would leave the direction in which images are the same.
        steps = [_within(mu, sign * along, low, high) for sign in (-1.0, 1.0)]
        missed = [value(mu + step) - here - np.tensordot(step, slopes, axes=1) for step in steps]
        found = np.concatenate([found, max(missed, key=lambda one: float(np.sum(one**2)))[None]])
    return found


def _within(mu: Array, step: Array, low: Array, high: Array) -> Array:
    """The step (d,) from ``mu``, shortened so that it ends in the box."""
    room = np.where(step > 0.0, high - mu, mu - low)
    moves = step != 0.0
    return step * min(1.0, float(np.min(room[moves] / np.abs(step[moves]), initial=1.0)))


def unobservable_in_run(
    parameters: Sequence[Parameter], estimates: Sequence[tuple[Estimate, NDArray[np.bool_]]]
) -> dict[tuple[int, ...], tuple[int, Unobservable]]:
    """What is unobservable in the frames of a run: by the parameters' indices in how many, and the last of it.

    Parameters
    ----------
    parameters : d of them.
    estimates : of the frames, each with the parameters (d,) that are held at an end of their range: they do not count.
    """
    d, ranges = len(parameters), np.array([p.upper - p.lower for p in parameters])
    found: dict[tuple[int, ...], tuple[int, Unobservable]] = {}
    for estimate, held in estimates:
        for part in unobservable(covariance_of_parameters(estimate)[:d, :d], ranges):
            if held[[*part.indices]].any():
                continue
            found[part.indices] = (found.get(part.indices, (0, part))[0] + 1, part)
    return found


def statement(parameters: Sequence[Parameter], part: Unobservable, where: str) -> str:
    """A sentence on what is unobservable ``where``."""
    names = [f"'{parameters[k].name}'" for k in part.indices]
    if len(names) == 1:
        return f"parameter {names[0]} is unobservable {where}"
    text = f"only a combination of parameters {', '.join(names[:-1])} and {names[-1]} is observable {where}"
    if len(part.directions) > 1:
        return text
    along = part.directions[0] * np.sign(part.directions[0][part.indices[0]])
    changes = [_change(parameters[k], along[k]) for k in part.indices]
    return f"{text}: the images stay the same when {' and '.join(changes)}"


def _change(parameter: Parameter, share: float) -> str:
    size = abs(share) * 0.1 * (parameter.display(parameter.upper) - parameter.display(parameter.lower))
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    return f"'{parameter.name}' is {size:.3g}{unit} {'larger' if share > 0 else 'smaller'}"


def with_deviation(parameter: Parameter, value: float, deviation: float) -> str:
    """A value and its standard deviation, SI, in words, in the parameter's own unit."""
    unit = "" if parameter.quantity == "ratio" else f" {parameter.unit}"
    return f"{parameter.display(value):.4g} ± {parameter.display(deviation):.2g}{unit}"


def one_value(parameter: Parameter, value: float, deviation: float, is_one_value: bool = True) -> dict[str, object]:
    """The figures of a parameter that is one over the sequence, in its own unit.

    Parameters
    ----------
    parameter : of the model.
    value, deviation : after the last frame, SI.
    is_one_value : whether no frames contradict each other in it.
    """
    low, high = value - INTERVAL_95 * deviation, value + INTERVAL_95 * deviation
    width = parameter.upper - parameter.lower
    return {
        "name": parameter.name,
        "unit": parameter.unit,
        "value": parameter.display(value),
        "standard_deviation": parameter.display(deviation),
        "interval_95": [parameter.display(low), parameter.display(high)],
        "is_one_value": is_one_value,
        "observable": bool(deviation < UNOBSERVABLE_SHARE * width),
        "at_bound": bool(min(value - parameter.lower, parameter.upper - value) < BOUND_SHARE * width),
    }


def value_line(figures: dict) -> str:
    """One line for the command line from `one_value`."""
    unit = "" if figures["unit"] == "1" else f" {figures['unit']}"
    low, high = figures["interval_95"]
    text = f"{figures['name']} = {figures['value']:.4g}{unit}"
    if not figures["is_one_value"]:
        return f"{text} in the last frames, and something else before"
    text += " over the sequence"
    if not figures["observable"]:
        return f"{text}, but it is unobservable"
    text += f", 95 % interval {low:.4g} to {high:.4g}{unit}"
    return f"{text}; its range ends there, the images do not tell it" if figures["at_bound"] else text


#: Von Mises stress is sqrt(s' Q s), of three plane or of six components of the stress.
_PLANE = np.array([[1.0, -0.5, 0.0], [-0.5, 1.0, 0.0], [0.0, 0.0, 3.0]])
_SOLID = np.diag([1.0, 1.0, 1.0, 3.0, 3.0, 3.0])
_SOLID[:3, :3] = 1.5 * np.eye(3) - 0.5


def displacement_std(model: ReducedModel, estimate: Estimate) -> Array:
    """Standard deviation (n,) of the displacement of every node of ``model``, metres.

    It is the root of the mean square distance, over all directions, in the object frame: the pose's
    uncertainty is not in it.
    """
    _, slopes = model.displacement.value_and_sensitivities(estimate.state.parameters)
    variances = _variances(slopes, estimate.image_covariance).sum(axis=1)
    return np.sqrt(variances + estimate.model_displacement_in_object**2)


def position_std(model: ReducedModel, estimate: Estimate) -> Array:
    """Standard deviation (n,) of the position of every node in the camera frame, metres.

    It is the root of the mean square distance, over all directions, with the pose's uncertainty in it.
    """
    value, slopes = model.displacement.value_and_sensitivities(estimate.state.parameters)
    rotation = estimate.state.camera_from_object.rotation
    turned = (model.nodes + value) @ rotation.T
    d = len(slopes)
    jacobian = np.empty((len(turned), 3, d + 6))
    jacobian[:, :, :d] = np.moveaxis(slopes @ rotation.T, 0, 2)
    jacobian[:, :, d : d + 3] = -cross_matrix(turned)
    jacobian[:, :, d + 3 :] = np.eye(3)
    variances = np.einsum("nij,jk,nik->n", jacobian, estimate.image_covariance, jacobian, optimize=True)
    return np.sqrt(np.maximum(variances, 0.0) + estimate.model_displacement**2)


def von_mises_std(model: ReducedModel, estimate: Estimate, place: str) -> Array:
    """Standard deviation (n,) of the von Mises stress at ``place``, a key of ``model.stresses``, pascals."""
    stress, slopes = model.stresses[place].value_and_sensitivities(estimate.state.parameters)
    form = _PLANE if stress.shape[1] == 3 else _SOLID
    turned = stress @ form
    size = np.sqrt(np.einsum("nc,nc->n", turned, stress))
    along = np.einsum("nc,dnc->dn", turned, slopes) / np.where(size > 0.0, size, 1.0)
    return np.sqrt(_variances(along[:, :, None], estimate.covariance)[:, 0])


def largest_displacement(
    model: ReducedModel, estimate: Estimate, discrepancy: Discrepancy | None = None
) -> tuple[float, float]:
    """The largest length of a node's displacement, metres, and its standard deviation.

    Parameters
    ----------
    model : of the object.
    estimate : of its state.
    discrepancy : what the displacement has beyond the model's; None where it was not estimated.
    """
    value = model.displacement.value(estimate.state.parameters)
    if discrepancy is not None:
        value = value + discrepancy.displacement(model.nodes)
    length = np.linalg.norm(value, axis=1)
    node = int(length.argmax())
    direction = value[node] / max(float(length[node]), 1e-300)
    deviation = _deviation(model.displacement, node, direction, estimate.state, estimate.image_covariance)
    # In one direction of three.
    variance = deviation**2 + estimate.model_displacement_in_object**2 / 3.0
    if discrepancy is not None:
        variance += float(direction @ discrepancy.covariances(model.nodes[[node]])[0] @ direction)
    return float(length[node]), float(np.sqrt(variance))


def largest_von_mises(model: ReducedModel, estimate: Estimate) -> tuple[float, float]:
    """The largest von Mises stress of a node at any place, pascals, and its standard deviation; or NaN."""
    found = (float("nan"), float("nan"))
    for place in model.stresses:
        stress = model.stresses[place].value(estimate.state.parameters)
        sizes = von_mises(stress)
        node = int(sizes.argmax())
        if not sizes[node] <= found[0]:
            form = _PLANE if stress.shape[1] == 3 else _SOLID
            direction = form @ stress[node] / max(float(sizes[node]), 1e-300)
            deviation = _deviation(model.stresses[place], node, direction, estimate.state, estimate.covariance)
            found = float(sizes[node]), deviation
    return found


def _deviation(field: SeparatedField, node: int, direction: Array, state: State, covariance: Array) -> float:
    """Standard deviation of a field's component along a direction (c,), at one of its points."""
    there = field.with_modes(field.modes[:, [node]])
    along = there.value_and_sensitivities(state.parameters)[1][:, 0] @ direction
    return float(np.sqrt(_variances(along[:, None, None], covariance)[0, 0]))


def _variances(slopes: Array, covariance: Array) -> Array:
    """Variances (n, c) of what has the derivatives (d, n, c) by the parameters, of a covariance (d + 6, d + 6)."""
    d = len(slopes)
    return np.maximum(np.einsum("dnc,de,enc->nc", slopes, covariance[:d, :d], slopes, optimize=True), 0.0)
