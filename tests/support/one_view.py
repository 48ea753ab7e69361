"""The systematic errors of points that were bound in one reference picture."""

from morph_dslam.online.uncertainty.bound_part import BoundPart, causes_of
from morph_dslam.online.uncertainty.systematic_errors import SystematicErrors

WINDOW = 17


def errors_of(estimator, points, reference, covariance):
    """With the covariance of the state there, None where it is not known."""
    part = BoundPart(slice(None), reference, causes_of(covariance, estimator.scale))
    return SystematicErrors(estimator, points, [part], WINDOW)
