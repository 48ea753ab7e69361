"""Values of what is identified, as measurements take them: a factor of all moduli divides loads of given size."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import Parameter, ReducedModel

Array = NDArray[np.float64]
#: Name of the common factor of all moduli among the unknowns.
FACTOR = "moduli_factor"


class Values:
    """Values of the unknowns, as measurements take them.

    Parameters
    ----------
    model : whose parameters they are.
    unknowns : all of them, and their values ``theta`` (k,), SI.
    scaled : names of the parameters that a factor of all moduli divides.

    Attributes
    ----------
    factor : the common one of all moduli.
    beyond : values, SI, of parameters that such a division has taken out of their ranges, by name.
    """

    def __init__(
        self, model: ReducedModel, unknowns: Sequence[Parameter], theta: Array, scaled: Collection[str] = ()
    ) -> None:
        self._model, self._scaled = model, scaled
        self._own = {p.name: float(value) for p, value in zip(unknowns, theta, strict=True)}
        self._divided = frozenset(scaled if FACTOR in self._own else ())
        self.factor = self._own.pop(FACTOR, 1.0)
        self.beyond: dict[str, list[float]] = {}

    def vector(self, known: Mapping[str, float], shown: bool = False) -> Array:
        """The model's parameters (d,), SI, where these are known; what is ``shown`` is so but for what is identified.

        Loads that are ``known`` are divided by the factor of the moduli (`given_loads`), but for those that were
        ``shown`` by pictures: with them the model, whose moduli they do not have, has the shape that was seen.
        """
        # A table is right about what it gives; a run saw shapes, of which what is identified is a part.
        mu = self._model.vector({**known, **self._own} if shown else {**self._own, **known})
        for k, parameter in enumerate(self._model.parameters):
            name = parameter.name
            if name in self._scaled and not (shown and name in known and name not in self._own):
                mu[k] /= self.factor
                if not parameter.in_range(mu[k]):
                    self.beyond.setdefault(name, []).append(float(mu[k]))
        return mu

    def free(self, given: Collection[str]) -> frozenset[str]:
        """Names of the model's parameters that they change where these are given."""
        return frozenset(self._own).difference(given) | self._divided

    def shown(self, names: Sequence[str]) -> Array:
        """Those unknowns (m,) as pictures show them, in which loads are those of the model."""
        return np.array([self._own[name] / (self.factor if name in self._scaled else 1.0) for name in names])
