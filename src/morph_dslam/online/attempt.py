"""What a frame is made into, what an attempt to find the object in it gave, and whether to believe it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.discrepancy import Discrepancy
from morph_dslam.online.estimation.depth_residuals import PointDepths
from morph_dslam.online.estimation.estimator import Estimate, Prior
from morph_dslam.online.measuring.measurement import Measurement
from morph_dslam.online.measuring.outline import OutlineMeasurement
from morph_dslam.online.tracker_options import TrackerOptions

#: Where less than this share of all points agree, they must agree closely.
MOST_AGREE = 0.5

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Picture:
    """A frame made ready.

    Attributes
    ----------
    grey : the undistorted image (h, w). flat : flattened.
    depth : (h, w) of a depth camera, as recorded, metres, NaN where unknown; None without one.
    in_front : (h, w) depth of other objects, metres, infinite where there are none; None if none is known.
    """

    grey: NDArray[np.uint8]
    flat: NDArray[np.uint8]
    depth: NDArray[np.float32] | None = None
    in_front: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Attempt:
    """An estimate, which measurements support it (p,), and all the measurements.

    Attributes
    ----------
    weights : (p,) that the measurements counted with, zero for those that do not support it.
    prior : what was known of the pose from the map when it was made; None if nothing was.
    depths : of the points that support it, where a depth camera saw them.
    discrepancy : what the shape has beyond the model's, once it was looked for.
    """

    estimate: Estimate
    inliers: NDArray[np.bool_]
    measurement: Measurement
    weights: Array
    prior: Prior | None = None
    outline: OutlineMeasurement | None = None
    depths: PointDepths | None = None
    discrepancy: Discrepancy | None = None


def refusal(attempt: Attempt, options: TrackerOptions) -> str:
    """Why an attempt is not to be believed; empty when it is.

    What covers an object may look like it by chance in places, but these do not agree closely. With a pose
    from the map the parameters alone are left to be found, which few points can tell. They must agree closely
    then, and be most of those that were found: what looks alike by chance does neither.
    """
    measurement, count = attempt.measurement, int(attempt.inliers.sum())
    needed = min(options.least_inliers, int(np.ceil(options.least_share * len(attempt.inliers))))
    visible, spread = int(measurement.visible.sum()), attempt.estimate.sigma_px
    if count >= needed:
        by_chance = count < MOST_AGREE * len(attempt.inliers) and spread > options.few_sigma_px
        return f"{count} of {visible} points agree, but only by {spread:.1f} px" if by_chance else ""
    if attempt.prior is None:
        return f"{count} of {visible} points agree, at least {needed} needed"
    if count < options.least_anchored:
        return f"{count} of {visible} points agree, at least {options.least_anchored} needed"
    found = int(measurement.valid.sum())
    if spread < options.few_sigma_px and count >= options.anchored_share * found:
        return ""
    return f"of {found} points found only {count} agree on a shape, by {spread:.1f} px"
