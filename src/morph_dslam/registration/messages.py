"""Warnings about a registration, and their texts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import StrEnum
from math import isclose
from typing import Any, ClassVar

from morph_dslam.notices import Notice


@dataclass(frozen=True)
class RegistrationWarning(Notice):
    """Something that a reader of a registration must know; each kind is a class of its own."""


class Ambiguity(StrEnum):
    """What makes a registration ambiguous."""

    SHAPES = "shapes"
    TILT = "tilt"
    BOARD_TILT = "board_tilt"
    BOARD_TAGS = "board_tags"
    TWO_PRINTS = "two_prints"
    SECOND_PLACE = "second_place"
    UNCONFIRMED = "unconfirmed"
    LANDMARKS_UNCONFIRMED = "landmarks_unconfirmed"
    IMAGES_DIFFER = "images_differ"
    TURNED = "turned"


_AMBIGUITIES = {
    Ambiguity.SHAPES: "{value:.0f} different shapes fit the landmarks equally well; add landmarks away from the "
    "object's outline, or take a reference frame that shows it bent",
    Ambiguity.TILT: "in one shape {value:.0f} poses fit the landmarks equally well, as of a flat part that is tilted "
    "to one side or to the other; add landmarks that stand out of its plane, film it from nearer or more aslant, or "
    "use depth or a second camera",
    Ambiguity.BOARD_TILT: "the board can be tilted the other way; show it larger or aslant",
    Ambiguity.BOARD_TAGS: "each of the board's tags may be turned by 180 degrees, as OpenCV's are against AprilTag's; "
    "show more of them, or say tag_corners in the board file",
    Ambiguity.TWO_PRINTS: "the print is in two places; the second one has {value:.0%} of the first one's features",
    Ambiguity.SECOND_PLACE: "another place in the map scores {value:.0%} of this one; look at registration.jpg, "
    "and give landmarks if it is wrong",
    Ambiguity.UNCONFIRMED: "no image confirms this place, and scenery that has the object's shape in another size "
    "would do; look at registration.jpg, and give landmarks if it is wrong",
    Ambiguity.LANDMARKS_UNCONFIRMED: "the landmarks alone speak for this place, and the map does not confirm it; look "
    "at registration.jpg: a landmark may belong to another point, or the map or the camera file be wrong",
    Ambiguity.IMAGES_DIFFER: "the keyframes' images differ by {value:.2f} px on the object; look at "
    "registration.jpg, and give landmarks if it is wrong",
    Ambiguity.TURNED: "undeformed, the object looks the same turned by {value:.0f} degrees, but it does not deform the "
    "same then; give landmarks on sides that you can tell apart",
}


@dataclass(frozen=True)
class Ambiguous(RegistrationWarning):
    """Another registration is nearly as good, or nothing confirms this one.

    Attributes
    ----------
    why : what makes it so.
    value : the number of shapes, or of poses of one shape, the share of the second place or print, the difference in
        pixels, or the turn in degrees.
    """

    why: Ambiguity
    value: float = 0.0

    @property
    def text(self) -> str:
        """For people."""
        return "registration ambiguous: " + _AMBIGUITIES[Ambiguity(self.why)].format(value=self.value)


@dataclass(frozen=True)
class Underdetermined(RegistrationWarning):
    """The landmarks give no more numbers than there are unknowns.

    Attributes
    ----------
    numbers : two for each landmark.
    unknowns : parameters and pose.
    enough : number of landmarks that would be.
    """

    template: ClassVar[str] = (
        "registration underdetermined: the landmarks give {numbers} numbers for {unknowns} unknowns, so the shape "
        "stays near its default; give {enough} landmarks or more"
    )
    numbers: int
    unknowns: int
    enough: int


@dataclass(frozen=True)
class PoorFit(RegistrationWarning):
    """The landmarks fit worse than carefully set ones do.

    Attributes
    ----------
    sigma_px : standard deviation of their pixels by the fit.
    expected_px : that of carefully set ones.
    """

    template: ClassVar[str] = (
        "the landmarks fit to {sigma_px:.1f} px, where carefully set ones on an exact mesh fit to {expected_px:g} px: "
        "the part and its drawing, or what else was given, differ by about as much; the stated deviations take that "
        "for errors of single landmarks"
    )
    sigma_px: float
    expected_px: float


@dataclass(frozen=True)
class NotAtRest(PoorFit):
    """The landmarks fit clearly better where the object is deformed, which was said to be at rest.

    Attributes
    ----------
    free_px : standard deviation of their pixels where the parameters are free.
    parameters : what the landmarks alone give then, with units.
    """

    template: ClassVar[str] = (
        "the landmarks fit to {sigma_px:.1f} px with the object at rest, and to {free_px:.1f} px with {parameters}: it "
        "is probably not at rest in this frame, so leave out --at-rest. If it is, its dimensions are not those of the "
        "mesh, or a landmark is wrong. The stated deviations contain none of that"
    )
    free_px: float
    parameters: str


@dataclass(frozen=True)
class DepthAgainstLandmarks(RegistrationWarning):
    """The landmarks fit alone, and not together with the depth image.

    Attributes
    ----------
    alone_px : standard deviation of their pixels by the fit without depth.
    with_depth_px : the same with it, beside what the scale of the depths explains.
    """

    template: ClassVar[str] = (
        "the depth image contradicts the landmarks: alone they fit to {alone_px:.1f} px, with depth to "
        "{with_depth_px:.1f} px. Depth is not aligned to the colour image, or of another unit or instant: "
        "align it, or track without --depth; until then places are off by more than stated"
    )
    alone_px: float
    with_depth_px: float


@dataclass(frozen=True)
class DepthScaleUnlikely(RegistrationWarning):
    """Landmarks and depth agree only if all depths are off by more than is likely.

    Attributes
    ----------
    percent : by which the depths would have to be changed.
    deviations : how many standard deviations of their scale that is.
    """

    template: ClassVar[str] = (
        "landmarks and depth image fit together only if all depths are changed by {percent:+.1f} %, {deviations:.1f} "
        "standard deviations of their scale: the mesh or the landmarks have another size than the object, or the focal "
        "length or --depth-per-metre is off; places are off by as much as one of these is"
    )
    percent: float
    deviations: float


@dataclass(frozen=True)
class DepthBehindObject(RegistrationWarning):
    """The depth camera sees through the object.

    Attributes
    ----------
    percent : of the depths measured where the object is seen, those that lie clearly behind it.
    """

    template: ClassVar[str] = (
        "the depth image sees through the object: {percent:.0f} % of what it measured there lies behind it. Depth is "
        "not aligned to the colour image, or of another instant: align it, or track without --depth; until then places "
        "are off by more than stated. If it is aligned, the mesh covers an opening, or landmarks are wrong"
    )
    percent: float


@dataclass(frozen=True)
class CamerasContradict(RegistrationWarning):
    """The landmarks of a rig's cameras do not go together with how these stand to each other.

    Attributes
    ----------
    camera : number of the camera whose landmarks are farthest from where its stated pose has them.
    turned_deg, moved_mm : how far it is from that pose, as the landmarks have it.
    free_px : standard deviation of a landmark's pixels if the poses of the cameras are free.
    together_px : the same if they are as stated.
    """

    template: ClassVar[str] = (
        "the cameras contradict each other: the landmarks fit to {free_px:.2g} px if camera {camera} is turned by "
        "about {turned_deg:.1g} degrees and moved by {moved_mm:.1g} mm from where the camera file has it, and to "
        "{together_px:.2g} px as it is there. Check the poses of the cameras in that file, the order of the landmark "
        "files, that the pictures are of one instant, and the size of the mesh; until then places, parameters and "
        "forces are off by more than stated"
    )
    camera: int
    turned_deg: float
    moved_mm: float
    free_px: float
    together_px: float


@dataclass(frozen=True)
class FewLandmarks(RegistrationWarning):
    """The landmarks are hardly more than the unknowns, so that their residuals do not show how exact they are.

    Attributes
    ----------
    n_landmarks : of all.
    assumed_px : standard deviation of their pixels that the covariance rests on.
    enough : number of landmarks that would show it.
    """

    template: ClassVar[str] = (
        "{n_landmarks} landmarks do not show how exactly they were set: the stated deviations assume {assumed_px:.2g} "
        "px each, and go in proportion; give {enough} landmarks or more"
    )
    n_landmarks: int
    assumed_px: float
    enough: int


@dataclass(frozen=True)
class ShapeAgainstPose(RegistrationWarning):
    """Shape and pose make good each other's changes in the frame, farther than the cost's curvature says.

    Attributes
    ----------
    parameters : those that the frame hardly shows, with their standard deviations and units.
    other_aids : that also fix the pose, and were not used.
    """

    template: ClassVar[str] = (
        "shapes in a wide range, each with a pose of its own, fit this frame: {parameters}. What fixes the pose "
        "narrows that: --still where camera and supports stand still, {other_aids}, or a start with the object at rest "
        "(--at-rest)"
    )
    parameters: str
    other_aids: str


@dataclass(frozen=True)
class OtherValues(RegistrationWarning):
    """Values of parameters far from each other fit the landmarks, in nearly the same shape.

    Attributes
    ----------
    parameters : with the value that was taken, and then the others.
    """

    template: ClassVar[str] = (
        "registration ambiguous: other values of parameters fit the landmarks as well, in nearly the same shape: "
        "{parameters}. The first value is taken, and stress and forces follow from it; narrow the range if you know "
        "which is right"
    )
    parameters: str


@dataclass(frozen=True)
class LandmarksTurnedAway(RegistrationWarning):
    """The camera would see the landmarks through the object.

    Attributes
    ----------
    turned_away : number of landmarks on faces that are turned away from the camera.
    n_landmarks : of all.
    """

    template: ClassVar[str] = (
        "{turned_away} of {n_landmarks} landmarks are on sides of the object that are turned away from the camera: the "
        "points are mirrored (rows of an image count downwards, y of a drawing mostly upwards), or on its back"
    )
    turned_away: int
    n_landmarks: int


@dataclass(frozen=True)
class AtBound(RegistrationWarning):
    """A parameter ends at a bound of its range.

    Attributes
    ----------
    parameter : its name.
    """

    template: ClassVar[str] = "registration: parameter '{parameter}' is at a bound of the model's range"
    parameter: str


@dataclass(frozen=True)
class UnusualSize(RegistrationWarning):
    """The model is so small or large that its unit may be wrong.

    Attributes
    ----------
    size : of the model, metres.
    """

    template: ClassVar[str] = (
        "the model is {size:.3g} m across: if that is not so, the unit of its mesh is wrong; one camera cannot see "
        "that, because an object twice as large at twice the distance looks the same"
    )
    size: float


@dataclass(frozen=True)
class OtherSize(RegistrationWarning):
    """The object has another size in a metric map than its mesh.

    Attributes
    ----------
    ratio : of its size there to that of the mesh.
    """

    template: ClassVar[str] = (
        "registration doubtful: in the map, which is metric, the object is {ratio:.3f} times as large as its mesh; "
        "check the mesh's dimensions, and the calibration of the depth camera or the stereo pair"
    )
    ratio: float


#: Units that meshes come in, metres.
UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 1e-3, "inches": 0.0254}
#: Those that landmarks may be in by mistake, in millimetres, which they should be in.
_UNITS_MM = {name: 1e3 * size for name, size in (UNITS | {"micrometres": 1e-6}).items() if name != "millimetres"}


@dataclass(frozen=True)
class WrongUnit(RegistrationWarning):
    """The landmarks lie on a part of the object, and would lie all over it in another unit.

    Attributes
    ----------
    spread : of the landmarks, metres.
    size : of the object, metres.
    factor : by which the mesh would have to be multiplied.
    meant : the unit of the mesh, if so.
    taken : the unit in which it was read.
    """

    spread: float
    size: float
    factor: float
    meant: str
    taken: str

    @property
    def text(self) -> str:
        """For people."""
        apart = f"{1e3 * self.spread:.4g} mm apart on an object of {1e3 * self.size:.4g} mm"
        return f"registration doubtful: the landmarks are {apart}{self.hint}"

    @property
    def hint(self) -> str:
        """What to do, for the end of a sentence."""
        fit = f"; they fit if its mesh is multiplied by {self.factor:.4g}: "
        mesh = f"a mesh in {self.meant} was taken for one in {self.taken}: correct its unit in the study"
        unit = next((name for name, size in _UNITS_MM.items() if isclose(size * self.factor, 1.0)), None)
        if unit is None:
            return f"{fit}perhaps {mesh}"
        return (
            f"{fit}either the landmark file is in {unit}, where its columns x_mm, y_mm and z_mm are millimetres, or "
            f"{mesh}"
        )


@dataclass(frozen=True)
class AssumedUndeformed(RegistrationWarning):
    """A board says where the object is, not how it is deformed."""

    template: ClassVar[str] = (
        "registered by a board, which says where the object is, not how it is deformed: it is taken to be undeformed"
    )


@dataclass(frozen=True)
class OutlineOnly(RegistrationWarning):
    """A guess was refined by the outline, which says little of the shape."""

    template: ClassVar[str] = "registered by a guess: its outline agrees with the image, which says little of the shape"


@dataclass(frozen=True)
class OutlineUnseen(RegistrationWarning):
    """Too little of the outline is seen to correct landmarks by it.

    Attributes
    ----------
    share : of the outline that is seen.
    """

    template: ClassVar[str] = (
        "the landmarks are not corrected by the outline: the frame shows only {share:.0%} of it clearly"
    )
    share: float


@dataclass(frozen=True)
class OutlineInexact(RegistrationWarning):
    """The outline fits the object worse than its landmarks do.

    Attributes
    ----------
    outline_px : standard deviation of its points, pixels.
    landmarks_px : that of the landmarks.
    """

    template: ClassVar[str] = (
        "the landmarks are not corrected by the outline: it is {outline_px:.1f} px off the object, the landmarks "
        "{landmarks_px:.1f} px; part and mesh differ, or other edges were taken for the outline"
    )
    outline_px: float
    landmarks_px: float


@dataclass(frozen=True)
class OutlineContradicts(RegistrationWarning):
    """The outline that was found pulls the object off its landmarks.

    Attributes
    ----------
    beside_px : root mean square by which the landmarks fit beside the outline.
    alone_px : the same without it.
    """

    template: ClassVar[str] = (
        "the landmarks are not corrected by the outline: beside it they would fit to {beside_px:.1f} px, alone to "
        "{alone_px:.1f} px; part and mesh differ, a landmark is wrong, or another edge was taken for the outline"
    )
    beside_px: float
    alone_px: float


@dataclass(frozen=True)
class OutlineElsewhere(RegistrationWarning):
    """The keyframes show the object's outline elsewhere.

    Attributes
    ----------
    share : of the outline that is where the registration has it, beyond what lies on edges by chance.
    """

    template: ClassVar[str] = (
        "registration doubtful: the keyframes show only {share:.0%} of the object's outline where it is, beyond "
        "what lies on edges by chance; it may be the mesh of another object, and the size of the map's unit wrong; "
        "look at registration.jpg"
    )
    share: float


@dataclass(frozen=True)
class AngleOpen(RegistrationWarning):
    """The undeformed object can be turned about its axis without a difference.

    Attributes
    ----------
    parameter : name of the parameter that is the angle.
    """

    template: ClassVar[str] = (
        "the angle about the object's axis is unobservable before it deforms: it is the parameter '{parameter}'"
    )
    parameter: str


@dataclass(frozen=True)
class TurnArbitrary(RegistrationWarning):
    """A rigid object can be turned about its axis without a difference."""

    template: ClassVar[str] = "the object is the same all around its axis: the pose's turn about it is arbitrary"


@dataclass(frozen=True)
class AttitudeArbitrary(RegistrationWarning):
    """An object can be turned without a difference, by a part of a turn.

    Attributes
    ----------
    degrees : the turn.
    """

    template: ClassVar[str] = (
        "the object is the same turned by {degrees:.0f} degrees: which of these attitudes its pose has is arbitrary"
    )
    degrees: float


@dataclass(frozen=True)
class TooLittleTexture(RegistrationWarning):
    """The keyframes could not be compared on the object, so that they did not refine its place."""

    template: ClassVar[str] = "the keyframes show too little texture on the object to refine its place"


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
class MeshOffSurface(RegistrationWarning):
    """The model's mesh differs from the surface that it was made from, and so does the place.

    Attributes
    ----------
    volume : of the mesh over that of the surface, less one.
    mean : distance between the two, metres.
    """

    volume: float
    mean: float

    @property
    def text(self) -> str:
        """For people."""
        return (
            f"the model's mesh is {abs(self.volume):.1%} {'smaller' if self.volume < 0.0 else 'larger'} than the "
            f"surface that it was made from, and {1e3 * self.mean:.2g} mm away from it on average, which the stated "
            "deviations contain: register the surface itself (`morph build --rigid`), and track the model with that "
            "registration"
        )


@dataclass(frozen=True)
class MapNotRigid(RegistrationWarning):
    """The map says of itself that its scene did not stay rigid.

    Attributes
    ----------
    correlation : of the misses of neighbouring points in the map, near 0 in a rigid scene.
    """

    template: ClassVar[str] = (
        "the object was placed in a map whose scene did not stay rigid (correlation {correlation:.2f}): its place and "
        "the size of the map's unit may be off by far more than is stated; map the scene again without what moves"
    )
    correlation: float


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


def _kinds(kind: type[RegistrationWarning]) -> dict[str, type[RegistrationWarning]]:
    """All kinds of warnings that are narrower than this one, by their names."""
    kinds = {}
    for narrower in kind.__subclasses__():
        kinds |= {narrower.__name__: narrower, **_kinds(narrower)}
    return kinds


def read_warning(content: Mapping[str, Any]) -> RegistrationWarning:
    """A warning from what `Notice.content` gave; raises KeyError or TypeError if it is none."""
    kind = _kinds(RegistrationWarning)["".join(part.capitalize() for part in content["kind"].split("_"))]
    return kind(**{field.name: content[field.name] for field in fields(kind)})
