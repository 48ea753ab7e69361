"""The messages as those of ROS 2, without ROS: names of types and values of fields, for whoever has the types.

Lengths are in metres and frames right-handed (REP 103). The camera's frame is an optical one: x to the right, y down, z
forward. Fields that are not named keep their defaults.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import chain, count
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from morph_dslam.geometry import RigidTransform
from morph_dslam.model.inner_structure import colour_of
from morph_dslam.streams.colours import colours_of
from morph_dslam.streams.messages import FrameMessage, ObjectInfo, ObjectMessage, SceneMessage

#: Constants of visualization_msgs/Marker, sensor_msgs/PointField and diagnostic_msgs/DiagnosticStatus.
TRIANGLE_LIST, DELETE = 11, 2
FLOAT32 = 7
LEVELS = {"tracked": 0, "hidden": 1, "lost": 2}


@dataclass(frozen=True)
class RosMessage:
    """A message of ROS 2.

    Attributes
    ----------
    type : "geometry_msgs/msg/PoseStamped" say.
    fields : values by name: numbers, texts, arrays of numbers, messages, or lists of messages.
    """

    type: str
    fields: dict[str, Any]


@dataclass(frozen=True)
class Octet:
    """A value of a field of the type byte, for which libraries have different types."""

    value: int


@dataclass(frozen=True)
class Topic:
    """A topic of a scene.

    Attributes
    ----------
    type : of its messages.
    make : its message of a frame; None if there is nothing to say.
    """

    type: str
    make: Callable[[FrameMessage], RosMessage | None]


def build(
    message: RosMessage,
    class_of: Callable[[str], Callable[..., Any]],
    numbers: Callable[[NDArray], Any],
    octet: Callable[[int], Any],
) -> Any:
    """The message as an object of a library.

    Parameters
    ----------
    message : to build.
    class_of : the class of a type, which takes the fields by their names.
    numbers : an array of numbers as the library takes it.
    octet : a byte as the library takes it.
    """
    made: dict[int, Any] = {}

    def built(value: Any) -> Any:
        if isinstance(value, RosMessage):
            # The corners of triangles share their points.
            if id(value) not in made:
                made[id(value)] = class_of(value.type)(**{name: built(part) for name, part in value.fields.items()})
            return made[id(value)]
        if isinstance(value, list):
            return [built(part) for part in value]
        if isinstance(value, np.ndarray):
            return numbers(value)
        return octet(value.value) if isinstance(value, Octet) else value

    return built(message)


def topics(scene: SceneMessage, prefix: str) -> dict[str, Topic]:
    """All topics of a scene by name.

    Parameters
    ----------
    scene : that is streamed.
    prefix : of the topics, "/morph" say; frames are named by it too.
    """
    frames = prefix.strip("/").replace("/", "_")
    camera, found = f"{frames}_camera_optical_frame", {}
    names = _unique([part.name for part in scene.objects])
    of_objects = _distinct([f"{frames}_{name}" for name in names], [camera])
    of_supports = _support_frames(scene.objects, of_objects, [camera, *of_objects])
    parts = [
        _ObjectTopics(info, f"{prefix}/{name}", camera, frame, held)
        for info, name, frame, held in zip(scene.objects, names, of_objects, of_supports, strict=True)
    ]

    def transforms(message: FrameMessage) -> RosMessage | None:
        pairs = zip(parts, message.objects, strict=True)
        listed = [one for part, now in pairs for one in part.transforms(message, now)]
        return RosMessage("tf2_msgs/msg/TFMessage", {"transforms": listed}) if listed else None

    def diagnostics(message: FrameMessage) -> RosMessage:
        status = [part.status(now) for part, now in zip(parts, message.objects, strict=True)]
        fields = {"header": _header(message, ""), "status": status}
        return RosMessage("diagnostic_msgs/msg/DiagnosticArray", fields)

    found["/tf"] = Topic("tf2_msgs/msg/TFMessage", transforms)
    found["/diagnostics"] = Topic("diagnostic_msgs/msg/DiagnosticArray", diagnostics)
    for number, part in enumerate(parts):
        found |= part.topics(number)
    return found


class _ObjectTopics:
    """Topics of one object.

    Parameters
    ----------
    info : the object.
    base : beginning of its topics.
    camera : the camera's frame.
    frame : the object's frame.
    held : the frame of each support, by its name.
    """

    def __init__(self, info: ObjectInfo, base: str, camera: str, frame: str, held: dict[str, str]) -> None:
        self._info, self._base, self._camera, self._frame = info, base, camera, frame
        self._held = held
        self._supports = dict(zip(info.supports, _unique(info.supports), strict=True))
        inner = [one.name for one in info.inner]
        self._inner = dict(zip(inner, _unique(inner), strict=True))

    def topics(self, number: int) -> dict[str, Topic]:
        """By name; ``number`` is that of the object in the frames."""

        def topic(kind: str, make: Callable[[FrameMessage, ObjectMessage], RosMessage | None]) -> Topic:
            return Topic(kind, lambda message: make(message, message.objects[number]))

        found = {
            f"{self._base}/pose": topic("geometry_msgs/msg/PoseStamped", self._pose),
            f"{self._base}/mesh": topic("visualization_msgs/msg/Marker", self._mesh),
            f"{self._base}/vertices": topic("sensor_msgs/msg/PointCloud2", self._vertices),
            f"{self._base}/parameters": topic("std_msgs/msg/Float64MultiArray", self._parameters),
        }
        for order, (structure, name) in enumerate(self._inner.items()):
            found[f"{self._base}/inner/{name}"] = topic(
                "visualization_msgs/msg/Marker", self._inner_of(order, structure)
            )
        for support, name in self._supports.items():
            found[f"{self._base}/reactions/{name}"] = topic("geometry_msgs/msg/WrenchStamped", self._wrench_of(support))
        return found

    def transforms(self, message: FrameMessage, now: ObjectMessage) -> Iterable[RosMessage]:
        """From the camera to the object, and from there to its supports, whose axes are the object's."""
        if now.camera_from_object is None:
            return
        yield self._transform(message, self._camera, self._frame, now.camera_from_object)
        for support, reaction in now.reactions.items():
            pose = RigidTransform(np.eye(3), reaction.point)
            yield self._transform(message, self._frame, self._held[support], pose)

    @staticmethod
    def _transform(message: FrameMessage, parent: str, child: str, pose: RigidTransform) -> RosMessage:
        moved = {"translation": _vector(pose.translation), "rotation": _quaternion(pose)}
        transform = RosMessage("geometry_msgs/msg/Transform", moved)
        fields = {"header": _header(message, parent), "child_frame_id": child, "transform": transform}
        return RosMessage("geometry_msgs/msg/TransformStamped", fields)

    def status(self, now: ObjectMessage) -> RosMessage:
        """OK while tracked, a warning while hidden, an error while lost; parameters as texts, in their own units."""
        values = []
        for parameter, value, deviation in zip(self._info.parameters, now.parameters, now.parameter_std, strict=True):
            shown = f"{value / parameter.shown_factor:.6g} +- {deviation / parameter.shown_factor:.2g}"
            text = f"{shown} {parameter.shown_unit}"
            values.append(RosMessage("diagnostic_msgs/msg/KeyValue", {"key": parameter.name, "value": text}))
        fields = {
            "level": Octet(LEVELS[now.status]),
            "name": f"morph: {self._info.name}",
            "message": now.text,
            "hardware_id": self._info.model,
            "values": values,
        }
        return RosMessage("diagnostic_msgs/msg/DiagnosticStatus", fields)

    def _pose(self, message: FrameMessage, now: ObjectMessage) -> RosMessage | None:
        if now.camera_from_object is None:
            return None
        fields = {"header": _header(message, self._camera), "pose": _pose(now.camera_from_object)}
        return RosMessage("geometry_msgs/msg/PoseStamped", fields)

    def _mesh(self, message: FrameMessage, now: ObjectMessage) -> RosMessage:
        """Triangles in colours for RViz; taken away while the shape is not known."""
        if now.vertices is None:
            return self._marker(message, now, self._info.name)
        corners = self._info.triangles.ravel()
        shades = [_colour(one) for one in (colours_of(now.scalar, self._info, len(now.vertices)) / 255.0).tolist()]
        coloured = {"color": _colour([1.0] * 4), "colors": [shades[corner] for corner in corners]}
        return self._marker(message, now, self._info.name, (now.vertices, corners), coloured)

    def _inner_of(self, order: int, structure: str) -> Callable[[FrameMessage, ObjectMessage], RosMessage]:
        """A structure inside, in one colour."""
        corners, name = self._info.inner[order].triangles.ravel(), f"{self._info.name}/{structure}"
        coloured = {"color": _colour([*(part / 255.0 for part in colour_of(order)), 1.0])}

        def marker(message: FrameMessage, now: ObjectMessage) -> RosMessage:
            if structure not in now.inner:
                return self._marker(message, now, name)
            return self._marker(message, now, name, (now.inner[structure], corners), coloured)

        return marker

    def _marker(
        self,
        message: FrameMessage,
        now: ObjectMessage,
        name: str,
        surface: tuple[NDArray[np.float32], NDArray[np.int64]] | None = None,
        coloured: dict[str, Any] | None = None,
    ) -> RosMessage:
        """A marker of triangles, by vertices (n, 3) and the corners (3 m,) in them; without these it is taken away."""
        fields: dict[str, Any] = {"header": _header(message, self._camera), "ns": name}
        if surface is None or now.camera_from_object is None:
            return RosMessage("visualization_msgs/msg/Marker", fields | {"action": DELETE})
        vertices, corners = surface
        points = [RosMessage("geometry_msgs/msg/Point", dict(zip("xyz", p, strict=True))) for p in vertices.tolist()]
        fields |= {
            "type": TRIANGLE_LIST,
            "pose": _pose(now.camera_from_object),
            "scale": _vector(np.ones(3)),
            "points": [points[corner] for corner in corners],
        }
        return RosMessage("visualization_msgs/msg/Marker", fields | (coloured or {}))

    def _vertices(self, message: FrameMessage, now: ObjectMessage) -> RosMessage | None:
        """The vertices in the object's frame, and the value at each."""
        if now.vertices is None:
            return None
        columns, names = [now.vertices], ["x", "y", "z"]
        if now.scalar is not None and self._info.scalar is not None:
            columns.append(now.scalar[:, None])
            names.append(_plain(self._info.scalar.name))
        table = np.ascontiguousarray(np.hstack(columns), dtype="<f4")
        listed = [
            {"name": name, "offset": 4 * column, "datatype": FLOAT32, "count": 1} for column, name in enumerate(names)
        ]
        fields = {
            "header": _header(message, self._frame),
            "height": 1,
            "width": len(table),
            "fields": [RosMessage("sensor_msgs/msg/PointField", one) for one in listed],
            "is_bigendian": False,
            "point_step": 4 * len(names),
            "row_step": table.nbytes,
            "data": table.view(np.uint8).ravel(),
            "is_dense": bool(np.isfinite(table).all()),
        }
        return RosMessage("sensor_msgs/msg/PointCloud2", fields)

    def _parameters(self, message: FrameMessage, now: ObjectMessage) -> RosMessage:
        """A row for each parameter: its value and standard deviation, SI."""
        names = ", ".join(f"{one.name} [{one.unit}]" for one in self._info.parameters)
        d = len(self._info.parameters)
        sizes = ((names, d, 2 * d), ("value, standard deviation", 2, 2))
        dimensions = [
            RosMessage("std_msgs/msg/MultiArrayDimension", {"label": label, "size": size, "stride": stride})
            for label, size, stride in sizes
        ]
        layout = RosMessage("std_msgs/msg/MultiArrayLayout", {"dim": dimensions, "data_offset": 0})
        data = np.column_stack([now.parameters, now.parameter_std]).ravel()
        return RosMessage("std_msgs/msg/Float64MultiArray", {"layout": layout, "data": data})

    def _wrench_of(self, support: str) -> Callable[[FrameMessage, ObjectMessage], RosMessage | None]:
        """What a support exerts on the object, in the support's own frame."""

        def wrench(message: FrameMessage, now: ObjectMessage) -> RosMessage | None:
            if support not in now.reactions:
                return None
            reaction = now.reactions[support]
            parts = {"force": _vector(reaction.force), "torque": _vector(reaction.moment)}
            header = _header(message, self._held[support])
            fields = {"header": header, "wrench": RosMessage("geometry_msgs/msg/Wrench", parts)}
            return RosMessage("geometry_msgs/msg/WrenchStamped", fields)

        return wrench


def _header(message: FrameMessage, frame: str) -> RosMessage:
    """By the clock for live frames, by the recording's time for others."""
    nanoseconds = round(1e9 * (message.timestamp if message.captured is None else message.captured))
    stamp = {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}
    return RosMessage(
        "std_msgs/msg/Header", {"stamp": RosMessage("builtin_interfaces/msg/Time", stamp), "frame_id": frame}
    )


def _colour(rgba: Sequence[float]) -> RosMessage:
    return RosMessage("std_msgs/msg/ColorRGBA", dict(zip("rgba", rgba, strict=True)))


def _vector(values: NDArray) -> RosMessage:
    return RosMessage("geometry_msgs/msg/Vector3", dict(zip("xyz", map(float, values), strict=True)))


def _quaternion(pose: RigidTransform) -> RosMessage:
    values = Rotation.from_matrix(pose.rotation).as_quat(canonical=True)
    return RosMessage("geometry_msgs/msg/Quaternion", dict(zip("xyzw", map(float, values), strict=True)))


def _pose(pose: RigidTransform) -> RosMessage:
    position = dict(zip("xyz", map(float, pose.translation), strict=True))
    fields = {"position": RosMessage("geometry_msgs/msg/Point", position), "orientation": _quaternion(pose)}
    return RosMessage("geometry_msgs/msg/Pose", fields)


def _plain(name: str) -> str:
    """A name as ROS takes it: letters, digits and underscores, with a letter first."""
    plain = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_") or "object"
    return plain if plain[0].isalpha() else f"n{plain}"


def _unique(names: Sequence[str]) -> list[str]:
    """The names as ROS takes them, each only once."""
    return _distinct(list(map(_plain, names)))


def _distinct(names: Sequence[str], taken: Sequence[str] = ()) -> list[str]:
    """The names, numbered from the second on where one repeats or is ``taken``."""
    found = list(taken)
    for plain in names:
        candidates = chain([plain], (f"{plain}_{number}" for number in count(2)))
        found.append(next(name for name in candidates if name not in found))
    return found[len(taken) :]


def _support_frames(objects: Sequence[ObjectInfo], frames: Sequence[str], taken: Sequence[str]) -> list[dict[str, str]]:
    """By object, the frame of each support; one name of all in the tree, where each frame has one parent."""
    asked = [(k, support) for k, info in enumerate(objects) for support in info.supports]
    plain = [f"{frames[k]}_{_plain(support)}" for k, support in asked]
    found: list[dict[str, str]] = [{} for _ in objects]
    for (k, support), name in zip(asked, _distinct(plain, taken), strict=True):
        found[k][support] = name
    return found
