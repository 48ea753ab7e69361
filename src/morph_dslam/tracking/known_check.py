"""Whether the images refute what is known of parameters: a sensor with another zero, unit or clock.

An estimate holds to what is known, and what that does not fit is left in the residuals, which would put the blame on
model, camera and registration. So the images are asked alone, with all errors that they and the model have. Where
unknown loads may do what a parameter does, images tell little of it: its deviation is that beside any loads.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.model_errors import ModelErrors
from morph_dslam.tracking.beside_texture import BesideTexture
from morph_dslam.tracking.estimator import Estimate
from morph_dslam.tracking.hypothesis import PoseHypothesis
from morph_dslam.tracking.outcomes import KnownRefuted
from morph_dslam.tracking.reference_misfit import REFUTED
from morph_dslam.tracking.systematic_errors import SystematicErrors

Array = NDArray[np.float64]


def refuted_values(
    hypothesis: PoseHypothesis,
    beside: BesideTexture,
    systematic: SystematicErrors,
    errors: ModelErrors | None,
    doubt_px: float,
    learns: bool,
) -> list[KnownRefuted]:
    """The known parameters that the images of a frame, alone, have elsewhere.

    Parameters
    ----------
    hypothesis : that is accepted, by images and known values.
    beside : that it was made by.
    systematic : errors of the reference and of the model's shape.
    errors : of the model's mesh and reduction; None where none are known.
    doubt_px : what the points that agree may have in common, pixels.
    learns : whether the residuals are the object's, so that they show how well the reference is known. Those that known
        values leave are not: a wrong sensor would pass for a wrong registration.
    """
    known = beside.estimator.known
    if not len(known.indices):
        return []
    rows, (values, deviations) = known.indices, known.now.T
    hypothesis = replace(hypothesis, correction=None)  # which was found with the sensors' help
    with known.set_aside():
        alone = beside.estimator.fit(beside.measured(hypothesis), hypothesis.estimate.state, hypothesis.prior)
        common_px = max(systematic.unexplained(alone, hypothesis.inliers).px, doubt_px)

        def stated(estimate: Estimate, learns: bool) -> Array:
            """Variances of the known parameters with all errors."""
            others = hypothesis.point_depths, beside.hessian_of_outline(hypothesis, estimate.state)
            asked = hypothesis.weights, common_px, hypothesis.prior, learns, None, False, hypothesis.blurred
            return np.diag(systematic.added(estimate, *asked, *others).covariance)[rows]

        variances = stated(alone, learns and hypothesis.blurred is None)
        if known.model.n_loads:
            variances = np.maximum(variances, _beside_any_loads(hypothesis, beside, alone, stated))
    found, variances = alone.state.parameters[rows], deviations**2 + variances
    if errors is not None:
        variances = variances + np.diag(errors.at(alone.state.parameters).parameters)[rows]
    sizes = np.abs(found - values) / np.sqrt(variances)
    parameters = [known.model.parameters[k] for k in rows]
    return [
        KnownRefuted(p.name, p.text(float(value)), p.text(float(by_images)), float(size))
        for p, value, by_images, size in zip(parameters, values, found, sizes, strict=True)
        if size > REFUTED
    ]


def _beside_any_loads(
    hypothesis: PoseHypothesis, beside: BesideTexture, alone: Estimate, stated: Callable[[Estimate, bool], Array]
) -> Array:
    """Variances of the known parameters where any unknown loads are as likely as others.

    What loads are likely is learned from the same frames: it makes an estimate, but no case against a sensor. They act
    to second order, and where they are large, images may seem to tell them from a parameter. They must do so where the
    sensor is right, too.

    Parameters
    ----------
    hypothesis, beside : as of `refuted_values`.
    alone : the images' own estimate.
    stated : variances (k,) of an estimate with all errors, and whether to learn from its residuals.
    """
    estimator, measured = beside.estimator, beside.measured(hypothesis)
    assert estimator.loads is not None
    with estimator.loads.set_aside():
        places = (alone, replace(alone, state=hypothesis.estimate.state))
        again = [estimator.restated(measured, place, hypothesis.prior) for place in places]
        return np.max([stated(estimate, False) for estimate in again], axis=0)
