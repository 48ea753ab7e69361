"""How well an estimate tells displacements and stresses: the parameters' covariance through the modes.

A field F(X, mu) has to first order the covariance S C S' at each point, with its sensitivities S = dF/dmu and
the parameters' covariance C. It is what the images leave open; the model's own error comes on top.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.geometry import cross_matrix
from morph_dslam.model import ReducedModel
from morph_dslam.model.reduced_model import von_mises
from morph_dslam.model.separated import SeparatedField
from morph_dslam.online.estimation.estimator import Estimate

Array = NDArray[np.float64]

#: Von Mises stress is sqrt(s' Q s), of three plane or of six components of the stress.
_PLANE = np.array([[1.0, -0.5, 0.0], [-0.5, 1.0, 0.0], [0.0, 0.0, 3.0]])
_SOLID = np.zeros((6, 6))
_SOLID[:3, :3] = 1.5 * np.eye(3) - 0.5
_SOLID[3:, 3:] = 3.0 * np.eye(3)


def displacement_std(model: ReducedModel, estimate: Estimate) -> Array:
    """Standard deviation (n,) of the displacement of every node of ``model``, metres.

    It is the root of the mean square distance, over all directions, in the object frame: the pose's
    uncertainty is not in it.
    """
    _, slopes = model.displacement.value_and_sensitivities(estimate.state.parameters)
    return np.sqrt(_variances(slopes, estimate).sum(axis=1))


def position_std(model: ReducedModel, estimate: Estimate) -> Array:
    """Standard deviation (n,) of the position of every node in the camera frame, metres.

    It is the root of the mean square distance, over all directions, with the pose's uncertainty in it.
    """
    value, slopes = model.displacement.value_and_sensitivities(estimate.state.parameters)
    rotation = estimate.state.camera_from_object.rotation
    turned = (model.nodes + value) @ rotation.T
    d = len(slopes)
    jacobian = np.empty((len(turned), 3, d + 6))
    jacobian[:, :, :d] = np.moveaxis(slopes @ rotation.T, 0, 2)
    jacobian[:, :, d : d + 3] = -cross_matrix(turned)
    jacobian[:, :, d + 3 :] = np.eye(3)
    variances = np.einsum("nij,jk,nik->n", jacobian, estimate.covariance, jacobian, optimize=True)
    return np.sqrt(np.maximum(variances, 0.0))


def von_mises_std(model: ReducedModel, estimate: Estimate, place: str) -> Array:
    """Standard deviation (n,) of the von Mises stress at ``place``, a key of ``model.stresses``, pascals."""
    stress, slopes = model.stresses[place].value_and_sensitivities(estimate.state.parameters)
    form = _PLANE if stress.shape[1] == 3 else _SOLID
    turned = stress @ form
    size = np.sqrt(np.einsum("nc,nc->n", turned, stress))
    along = np.einsum("nc,dnc->dn", turned, slopes) / np.where(size > 0.0, size, 1.0)
    return np.sqrt(_variances(along[:, :, None], estimate)[:, 0])


def largest_displacement(model: ReducedModel, estimate: Estimate) -> tuple[float, float]:
    """The largest length of a node's displacement, metres, and its standard deviation."""
    value = model.displacement.value(estimate.state.parameters)
    length = np.linalg.norm(value, axis=1)
    node = int(length.argmax())
    direction = value[node] / max(float(length[node]), 1e-300)
    return float(length[node]), _deviation(model.displacement, node, direction, estimate)


def largest_von_mises(model: ReducedModel, estimate: Estimate) -> tuple[float, float]:
    """The largest von Mises stress of a node at any place, pascals, and its standard deviation; or NaN."""
    found = (float("nan"), float("nan"))
    for place in model.stresses:
        stress = model.stresses[place].value(estimate.state.parameters)
        sizes = von_mises(stress)
        node = int(sizes.argmax())
        if not sizes[node] <= found[0]:
            form = _PLANE if stress.shape[1] == 3 else _SOLID
            direction = form @ stress[node] / max(float(sizes[node]), 1e-300)
            found = float(sizes[node]), _deviation(model.stresses[place], node, direction, estimate)
    return found


def _deviation(field: SeparatedField, node: int, direction: Array, estimate: Estimate) -> float:
    """Standard deviation of a field's component along a direction (c,), at one of its points."""
    there = field.with_modes(field.modes[:, [node]])
    along = there.value_and_sensitivities(estimate.state.parameters)[1][:, 0] @ direction
    return float(np.sqrt(_variances(along[:, None, None], estimate)[0, 0]))


def _variances(slopes: Array, estimate: Estimate) -> Array:
    """Variances (n, c) of what has the derivatives (d, n, c) by the parameters."""
    d = len(slopes)
    covariance = estimate.covariance[:d, :d]
    return np.maximum(np.einsum("dnc,de,enc->nc", slopes, covariance, slopes, optimize=True), 0.0)
