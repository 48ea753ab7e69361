"""Warnings about a mesh in a map: why images did not refine its place, and where alone it was looked for."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

from morph_dslam.registration.messages import RegistrationWarning


class Unrefined(StrEnum):
    """Why the keyframes' images did not refine an object's place, where its texture is not the reason."""

    FEW_KEYFRAMES = "few_keyframes"
    LOOK_DIFFERENT = "look_different"
    IMAGES_DIFFER = "images_differ"
    OFF_EDGES = "off_edges"


_REASONS = {
    Unrefined.FEW_KEYFRAMES: "only {value:.0f} of them has half of the object or more in its image, and two are needed",
    Unrefined.LOOK_DIFFERENT: "only {value:.0%} of the points on it look alike in two of them; it shines, something "
    "else is before it, or it is placed wrong, so look at registration.jpg",
    Unrefined.IMAGES_DIFFER: "where they agree best they still differ by {value:.2f} px on it, as they do on weak "
    "texture or if it is placed wrong",
    Unrefined.OFF_EDGES: "they would move it off its edges, to where its score is {value:.0f}, so that edges alone "
    "give its place",
}


@dataclass(frozen=True)
class NotRefined(RegistrationWarning):
    """The keyframes' images did not refine the object's place, though they may have texture.

    Attributes
    ----------
    why : the reason.
    value : the number of keyframes, the share of points, the difference in pixels, or the score.
    """

    why: Unrefined
    value: float

    @property
    def text(self) -> str:
        """For people."""
        reason = _REASONS[Unrefined(self.why)].format(value=self.value)
        return f"the keyframes' images do not refine the object's place: {reason}"


@dataclass(frozen=True)
class OnlyInBox(RegistrationWarning):
    """A registration that is in doubt was looked for in a box alone.

    Attributes
    ----------
    frame : number of the keyframe that the box is in.
    """

    template: ClassVar[str] = (
        "the object was looked for only in the box that was given in keyframe {frame}, as about as large as the box: "
        "draw it around the whole object, with little margin, or leave it out"
    )
    frame: int
