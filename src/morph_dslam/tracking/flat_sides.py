"""Sides on which a parameter changes nothing, as before a contact: there a deviation by derivatives does not hold.

An estimate may end where the images begin to tell a parameter: at the depth at which a plate touches. Its derivatives
are those of one side, and their covariance takes them for those of both. So each parameter is moved alone, by two of
its standard deviations. Where the shape then changes by much less than these derivatives say, it is moved on, until the
shape changes by as much, or to the end of the range; any value up to there is as likely as another.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel
from morph_dslam.model.model_errors import ModelErrors
from morph_dslam.model.parameter_errors import mean_products, surface_modes

Array = NDArray[np.float64]
#: Standard deviations by which a parameter is moved first.
LOOK = 2.0
#: A smaller share of the squared change that is expected is none.
FLAT_SHARE = 0.25
#: Halvings of the last step, which doubled the way.
HALVINGS = 4


def reach(change: Callable[[float], float], expected: float, room: float) -> float:
    """How far a parameter may go to one side before what it predicts has changed as much as is expected nearby.

    Parameters
    ----------
    change : squared change of the predictions so many standard deviations away.
    expected : the same by the derivatives, `LOOK` standard deviations away.
    room : standard deviations to the end of the range.

    Returns
    -------
    Standard deviations; 0 where the derivatives hold.
    """
    if room <= LOOK or not change(LOOK) < FLAT_SHARE * expected:
        return 0.0
    near = LOOK
    while True:
        far = min(2.0 * near, room)
        if not change(far) < expected:
            break
        if far == room:
            return room
        near = far
    for _ in range(HALVINGS):
        middle = 0.5 * (near + far)
        near, far = (middle, far) if change(middle) < expected else (near, middle)
    return far


def flat_variance(distance: Array | float) -> Array | float:
    """Variance about an estimate of values that are alike from there to a ``distance``: of a uniform distribution."""
    return distance**2 / 3.0


class FlatSides:
    """Finds them in the shapes of a model.

    Parameters
    ----------
    model : of the object.
    errors : of the model, whose mean products of modes are taken where it has them; None where none are known.
    """

    def __init__(self, model: ReducedModel, errors: ModelErrors | None = None) -> None:
        known = None if errors is None or errors.mesh is None else errors.mesh.products
        self._products = mean_products(surface_modes(model)) if known is None else known
        self._functions = model.displacement.functions
        self._lower, self._upper = model.lower, model.upper
        self._sought = range(len(model.parameters) - model.n_loads)

    def variances(self, mu: Array, deviations: Array) -> Array | None:
        """What they add to the variances of parameters; None where the derivatives hold on both sides of all.

        Parameters
        ----------
        mu : (d,) the estimate, SI.
        deviations : (d,) standard deviations, with all errors.

        Returns
        -------
        (d,), SI.
        """
        sides = [
            (k, sign, room / deviations[k])
            for k in self._sought
            if 0.0 < deviations[k] < np.inf
            for sign, room in ((-1.0, mu[k] - self._lower[k]), (1.0, self._upper[k] - mu[k]))
            if room > LOOK * deviations[k]
        ]
        if not sides:
            return None
        here, *slopes = self._functions.rows(mu)
        found = np.zeros(len(mu))
        for k, sign, room in sides:

            def change(away: float, k: int = k, step: float = sign * deviations[k]) -> float:
                there = mu.copy()
                there[k] += away * step
                return self._squared(self._functions.rows(there)[0] - here)

            expected = self._squared(LOOK * deviations[k] * slopes[k])
            found[k] = max(found[k], flat_variance(reach(change, expected, room) * deviations[k]))
        return found if found.any() else None

    def _squared(self, coefficients: Array) -> float:
        """Mean square length over the surface, m2, of the modes with these coefficients (m,)."""
        return float(coefficients @ self._products @ coefficients)
