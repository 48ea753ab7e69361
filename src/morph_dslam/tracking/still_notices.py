"""What a pose that is one over a sequence says beside the registration that it began with."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from morph_dslam.camera import Camera
from morph_dslam.registration.messages import RegistrationWarning
from morph_dslam.tracking.known_state import LandmarkTerm, StateTerm
from morph_dslam.tracking.still import TERM_STD, StillFit, corner_radius

#: Landmarks that miss by more standard deviations, as root mean square, are said to; a term of the camera as well.
MOST_DEVIATIONS = 3.0


@dataclass(frozen=True)
class PoseAwayFromLandmarks(RegistrationWarning):
    """The motion fits in another place than where the landmarks have the object.

    Attributes
    ----------
    off_px : how far the landmarks are off in the pose over the sequence, root mean square.
    off_mm : the same on the object.
    alone_px : standard deviation of their pixels as they fit alone.
    worst : number of the one that is off most, from 1.
    worst_px : by how much.
    """

    template: ClassVar[str] = (
        "in the one pose for the whole sequence the landmarks are {off_px:.0f} px ({off_mm:.2g} mm) off, number "
        "{worst} by {worst_px:.0f} px; alone they fit to {alone_px:.1f} px. The motion fits the model best there: a "
        "support gives way, or the mesh, the law or the lens is not the real one. Places on the mesh are off by as "
        "much; the motion of what is seen there is not"
    )
    off_px: float
    off_mm: float
    alone_px: float
    worst: int
    worst_px: float


@dataclass(frozen=True)
class FocalLengthEstimated(RegistrationWarning):
    """The focal length was estimated with the pose.

    Attributes
    ----------
    value : pixels.
    std : its standard deviation.
    given : by the camera file.
    """

    template: ClassVar[str] = "estimated with the pose: focal length {value:.0f} +- {std:.0f} px ({given:.0f} given)"
    value: float
    std: float
    given: float


@dataclass(frozen=True)
class FocalLengthFarFromGiven(FocalLengthEstimated):
    """It is not what the camera file has, by far."""

    template: ClassVar[str] = FocalLengthEstimated.template + (
        ": so far from that, an error of the model passes for perspective, and the deviation does not contain it. "
        "Calibrate the lens, or leave --refine-camera focal out"
    )


@dataclass(frozen=True)
class RadialTermEstimated(RegistrationWarning):
    """The first radial term of the lens was estimated with the pose.

    Attributes
    ----------
    value : the coefficient k1.
    std : its standard deviation.
    corner_px : by how much it moves the image's farthest corner.
    """

    template: ClassVar[str] = (
        "estimated with the pose: radial term k1 = {value:.3g} +- {std:.2g}, {corner_px:+.1f} px in the image's corner"
    )
    value: float
    std: float
    corner_px: float


#: All that `still_notices` says.
STILL_NOTICES = (PoseAwayFromLandmarks, FocalLengthEstimated, RadialTermEstimated)


def still_notices(found: StillFit, known: LandmarkTerm | StateTerm, given: Camera) -> Iterator[RegistrationWarning]:
    """What a reader must know of a pose over a sequence, and of the camera's terms.

    Parameters
    ----------
    found : the pose and the terms.
    known : what the registration rests on that it began with.
    given : the camera as its file has it.
    """
    if isinstance(known, LandmarkTerm):
        deviations = np.linalg.norm(known.away(found.camera, found.state), axis=1)
        # Of a coordinate, as the standard deviation is.
        rms = float(np.sqrt(np.mean(deviations**2) / 2.0))
        if rms > MOST_DEVIATIONS:
            worst = int(deviations.argmax())
            off_px = float(np.sqrt(np.mean(deviations**2))) * known.sigma_px
            off_mm = 1e3 * off_px / found.camera.fx * float(found.state.camera_from_object.translation[2])
            worst_px = float(deviations[worst]) * known.sigma_px
            yield PoseAwayFromLandmarks(off_px, off_mm, known.sigma_px, worst + 1, worst_px)
    if "focal" in found.terms:
        value, std = found.terms["focal"]
        is_far = abs(np.log(value / given.fx)) > MOST_DEVIATIONS * TERM_STD["focal"]
        yield (FocalLengthFarFromGiven if is_far else FocalLengthEstimated)(value, std, given.fx)
    if "radial" in found.terms:
        value, std = found.terms["radial"]
        radius = corner_radius(found.camera)
        yield RadialTermEstimated(value, std, value * radius**3 * found.camera.fx)
