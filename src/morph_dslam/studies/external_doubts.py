"""What is doubtful about solutions of another program.

States that the others contradict, parameters without an effect, and empty parts of the box.

Each finding is a sentence for whoever builds the model; right tables have none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.spatial import KDTree

from morph_dslam.even_rows import evenly
from morph_dslam.model.functions import total_degree_indices
from morph_dslam.reduction.regression import design_matrix

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
#: A state is far off if the others miss it by so many times their own error, and by this share of the largest value.
TIMES, SHARE = 20.0, 0.05
#: Beyond the others a smooth field may rise steeply. There only a value so many times theirs is far off, and one that
#: is zero where they predict this share of their largest.
TIMES_BEYOND, SHARE_ZERO = 100.0, 0.4
#: Least error that can be distinguished from rounding, over the largest value.
ROUNDING = 1e-8
#: Part and number of the states that may be wrong at most for the others to tell.
WRONG, MOST_WRONG = 0.1, 10
#: Highest degree of polynomials tried, and the number of their terms over that of states.
HIGHEST, FILLED = 6, 0.6
#: Places in the box are far from all states if twice as far as scattered ones leave them on average. Scattered tables
#: leave 5 % of the box so (two parameters; less with more), the emptiest of 640 left 17 %.
FAR, EMPTY = 2.0, 0.25
_PROBES, _TABLES = 1024, 16
#: Orders in which the values of a parameter are tried: its own does best in one of 20 cases by chance. So many states
#: say enough of that.
_ORDERS, _STATES = 19, 200


@dataclass(frozen=True)
class FarOff:
    """A state that the others contradict.

    Attributes
    ----------
    index : of the state.
    missed : norm of what the others miss, as a share of the largest field of theirs.
    times : the same over the usual error of the others.
    zero : whether the state's field is zero everywhere.
    """

    index: int
    missed: float
    times: float
    zero: bool


@dataclass(frozen=True)
class _Fit:
    """Polynomials of one degree through some of n states.

    Attributes
    ----------
    error : root of the mean square of what each of these states is missed by if it is left out.
    missed : (n,) norm by which each state is missed by polynomials that have not seen it.
    weighed : (n,) the same, less where few other states are near: over the root of what noise of size one leaves.
    usual : root of the mean square of ``weighed`` over these states.
    """

    error: float
    missed: Array
    weighed: Array
    usual: float


def far_off(samples: Array, gram: Array) -> list[FarOff]:
    """States whose field is far from what polynomials through the others give.

    First the states that low polynomials miss most are set aside, a tenth of all and ten at most. Then the polynomials
    that suit the rest best judge these. States beyond the others in the box are judged by `TIMES_BEYOND` only.

    Parameters
    ----------
    samples : (n, d) parameters, from -1 to 1.
    gram : (n, n) scalar products of the fields; those of polynomials' residuals follow from them.
    """
    kept, aside = np.arange(len(samples)), []
    while len(aside) < min(max(1, int(WRONG * len(samples))), MOST_WRONG):
        fits = _fits(samples, gram, kept, 2)
        if not fits:
            return []
        shares = [fit.weighed[kept] / max(float(np.median(fit.weighed[kept])), np.finfo(float).tiny) for fit in fits]
        worst = int(kept[max(shares, key=lambda share: float(share.max())).argmax()])
        aside.append(worst)
        kept = kept[kept != worst]
    fits = _fits(samples, gram, kept, HIGHEST)
    if not fits:
        return []
    fit, sizes = min(fits, key=lambda fit: fit.error), np.sqrt(np.diag(gram))
    largest = float(sizes[kept].max())
    if largest == 0.0:
        return []
    # Polynomials that meet the others exactly leave an error of rounding, whose square is that of the products.
    times = fit.weighed / max(fit.usual, ROUNDING * largest)
    suspects = [index for index in aside if times[index] > TIMES]
    others = np.delete(samples, suspects, axis=0)
    found = []
    for index in suspects:
        missed, zero = float(fit.missed[index]), bool(sizes[index] == 0.0)
        least = SHARE * max(largest, float(sizes[index]))
        if not _is_between(others, samples[index]):
            least = (SHARE_ZERO if zero else TIMES_BEYOND) * largest
        if missed > least:
            found.append(FarOff(index, missed / largest, float(times[index]), zero))
    return found


def _fits(samples: Array, gram: Array, kept: Indices, highest: int) -> list[_Fit]:
    """Polynomials of each degree up to the highest that the states ``kept`` determine."""
    return [fit for fit, _ in _with_terms(samples, gram, kept, highest)]


def _with_terms(samples: Array, gram: Array, kept: Indices, highest: int = HIGHEST) -> list[tuple[_Fit, Indices]]:
    """The same polynomials, each with its terms."""
    found = []
    for degree in range(1, highest + 1):
        indices = total_degree_indices(samples.shape[1], degree)
        fit = _fit(samples, gram, kept, indices)
        if fit is None:
            break
        found.append((fit, indices))
    return found


def _fit(samples: Array, gram: Array, kept: Indices, indices: Indices) -> _Fit | None:
    """Polynomials of these terms through the states ``kept``; None if these do not determine them."""
    if len(indices) > FILLED * len(kept):
        return None
    ones = np.ones(samples.shape[1])
    terms = design_matrix(samples, -ones, ones, indices)[0]
    basis, triangle = np.linalg.qr(terms[kept])
    pivots = np.abs(np.diag(triangle))
    if pivots.min() < 1e-6 * pivots.max():
        return None
    rows = np.linalg.solve(triangle.T, terms.T).T
    residual = np.eye(len(samples))
    residual[:, kept] -= rows @ basis.T
    missed = np.sqrt(np.maximum(np.sum(residual @ gram * residual, axis=1), 0.0))
    spread = np.ones(len(samples)) + np.sum(rows**2, axis=1)
    # Of a state that the fit has seen, the residual grows by 1 / (1 - h) where the state is left out.
    seen = np.maximum(2.0 - spread[kept], 1e-9)
    weighed = missed / np.sqrt(spread)
    weighed[kept] = missed[kept] / np.sqrt(seen)
    missed[kept] /= seen
    error, usual = (float(np.sqrt(np.mean(values[kept] ** 2))) for values in (missed, weighed))
    return _Fit(error, missed, weighed, usual)


def _is_between(others: Array, sample: Array) -> bool:
    """Whether a sample (d,) lies in the convex hull of others (n, d): it is a mean of them with weights above zero."""
    _, missed = nnls(np.vstack([others.T, np.ones(len(others))]), np.append(sample, 1.0))
    return bool(missed < 1e-9)


def without_effect(samples: Array, grams: Sequence[Array]) -> Indices:
    """Parameters (k,) that do not help the best polynomials of the others to predict states that were left out.

    A permutation test: a parameter helps if it does more than the same values in other orders. All fields count alike.

    Parameters
    ----------
    samples : (n, d) parameters, from -1 to 1.
    grams : (n, n) scalar products of the states' fields, of each field.
    """
    d, rows = samples.shape[1], evenly(len(samples), _STATES)
    sizes = [float(np.trace(gram)) for gram in grams]
    gram = np.sum([each / size for each, size in zip(grams, sizes, strict=True) if size > 0.0], axis=0)
    if d == 1 or np.ndim(gram) == 0:
        return np.zeros(0, dtype=np.int64)
    seen, products = samples[rows], gram[np.ix_(rows, rows)]
    return np.array([k for k in range(d) if not _has_effect(seen, products, k)], dtype=np.int64)


def _has_effect(samples: Array, gram: Array, k: int) -> bool:
    """Whether terms of parameter ``k``, alone and times each one, help to predict a field, or nobody can tell."""
    d, every, rng = samples.shape[1], np.arange(len(samples)), np.random.default_rng(0)
    alone = np.eye(d, dtype=np.int64)
    fits = [
        (fit.error, np.vstack([np.insert(of_others, k, 0, axis=1), alone[k], alone + alone[k]]))
        for fit, of_others in _with_terms(np.delete(samples, k, axis=1), gram, every)
    ]
    fits = [fit for fit in fits if len(fit[1]) <= FILLED * len(samples)]
    least, indices = min(fits, key=lambda fit: fit[0], default=(np.inf, None))
    usual = float(np.sqrt(np.mean(np.diag(gram))))
    if indices is None or least > SHARE * usual:
        return True

    def error(order: Indices) -> float:
        columns = samples.copy()
        columns[:, k] = samples[order, k]
        fit = _fit(columns, gram, every, indices)
        return np.inf if fit is None else fit.error

    own = error(every)
    # Columns that are proportional have one effect together: nobody can tell whose it is.
    if not np.isfinite(own):
        return True
    if least <= ROUNDING * usual:
        return False
    return own < min(error(rng.permutation(len(samples))) for _ in range(_ORDERS))


def empty_share(samples: Array) -> float:
    """Share of the box that is far from all samples (n, d), from 0 to 1, in comparison with as many scattered ones."""
    rng = np.random.default_rng(0)
    probes = rng.random((_PROBES, samples.shape[1]))

    def distances(points: Array) -> Array:
        return np.asarray(KDTree(points).query(probes)[0])

    scattered = np.mean([distances(scaled(rng.random(samples.shape))) for _ in range(_TABLES)])
    return float(np.mean(distances(samples) > FAR * scattered))


def scaled(values: Array) -> Array:
    """Columns of values (n, d) that fill the range from 0 to 1."""
    lower = values.min(axis=0)
    return (values - lower) / (values.max(axis=0) - lower)


def doubts(samples: Array, names: Sequence[str], grams: dict[str, Array], places: Sequence[str]) -> list[str]:
    """Sentences on a table: one on each state that is far off, and on each parameter without an effect.

    Parameters
    ----------
    samples : (n, d) parameters, SI.
    names : of the d parameters.
    grams : (n, n) scalar products of the states' fields by name, the most important first.
    places : file and line of each state, for people.
    """
    filling, sentences = scaled(samples), dict[int, str]()
    for name, gram in grams.items():
        for off in far_off(2.0 * filling - 1.0, gram):
            sentences.setdefault(off.index, f"{places[off.index]}: {_far_off(name.removesuffix('_solid'), off)}")
    found = [sentence for _, sentence in sorted(sentences.items())]
    found += [
        f"parameter '{names[k]}' has no effect that the solutions show: those left out are predicted as well without "
        "it; leave its column out, as it costs accuracy, or solve more states if its effect is small beside the others'"
        for k in without_effect(2.0 * filling - 1.0, list(grams.values()))
    ]
    share = empty_share(filling) if samples.shape[1] > 1 else 0.0
    if share > EMPTY:
        found.append(
            f"the solutions leave {100.0 * share:.0f} % of the parameter box empty, as along one history of loads: "
            "there the model is a guess that the certificate's errors say nothing of; add solutions there"
        )
    return found


def _far_off(name: str, off: FarOff) -> str:
    missed = f"{100.0 * off.missed:.2g} % of" if off.missed < 1.0 else f"{_short(off.missed)} times"
    if off.zero:
        return (
            f"the {name} is zero everywhere, where the other solutions predict {missed} the largest: leave the "
            "row out if the solution failed"
        )
    return (
        f"the {name} is off by {missed} the largest from what the other solutions predict, {_short(off.times)} "
        "times their usual error: check its parameters, its units and the order of its nodes"
    )


def _short(number: float) -> str:
    return f"{float(f'{number:.2g}'):g}"
