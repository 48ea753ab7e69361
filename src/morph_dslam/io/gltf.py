"""States of a model as an animation in binary glTF 2.0 (Khronos specification, sections 3.7.2, 3.11 and 4).

With colours, each state is a mesh with colours at its vertices, and the animation shows one after the other by the
scale of their nodes: zero hides a mesh (section 3.11, note on visibility). glTF can also change colours by morph
targets, but viewers need not heed them, and most do not. Without colours, modes are morph targets, and functions their
weights.

Normals are left out: a viewer then uses those of the triangles.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam._version import __version__
from morph_dslam.errors import ExportError
from morph_dslam.io.state_choice import States
from morph_dslam.model.inner_structure import SEE_THROUGH, CarriedStructure, colour_of
from morph_dslam.model.shown_field import Shown, ShownField, shown_field, surface_points

Array = NDArray[np.float64]
Colours = Literal["stress", "strain", "displacement", "none"]

#: What files call the program that wrote them; its version comes behind.
GENERATOR = "morph-dslam"
FRAMES_PER_SECOND = 12.0
COLOUR_MAP = "turbo"
#: Bytes of a vertex in one state: three floats, and a colour of four 16-bit numbers.
_VERTEX_BYTES = 20
#: Lengths in the file are unsigned 32-bit numbers; the rest is left for what is no vertex.
_MOST_BYTES = 2**32 - 2**28
_NUMBERS = {"f": (5126, "<f4"), "u": (5125, "<u4"), "i": (5125, "<u4")}
_COLOUR_NUMBERS = (5123, "<u2")
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_VERTICES, _INDICES = 34962, 34963
#: glTF's y points up and its z to the viewer; this turn makes our z point up, and Blender turns it back.
_Z_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]


class _Buffer:
    """Arrays behind one another, each a multiple of four bytes long, with the accessors that describe them."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.length = 0
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: NDArray, target: int | None = None) -> int:
        """Append floats, indices, or 16-bit colours, (n,) or (n, c); returns the number of its accessor."""
        is_colour = array.dtype == np.uint16
        number, stored = _COLOUR_NUMBERS if is_colour else _NUMBERS[array.dtype.kind]
        data = np.ascontiguousarray(array, dtype=stored)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": self.length, "byteLength": data.nbytes}
        if target is not None:
            view["target"] = target
        low, high = (np.atleast_1d(part).tolist() for part in (data.min(axis=0), data.max(axis=0)))
        accessor = {
            "bufferView": len(self.views),
            "componentType": number,
            "count": len(data),
            "type": _TYPES[data[0].size],
            "min": low,
            "max": high,
        }
        if is_colour:
            accessor["normalized"] = True
        self.parts.append(data.tobytes())
        self.length += data.nbytes
        self.views.append(view)
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def write_glb(path: Path, states: States, show: Colours | None = None) -> None:
    """Write the surface of a model along states of it; metres, z up in the object frame.

    Parameters
    ----------
    path : of the file.
    states : of the model.
    show : what colours it; by default the stress of a model that has it, else the displacement.

    Raises
    ------
    ParameterError
        If the model does not hold what is to be shown.
    ExportError
        If the file would be larger than glTF allows.
    """
    buffer, model = _Buffer(), states.model
    if show == "none" or not model.parameters:  # a rigid object has nothing to be coloured by
        content = _modes(buffer, states)
    else:
        content = _coloured(buffer, states, shown_field(model, show))
    document = {
        "asset": {"version": "2.0", "generator": f"{GENERATOR} {__version__}"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        **content,
        "buffers": [{"byteLength": buffer.length}],
        "bufferViews": buffer.views,
        "accessors": buffer.accessors,
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    with path.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + buffer.length))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", buffer.length, b"BIN\0"))
        file.writelines(buffer.parts)


def _materials(colour: list[float], inner: Sequence[CarriedStructure]) -> list[dict[str, Any]]:
    """That of the surface, which structures inside are seen through, and those of the structures."""
    surface = _material("surface", [*colour[:3], SEE_THROUGH if inner else 1.0])
    if inner:
        surface["alphaMode"] = "BLEND"
    colours = (_linear(np.array(colour_of(k)) / 255.0).tolist() for k in range(len(inner)))
    return [surface, *(_material(one.name, [*c, 1.0]) for one, c in zip(inner, colours, strict=True))]


def _material(name: str, colour: list[float]) -> dict[str, Any]:
    look = {"baseColorFactor": colour, "metallicFactor": 0.0, "roughnessFactor": 0.7}
    return {"name": name, "pbrMetallicRoughness": look, "doubleSided": True}


def _modes(buffer: _Buffer, states: States) -> dict[str, Any]:
    """The grey surface at rest, its modes as morph targets, and their weights; structures inside in the same way."""
    model = states.model
    nodes, triangles = np.unique(model.triangles, return_inverse=True)
    weights = np.array([model.displacement.functions.evaluate(mu)[0] for mu in states.parameters])

    def mesh(
        material: int, name: str, rest: Array, modes: NDArray[np.floating[Any]], corners: NDArray[np.int64]
    ) -> dict[str, Any]:
        primitive = {
            "attributes": {"POSITION": buffer.add(rest, _VERTICES)},
            "indices": buffer.add(corners.ravel(), _INDICES),
            "material": material,
            "targets": [{"POSITION": buffer.add(mode, _VERTICES)} for mode in modes],
        }
        return {
            "name": name,
            "primitives": [primitive],
            "weights": weights[0].astype(np.float32).tolist(),
            "extras": {"targetNames": [f"mode {i + 1}" for i in range(len(modes))]},
        }

    meshes = [mesh(0, model.name, model.nodes[nodes], model.displacement.modes[:, nodes], triangles)]
    for k, one in enumerate(states.inner):
        meshes.append(mesh(k + 1, one.name, one.rest, one.field.modes, one.triangles))
    top: dict[str, Any] = {"name": model.name, "mesh": 0, "rotation": _Z_UP}
    if states.inner:
        top["children"] = list(range(1, len(meshes)))
    content: dict[str, Any] = {
        "nodes": [top, *({"name": one["name"], "mesh": k + 1} for k, one in enumerate(meshes[1:]))],
        "meshes": meshes,
        "materials": _materials([0.62, 0.68, 0.74], states.inner),
    }
    if len(states) > 1:
        times = np.arange(len(weights)) / FRAMES_PER_SECOND
        sampler = {"input": buffer.add(times), "output": buffer.add(weights.ravel()), "interpolation": "LINEAR"}
        channels = [{"sampler": 0, "target": {"node": k, "path": "weights"}} for k in range(len(meshes))]
        content["animations"] = [{"name": "parameters", "samplers": [sampler], "channels": channels}]
    return content


def _coloured(buffer: _Buffer, states: States, show: Shown) -> dict[str, Any]:
    """A mesh a state, all but the first one hidden, and the animation that shows them in turn."""
    model = states.model
    points, triangles = surface_points(model)
    rest, field = model.nodes[points.corners[:, 0]], ShownField(model, points, show)
    count = len(rest) + sum(len(one.rest) for one in states.inner)
    size = _VERTEX_BYTES * count * len(states)
    if size > _MOST_BYTES:
        raise ExportError(
            f"{len(states)} states of {count} coloured points take {size / 2**30:.1f} GB, and a glTF file has "
            "4 GB at most: choose fewer states, or --show none, which writes the modes"
        )
    moved = [
        field.displacement(mu) + states.beyond_model(i, rest)
        for i, mu in enumerate(tqdm(states.parameters, desc="states", unit="state"))
    ]
    values = [field.values(mu, u) for mu, u in zip(states.parameters, moved, strict=True)]
    _, top = field.range_of(values)
    # Positions are relative to the middle, and nodes stand there, so that hidden ones do not widen what is framed.
    nodes: list[dict[str, Any]] = [{"name": model.name, "rotation": _Z_UP, "children": []}]
    middle, indices, meshes = rest.mean(axis=0), buffer.add(triangles.ravel(), _INDICES), []
    for i, u in enumerate(moved):
        attributes = {
            "POSITION": buffer.add(rest - middle + u, _VERTICES),
            "COLOR_0": buffer.add(_linear_colours(values[i] / top), _VERTICES),
        }
        primitive = {"attributes": attributes, "indices": indices, "material": 0}
        meshes.append({"name": f"state {i}", "primitives": [primitive]})
        scale = {} if i == 0 else {"scale": [0.0, 0.0, 0.0]}
        nodes.append({"name": f"state {i}", "mesh": i, "translation": middle.tolist(), **scale})
        nodes[0]["children"].append(i + 1)
    _add_inner(buffer, states, middle, nodes, meshes)
    colours = {"field": field.kind.name, "unit": field.kind.unit, "range": [0.0, top], "colour_map": COLOUR_MAP}
    nodes[0]["extras"] = {"colours": colours}
    content: dict[str, Any] = {"nodes": nodes, "meshes": meshes, "materials": _materials([1.0] * 3, states.inner)}
    if len(states) > 1:
        content["animations"] = [_turns(buffer, len(states))]
    return content


def _add_inner(
    buffer: _Buffer, states: States, middle: Array, nodes: list[dict[str, Any]], meshes: list[dict[str, Any]]
) -> None:
    """Below the node of each state (1, 2, ...) one for each structure inside, shown and hidden with it."""
    for k, structure in enumerate(states.inner):
        indices = buffer.add(structure.triangles.ravel(), _INDICES)
        for i in range(len(states)):
            at = structure.rest - middle + states.inner_displacement(structure, i)
            primitive = {"attributes": {"POSITION": buffer.add(at, _VERTICES)}, "indices": indices, "material": k + 1}
            nodes[i + 1].setdefault("children", []).append(len(nodes))
            nodes.append({"name": structure.name, "mesh": len(meshes)})
            meshes.append({"name": f"{structure.name}, state {i}", "primitives": [primitive]})


def _turns(buffer: _Buffer, count: int) -> dict[str, Any]:
    """Each node (1, 2, ...) is shown for the time of one state, and has no size before and after."""
    samplers, channels = [], []
    for i in range(count):
        sizes = {0.0: 0.0, i / FRAMES_PER_SECOND: 1.0, (i + 1) / FRAMES_PER_SECOND: float(i == count - 1)}
        times, shown = np.array(list(sizes)), np.array(list(sizes.values()))
        output = buffer.add(np.repeat(shown[:, None], 3, axis=1))
        samplers.append({"input": buffer.add(times), "output": output, "interpolation": "STEP"})
        channels.append({"sampler": i, "target": {"node": i + 1, "path": "scale"}})
    return {"name": "states", "samplers": samplers, "channels": channels}


def _linear_colours(shares: Array) -> NDArray[np.uint16]:
    """Colours (n, 4) of shares (n,) of the range."""
    import matplotlib  # it takes long to load, and not all who import this draw

    srgb = matplotlib.colormaps[COLOUR_MAP](np.clip(shares, 0.0, 1.0))
    srgb[:, :3] = _linear(srgb[:, :3])
    return np.round(65535 * srgb).astype(np.uint16)


def _linear(rgb: Array) -> Array:
    """Colours as glTF has them, linear, of those in sRGB (IEC 61966-2-1); both from 0 to 1."""
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
