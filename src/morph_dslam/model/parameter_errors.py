"""What a model's discretisation error amounts to in its parameters.

Elements that are too coarse are too stiff, so that an object seen in a shape needs more load in the model than in
truth. The parameters that bring the model's surface nearest to that of finer elements say how much. A certificate has
this at the states that were solved again; in others it is taken to be as much for each millimetre of displacement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.functions import Functions
from morph_dslam.model.reduced_model import ReducedModel

Array = NDArray[np.float64]
#: The certificate's entries of these errors, within that of the discretisation.
ENTRY, ERRORS, SIZES = "parameters", "errors", "displacement_rms_mm"
#: Combinations of parameters that move the surface by less than this part of what others do are left out.
LEAST_EFFECT = 1e-3


def equivalent_errors(model: ReducedModel, mu: Array, error: Array) -> Array:
    """Parameters' changes (d,), SI, that move the surface most nearly as an error of the displacement does.

    Parameters
    ----------
    model : whose sensitivities are taken.
    mu : (d,) the state, SI.
    error : (n, 3) true displacement minus the model's, at the nodes, metres.
    """
    nodes, ranges = np.unique(model.triangles), np.array([p.upper - p.lower for p in model.parameters])
    _, slopes = model.fields["displacement"].value_and_sensitivities(mu)
    effects = slopes[:, nodes].reshape(len(ranges), -1).T * ranges
    changes = np.linalg.lstsq(effects, error[nodes].ravel(), rcond=LEAST_EFFECT)[0]
    return np.asarray(ranges * changes, dtype=np.float64)


def parameter_errors(model: ReducedModel, states: Sequence[tuple[Array, Array, Array]]) -> dict[str, Any]:
    """The certificate's entry of what the discretisation error amounts to in the parameters, in plain JSON types.

    Parameters
    ----------
    model : of the study.
    states : that were solved again: parameters (d,), and displacements (n, 3) of the nodes by the study's elements and
        by finer ones, SI.

    Returns
    -------
    dict
        "errors", by parameter, of each state, SI; "displacement_rms_mm" of the surface there.
    """
    nodes = np.unique(model.triangles)
    found = np.array([equivalent_errors(model, mu, finer - own) for mu, own, finer in states])
    sizes = [1e3 * _rms(finer[nodes]) for _, _, finer in states]
    return {ERRORS: {p.name: found[:, k].tolist() for k, p in enumerate(model.parameters)}, SIZES: sizes}


def _rms(displacement: Array) -> float:
    """Root mean square length of vectors (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(displacement**2, axis=1))))


@dataclass(frozen=True)
class ParameterErrors:
    """Errors of estimated parameters by a model's discretisation.

    Attributes
    ----------
    per_metre : (k, d) errors at the states solved again, SI, over the root mean square displacement there.
    functions : of the displacement.
    products : (m, m) mean products of its modes on the surface, squared metres.
    """

    per_metre: Array
    functions: Functions
    products: Array

    @classmethod
    def of(cls, model: ReducedModel) -> ParameterErrors | None:
        """Those of a model; None where its certificate states none."""
        stated = model.certificate.get("discretisation", {}).get(ENTRY)
        if stated is None or not model.parameters:
            return None
        sizes, none = 1e-3 * np.array(stated[SIZES]), [0.0] * len(stated[SIZES])
        errors = np.array([stated[ERRORS].get(p.name, none) for p in model.parameters]).T
        moved = sizes > 0.0
        if not moved.any():
            return None
        nodes, field = np.unique(model.triangles), model.fields["displacement"]
        modes = field.modes[:, nodes].reshape(field.n_modes, -1).astype(np.float64)
        return cls(errors[moved] / sizes[moved, None], field.functions, modes @ modes.T / len(nodes))

    def covariance(self, mu: Array) -> Array:
        """Covariance (d, d) of the parameters at a state ``mu`` (d,), SI."""
        row = self.functions.rows(self.functions.nearest_inside(mu))[0]
        size = max(float(row @ self.products @ row), 0.0)
        return np.asarray(size * self.per_metre.T @ self.per_metre / len(self.per_metre))
