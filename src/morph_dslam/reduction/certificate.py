"""The certificate: what a reduced model gets wrong on held-out solutions, and how stable the solutions are.

Every figure is measured on held-out solves, which the reduction never uses (docs/certificate.md). Nodes count
alike, as in the paper's "Cartesian mean error"; a value's size is the Euclidean norm of a vector and the Frobenius
norm of a tensor, neither of which depends on the axes.

An equilibrium is stable under its prescribed supports where the tangent on the free degrees of freedom is positive
definite; Sylvester's law of inertia counts its negative eigenvalues from the factorisation, and `stability` those of a
tangent that is not symmetric. Where the count differs
between two neighbours of the sweep, a critical point lies between them: a limit point, or a bifurcation.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.evaluation.model_summary import describe_point
from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.reduced_model import von_mises
from morph_dslam.model.reduction_errors import HELD_OUT, ON_MODES, errors_on_modes
from morph_dslam.studies.problem import Snapshot

Array = NDArray[np.float64]
UNSTABLE_START = (
    "the solution at the defaults, from which all others are followed, is unstable: the body would leave it, and may "
    "be in none of these states. Choose defaults at which loads are small and supports have not moved"
)


def stability_report(
    parameters: Sequence[Parameter], samples: Array, pivots: dict[int, int | None], parents: Sequence[int]
) -> dict[str, Any]:
    """What a certificate says of stability, in plain JSON types.

    Parameters
    ----------
    samples : (n, d), SI.
    pivots : of each solved sample, the negative pivots of its tangent; None if they are not known.
    parents : of every sample, the neighbour that the sweep tree joins it to, or -1.

    Returns
    -------
    dict
        "statement"; numbers of solutions "stable", "unstable", "unknown"; "unstable_samples", coordinates and
        negative pivots of each; "unstable_start", whether what all others are followed from is unstable; "passed", the
        neighbours between which the count changes.
    """
    counts = {index: count for index, count in sorted(pivots.items()) if count is not None}
    unstable = [index for index, count in counts.items() if count > 0]
    passed = [(parents[index], index) for index, count in counts.items() if counts.get(parents[index], count) != count]
    starts = [counts[index] for index, parent in enumerate(parents) if parent < 0 and index in counts]
    return {
        "statement": _statement(len(pivots), len(counts), len(unstable), len(passed)),
        "unstable_start": bool(starts) and min(starts) > 0,
        "stable": len(counts) - len(unstable),
        "unstable": len(unstable),
        "unknown": len(pivots) - len(counts),
        "unstable_samples": [
            {"coordinates": samples[index].tolist(), "negative_pivots": counts[index]} for index in unstable
        ],
        "passed": [
            {
                "between": [describe_point(parameters, samples[index]) for index in pair],
                "coordinates": [samples[index].tolist() for index in pair],
                "negative_pivots": [counts[index] for index in pair],
            }
            for pair in passed
        ],
    }


def stability_warnings(certificate: dict[str, Any]) -> list[str]:
    """Lines for whoever builds a model, on solutions that are known to be unstable, and on what was passed.

    That the solver cannot tell, as of viscous bodies, the certificate says.
    """
    report = certificate.get("stability")
    if report is None or not report["unstable"] + len(report["passed"]):
        return []
    lines = [UNSTABLE_START, report["statement"]] if report.get("unstable_start") else [report["statement"]]
    for place in report["passed"][:3]:
        before, after = place["negative_pivots"]
        lines.append(f"negative pivots change from {before} to {after} between {' and '.join(place['between'])}")
    return lines


def _statement(solved: int, known: int, unstable: int, passed: int) -> str:
    if not known:
        return "the solver cannot tell whether the solutions are stable"
    told = f"; of {solved - known} it is not known" if known < solved else ""
    if not unstable:
        return f"{known} solutions are stable{told}" if told else f"all {known} solutions are stable"
    places = f"in {passed} places" if passed > 1 else "in one place"
    branches = f"; bifurcations may have been passed {places}" if passed else ""
    return f"{unstable} of {solved} solutions are unstable{branches}{told}"


CONFIDENCE = 0.95
#: Squared components in a value's squared norm; of a symmetric tensor the shears stand for two components.
_NORM_WEIGHTS = {1: [1.0], 3: [1.0, 1.0, 1.0], 6: [1.0, 1.0, 1.0, 2.0, 2.0, 2.0]}
_PLANE_TENSOR = [1.0, 1.0, 2.0]
#: True values whose root mean square is below this part of that in the solution where it is largest are rounding of the
#: solver, as stress after a body was released: errors relative to them say nothing.
ROUNDING = 1e-5
_STRESS = "stress_"
#: Unit in which a field's errors are stated, as the ending of its keys, and what it is in SI.
_UNITS = {
    "displacement": ("_mm", 1e-3),
    _STRESS: ("_MPa", 1e6),
    "strain": ("", 1.0),
    "reaction_force_": ("_N", 1.0),
    "reaction_moment_": ("_Nmm", 1e-3),
}


def covered_share(count: int, confidence: float = CONFIDENCE) -> float:
    """Share of the box in which errors stay below the largest of ``count`` held-out ones, at ``confidence``.

    A share p of independent uniform samples lies where the error is below its p-quantile; the largest of n
    errors falls short of that quantile with probability p^n (the first order statistic of Wilks, 1941), so
    that p = (1 - confidence)^(1/n): 59 solves bound 95 % of the box, 299 bound 99 %.
    """
    return (1.0 - confidence) ** (1.0 / count)


def confidence_statement(count: int) -> str:
    """What the largest of ``count`` held-out errors says of the whole box; the share is rounded down."""
    share = math.floor(1000.0 * covered_share(count)) / 10.0
    return (
        f"with {100.0 * CONFIDENCE:.0f} % confidence at least {share:.1f} % of the parameter box "
        f"errs no more than the largest of these {count}"
    )


class _ErrorTally:
    """Errors of one quantity, gathered sample by sample.

    Parameters
    ----------
    weights : (c,) of the squared components in the squared norm of a value.
    typical : root mean square of such values in the solution of the study where it is largest, SI; 0 if unknown.
    """

    def __init__(self, weights: Array, typical: float = 0.0) -> None:
        self._weights, self._typical = weights, typical
        self._missed, self._norm, self._largest, self._count = 0.0, 0.0, 0.0, 0
        self._means: list[float] = []
        self._maxima: list[float] = []

    def add(self, predicted: Array, truth: Array) -> None:
        """One sample's values (n, c)."""
        truth = truth.astype(np.float64)
        missed = (predicted - truth) ** 2 @ self._weights
        size = truth**2 @ self._weights
        self._missed += float(missed.sum())
        self._norm += float(size.sum())
        self._count += len(size)
        self._largest = max(self._largest, float(np.sqrt(size.max())))
        self._means.append(float(np.sqrt(missed).mean()))
        self._maxima.append(float(np.sqrt(missed.max())))

    @property
    def sample_means(self) -> Array:
        """Mean error over the nodes of each sample, SI."""
        return np.array(self._means)

    @property
    def sample_maxima(self) -> Array:
        """Largest error of any node of each sample, SI."""
        return np.array(self._maxima)

    def relative(self) -> dict[str, float | None]:
        """The two relative measures; None where all true values are zero but for rounding."""
        if math.sqrt(self._norm) <= ROUNDING * self._typical * math.sqrt(self._count):
            return {"relative_l2": None, "mean_relative_to_largest": None}
        mean = float(self.sample_means.mean())
        return {"relative_l2": math.sqrt(self._missed / self._norm), "mean_relative_to_largest": mean / self._largest}

    def figures(self, ending: str, unit: float) -> dict[str, Any]:
        """All measures; keys of absolute ones end in ``ending``, and ``unit`` is its size in SI."""
        absolute = {
            "mean": self.sample_means.mean(),
            "max": self.sample_maxima.max(),
            "worst_sample_mean": self.sample_means.max(),
            "largest": self._largest,
        }
        return {f"{name}{ending}": float(value) / unit for name, value in absolute.items()} | self.relative()


def typical_sizes(model: ReducedModel, states: Iterable[Array]) -> dict[str, float]:
    """Of each field, the root mean square over the nodes in the state where it is largest, SI.

    Parameters
    ----------
    model : which has the fields.
    states : parameters (d,) of solutions, SI, as of those that it was made from.
    """
    states, sizes = list(states), {}
    for name, field in model.fields.items():
        weights = _norm_weights(name, field.modes.shape[2])
        products = np.einsum("inc,jnc,c->ij", field.modes, field.modes, weights, optimize=True) / field.modes.shape[1]
        values = np.array([field.functions.evaluate(state)[0] for state in states]).reshape(-1, field.n_modes)
        squares = np.einsum("si,ij,sj->s", values, products, values, optimize=True)
        sizes[name] = math.sqrt(max(float(squares.max(initial=0.0)), 0.0))
    return sizes


def certify(
    model: ReducedModel, held_out: list[Snapshot], scattered: bool = True, sizes: Mapping[str, float] | None = None
) -> dict[str, Any]:
    """Errors of every field of a model over held-out solves, in plain JSON types.

    Parameters
    ----------
    model : whose errors they are.
    held_out : solves that it was not made from.
    scattered : whether their parameters are uniform in the box, as the statement on the whole box needs.
    sizes : of each field over all solutions, for what is rounding in the held-out ones (`typical_sizes`).

    Returns
    -------
    dict
        For each field its name with "mean", "max" (of any node of any solve), "worst_sample_mean" and
        "largest" (true value), keys ending in the unit; "relative_l2"; "mean_relative_to_largest". A stress
        has the same under "von_mises". The displacement has besides "mean_mm_by_modes", with the first 1, 2,
        ... modes only; "worst_sample", coordinates (SI) where its mean error is largest; "n_held_out";
        "confidence", where they are scattered. "sensitivity" holds the two relative measures of the
        displacement's derivative by each parameter, and is absent where the solver gave none. "held_out" holds
        coordinates (SI), mean and largest displacement error of each solve, and this error's products with the
        modes (`errors_on_modes`).
    """
    certificate: dict[str, Any] = {}
    sizes = sizes or {}
    for name, field in model.fields.items():
        if name == "displacement":
            certificate |= _displacement_errors(model, held_out, scattered, sizes.get(name, 0.0))
        else:
            certificate[name] = field_errors(name, _pairs(field, name, held_out), sizes.get(name, 0.0))
    if all("displacement" in snapshot.sensitivities for snapshot in held_out):
        certificate["sensitivity"] = _sensitivity_errors(model, held_out)
    return certificate


def errors_by_modes(field: SeparatedField, name: str, held_out: list[Snapshot]) -> Array:
    """Mean error over nodes and solves (m,) of a field cut to its first 1, 2, ..., m modes, SI."""
    weights = _norm_weights(name, field.modes.shape[2])
    totals = np.zeros(field.n_modes)
    for snapshot in held_out:
        values, _ = field.functions.evaluate(snapshot.coordinates)
        missed = -snapshot.fields[name].astype(np.float64)
        for mode in range(field.n_modes):
            missed += values[mode] * field.modes[mode]
            totals[mode] += np.sqrt(missed**2 @ weights).mean()
    return totals / len(held_out)


def compression_percent(model: ReducedModel, n_snapshots: int) -> float:
    """The paper's compression factor of the displacement, C = (1 - M_P / M_O) 100.

    M_P is the memory of the separated field, modes and functions, and M_O that of the ``n_snapshots``
    solutions it stands for, each number taken in the same precision.
    """
    field = model.displacement
    original = n_snapshots * field.modes.shape[1] * field.modes.shape[2]
    return 100.0 * (1.0 - field.n_floats / original)


def _norm_weights(name: str, n_components: int) -> Array:
    plane = name.startswith(_STRESS) and n_components == 3
    return np.array(_PLANE_TENSOR if plane else _NORM_WEIGHTS[n_components])


def _unit(name: str) -> tuple[str, float]:
    return next(unit for start, unit in _UNITS.items() if name.startswith(start))


def _tally(field: SeparatedField, name: str, held_out: list[Snapshot], typical: float) -> _ErrorTally:
    tally = _ErrorTally(_norm_weights(name, field.modes.shape[2]), typical)
    for predicted, truth in _pairs(field, name, held_out):
        tally.add(predicted, truth)
    return tally


def _pairs(field: SeparatedField, name: str, held_out: list[Snapshot]) -> Iterator[tuple[Array, Array]]:
    """What the model says of a field and what is true, solve by solve."""
    return ((field.value(snapshot.coordinates), snapshot.fields[name]) for snapshot in held_out)


def field_errors(name: str, pairs: Iterable[tuple[Array, Array]], typical: float = 0.0) -> dict[str, Any]:
    """Errors of one field as `certify` states them.

    Parameters
    ----------
    name : of the field.
    pairs : values (n, c), SI: those to judge, and the truth.
    typical : root mean square of the field in the solution where it is largest (`typical_sizes`); 0 if unknown.
    """
    tallies: dict[str, _ErrorTally] = {}
    for predicted, truth in pairs:
        kinds = {name: (predicted, truth, _norm_weights(name, truth.shape[1]))}
        if name.startswith(_STRESS):
            ours, true = (von_mises(values.astype(np.float64))[:, None] for values in (predicted, truth))
            kinds["von_mises"] = (ours, true, np.ones(1))
        for kind, (ours, true, weights) in kinds.items():
            tallies.setdefault(kind, _ErrorTally(weights, typical)).add(ours, true)
    figures = {kind: tally.figures(*_unit(name)) for kind, tally in tallies.items()}
    return figures.pop(name) | figures


def _displacement_errors(
    model: ReducedModel, held_out: list[Snapshot], scattered: bool, typical: float
) -> dict[str, Any]:
    """The entries "displacement" and "held_out"."""
    field, name = model.displacement, "displacement"
    tally = _tally(field, name, held_out, typical)
    coordinates = [snapshot.coordinates.tolist() for snapshot in held_out]
    figures = tally.figures(*_unit(name)) | {
        "mean_mm_by_modes": (1e3 * errors_by_modes(field, name, held_out)).tolist(),
        "worst_sample": coordinates[int(tally.sample_means.argmax())],
        "n_held_out": len(held_out),
    }
    if scattered:
        figures["confidence"] = confidence_statement(len(held_out))
    samples = {
        "coordinates": coordinates,
        "mean_mm": (1e3 * tally.sample_means).tolist(),
        "max_mm": (1e3 * tally.sample_maxima).tolist(),
        ON_MODES: errors_on_modes(model, (truth - found for found, truth in _pairs(field, name, held_out))),
    }
    return {name: figures, HELD_OUT: samples}


def _sensitivity_errors(model: ReducedModel, held_out: list[Snapshot]) -> dict[str, Any]:
    """Relative errors of the displacement's derivative by each parameter."""
    tallies = {parameter.name: _ErrorTally(np.ones(3)) for parameter in model.parameters}
    for snapshot in held_out:
        _, slopes = model.displacement.value_and_sensitivities(snapshot.coordinates)
        truth = snapshot.sensitivities["displacement"]
        for tally, predicted, true in zip(tallies.values(), slopes, truth, strict=True):
            tally.add(predicted, true)
    return {name: tally.relative() for name, tally in tallies.items()}
