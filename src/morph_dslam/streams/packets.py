"""The messages as bytes, for the WebSocket: a JSON head and arrays (docs/streams.md)."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.io.packing import packed
from morph_dslam.streams.messages import FrameMessage, ObjectInfo, ObjectMessage, SceneMessage

PROTOCOL, VERSION = "morph-stream", 1


def scene_packet(scene: SceneMessage, colours: list[list[int]]) -> bytes:
    """The scene with all meshes.

    Parameters
    ----------
    scene : that is sent.
    colours : the colour map, red, green, blue, alpha from 0 to 255 of each step.
    """
    camera, arrays = scene.camera, {}
    for part in scene.objects:
        arrays[f"{part.name}/rest"] = part.rest
        arrays[f"{part.name}/triangles"] = part.triangles
        arrays[f"{part.name}/nodes"] = part.nodes
        for one in part.inner:
            arrays[f"{part.name}/inner/{one.name}/rest"] = one.rest
            arrays[f"{part.name}/inner/{one.name}/triangles"] = one.triangles
    facts = {
        "protocol": PROTOCOL,
        "version": VERSION,
        "type": "scene",
        "camera": {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
        "objects": [_object_facts(part) for part in scene.objects],
        "colours": colours,
    }
    return packed(facts, **arrays)


def frame_packet(message: FrameMessage) -> bytes:
    """A frame with the surfaces of all tracked objects."""
    arrays: dict[str, NDArray] = {}
    for part in message.objects:
        if part.vertices is not None:
            arrays[f"{part.name}/vertices"] = part.vertices
        if part.scalar is not None:
            arrays[f"{part.name}/scalar"] = part.scalar
        arrays |= {f"{part.name}/inner/{name}/vertices": vertices for name, vertices in part.inner.items()}
    facts = {
        "type": "frame",
        "number": message.number,
        "frame": message.frame,
        "timestamp": message.timestamp,
        "captured": message.captured,
        "objects": [_state_facts(part) for part in message.objects],
    }
    return packed(facts, **arrays)


def end_packet() -> bytes:
    """No frame will follow."""
    return packed({"type": "end"})


def _object_facts(part: ObjectInfo) -> dict[str, Any]:
    return {
        "name": part.name,
        "model": part.model,
        "parameters": [asdict(parameter) for parameter in part.parameters],
        "scalar": None if part.scalar is None else asdict(part.scalar),
        "supports": list(part.supports),
        "inner": [one.name for one in part.inner],
    }


def _state_facts(part: ObjectMessage) -> dict[str, Any]:
    pose = part.camera_from_object
    return {
        "name": part.name,
        "status": part.status,
        "text": part.text,
        "camera_from_object": None if pose is None else pose.matrix.tolist(),
        "pose_std": _numbers(part.pose_std),
        "parameters": _numbers(part.parameters),
        "parameter_std": _numbers(part.parameter_std),
        "reactions": {
            name: {key: _numbers(value) if np.ndim(value) else _number(value) for key, value in vars(reaction).items()}
            for name, reaction in part.reactions.items()
        },
    }


def _numbers(values: NDArray[np.float64]) -> list[float | None]:
    """A list for JSON, which knows no NaN and no infinity: None where a value is not known."""
    return list(map(_number, values))


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
