"""Binary glTF 2.0 (.glb): the visible surface, its modes as morph targets, the functions as an animation.

A separated displacement is what glTF calls morph targets: position = rest + sum_i weight_i target_i, with
the modes F_i as targets and the functions H_i(mu) as weights. Normals are left out on purpose: a viewer then
has to use those of the deformed triangles, where morphed normals would be wrong.

Source: Khronos Group, glTF 2.0 Specification, sections 3.7.2 (morph targets), 3.11 (animations), 4 (GLB).
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam import __version__
from morph_dslam.model import ReducedModel

Array = NDArray[np.float64]

FRAMES_PER_SECOND = 12.0

_FLOAT, _UNSIGNED_INT = 5126, 5125
_VERTICES, _INDICES = 34962, 34963
#: glTF's y points up and its z to the viewer; this turn makes our z point up, and Blender turns it back.
_Z_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]


class _Buffer:
    """Arrays of 4-byte numbers behind one another, with the accessors that describe them."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.length = 0
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: NDArray, target: int | None = None) -> int:
        """Append an array of floats or indices, (n,) or (n, 3); returns the number of its accessor."""
        index = np.issubdtype(array.dtype, np.integer)
        data = np.ascontiguousarray(array, dtype="<u4" if index else "<f4")
        view: dict[str, Any] = {"buffer": 0, "byteOffset": self.length, "byteLength": data.nbytes}
        if target is not None:
            view["target"] = target
        low, high = (np.atleast_1d(part).tolist() for part in (data.min(axis=0), data.max(axis=0)))
        accessor = {
            "bufferView": len(self.views),
            "componentType": _UNSIGNED_INT if index else _FLOAT,
            "count": len(data),
            "type": "SCALAR" if data.ndim == 1 else "VEC3",
            "min": low,
            "max": high,
        }
        self.parts.append(data.tobytes())
        self.length += data.nbytes
        self.views.append(view)
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def _animation(buffer: _Buffer, weights: Array) -> dict[str, Any]:
    times = np.arange(len(weights)) / FRAMES_PER_SECOND
    sampler = {"input": buffer.add(times), "output": buffer.add(weights.ravel()), "interpolation": "LINEAR"}
    channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
    return {"name": "parameters", "samplers": [sampler], "channels": [channel]}


def _document(model: ReducedModel, states: Array) -> tuple[dict[str, Any], bytes]:
    """The JSON part and the binary part."""
    buffer = _Buffer()
    nodes, triangles = np.unique(model.triangles, return_inverse=True)
    weights = np.array([model.displacement.functions.evaluate(mu)[0] for mu in states])
    primitive = {
        "attributes": {"POSITION": buffer.add(model.nodes[nodes], _VERTICES)},
        "indices": buffer.add(triangles.ravel(), _INDICES),
        "material": 0,
        "targets": [{"POSITION": buffer.add(mode[nodes], _VERTICES)} for mode in model.displacement.modes],
    }
    names = [f"mode {i + 1}" for i in range(model.displacement.n_modes)]
    mesh = {
        "name": model.name,
        "primitives": [primitive],
        "weights": weights[0].astype(np.float32).tolist(),
        "extras": {"targetNames": names},
    }
    grey = {"baseColorFactor": [0.62, 0.68, 0.74, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.7}
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"morph-dslam {__version__}"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": model.name, "mesh": 0, "rotation": _Z_UP}],
        "meshes": [mesh],
        "materials": [{"name": "surface", "pbrMetallicRoughness": grey, "doubleSided": True}],
    }
    if len(states) > 1:
        document["animations"] = [_animation(buffer, weights)]
    document |= {
        "buffers": [{"byteLength": buffer.length}],
        "bufferViews": buffer.views,
        "accessors": buffer.accessors,
    }
    return document, b"".join(buffer.parts)


def write_glb(path: Path, model: ReducedModel, states: Array) -> None:
    """Write the displacement of ``model`` along ``states`` (s, d); metres, z up in the object frame."""
    document, binary = _document(model, states)
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    with path.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary)))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", len(binary), b"BIN\0") + binary)
