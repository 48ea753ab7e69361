"""Profiles: the midline of a wall of revolution, walked by arc length."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import Akima1DInterpolator

from morph_dslam.errors import StudyError

Array = NDArray[np.float64]

#: Points between two given ones at which arc length is summed; the sum's relative error is about 1e-6.
_SAMPLES = 400


class Profile:
    """A smooth curve (r, z) through given points, from the bottom upwards.

    Akima's interpolation (J. ACM 17, 1970) by chord length: a straight stretch of points stays straight, and
    the curve does not overshoot where it meets a fold.

    Parameters
    ----------
    points : (p, 2) radius and height, metres.

    Raises
    ------
    StudyError
        If there are fewer than two points, two in a row coincide, a radius is not positive, or the profile
        runs downwards.
    """

    def __init__(self, points: Sequence[Sequence[float]] | Array):
        try:
            knots = np.array(points, dtype=np.float64)
        except ValueError as error:
            raise StudyError(f"the profile is not a list of points (r, z): {error}") from error
        if knots.ndim != 2 or knots.shape[1] != 2 or len(knots) < 2 or not np.isfinite(knots).all():
            raise StudyError("the profile needs two points (r, z) or more, all of them finite numbers")
        chords = np.linalg.norm(np.diff(knots, axis=0), axis=1)
        if (chords == 0.0).any():
            i = int(np.argmin(chords))
            raise StudyError(
                f"points {i + 1} and {i + 2} of the profile coincide at {knots[i].tolist()}; drop one"
            )
        if knots[:, 0].min() <= 0.0:
            raise StudyError(f"the profile has radius {knots[:, 0].min()} m; keep every radius positive")
        if knots[-1, 1] < knots[0, 1]:
            raise StudyError("the profile runs downwards; list its points from the bottom upwards")
        self._chord = np.concatenate([[0.0], np.cumsum(chords)])
        self._points_at = self._chord
        if len(knots) == 2:  # Akima's slopes need three points
            knots = np.insert(knots, 1, knots.mean(axis=0), axis=0)
            self._chord = np.insert(self._chord, 1, self._chord[-1] / 2.0)
        self._curve = Akima1DInterpolator(self._chord, knots)
        steps = np.linspace(0.0, 1.0, _SAMPLES, endpoint=False)
        fine = (self._chord[:-1, None] + np.diff(self._chord)[:, None] * steps).ravel()
        self._fine = np.append(fine, self._chord[-1])
        pieces = np.linalg.norm(np.diff(self._curve(self._fine), axis=0), axis=1)
        self._arc = np.concatenate([[0.0], np.cumsum(pieces)])

    @property
    def length(self) -> float:
        """Arc length, metres."""
        return float(self._arc[-1])

    def at(self, fractions: Array) -> tuple[Array, Array]:
        """Points (n, 2) and outward unit normals (n, 2) at fractions (n,) of the arc length.

        Outward is to the right of the way upwards: away from the axis where the profile rises.
        """
        chord = np.interp(fractions * self.length, self._arc, self._fine)
        tangents = self._curve(chord, nu=1)
        tangents /= np.linalg.norm(tangents, axis=1)[:, None]
        return self._curve(chord), np.column_stack([tangents[:, 1], -tangents[:, 0]])

    def spread(self, values: float | Sequence[float] | Array, what: str) -> Callable[[Array], Array]:
        """A function of fractions of the arc length: linear between values given at the profile's points.

        Raises
        ------
        StudyError
            If there is neither one value nor one for each point; ``what`` names them.
        """
        given = np.atleast_1d(np.asarray(values, dtype=np.float64))
        if given.shape not in ((1,), (len(self._points_at),)):
            raise StudyError(
                f"{what} has {given.size} values for a profile of {len(self._points_at)} points; "
                "give one, or one for each point"
            )
        places = np.interp(self._points_at, self._fine, self._arc) / self.length
        return lambda fractions: np.interp(fractions, places, np.broadcast_to(given, places.shape))
