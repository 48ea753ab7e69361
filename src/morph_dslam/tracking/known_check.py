"""Whether the images refute what is known of parameters: a sensor with another zero, unit or clock.

An estimate holds to what is known, and what that does not fit is left in the residuals, which would put the blame on
model, camera and registration. So the images are asked alone, with all errors that they and the model have.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.model_errors import ModelErrors
from morph_dslam.tracking.frame_estimation import FrameEstimation
from morph_dslam.tracking.hypothesis import PoseHypothesis
from morph_dslam.tracking.outcomes import KnownRefuted
from morph_dslam.tracking.reference_misfit import REFUTED
from morph_dslam.tracking.systematic_errors import SystematicErrors

Array = NDArray[np.float64]


def refuted_values(
    hypothesis: PoseHypothesis,
    estimation: FrameEstimation,
    systematic: SystematicErrors,
    errors: ModelErrors | None,
    doubt_px: float,
    learns: bool,
) -> list[KnownRefuted]:
    """The known parameters that the images of a frame, alone, have elsewhere.

    Parameters
    ----------
    hypothesis : that is accepted, by images and known values.
    estimation : that it was made by.
    systematic : errors of the reference and of the model's shape.
    errors : of the model's mesh and reduction; None where none are known.
    doubt_px : what the points that agree may have in common, pixels.
    learns : whether the residuals are the object's, so that they show how well the reference is known. Those that known
        values leave are not: a wrong sensor would pass for a wrong registration.
    """
    known = estimation.known
    if not len(known.indices):
        return []
    rows, (values, deviations) = known.indices, known.now.T
    with known.set_aside():
        alone = estimation.fitted(hypothesis)
        common_px = max(systematic.unexplained(alone, hypothesis.inliers).px, doubt_px)
        weights, prior = hypothesis.weights, hypothesis.prior
        blurred, depths = hypothesis.blurred, hypothesis.point_depths
        others = depths, estimation.hessian_of_outline(replace(hypothesis, estimate=alone))
        learns = learns and blurred is None
        alone = systematic.added(alone, weights, common_px, prior, learns, None, False, blurred, *others)
    found, variances = alone.state.parameters[rows], deviations**2 + np.diag(alone.covariance)[rows]
    if errors is not None:
        variances = variances + np.diag(errors.at(alone.state.parameters).parameters)[rows]
    sizes = np.abs(found - values) / np.sqrt(variances)
    parameters = [known.model.parameters[k] for k in rows]
    return [
        KnownRefuted(p.name, p.text(float(value)), p.text(float(by_images)), float(size))
        for p, value, by_images, size in zip(parameters, values, found, sizes, strict=True)
        if size > REFUTED
    ]
