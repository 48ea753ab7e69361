"""Changes of parameters that a model cannot tell apart, because the surface moves by less than the model's own error.

A load and a modulus may have the same shapes for all values of one ratio. A reduced model has them nearly so: along
this valley its surface moves a little, as its error changes. Where the error changes fast, the derivatives there seem
to tell both parameters, while all of the valley is within the error. So directions of small derivatives are followed,
and the other parameters make good what they can, until the surface has moved by as much as the error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: Polynomials of degree p that are at most as large as the error change by up to 2 p^2 of it over a range (Markov's
#: inequality). Derivatives that are this many times the error are no error's, and are not followed.
STEEPEST = 50.0
#: The longest first step, as a share of the ranges: no hump is to be stepped over.
FIRST_STEP = 0.125
#: A step of which the ends of the ranges leave less than this share leads no further.
LEAST_WAY = 0.1
#: How often a step is halved that leaves a hidden way, as where it bends or ends.
HALVINGS = 2
#: A parameter with a smaller part in a step does not end it: it stays at the end of its range.
PART = 1e-3


def anywhere(place: Array) -> Array:
    """Second moments (f,) about places in ranges from 0 to 1 of values that are anywhere in these."""
    return np.asarray((place**3 + (1.0 - place) ** 3) / 3.0)


@dataclass(frozen=True)
class Hidden:
    """What a model hides about one state.

    Attributes
    ----------
    effects : (f, m) derivatives of the displacement's functions, over the ranges, each principal direction with what
        is left of it over all the way that is hidden.
    spread : (f, f) covariance of parameters, over the ranges, that are anywhere on these ways, as far as derivatives do
        not tell them.
    """

    effects: Array
    spread: Array


class HiddenChanges:
    """Finds them about one state.

    Parameters
    ----------
    rows : values and derivatives (1 + f, m) of the displacement's functions at parameters (f,), over their ranges.
    products : (m, m) mean products of the modes on the surface, squared metres.
    place : (f,) of the state in the ranges, from 0 to 1.
    least : squared movement of the surface, square metres, below which the error hides a change.
    """

    def __init__(self, rows: Callable[[Array], Array], products: Array, place: Array, least: float) -> None:
        self._rows, self._products, self._place, self._least = rows, products, place, least
        found = rows(place)
        self._here, self._effects = found[0], found[1:]

    def found(self) -> Hidden:
        """What is hidden, by principal directions of the derivatives."""
        count = len(self._place)
        values, vectors = np.linalg.eigh(self._effects @ self._products @ self._effects.T)
        spread, shares = np.zeros((count, count)), np.ones(count)
        for k, value in enumerate(np.maximum(values, 0.0)):
            if value <= STEEPEST**2 * self._least:
                others = np.ascontiguousarray(vectors.T[np.arange(count) != k])
                along, slope = np.ascontiguousarray(vectors[:, k]), float(np.sqrt(value))
                back, forth = self._way(-along, others, slope), self._way(along, others, slope)
                shares[k], part = _judged(*back, *forth, slope, self._least)
                spread += part
        # No parameter is farther off than its range allows, however many directions it takes part in.
        cut = np.sqrt(np.minimum(1.0, anywhere(self._place) / np.maximum(np.diag(spread), np.finfo(float).tiny)))
        return Hidden((vectors * shares) @ vectors.T @ self._effects, spread * np.outer(cut, cut))

    def _way(self, along: Array, others: Array, slope: float) -> tuple[Array, float]:
        """How far (f,) parameters may go, first ``along`` (f,), and how far the surface has moved then, metres.

        Parameters
        ----------
        others : (f - 1, f) directions in which they may turn aside.
        slope : movement of the surface by the derivatives, metres over the ranges.
        """
        place, least = self._place, self._least
        way, moved = _begun(place, along, slope, least)
        step, share, halvings, is_first = along, 1.0, 0, True
        while moved < np.inf and len(tried := _tried(place, way, step, share)):
            rows = self._rows(place + tried)
            turned, moves = _turned(place, tried, self._here, rows, self._products, others, least)
            ahead, moved_ahead, step, goes_on = _gone(way, moved, turned, moves, step, along, least)
            if not goes_on and (is_first or halvings == HALVINGS):
                return ahead, moved_ahead
            is_first = False
            if goes_on:
                way, moved = ahead, moved_ahead
            else:
                share, halvings = 0.5 * share, halvings + 1
        return way, moved


@njit(cache=True, nogil=True)
def _begun(place, along, slope, least):
    """The way (f,) for which derivatives hold, and how far the surface moves on it; infinite where there is none."""
    sure = min(np.sqrt(least) / slope, FIRST_STEP) if slope > 0.0 else FIRST_STEP
    way = _inside(place, min(sure, _room(place, along)) * along)
    length = np.sqrt(way @ way)
    return (way, slope * length) if length > LEAST_WAY * sure else (0.0 * way, np.inf)


@njit(cache=True, nogil=True)
def _tried(place, way, step, share):
    """The way (f,) that is twice as long, as far as the ranges allow, or a share; empty where they allow no more."""
    length, room = np.sqrt(way @ way), _room(place + way, step)
    far = share * min(length, room)
    return _inside(place, way + far * step) if far > LEAST_WAY * length else np.empty(0)


def _turned(place, way, here, rows, products, others, least):
    """A way (f,) turned aside so that the surface moves least, and by how much it does, metres.

    Parameters
    ----------
    place : (f,) where it begins, in the ranges.
    way : (f,) so far.
    here, rows : values (m,) of the functions at the place, and values and derivatives (1 + f, m) at the way's end.
    products, others, least : as in `HiddenChanges`.
    """
    change, slopes = rows[0] - here, rows[1:]
    aside = others @ slopes
    weighted = aside @ products
    normal = weighted @ aside.T + least * np.eye(len(others))
    turned = _inside(place, way - np.linalg.solve(normal, weighted @ change) @ others)
    left = change + (turned - way) @ slopes
    return turned, np.sqrt(max(left @ products @ left, 0.0))


@njit(cache=True, nogil=True)
def _gone(way, moved, turned, moves, step, along, least):
    """The way (f,) so far, how far the surface has moved, the next step's direction (f,) and whether there is one.

    Parameters
    ----------
    way, moved, step : before the last step.
    turned, moves : after it; where the surface moves by more than the error, only a part of the step counts.
    """
    taken, error = turned - way, np.sqrt(least)
    length = np.sqrt(taken @ taken)
    if not taken @ along > 0.0:
        return way, moved, step, False
    if moves > error:
        share = max((error - moved) / (moves - moved), 0.0) if moves > moved else 0.0
        return way + share * taken, max(error, moved), step, False
    return turned, moves, taken / length, True


@njit(cache=True, nogil=True)
def _judged(back, moved_back, forth, moved_forth, slope, least):
    """What is left of a direction's derivative over its ways (f,), and the covariance (f, f) that these leave.

    Where derivatives hold, they tell the rest; where a way does not bear them out, they tell nothing.
    """
    lengths = np.sqrt(back @ back), np.sqrt(forth @ forth)
    share, moments = 1.0, np.zeros((len(back), len(back)))
    for way, moved, length in ((back, moved_back, lengths[0]), (forth, moved_forth, lengths[1])):
        if length > 0.0:
            for a in range(len(way)):
                for b in range(len(way)):
                    moments[a, b] += length / 3.0 * (way[a] * way[b])
            if slope * length > 0.0:
                share = min(share, moved / (slope * length))
    left = (least / (slope**2 + least)) ** 2
    return share, (1.0 - share**2 * (1.0 - left)) / max(lengths[0] + lengths[1], 1e-300) * moments


@njit(cache=True, nogil=True)
def _room(place, step):
    """How far a step (f,) of length one goes on from a place (f,) until a parameter that it is of ends."""
    least = np.inf
    for k in range(len(step)):
        if abs(step[k]) > PART:
            least = min(least, max((1.0 - place[k]) / step[k], -place[k] / step[k]))
    return least


@njit(cache=True, nogil=True)
def _inside(place, way):
    """A way (f,) from a place (f,) in the ranges, no further than to their ends."""
    return np.minimum(np.maximum(place + way, 0.0), 1.0) - place
