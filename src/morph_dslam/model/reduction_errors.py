"""What a model's reduction error amounts to in its parameters.

A certificate has how far the displacement is off in held-out solutions. Where two parameters change the shape nearly
alike, little of it is much of a parameter. As rigid motions are found by the pose, only the rest counts. An error that
lies in the modes of the displacement is kept by its products with them: the derivatives by the parameters lie there
too.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.functions import Functions
from morph_dslam.model.hidden_changes import Hidden, HiddenChanges, anywhere
from morph_dslam.model.parameter_errors import mean_products, rigid_motions, surface_modes
from morph_dslam.model.reduced_model import ReducedModel

Array = NDArray[np.float64]
#: The certificate's entry of the held-out solutions, and there that of the products of errors and modes.
HELD_OUT, ON_MODES = "held_out", "error_on_modes_m2"
#: Variance of a parameter that is somewhere in its range, over the range squared: that of a uniform distribution.
UNKNOWN = 1.0 / 12.0
#: Distance below which a state is a held-out one, over the ranges.
SAME_STATE = 1e-3


def errors_on_modes(model: ReducedModel, errors: Iterable[Array]) -> list[list[float]]:
    """Mean products (k, m), m2, of displacement errors (n, 3) at the nodes, metres, with the modes on the surface."""
    modes, nodes = _deforming_modes(model), np.unique(model.triangles)
    return [(modes @ error[nodes].astype(np.float64).ravel() / len(nodes)).tolist() for error in errors]


def _deforming_modes(model: ReducedModel) -> Array:
    """The displacement's modes (m, 3 s) at the surface's nodes (s,), without rigid motions."""
    nodes, modes = np.unique(model.triangles), surface_modes(model)
    motions = rigid_motions(model.nodes[nodes])
    return np.asarray(modes - (modes @ motions) @ motions.T)


@dataclass(frozen=True)
class ReductionErrors:
    """Errors of estimated parameters by a model's reduction.

    Attributes
    ----------
    states : (k, d) held-out, SI.
    on_modes : (k, m) as of `errors_on_modes`.
    sizes : (k,) of the displacement's errors, metres.
    lower, ranges : (d,) of the parameters, where they begin and how wide they are.
    functions : of the displacement.
    products : (m, m) mean products of its modes on the surface, without rigid motions, squared metres.
    """

    states: Array
    on_modes: Array
    sizes: Array
    lower: Array
    ranges: Array
    functions: Functions
    products: Array

    @classmethod
    def of(cls, model: ReducedModel) -> ReductionErrors | None:
        """Those of a model; None where its certificate does not have them of this displacement."""
        stated = model.certificate.get(HELD_OUT, {})
        on_modes, states = np.array(stated.get(ON_MODES, ())), np.array(stated.get("coordinates", ()))
        # With an angle about an axis of revolution, or unknown loads, a model has other modes than it was built with.
        wanted = (len(states), model.displacement.n_modes), (len(on_modes), len(model.parameters))
        if not len(states) or not len(model.parameters) or (on_modes.shape, states.shape) != wanted:
            return None
        products = mean_products(_deforming_modes(model))
        sizes = 1e-3 * np.array(stated["mean_mm"], dtype=np.float64)
        ranges, functions = model.upper - model.lower, model.displacement.functions
        return cls(states, on_modes, sizes, model.lower, ranges, functions, products)

    def covariance(
        self, mu: Array, constant: NDArray[np.bool_], known: NDArray[np.bool_] | None = None, followed: bool = True
    ) -> Array:
        """Covariance (d, d) of the parameters at a state, SI.

        With D the effects, e the error and r its size, the parameters are off by (D'D + r^2)^-1 D'e. What that leaves
        out is how far they are from where they are taken without evidence, r^2 (D'D + r^2)^-1 of it: one that moves the
        surface by less than the error is anywhere that the error hides, see `hidden_changes`. Errors of nearby held-out
        states count more.

        Parameters
        ----------
        mu : (d,) the state, SI.
        constant : (d,) which parameters are found from many states together. Their errors are those at the held-out
            states, of which each counts by how well it shows the parameter.
        known : (d,) which parameters are known exactly: they make no error good. None without any.
        followed : whether hidden changes are followed beyond where the derivatives hold. Without, the changes still
            move the surface by these derivatives as the errors do.
        """
        effects, known = self._effects(mu), np.zeros(len(mu), dtype=bool) if known is None else known
        constant, free = constant & ~known, np.flatnonzero(~constant & ~known)
        least = self._least(mu)
        inverse = self._inverse(effects[free], least)
        unknown = least * inverse
        hidden = Hidden(effects[free], UNKNOWN * unknown @ unknown.T)
        hidden = self._hidden(mu, free, least) if followed else hidden
        found = np.zeros((len(mu), len(mu)))
        errors = inverse @ hidden.effects @ self.on_modes.T
        found[np.ix_(free, free)] = errors * self._weights(mu) @ errors.T + hidden.spread
        # What a constant is off by, the others make good as far as they can.
        taken = np.eye(len(mu))[:, constant]
        taken[free] = -inverse @ effects[free] @ self.products @ effects[constant].T
        found += taken * self._of_constants(mu, known)[constant] @ taken.T
        return np.asarray(found * np.outer(self.ranges, self.ranges))

    def size_at(self, mu: Array) -> float:
        """Root mean square error of the displacement near a state (d,), metres."""
        return float(np.sqrt(self._weights(mu) @ self.sizes**2))

    def _weights(self, mu: Array) -> Array:
        """How much each held-out state (k,) counts at a state: half of it by its nearness, half as all others.

        A model is often poor in one corner of its box only; but one good state does not make its surroundings good.
        """
        apart = (self.states - mu) / self.ranges
        apart -= np.where(self._periodic, np.rint(apart), 0.0)
        nearness = 1.0 / np.maximum(np.sum(apart**2, axis=1), SAME_STATE**2)
        return np.asarray(0.5 * (nearness / nearness.sum() + 1.0 / len(nearness)))

    def _effects(self, mu: Array) -> Array:
        """Derivatives (d, m) of the displacement's functions by the parameters, over their whole ranges."""
        return self.functions.rows(self.functions.nearest_inside(mu))[1:] * self.ranges[:, None]

    def _hidden(self, mu: Array, sought: NDArray[np.int64], least: float) -> Hidden:
        """What the error, ``least`` as of `_least`, hides of parameters ``sought`` (f,), by number, at a state (d,)."""
        inside = self.functions.nearest_inside(mu)
        begins = np.where(self._periodic, inside - 0.5 * self.ranges, self.lower)[sought]
        ranges, taken = self.ranges[sought], np.append(0, 1 + sought)
        factors = np.append(1.0, ranges)[:, None]

        def rows(place: Array) -> Array:
            there = inside.copy()
            there[sought] = begins + ranges * place
            return np.asarray(self.functions.rows(there)[taken] * factors)

        return HiddenChanges(rows, self.products, self._places(inside)[sought], least).found()

    def _inverse(self, effects: Array, least: float) -> Array:
        """Of the parameters' normal matrix (d, d); one that moves the surface by less than the error is unknown."""
        normal = effects @ self.products @ effects.T
        return np.asarray(np.linalg.inv(normal + least * np.eye(len(normal))), dtype=np.float64)

    def _least(self, mu: Array) -> float:
        """Squared movement of the surface, square metres, below which the error hides a parameter."""
        return max(self.size_at(mu) ** 2, float(np.finfo(float).tiny))

    def _of_constants(self, mu: Array, known: NDArray[np.bool_]) -> Array:
        """Variances (d,) of parameters found from many states, over their ranges squared; 0 of those known (d,).

        What the states hide of a range, they hide wherever in it the parameter is found, at a state (d,).
        """
        key = known.tobytes()
        if key not in self._variances:
            self._variances[key] = self._of_states(np.flatnonzero(~known))
        of_errors, hidden = self._variances[key]
        return of_errors + hidden * anywhere(self._places(mu))

    def _of_states(self, sought: NDArray[np.int64]) -> tuple[Array, Array]:
        """What the held-out states tell together of parameters ``sought`` (f,), by number, over the ranges squared.

        Returns
        -------
        Variances (d,) by their errors, and shares (d,) that are hidden of the variance of a value that is anywhere.
        """
        sums = np.zeros((4, len(sought)))
        for mu, on_modes in zip(self.states, self.on_modes, strict=True):
            least = self._least(mu)
            hidden = self._hidden(mu, sought, least)
            shown = 1.0 / np.diag(self._inverse(hidden.effects, least))
            squares = (self._inverse(self._effects(mu)[sought], least) @ hidden.effects @ on_modes) ** 2
            most = anywhere(self._places(mu)[sought])
            sums += shown * np.array([np.ones(len(sought)), squares, np.diag(hidden.spread), most])
        weights, errors, spread, most = sums
        found = np.zeros((2, len(self.ranges)))
        found[:, sought] = errors / weights, spread / most
        return found[0], found[1]

    def _places(self, mu: Array) -> Array:
        """Where in its range each parameter is at a state (d,), from 0 to 1.

        A periodic one is in the middle: its range, of which the zero is a convention, goes half a turn each way.
        """
        places = np.clip((mu - self.lower) / self.ranges, 0.0, 1.0)
        return np.asarray(np.where(self._periodic, 0.5, places))

    @property
    def _periodic(self) -> NDArray[np.bool_]:
        """Which parameters (d,) are angles that begin again at the end of their range."""
        return np.isinf(self.functions.bounds[0])

    @cached_property
    def _variances(self) -> dict[bytes, tuple[Array, Array]]:
        """What `_of_states` says, by what is known: it is asked for in every frame."""
        return {}
