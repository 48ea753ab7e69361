"""What a frame can come to: its status, why an estimate is rejected, and what a reader must know of one.

Decisions rest on these types; the texts are for people and are made here only.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

from morph_dslam.notices import Notice


class Status(StrEnum):
    """Whether the object was found in a frame."""

    #: Pose and parameters are estimated.
    TRACKED = "tracked"
    #: The map gives the pose of an anchored object, but too few points give the parameters.
    HIDDEN = "hidden"
    #: Neither pose nor parameters are known.
    LOST = "lost"


class FoundBy(StrEnum):
    """How the object was found in a frame."""

    FLOW = "followed from the previous frame"
    LAST_STATE = "found again where it was last seen"
    FEATURES = "recovered from the reference view's features"


class PoseSource(StrEnum):
    """Where a frame's pose comes from."""

    POINTS = "points"
    POINTS_AND_MAP = "points and map"
    SEQUENCE = "sequence"
    OUTLINE = "outline"
    OUTLINE_AND_MAP = "outline and map"
    MAP = "map"
    NONE = ""

    @property
    def is_of_frame_alone(self) -> bool:
        """Whether nothing but the frame's own picture tells the pose, which then makes good what is nearly rigid."""
        return self in (PoseSource.POINTS, PoseSource.OUTLINE)


class RejectionReason(StrEnum):
    """Why an estimate is not accepted; the texts are filled in by `Rejection`."""

    FEW_POINTS = "{agreeing} of {points} points agree, at least {needed} needed"
    LOOSE_AGREEMENT = "{agreeing} of {points} points agree, but only by {spread_px:.1f} px"
    NO_COMMON_SHAPE = "of {points} points found only {agreeing} agree on a shape, by {spread_px:.1f} px"
    FEW_FEATURES = "only {agreeing} features of the reference view were found again"
    PART_ABSENT = "a part is missing: {agreeing} of {points} points of the outline show what is beside the object"
    TWO_PLACES = "it could be in two places, where {agreeing} and {points} points agree"
    PLACE_TAKEN = "where it seems to be, with {agreeing} of {points} points, another object stands that looks like it"
    CAMERAS_CONTRADICT = "the cameras contradict each other: is their calibration right?"
    NO_CAMERA = "no camera sees the object"
    NO_PICTURE = "the camera has no picture"


@dataclass(frozen=True)
class Rejection:
    """Why the object was not found in a frame.

    Attributes
    ----------
    reason : what was missing.
    agreeing : number of points (or features) that agree.
    points : number of points that could be seen (`NO_COMMON_SHAPE`: that were found).
    needed : number of points that must agree.
    spread_px : robust spread of the residuals of those that agree, pixels.
    then : why looking for it by its features failed too; None if that was not tried.
    """

    reason: RejectionReason
    agreeing: int = 0
    points: int = 0
    needed: int = 0
    spread_px: float = 0.0
    then: Rejection | None = None

    @property
    def text(self) -> str:
        """For people."""
        own = self.reason.value.format(**vars(self))
        return own if self.then is None else f"{own}; {self.then.text}"


@dataclass(frozen=True)
class TrackingWarning(Notice):
    """Something that a reader of a frame's result must know; each kind is a class of its own.

    Attributes
    ----------
    doubts_result : whether the estimate may be wrong by more than its deviations state.
    """

    doubts_result: ClassVar[bool] = True


@dataclass(frozen=True)
class ObjectMoved(TrackingWarning):
    """An anchored object is away from its place in the map; its points alone give the pose."""

    template: ClassVar[str] = "the object has moved from its place in the map"


@dataclass(frozen=True)
class FewPointsAgree(TrackingWarning):
    """Few points agree, and less closely than usual, or most of them far less closely.

    Something may cover the object in part, or what looks alike was taken for it.

    Attributes
    ----------
    spread_px : robust spread of their residuals, pixels.
    """

    template: ClassVar[str] = (
        "few points agree, and less closely than usual, or most of them far less closely: by {spread_px:.2g} px"
    )
    spread_px: float


def may_be_mistaken(warnings: Iterable[TrackingWarning]) -> bool:
    """Whether a frame's result is not to be relied on at all: its deviations do not cover what may be wrong."""
    return any(isinstance(warning, FewPointsAgree) for warning in warnings)


@dataclass(frozen=True)
class TiltAmbiguous(TrackingWarning):
    """A flat object far away may as well be tilted to the other side; deviations hold that.

    Attributes
    ----------
    probability : that it is.
    angle_deg : between both, degrees.
    """

    doubts_result: ClassVar[bool] = False
    template: ClassVar[str] = "it may be tilted to the other side, {angle_deg:.0f} degrees from here: this looks alike"
    probability: float
    angle_deg: float


@dataclass(frozen=True)
class BlurredByMotion(TrackingWarning):
    """Motion blurs the picture: points are measured somewhere on their paths during the exposure, at no one instant.

    Attributes
    ----------
    path_px : root mean square length of these paths, pixels.
    """

    template: ClassVar[str] = "motion blurs the picture, over paths of about {path_px:.0f} px"
    path_px: float


@dataclass(frozen=True)
class ReferenceBlurred(TrackingWarning):
    """Motion blurs the reference picture, as a frame that is sharper shows.

    Attributes
    ----------
    path_px : root mean square length of the points' paths during its exposure, as this frame would show them, pixels.
    """

    template: ClassVar[str] = "motion blurs the reference picture, over paths of about {path_px:.0f} px"
    path_px: float


@dataclass(frozen=True)
class SamePlace(TrackingWarning):
    """Two objects of a session stand in one place, which bodies cannot: one of them was taken for the other.

    Attributes
    ----------
    other : name of the other object.
    """

    template: ClassVar[str] = "it stands where '{other}' stands: one of both was taken for the other"
    other: str


@dataclass(frozen=True)
class ModelDoesNotExplain(TrackingWarning):
    """Neighbouring points are off together, which noise does not do: the model is wrong there.

    Attributes
    ----------
    residual_px : root mean square of what they have in common, pixels.
    shift_px : the one shift of all points that explains most of it, pixels, where the pose is one over the sequence; 0
        if none does.
    """

    template: ClassVar[str] = "the model does not explain the images: {residual_px:.1f} px are left"
    residual_px: float
    shift_px: float = 0.0


@dataclass(frozen=True)
class CamerasDisagree(TrackingWarning):
    """Each of several cameras is explained by the model alone, and all together are not.

    Attributes
    ----------
    residual_px : root mean square of what neighbouring points of one camera have in common, pixels.
    """

    template: ClassVar[str] = "the cameras do not agree with each other: {residual_px:.1f} px are left"
    residual_px: float


@dataclass(frozen=True)
class SurfaceJumps(TrackingWarning):
    """The surface opens or slips along a line, and the model does not: stress near the line does not hold.

    Attributes
    ----------
    where : how far and where it opens most.
    """

    template: ClassVar[str] = "the surface opens or slips along a line, as at a crack, by {where}"
    where: str


@dataclass(frozen=True)
class ReferenceWidened(TrackingWarning):
    """The frames show that the reference state is worse known than the registration states, and deviations follow.

    Attributes
    ----------
    factor : by which its deviations are widened.
    """

    template: ClassVar[str] = "deviations widened {factor:.1f} times, as the frames ask for"
    factor: float


@dataclass(frozen=True)
class KnownRefuted(TrackingWarning):
    """The images alone have a known parameter elsewhere, by far: the sensor's zero, unit, clock or deviation is wrong.

    Attributes
    ----------
    parameter : its name.
    known : what is known of it, with its unit.
    found : what the images alone give, with its unit.
    deviations : by how many standard deviations of both together these differ.
    """

    template: ClassVar[str] = "the images refute the known {parameter} = {known}: alone they give {found}"
    parameter: str
    known: str
    found: str
    deviations: float


@dataclass(frozen=True)
class PastForgotten(TrackingWarning):
    """Some frames in a row contradict all those before in what is one over the sequence: from here on they count."""

    template: ClassVar[str] = (
        "the last frames contradict those before in what is to be one value over the sequence: it is found anew"
    )


@dataclass(frozen=True)
class TimeOutside(TrackingWarning):
    """A frame is before the instant at which the model's time begins, or after the end of its range: it is not known.

    Attributes
    ----------
    parameter : that measures time.
    time : of the frame, with its unit.
    range : of the parameter, with its unit.
    is_before : whether the model's time has not begun.
    """

    template: ClassVar[str] = (
        "{parameter} is {time} here, outside of the model's range from {range}: it counts as unknown"
    )
    parameter: str
    time: str
    range: str
    is_before: bool = False


@dataclass(frozen=True)
class OtherReferenceView(TrackingWarning):
    """The frame was compared with another reference view than the first.

    Attributes
    ----------
    number : of the view, in the order in which they were made.
    """

    doubts_result: ClassVar[bool] = False
    template: ClassVar[str] = "by reference view {number}"
    number: int


@dataclass(frozen=True)
class CameraLost(TrackingWarning):
    """The camera of an anchored object was not found in the map; the object's points alone give the pose.

    Attributes
    ----------
    why : what camera tracking says.
    """

    doubts_result: ClassVar[bool] = False
    template: ClassVar[str] = "the camera is lost in the map: {why}"
    why: str


@dataclass(frozen=True)
class DepthNotUsed(TrackingWarning):
    """Depth was asked for and did not count in this frame.

    Attributes
    ----------
    ratio : the distance of the object by the depth image over that by its points; None where no depth was measured
        on it.
    """

    doubts_result: ClassVar[bool] = False
    ratio: float | None = None

    @property
    def text(self) -> str:
        """For people."""
        if self.ratio is None:
            return "no depth was measured on the object"
        at = f"{self.ratio:.3g} times its distance"
        return (
            f"depth does not count: it has the object at {at}; is it in metres (--depth-per-metre)? If so, the "
            "registration is off: register with the depth image of the reference frame too (--depth)"
        )


@dataclass(frozen=True)
class ReadoutNotUsed(TrackingWarning):
    """The camera has a readout time, which did not count: the frame's time does not tell how the object moves.

    Attributes
    ----------
    gap_s : time since the frame before, seconds; None where the frame has no time.
    """

    gap_s: float | None = None

    @property
    def text(self) -> str:
        """For people."""
        if self.gap_s is None:
            return "readout_s does not count: the frame has no time"
        return f"readout_s does not count: the frame before is {self.gap_s:.3g} s ago; are the times in seconds?"


@dataclass(frozen=True)
class CameraIgnored(TrackingWarning):
    """One of several cameras does not count in this frame.

    Attributes
    ----------
    camera : its number.
    status : of the object in its image.
    rejection : why the object was not found there; None if it contradicts the other cameras.
    """

    doubts_result: ClassVar[bool] = False
    camera: int
    status: Status
    rejection: Rejection | None = None

    @property
    def has_no_picture(self) -> bool:
        """Whether the camera has not recorded the frame."""
        return self.rejection is not None and self.rejection.reason is RejectionReason.NO_PICTURE

    @property
    def text(self) -> str:
        """For people."""
        if self.rejection is None:
            return f"camera {self.camera} contradicts the others and does not count"
        return f"camera {self.camera}: {self.status}: {self.rejection.text}"


def reason_text(
    status: Status, found_by: FoundBy | None, rejection: Rejection | None, warnings: Iterable[TrackingWarning]
) -> str:
    """One line for people, without the status: how the object was found or why it was not, then the warnings."""
    why = "" if rejection is None else rejection.text
    if status is Status.HIDDEN:
        first = f"{why}; its place is known from the map, its parameters are not"
    else:
        first = why if status is Status.LOST else str(found_by)
    return "; ".join([first, *(warning.text for warning in warnings)])
