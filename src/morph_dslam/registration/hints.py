"""What a user knows of where an object is in a map."""

from __future__ import annotations

from dataclasses import dataclass

from morph_dslam.geometry import RigidTransform
from morph_dslam.registration.edges import Sighting


@dataclass(frozen=True)
class GuessedPose:
    """About where an object is in a frame.

    Attributes
    ----------
    frame : its number.
    camera_from_world : the camera's pose in the map.
    pose : camera_from_object, metres.
    """

    frame: int
    camera_from_world: RigidTransform
    pose: RigidTransform


@dataclass(frozen=True)
class Hints:
    """What is known of where the object is in a map, each alone or together.

    Attributes
    ----------
    clicks : landmarks in frames whose camera is known.
    distance : rough distance of the object from the camera in the keyframes, metres.
    region : number of a keyframe, and left, top, right and bottom of a box around the whole object in it, pixels, with
        any margin up to half the object's width on each side.
    guess : about where it is in a frame whose camera is known.
    """

    clicks: tuple[Sighting, ...] = ()
    distance: float | None = None
    region: tuple[int, tuple[float, float, float, float]] | None = None
    guess: GuessedPose | None = None


NO_HINTS = Hints()
