"""What parameters are identified from: points measured in loaded states (`measured_points`), and forces on supports
(`measured_forces`).

Each measurement predicts its values for given unknowns and says which of them belong together: errors within a state,
or along a stretch of a force curve, are not independent of each other.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from morph_dslam.evaluation.run_folder import Run
from morph_dslam.identification.values import Values
from morph_dslam.model import ReducedModel

Array = NDArray[np.float64]


class Measurement(Protocol):
    """One table of measured values."""

    @property
    def name(self) -> str: ...
    @property
    def model(self) -> ReducedModel: ...
    @property
    def given(self) -> frozenset[str]:
        """Names of the parameters that it gives; those that are not identified either have their defaults."""
        ...

    @property
    def unit(self) -> str:
        """Of errors in reports."""
        ...

    @property
    def scale(self) -> float:
        """From SI to this unit."""
        ...

    @property
    def values(self) -> Array:
        """(n,), SI."""
        ...

    @property
    def groups(self) -> NDArray[np.int64]:
        """(n,) labels of values whose errors may belong together."""
        ...

    def changes(self, predicted: Array) -> Array:
        """By how much the load changed the values (n,), SI.

        Those in another frame need the predictions (n,), without what is not known of the measurement itself.
        """
        ...

    @property
    def mesh_error_stated(self) -> bool:
        """Whether the model states what its mesh adds to the errors of predictions."""
        ...

    def predict(self, unknowns: Values) -> Array:
        """(n,), SI."""
        ...

    def adjusted(self, predicted: Array) -> Array:
        """Predictions (n,) with what is not known of the measurement itself, such as the zero of a load cell."""
        ...

    def loose(self, predicted: Array) -> Array:
        """How what is not known of the measurement itself moves adjusted predictions (n,): columns (n, q) that span it,
        of which the fit takes as many values.
        """
        ...

    def model_errors(self, unknowns: Values) -> Array:
        """Errors (e, n) of predictions by the model itself, SI, independent of each other, of either sign.

        Measurements of one unit share them.
        """
        ...

    @property
    def run(self) -> Run | None:
        """The run that found the states in which it was measured, if one did."""
        ...

    def state_errors(self, unknowns: Values) -> Array:
        """Errors (e, n) of predictions by those of the states that a run found, SI, independent of each other.

        Measurements of one run share them.
        """
        ...
