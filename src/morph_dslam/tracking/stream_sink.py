"""A sink that sends each frame's results to other programs: over the network, to viewers, to robots' software."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import StreamError
from morph_dslam.model import Parameter, ReducedModel
from morph_dslam.model.inner_structure import CarriedStructure
from morph_dslam.model.shown_field import Shown, ShownField, shown_field, surface_points
from morph_dslam.streams.destinations import open_destination
from morph_dslam.streams.messages import (
    FrameMessage,
    InnerInfo,
    ObjectInfo,
    ObjectMessage,
    ParameterInfo,
    Publisher,
    ReactionMessage,
    ScalarInfo,
    SceneMessage,
)
from morph_dslam.tracking.displacement_jumps import near_jumps
from morph_dslam.tracking.estimator import Estimate
from morph_dslam.tracking.outcomes import may_be_mistaken
from morph_dslam.tracking.reactions import Reactions
from morph_dslam.tracking.result import FrameResult
from morph_dslam.tracking.sinks import TrackedFrame
from morph_dslam.units import FACTORS


@dataclass(frozen=True)
class StreamedObject:
    """What streams tell of an object.

    Attributes
    ----------
    model : of the object.
    name : that streams call it by; that of its tracker if empty.
    show : what colours it; None for the stress of a model that has it, else the displacement.
    field : what colours the surface, where it is drawn as well; None to make one.
    inner : structures inside that are sent too.
    """

    model: ReducedModel
    name: str = ""
    show: Shown | None = None
    field: ShownField | None = None
    inner: Sequence[CarriedStructure] = ()


class StreamSink:
    """Sends the results of a session to other programs (docs/streams.md); a context manager.

    Parameters
    ----------
    destinations : "ws:8767" say; or publishers of one's own.
    overwrite : whether to replace a file that holds an earlier recording.

    Raises
    ------
    StreamError
        If there is no such destination, what it needs is not installed, it cannot be taken, or it is a file that is not
        to be replaced.
    """

    def __init__(self, destinations: Sequence[str | Publisher], overwrite: bool = False) -> None:
        self._objects: dict[str, _ObjectMessages] = {}
        self._number = 0
        with ExitStack() as stack:
            self.publishers: list[Publisher] = []
            for where in destinations:
                publisher = open_destination(where, overwrite) if isinstance(where, str) else where
                stack.callback(publisher.close)
                self.publishers.append(publisher)
            self._stack = stack.pop_all()

    def begin(self, objects: Mapping[str, ReducedModel | StreamedObject], camera: Camera) -> StreamSink:
        """Tell what will be tracked; returns the sink.

        Parameters
        ----------
        objects : by the names of the session's trackers.
        camera : of the frames; the first one of several.

        Raises
        ------
        TrackingError
            If a model does not hold the field that is to be shown.
        """
        listed = {name: StreamedObject(one) if isinstance(one, ReducedModel) else one for name, one in objects.items()}
        self._objects = {name: _ObjectMessages(one.name or name, one) for name, one in listed.items()}
        scene = SceneMessage(camera, tuple(part.info for part in self._objects.values()))
        for publisher in self.publishers:
            publisher.begin(scene)
        return self

    def __enter__(self) -> StreamSink:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Tell receivers that no frame will follow; once is enough."""
        self._stack.close()

    def __call__(self, tracked: TrackedFrame) -> None:
        """Send a frame on, if anybody wants it; raises StreamError before `begin`, or if that named another object."""
        if not self._objects:
            raise StreamError("the stream does not know what is tracked: call its method begin(objects, camera) first")
        if missing := [name for name in self._objects if name not in tracked.results]:
            raise StreamError(
                f"the stream was begun with the object '{missing[0]}', and the session tracks "
                f"{', '.join(tracked.results)}: give begin(objects, camera) the names of the session's trackers"
            )
        number, self._number = self._number, self._number + 1
        watched = [publisher for publisher in self.publishers if publisher.is_watched]
        if not watched:
            return
        frame, captured = tracked.frame, tracked.frame.captured
        message = FrameMessage(
            number,
            frame.index,
            frame.timestamp,
            None if captured is None else time.time() - (time.monotonic() - captured),
            np.asarray(frame.image, dtype=np.uint8),
            partial(_described, self._objects, tracked.results),
        )
        for publisher in watched:
            publisher.publish(message)


def _described(objects: Mapping[str, _ObjectMessages], results: Mapping[str, FrameResult]) -> tuple[ObjectMessage, ...]:
    return tuple(part.message(results[name]) for name, part in objects.items())


class _ObjectMessages:
    """Makes the messages of one object."""

    def __init__(self, name: str, streamed: StreamedObject) -> None:
        model = streamed.model
        points, triangles = surface_points(model)
        kind = shown_field(model, streamed.show)
        self._rest = model.rest_positions(points)
        self._field, self._reactions = streamed.field or ShownField(model, points, kind), Reactions(model)
        self._inner = tuple(streamed.inner)
        self._covers_jumps, self._si_factor = kind == "displacement", self._field.kind.si_factor
        self.info = ObjectInfo(
            name,
            model.name,
            self._rest,
            triangles,
            points.corners[:, 0],
            tuple(map(_parameter_info, model.study_parameters)),
            _scalar_info(self._field) if model.parameters else None,
            tuple(self._reactions.names),
            tuple(InnerInfo(one.name, one.rest, one.triangles) for one in self._inner),
        )

    def message(self, result: FrameResult) -> ObjectMessage:
        """The object in a frame."""
        found = result.estimate
        vertices, scalar = (None, None) if found is None else self._surface(result, found)
        reactions, inside = {}, dict[str, NDArray[np.float32]]()
        if found is not None:
            reactions, mu = self._reactions(found, result.modulus_std), found.state.parameters
            inside = {one.name: one.nodes(mu, result.discrepancy).astype(np.float32) for one in self._inner}
        return ObjectMessage(
            self.info.name,
            result.status.value,
            result.reason,
            result.pose,
            result.pose_std,
            np.array(list(result.parameters.values())),
            np.array(list(result.parameter_std.values())),
            vertices,
            scalar,
            {
                name: ReactionMessage(
                    one.point, one.force.value, one.force.std, one.force.size_std, one.moment.value, one.moment.std
                )
                for name, one in reactions.items()
            },
            inside,
        )

    def _surface(self, result: FrameResult, found: Estimate) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """Vertices (n, 3), and the field (n,) in SI where the object has one."""
        mu = found.state.parameters
        displacement = self._field.displacement(mu)
        if result.discrepancy is not None:
            displacement = displacement + result.discrepancy.displacement(self._rest)
        vertices = (self._rest + displacement).astype(np.float32)
        if self.info.scalar is None:
            return vertices, None
        values = self._si_factor * self._field.values(mu, displacement)
        if not self._covers_jumps:
            mistaken = may_be_mistaken(result.warnings)
            values = np.where(mistaken | near_jumps(result.jumps, self._rest), np.nan, values)
        return vertices, values.astype(np.float32)


def _parameter_info(parameter: Parameter) -> ParameterInfo:
    units = FACTORS[parameter.quantity]
    unit = next(name for name, factor in units.items() if factor == 1.0)
    return ParameterInfo(
        parameter.name,
        parameter.description,
        unit,
        parameter.unit,
        units[parameter.unit],
        parameter.lower,
        parameter.upper,
    )


def _scalar_info(field: ShownField) -> ScalarInfo:
    low, high = field.range_of_box()
    shown = field.kind
    return ScalarInfo(
        shown.name, shown.si_unit, shown.unit, shown.si_factor, low * shown.si_factor, high * shown.si_factor
    )
