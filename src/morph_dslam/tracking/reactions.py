"""What supports, and unknown loads, exert on the object in a state, with standard deviations: forces from images.

The reduced model holds force and moment of every support as functions of the parameters. Their deviations follow from
those of the parameters to first order, and beyond it where a parameter is unobservable; a common factor by which all
moduli may be off changes every force alike, and is added. Neither the error of the model nor that of its law is in
them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
_Place = Callable[[Array], Array]


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
    moment : about the point, N m; of unknown loads by the arms that they have in the parametric state.
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
        for name, (place, *fields) in self._parts.items():
            (force, forces), (moment, moments) = (field(mu) for field in fields)
            values, slopes = np.stack([force, moment]), np.stack([forces, moments], axis=1)
            spread = np.full((2, 3, 3), np.inf)
            if known:
                missed = beyond_first_order(partial(_values, fields), slopes, mu, covariance, self._model)
                spread = np.einsum("dpx,de,epy->pxy", slopes, covariance, slopes)
                spread += np.einsum("mpx,mpy->pxy", missed, missed)
            # A common factor of the moduli is one more parameter, by which the derivative is the value itself.
            spread = spread + modulus_std**2 * np.einsum("px,py->pxy", values, values)
            found[name] = Reaction(place(mu), *map(VectorEstimate.of, values, spread))
        return found

    def forces(self, mu: Array) -> dict[str, tuple[Array, Array]]:
        """Point (3,), m, and force (3,), N, of each support at parameters (d,), in the object frame."""
        return {name: (place(mu), force(mu)[0]) for name, (place, force, _) in self._parts.items()}

    @property
    def names(self) -> list[str]:
        """Of the supports."""
        return list(self._parts)


def _values(fields: Sequence[_Field], mu: Array) -> Array:
    """Values (k, 3) of k fields at parameters (d,)."""
    return np.stack([field(mu)[0] for field in fields])


def _fields_of(model: ReducedModel, name: str) -> tuple[_Place, _Field, _Field]:
    """Place of a support, its force, and its moment about the place.

    Unknown loads have moments by the arms of the parametric state. So that about their place takes the place in that
    state, too: how far they have moved it themselves is no arm.
    """
    d = len(model.parameters)

    def nothing(mu: Array) -> tuple[Array, Array]:
        return np.zeros(3), np.zeros((d, 3))

    force, moment = (model.reactions.get(kind + name) for kind in (FORCE, MOMENT))
    assert force is not None
    # A moment that never exceeds rounding is not in the file.
    of_force, about_origin = _of_one_point(force), nothing if moment is None else _of_one_point(moment)
    if name == LOADS and model.energy is not None:
        place, in_parametric_state = _places_of_loads(model, model.energy)
        return place, of_force, _about(in_parametric_state, of_force, about_origin)
    field = _place_of_support(model, model.supports[name]) if name in model.supports else nothing
    return lambda mu: field(mu)[0], of_force, _about(field, of_force, about_origin)


def _about(place: _Field, force: _Field, about_origin: _Field) -> _Field:
    """The moment about a place, by the force and the moment about the origin."""

    def of(mu: Array) -> tuple[Array, Array]:
        (point, arms), (value, slopes), (moment, moments) = place(mu), force(mu), about_origin(mu)
        return moment - np.cross(point, value), moments - np.cross(arms, value) - np.cross(point, slopes)

    return of


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


def _places_of_loads(model: ReducedModel, energy: ElasticEnergy) -> tuple[_Place, _Field]:
    """The mean of the loads' nodes by the square of their traction: deformed, and as the study's parameters have them.

    The slopes of the latter are those with the tractions as they are.
    """
    held, alone = model.supports[LOADS], energy.model
    areas = node_areas(model, held)

    def weights(mu: Array) -> Array:
        # By their squares: small tractions all over the surface would draw the mean to its middle, and where a traction
        # counts from a least size on, the place jumps with each load that passes it.
        found = np.sum(energy.traction.value(mu)[held] ** 2, axis=1) * areas
        return np.asarray(found / max(float(found.sum()), 1e-300))

    def place(mu: Array) -> Array:
        return np.asarray(weights(mu) @ (model.nodes + model.displacement.value(mu))[held])

    def in_parametric_state(mu: Array) -> tuple[Array, Array]:
        shares, own = weights(mu), len(alone.parameters)
        middle = np.tensordot(shares, alone.displacement.modes[:, held], axes=(0, 1))[:, None]
        value, slopes = _of_one_point(alone.displacement.with_modes(middle))(mu[:own])
        return shares @ model.nodes[held] + value, np.concatenate([slopes, np.zeros((len(mu) - own, 3))])

    return place, in_parametric_state
