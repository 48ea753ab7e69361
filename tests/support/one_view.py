"""The systematic errors of points that were bound in one reference picture."""

from morph_dslam.tracking.covariance import BoundPart
from morph_dslam.tracking.systematic_errors import SystematicErrors, error_factors_of

WINDOW = 17


def errors_of(estimator, points, reference, covariance):
    """With the covariance of the state there, None where it is not known."""
    part = BoundPart(slice(None), reference, error_factors_of(covariance, estimator.scale))
    return SystematicErrors(estimator, points, [part], WINDOW)
