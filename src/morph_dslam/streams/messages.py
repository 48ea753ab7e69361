"""What is sent to other programs: a scene once, then a message for each frame. Every kind of stream is made from these.

All values are in SI units. The camera looks along +z, with x to the right and y down in its image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ParameterInfo:
    """A parameter of an object's model.

    Attributes
    ----------
    name : of the parameter.
    description : for people.
    unit : of its values, SI: "m", "rad", "Pa", "1" ...
    shown_unit : in which people read it, "mm" say.
    shown_factor : a value in the shown unit is that in SI divided by this.
    lower : lower end of its range.
    upper : upper end.
    """

    name: str
    description: str
    unit: str
    shown_unit: str
    shown_factor: float
    lower: float
    upper: float


@dataclass(frozen=True)
class ScalarInfo:
    """The field that colours an object's surface.

    Attributes
    ----------
    name : "von Mises stress", "equivalent strain", "displacement" or "traction of unknown loads".
    unit : of its values, SI.
    shown_unit : in which people read it.
    shown_factor : a value in the shown unit is that in SI divided by this.
    low : where colours begin.
    high : where colours end; single values may be larger.
    """

    name: str
    unit: str
    shown_unit: str
    shown_factor: float
    low: float
    high: float


@dataclass(frozen=True)
class InnerInfo:
    """What does not change of a structure inside an object.

    Attributes
    ----------
    name : of the structure.
    rest : (p, 3) vertices of its undeformed surface, object frame, metres.
    triangles : (m, 3) in these vertices.
    """

    name: str
    rest: Array
    triangles: NDArray[np.int64]


@dataclass(frozen=True)
class ObjectInfo:
    """What does not change of an object.

    Attributes
    ----------
    name : by which the frames call it.
    model : name of its model.
    rest : (n, 3) vertices of the undeformed surface, object frame, metres.
    triangles : (m, 3) in these vertices, anticlockwise seen from outside.
    nodes : (n,) numbers of the vertices among the nodes of the model.
    parameters : in the order of the values in a frame.
    scalar : the field that colours it; None for a rigid object.
    supports : names of those that have reactions.
    inner : structures inside.
    """

    name: str
    model: str
    rest: Array
    triangles: NDArray[np.int64]
    nodes: NDArray[np.int64]
    parameters: tuple[ParameterInfo, ...]
    scalar: ScalarInfo | None
    supports: tuple[str, ...]
    inner: tuple[InnerInfo, ...] = ()


@dataclass(frozen=True)
class SceneMessage:
    """What a receiver must know before the first frame.

    Attributes
    ----------
    camera : of the frames; the first one of several.
    objects : in the order of `FrameMessage.objects`.
    """

    camera: Camera
    objects: tuple[ObjectInfo, ...]


@dataclass(frozen=True)
class ReactionMessage:
    """What a support exerts on an object, object frame.

    Attributes
    ----------
    point : (3,) where the support is in the middle, metres.
    force : (3,) N.
    force_std : (3,) standard deviations.
    force_size_std : standard deviation of the force's size, N.
    moment : (3,) about the point, N m.
    moment_std : (3,) standard deviations.
    """

    point: Array
    force: Array
    force_std: Array
    force_size_std: float
    moment: Array
    moment_std: Array


@dataclass(frozen=True)
class ObjectMessage:
    """An object in a frame.

    Attributes
    ----------
    name : of the object.
    status : "tracked", "hidden" (its pose is known, its shape is not) or "lost".
    text : for people: how it was found, or why it was not, and warnings.
    camera_from_object : its pose, None when lost.
    pose_std : (6,) standard deviations of the rotation vector (rad) and the translation (m); NaN when lost.
    parameters : (d,), NaN unless tracked.
    parameter_std : (d,), NaN unless tracked.
    vertices : (n, 3) deformed surface, object frame, metres; None unless tracked.
    scalar : (n,) of the field that colours it, NaN where it does not hold; None unless tracked, or if it has none.
    reactions : by support; empty unless tracked.
    inner : deformed vertices (p, 3) of structures inside by their names, object frame, metres; empty unless tracked.
    """

    name: str
    status: str
    text: str
    camera_from_object: RigidTransform | None
    pose_std: Array
    parameters: Array
    parameter_std: Array
    vertices: NDArray[np.float32] | None = None
    scalar: NDArray[np.float32] | None = None
    reactions: dict[str, ReactionMessage] = field(default_factory=dict)
    inner: dict[str, NDArray[np.float32]] = field(default_factory=dict)


@dataclass(frozen=True)
class FrameMessage:
    """All objects in a frame.

    Attributes
    ----------
    number : counts the messages of a run, from 0 on: who misses one sees it.
    frame : number of the frame in its recording or live stream.
    timestamp : of the frame, seconds.
    captured : when a live frame was captured, seconds since 1970; None in a recording.
    image : (h, w, 3) as recorded: blue, green, red.
    describe : makes `objects`, when somebody asks for them: in the thread of a stream, and not in that of the tracker.
    """

    number: int
    frame: int
    timestamp: float
    captured: float | None
    image: NDArray[np.uint8]
    describe: Callable[[], tuple[ObjectMessage, ...]]

    @cached_property
    def objects(self) -> tuple[ObjectMessage, ...]:
        """In the order of the scene."""
        return self.describe()


class Publisher(Protocol):
    """One way to send messages on; it must not keep the caller waiting for a receiver."""

    @property
    def place(self) -> str:
        """Where it goes, for people."""
        ...

    @property
    def is_watched(self) -> bool:
        """Whether frames are of use to anybody now."""
        ...

    def begin(self, scene: SceneMessage) -> None:
        """Tell the scene, before its frames."""
        ...

    def publish(self, message: FrameMessage) -> None:
        """Tell a frame."""
        ...

    def close(self) -> None:
        """End the stream."""
        ...
