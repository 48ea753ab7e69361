"""What the page draws: a model's visible surface, moved and coloured for given parameters."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from morph_dslam.model import ReducedModel
from morph_dslam.model.reduced_model import von_mises

Array = NDArray[np.float64]

#: Colours end at this percentile of the field over the surface and the box: stress has narrow peaks.
_PERCENTILE = 99.5
#: States of the box, besides its middle, that the range of colours is taken from (a power of two).
_SAMPLES = 64
#: Labels of the stresses, in the order in which they are offered.
_PLACES = {"solid": "von Mises stress", "top": "von Mises stress, top", "bottom": "von Mises stress, bottom"}


def _round_up(top: float) -> float:
    """The next number whose fifths are short."""
    power = 10.0 ** np.floor(np.log10(max(top, 1e-9)))
    return float(
        next(step * power for step in (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.5, 10.0) if step * power >= top)
    )


@dataclass(frozen=True)
class ColourField:
    """A scalar that the surface can be coloured by; ``top`` is the end of its colours, in ``unit``."""

    key: str
    label: str
    unit: str
    top: float


class ModelSurface:
    """The visible surface of a reduced model, evaluated for one state after the other.

    Attributes
    ----------
    nodes : (n, 3) surface nodes at rest, metres. triangles : (m, 3) in these nodes.
    """

    def __init__(self, model: ReducedModel) -> None:
        self._model = model
        used, corners = np.unique(model.triangles, return_inverse=True)
        self.nodes, self.triangles = model.nodes[used], corners.reshape(-1, 3)
        one = np.ones((len(used), 1))
        self._displacement = model.displacement.restrict(used[:, None], one)
        self._stresses = {
            place: field.restrict(used[:, None], one) for place, field in model.stresses.items()
        }

    def values(self, mu: Array, key: str) -> Array:
        """The field ``key`` (n,) for parameters ``mu`` (d,) in the unit of its colours: mm or MPa.

        Raises
        ------
        KeyError
            If the model has no such field.
        """
        if key == "displacement":
            return 1e3 * np.linalg.norm(self._displacement.value(mu), axis=1)
        return 1e-6 * von_mises(self._stresses[key].value(mu))

    def state(self, mu: Array, key: str) -> bytes:
        """Little-endian floats: displacements (n, 3) in metres, then the values (n,) of field ``key``."""
        parts = (self._displacement.value(mu), self.values(mu, key))
        return b"".join(np.ascontiguousarray(part, dtype="<f4").tobytes() for part in parts)

    def shape(self) -> bytes:
        """Little endian: nodes (n, 3) in single precision, then triangles (m, 3) as 32-bit integers."""
        return self.nodes.astype("<f4").tobytes() + self.triangles.astype("<u4").tobytes()

    @cached_property
    def fields(self) -> tuple[ColourField, ...]:
        """The fields to choose from, with one range of colours for the whole box."""
        model = self._model
        sobol = qmc.Sobol(len(model.parameters), scramble=False).random(_SAMPLES)
        samples = [model.default, *(model.lower + sobol * (model.upper - model.lower))]
        names = {"displacement": "displacement"}
        names |= {place: label for place, label in _PLACES.items() if place in self._stresses}
        result = []
        for key, label in names.items():
            top = float(np.percentile([self.values(mu, key) for mu in samples], _PERCENTILE))
            result.append(ColourField(key, label, "mm" if key == "displacement" else "MPa", _round_up(top)))
        return tuple(result)

    def description(self) -> dict[str, Any]:
        """Everything else that the page needs, as plain JSON; parameters in their own units."""
        parameters = [
            {
                "name": p.name,
                "description": p.description,
                "unit": "" if p.unit == "1" else p.unit,
                "lower": p.display(p.lower),
                "upper": p.display(p.upper),
                "default": p.display(p.default),
            }
            for p in self._model.parameters
        ]
        colours = matplotlib.colormaps["turbo"](np.arange(256), bytes=True)
        return {
            "name": self._model.name,
            "nodes": len(self.nodes),
            "triangles": len(self.triangles),
            "parameters": parameters,
            "fields": [asdict(field) for field in self.fields],
            "colours": np.asarray(colours).tolist(),
        }
