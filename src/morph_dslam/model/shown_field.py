"""The field that colours an object in pictures, streams and exports: stress, strain, displacement, or tractions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import ParameterError
from morph_dslam.model.reduced_model import MaterialPoints, ReducedModel, equivalent_strain, von_mises
from morph_dslam.model.separated import SeparatedField
from morph_dslam.model.stated_errors import stated_stresses

Array = NDArray[np.float64]
Shown = Literal["stress", "strain", "displacement", "traction"]
#: Colours end at this percentile of the field: stress has narrow peaks.
PERCENTILE = 99.5
#: States of the parameter box from which the range of colours is taken (a power of two).
SAMPLES = 32


@dataclass(frozen=True)
class ShownKind:
    """How a field is called.

    Attributes
    ----------
    name : for people.
    unit : in which people read it.
    si_unit : "%" is a ratio, "1".
    si_factor : a value in SI is that in ``unit`` times this.
    """

    name: str
    unit: str
    si_unit: str
    si_factor: float


STRESS = "von Mises stress"
SHOWN: dict[Shown, ShownKind] = {
    "stress": ShownKind(STRESS, "MPa", "Pa", 1e6),
    "strain": ShownKind("equivalent strain", "%", "1", 1e-2),
    "displacement": ShownKind("displacement", "mm", "m", 1e-3),
    "traction": ShownKind("traction of unknown loads", "kPa", "Pa", 1e3),
}
#: Stress of soft bodies, from the smallest largest one, MPa, upwards.
_SMALL_STRESSES = {1e-4: ShownKind(STRESS, "Pa", "Pa", 1.0), 0.1: ShownKind(STRESS, "kPa", "Pa", 1e3)}


def shown_kind(model: ReducedModel, show: Shown) -> ShownKind:
    """How a field of a model is called: stress that stays small, by the model's certificate, in kPa or Pa."""
    largest = max((entry.get("largest_MPa") or 0.0 for entry in stated_stresses(model)), default=0.0)
    if show == "stress" and largest > 0.0:
        return next((kind for below, kind in _SMALL_STRESSES.items() if largest < below), SHOWN[show])
    return SHOWN[show]


class ShownField:
    """A field at points of a model, and their displacement, in single precision: as exact as the model file.

    Both are kept for the last parameters asked for, so that all who show a frame evaluate them once.

    Parameters
    ----------
    model : that holds the field.
    points : where.
    show : the field.

    Attributes
    ----------
    kind : how it is called, and its unit.
    """

    def __init__(self, model: ReducedModel, points: MaterialPoints, show: Shown) -> None:
        self._model, self._points, self._show = model, points, show
        self.kind = shown_kind(model, show)
        self._displacement = self._restricted("displacement")
        self._fields = {name: self._restricted(name) for name in _fields_of(model, show)}
        self._last: dict[str, tuple[Array, Array]] = {}

    def _restricted(self, name: str) -> SeparatedField:
        return self._model.restrict(self._points, name, np.float32)

    @property
    def has_sides(self) -> bool:
        """Whether the field has a value on either face of a sheet."""
        return "stress_top" in self._fields

    def displacement(self, parameters: Array) -> Array:
        """(n, 3), metres."""
        return self._kept("displacement", parameters, self._displacement.value)

    def values(self, parameters: Array, displacement: Array, side: Literal["top", "bottom"] | None = None) -> Array:
        """The field (n,) in the unit of `kind`; NaN for a rigid object.

        Parameters
        ----------
        parameters : (d,), SI.
        displacement : (n, 3) of the points, metres.
        side : of a sheet; by default the larger stress of both.
        """
        if not self._model.parameters:
            return np.full(len(displacement), np.nan)
        if self._show == "displacement":
            return np.linalg.norm(displacement, axis=1) / self.kind.si_factor
        names = list(self._fields) if side is None else [f"stress_{side}"]
        return np.max([self._kept(name, parameters, partial(self._size, name)) for name in names], axis=0)

    def _size(self, name: str, parameters: Array) -> Array:
        """What is shown (n,) of a field."""
        field = self._fields[name].value(parameters)
        if self._show == "strain":
            size = equivalent_strain(field)
        else:
            size = np.linalg.norm(field, axis=1) if self._show == "traction" else von_mises(field)
        return size / self.kind.si_factor

    def _kept(self, name: str, parameters: Array, evaluate: Callable[[Array], Array]) -> Array:
        """What was evaluated for the same parameters last, whichever thread did it, or now."""
        kept = self._last.get(name)
        if kept is None or not np.array_equal(kept[0], parameters):
            kept = self._last[name] = np.array(parameters), evaluate(parameters)
        return kept[1]

    def range_of(self, fields: Sequence[Array]) -> tuple[float, float]:
        """One range of colours for values (n,) of several states; from 0 to 1 for a rigid object."""
        if not self._model.parameters:
            return 0.0, 1.0
        return 0.0, max(float(np.percentile(np.stack(fields), PERCENTILE)), 1e-6)

    def range_of_box(self) -> tuple[float, float]:
        """One range of colours for all states of the parameter box, known before any is seen."""
        model = self._model
        shapes = model.spread_parameters(SAMPLES)
        if self._show == "traction" and model.energy is not None:
            shapes[:, -model.n_loads :] = np.sqrt(model.energy.work)
        return self.range_of([self.values(mu, self.displacement(mu)) for mu in shapes])


def surface_points(model: ReducedModel) -> tuple[MaterialPoints, NDArray[np.int64]]:
    """The nodes of a model's surface, each as its first corner, and the triangles (m, 3) in them."""
    used, corners = np.unique(model.triangles, return_inverse=True)
    pairs, weights = np.column_stack([used, used]), np.tile([1.0, 0.0], (len(used), 1))
    return MaterialPoints(pairs, weights), corners.reshape(-1, 3)


def shown_field(model: ReducedModel, show: Shown | None) -> Shown:
    """What colours an object, by default the stress of a model that has it; raises ParameterError if it has it not."""
    has = {
        "stress": bool(model.stresses),
        "strain": model.strain is not None,
        "displacement": True,
        "traction": model.energy is not None,
    }
    if show is None:
        return "stress" if has["stress"] else "displacement"
    if not has.get(show, False):
        held = ", ".join(name for name, is_held in has.items() if is_held)
        raise ParameterError(f"the model '{model.name}' holds no {show} to show (--show); it has: {held}")
    return show


def _fields_of(model: ReducedModel, show: Shown) -> list[str]:
    """Names of the fields that are shown, as in `ReducedModel.fields`."""
    if show == "stress":
        return [f"stress_{place}" for place in model.stresses]
    return [show] if show in ("strain", "traction") else []
