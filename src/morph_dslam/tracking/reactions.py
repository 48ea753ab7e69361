"""What supports, and unknown loads, exert on the object in a state, with standard deviations: forces from images.

The reduced model holds force and moment of every support as functions of the parameters. Their deviations follow from
those of the parameters to first order, and beyond it where a parameter is unobservable; a common factor by which all
moduli may be off changes every force alike, and is added. Neither the error of the model nor that of its law is in
them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel, SeparatedField
from morph_dslam.model.reduced_model import FORCE, MOMENT
from morph_dslam.model.unknown_loads import LOADS, ElasticEnergy, node_areas
from morph_dslam.tracking.estimator import Estimate
from morph_dslam.tracking.observability import beyond_first_order

Array = NDArray[np.float64]
#: Values (3,) of a field at parameters, and their derivatives (d, 3).
_Field = Callable[[Array], tuple[Array, Array]]


@dataclass(frozen=True)
class VectorEstimate:
    """A vector with standard deviations.

    Attributes
    ----------
    value : (3,) in the object frame.
    std : (3,) of its components.
    size_std : of its length.
    """

    value: Array
    std: Array
    size_std: float

    @classmethod
    def of(cls, value: Array, covariance: Array) -> VectorEstimate:
        """A vector (3,) whose components have a covariance (3, 3); deviations are infinite where that is not finite.

        The deviation of the length is that along the vector; without any length, the largest in any direction.
        """
        if not np.isfinite(covariance).all():
            return cls(value, np.full(3, np.inf), np.inf)
        size = float(np.linalg.norm(value))
        along = value / size if size else np.linalg.eigh(covariance)[1][:, -1]
        variances = np.maximum([*np.diag(covariance), along @ covariance @ along], 0.0)
        return cls(value, np.sqrt(variances[:3]), float(np.sqrt(variances[3])))

    @property
    def size(self) -> float:
        """Its length."""
        return float(np.linalg.norm(self.value))


@dataclass(frozen=True)
class Reaction:
    """What one support, or all unknown loads together, exert on the object.

    Attributes
    ----------
    point : (3,) mean of the deformed nodes that the support holds, object frame, m; the origin for a model file that
        does not name them; of unknown loads the mean of the deformed nodes by the square of their traction.
    force : N.
    moment : about the point, N m.
    """

    point: Array
    force: VectorEstimate
    moment: VectorEstimate


class Reactions:
    """The reactions of a model's supports."""

    def __init__(self, model: ReducedModel) -> None:
        names = [name.removeprefix(FORCE) for name in model.reactions if name.startswith(FORCE)]
        self._parts = {name: _fields_of(model, name) for name in names}
        self._model = model

    def __call__(self, estimate: Estimate, modulus_std: float = 0.0) -> dict[str, Reaction]:
        """The reaction of each support, by the name of its set.

        Parameters
        ----------
        estimate : of a frame.
        modulus_std : standard deviation of a factor common to all moduli.
        """
        mu = estimate.state.parameters
        covariance = estimate.covariance[: len(mu), : len(mu)]
        known = np.isfinite(covariance).all()

        found = {}
        for name, fields in self._parts.items():
            (point, arms), (force, forces), (about_origin, moments) = (field(mu) for field in fields)
            moment_slopes = moments - np.cross(arms, force) - np.cross(point, forces)
            values = np.stack([force, about_origin - np.cross(point, force)])
            slopes = np.stack([forces, moment_slopes], axis=1)
            spread = np.full((2, 3, 3), np.inf)
            if known:
                of_name = partial(_force_and_moment, fields)
                missed = beyond_first_order(of_name, slopes, mu, covariance, self._model)
                spread = np.einsum("dpx,de,epy->pxy", slopes, covariance, slopes)
                spread += np.einsum("mpx,mpy->pxy", missed, missed)
            # A common factor of the moduli is one more parameter, by which the derivative is the value itself.
            spread = spread + modulus_std**2 * np.einsum("px,py->pxy", values, values)
            found[name] = Reaction(point, *map(VectorEstimate.of, values, spread))
        return found

    def forces(self, mu: Array) -> dict[str, tuple[Array, Array]]:
        """Point (3,), m, and force (3,), N, of each support at parameters (d,), in the object frame."""
        return {name: (place(mu)[0], force(mu)[0]) for name, (place, force, _) in self._parts.items()}

    @property
    def names(self) -> list[str]:
        """Of the supports."""
        return list(self._parts)


def _force_and_moment(fields: tuple[_Field, _Field, _Field], mu: Array) -> Array:
    """Force of a support and moment about its point (2, 3) at parameters (d,)."""
    point, force, about_origin = (field(mu)[0] for field in fields)
    return np.stack([force, about_origin - np.cross(point, force)])


def _fields_of(model: ReducedModel, name: str) -> tuple[_Field, _Field, _Field]:
    """Place of a support, its force and its moment about the origin."""
    d = len(model.parameters)

    def nothing(mu: Array) -> tuple[Array, Array]:
        return np.zeros(3), np.zeros((d, 3))

    place: _Field = nothing
    if name == LOADS and model.energy is not None:
        place = _place_of_loads(model, model.energy)
    elif name in model.supports:
        place = _place_of_support(model, model.supports[name])
    # A moment that never exceeds rounding is not in the file.
    moment = model.reactions.get(MOMENT + name)
    return place, _of_one_point(model.reactions[FORCE + name]), nothing if moment is None else _of_one_point(moment)


def _of_one_point(field: SeparatedField) -> _Field:
    """The values (3,) and slopes (d, 3) of a field of one point."""

    def of(mu: Array) -> tuple[Array, Array]:
        value, slopes = field.value_and_sensitivities(mu)
        return value[0], slopes[:, 0]

    return of


def _place_of_support(model: ReducedModel, held: NDArray[np.int64]) -> _Field:
    """The mean of the deformed nodes that are held."""
    rest = model.nodes[held].mean(axis=0)
    middle = model.displacement.modes[:, held].mean(axis=1, keepdims=True, dtype=np.float64)
    moved = _of_one_point(model.displacement.with_modes(middle))

    def place(mu: Array) -> tuple[Array, Array]:
        value, slopes = moved(mu)
        return rest + value, slopes

    return place


def _place_of_loads(model: ReducedModel, energy: ElasticEnergy) -> _Field:
    """The mean of the deformed nodes by the square of the unknown loads' traction."""
    held, alone = model.supports[LOADS], energy.model
    areas = node_areas(model, held)

    def place(mu: Array) -> tuple[Array, Array]:
        # By their squares: small tractions all over the surface would draw the mean to its middle, and where a traction
        # counts from a least size on, the place jumps with each load that passes it.
        weights = np.sum(energy.traction.value(mu)[held] ** 2, axis=1) * areas
        weights /= max(float(weights.sum()), 1e-300)
        positions = (model.nodes + model.displacement.value(mu))[held]
        # As the surface is moved by the study's parameters; loads have their moments to first order.
        slopes, own = np.zeros((len(mu), 3)), len(alone.parameters)
        middle = np.tensordot(weights, alone.displacement.modes[:, held], axes=(0, 1))[:, None]
        slopes[:own] = _of_one_point(alone.displacement.with_modes(middle))(mu[:own])[1]
        return weights @ positions, slopes

    return place
