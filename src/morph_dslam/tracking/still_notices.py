"""What a pose that is one over a sequence says beside the registration that it began with."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from morph_dslam.better_fit import chance_of_better_fit
from morph_dslam.camera import Camera
from morph_dslam.registration.landmark_fit import poor_px
from morph_dslam.registration.messages import RegistrationWarning
from morph_dslam.tracking.known_state import LandmarkTerm
from morph_dslam.tracking.still import TERM_STD, StillFit, corner_radius

#: A term of the camera that is off what was given by more standard deviations is said to be.
MOST_DEVIATIONS = 3.0
#: Landmarks that are right fit so much worse in the right pose than alone, as much as is said of, with this chance.
AWAY_CHANCE = 1e-3


@dataclass(frozen=True)
class PoseAwayFromLandmarks(RegistrationWarning):
    """The motion fits in another place than where the landmarks have the object.

    Attributes
    ----------
    off_px : how far the landmarks are off in the pose over the sequence, root mean square.
    off_mm : the same on the object.
    alone_px : the same in pixels in the pose that they have alone.
    worst : number of the one that is off most, from 1.
    worst_px : by how much.
    length_percent : by how much lengths are too large in that pose, if the landmarks are right; below zero too small.
    """

    template: ClassVar[str] = (
        "in the one pose for the whole sequence the landmarks are {off_px:.0f} px ({off_mm:.2g} mm) off, number "
        "{worst} by {worst_px:.0f} px, alone {alone_px:.1f} px. The motion fits the model best there: a support gives "
        "way, or a small error of mesh, law or lens passes for a tilt. If the landmarks are right, places on the mesh "
        "are off by as much, and lengths such as strokes by {length_percent:+.1f} %, which the deviations do not "
        "contain: measure the part, calibrate the lens (--refine-camera radial stands in for that), and compare with "
        "a run without --still"
    )
    off_px: float
    off_mm: float
    alone_px: float
    worst: int
    worst_px: float
    length_percent: float


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


@dataclass(frozen=True)
class LandmarksAlone:
    """Landmarks as they fit where nothing else counts.

    Attributes
    ----------
    term : what they say of a state.
    rms_px : by how much they are off then, root mean square.
    n_unknowns : how many they were fitted by.
    click_px : standard deviation of a carefully set landmark.
    """

    term: LandmarkTerm
    rms_px: float
    n_unknowns: int
    click_px: float

    def away(self, found: StillFit) -> PoseAwayFromLandmarks | None:
        """That the pose over the sequence is away from them; None where errors of clicks may do that.

        The statistic is F: what the squares rise by, for each of the unknowns, in the variance that the landmarks show
        alone by their squares, or that of carefully set ones if that is larger. In the right pose they rise by no more
        than the landmarks' errors have taken up before. Where they fit well as landmarks go, it is of no account.
        """
        term, k = self.term, len(self.term.recorded)
        off = term.sigma_px * term.away(found.camera, found.state)
        lengths, freedom = np.linalg.norm(off, axis=1), 2 * k - self.n_unknowns
        off_px = float(np.sqrt(np.mean(lengths**2)))
        if freedom < 1 or off_px < np.sqrt(2.0) * poor_px(found.camera, self.click_px):
            return None
        squares = k * off_px**2, k * self.rms_px**2
        if chance_of_better_fit(*squares, self.n_unknowns, freedom, self.click_px) > AWAY_CHANCE:
            return None
        drawn = found.camera.undistort_pixels(term.recorded) + off
        drawn, seen = (pixels - pixels.mean(axis=0) for pixels in (drawn, drawn - off))
        length_percent = 100.0 * (float(np.sum(drawn * seen) / np.sum(drawn**2)) - 1.0)
        off_mm = 1e3 * off_px / found.camera.fx * float(found.state.camera_from_object.translation[2])
        worst = int(lengths.argmax())
        return PoseAwayFromLandmarks(off_px, off_mm, self.rms_px, worst + 1, float(lengths[worst]), length_percent)


def still_notices(found: StillFit, landmarks: LandmarksAlone | None, given: Camera) -> Iterator[RegistrationWarning]:
    """What a reader must know of a pose over a sequence, and of the camera's terms.

    Parameters
    ----------
    found : the pose and the terms.
    landmarks : that the registration began with; None where it began otherwise.
    given : the camera as its file has it.
    """
    away = None if landmarks is None else landmarks.away(found)
    if away is not None:
        yield away
    if "focal" in found.terms:
        value, std = found.terms["focal"]
        is_far = abs(np.log(value / given.fx)) > MOST_DEVIATIONS * TERM_STD["focal"]
        yield (FocalLengthFarFromGiven if is_far else FocalLengthEstimated)(value, std, given.fx)
    if "radial" in found.terms:
        value, std = found.terms["radial"]
        radius = corner_radius(found.camera)
        yield RadialTermEstimated(value, std, value * radius**3 * found.camera.fx)
