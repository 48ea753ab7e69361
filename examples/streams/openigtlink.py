"""Sends a stream on by OpenIGTLink, to 3D Slicer say: the object's pose as TRANSFORM, its surface as POLYDATA.

    python examples/streams/openigtlink.py 'http://127.0.0.1:8767/?token=...'

with the address that `morph` printed. It listens at this computer's port 18944, where an OpenIGTLink client connects.
Lengths are in millimetres. OBJECT has the surface in the object's frame, with the value at each vertex in the unit that
people read; OBJECT_pose takes it into the camera's frame. Structures inside have their own names, and the same frame.
Names longer than OpenIGTLink allows are cut, and numbered where two would be the same.
"""

from __future__ import annotations

import argparse
import socket
import struct
import threading
from typing import Any

import numpy as np
from client import messages, run
from numpy.typing import NDArray

PORT = 18944
#: Seconds after which a client that takes nothing is left.
PATIENCE = 2.0
#: Of the header: version, type, device, seconds and their fraction, size and check sum of the body.
HEADER = struct.Struct(">H12s20sIIQQ")
VERSION = 1
#: Bytes in the name of a device.
MOST_BYTES = 20
#: An attribute of points with one component.
SCALAR = 0


def _crc_table() -> list[int]:
    table = []
    for byte in range(256):
        value = byte << 56
        for _ in range(8):
            value = (value << 1) ^ (0x42F0E1EBA9EA3693 if value >> 63 else 0)
            value &= (1 << 64) - 1
        table.append(value)
    return table


_TABLE = _crc_table()


def crc64(data: bytes) -> int:
    """The check sum of ECMA-182."""
    value = 0
    for byte in data:
        value = ((value << 8) & 0xFFFFFFFFFFFFFFFF) ^ _TABLE[(value >> 56) ^ byte]
    return value


def packed(kind: str, device: str, body: bytes, seconds: float) -> bytes:
    """A message of version 1 with its header; a device's name has `MOST_BYTES` at most.

    A time that the header cannot hold is sent as 0: before 0, or not below 2**32 s, as in nanoseconds since 1970.
    """
    seconds = seconds if 0.0 <= seconds < 2**32 else 0.0
    whole = int(seconds)
    fraction = int((seconds - whole) * 2**32)
    name = device.encode()
    return HEADER.pack(VERSION, kind.encode(), name, whole, fraction, len(body), crc64(body)) + body


def transform_body(matrix: NDArray) -> bytes:
    """The body of TRANSFORM: the upper three rows of a matrix (4, 4), column by column."""
    return np.asarray(matrix, dtype=">f4")[:3].T.tobytes()


def polydata_body(points: NDArray, triangles: NDArray, name: str = "", values: NDArray | None = None) -> bytes:
    """The body of POLYDATA.

    Parameters
    ----------
    points : (n, 3).
    triangles : (m, 3) in these points.
    name : of the values.
    values : (n,) at the points; None for none.
    """
    polygons = np.column_stack([np.full(len(triangles), 3), triangles]).astype(">u4").tobytes()
    # Points; number and size of vertices, lines, polygons and strips; attributes.
    head = (len(points), 0, 0, 0, 0, len(triangles), len(polygons), 0, 0, int(values is not None))
    body = struct.pack(">10I", *head) + np.asarray(points, dtype=">f4").tobytes() + polygons
    if values is None:
        return body
    text = name.encode() + b"\0"
    padding = b"\0" * (len(text) % 2)
    return body + struct.pack(">BBI", SCALAR, 1, len(values)) + text + padding + values.astype(">f4").tobytes()


def device_names(scene: dict[str, Any]) -> dict[tuple[str, ...], str]:
    """The devices of a stream, no two of one name: a client takes these for one and the same.

    Returns
    -------
    By (object,), (object, "pose") and (object, "inner", structure).
    """
    found: dict[tuple[str, ...], str] = {}
    for known in scene["objects"]:
        name = known["name"]
        inner = {(name, "inner", structure): (structure, "") for structure in known["inner"]}
        wanted = {(name,): (name, ""), (name, "pose"): (name, "_pose"), **inner}
        for key, (stem, ending) in wanted.items():
            device, number = _cut(stem, ending), 1
            while device in found.values():
                number += 1
                device = _cut(stem, f"_{number}{ending}")
            found[key] = device
    return found


def _cut(stem: str, ending: str) -> str:
    """A name that fits, of whole letters."""
    return stem.encode()[: MOST_BYTES - len(ending)].decode(errors="ignore") + ending


def frame_messages(scene: dict[str, Any], frame: dict[str, Any]) -> bytes:
    """TRANSFORM of each object that is not lost, and POLYDATA of each whose shape is known and of what it has inside.

    Parameters
    ----------
    scene : message of a stream.
    frame : message of the same stream.
    """
    seconds, parts, devices = frame["captured"] or frame["timestamp"], [], device_names(scene)
    for known, now in zip(scene["objects"], frame["objects"], strict=True):
        name = now["name"]
        if now["camera_from_object"] is not None:
            matrix = np.array(now["camera_from_object"])
            matrix[:3, 3] *= 1e3
            parts.append(packed("TRANSFORM", devices[name, "pose"], transform_body(matrix), seconds))
        if (vertices := frame["arrays"].get(f"{name}/vertices")) is None:
            continue
        triangles = scene["arrays"][f"{name}/triangles"].reshape(-1, 3)
        label, values = "", frame["arrays"].get(f"{name}/scalar")
        if values is not None:
            label, values = known["scalar"]["name"], values / known["scalar"]["shown_factor"]
        body = polydata_body(1e3 * vertices.reshape(-1, 3), triangles, label, values)
        parts.append(packed("POLYDATA", devices[name,], body, seconds))
        for inner in known["inner"]:
            array = f"{name}/inner/{inner}"
            vertices = frame["arrays"][f"{array}/vertices"].reshape(-1, 3)
            triangles = scene["arrays"][f"{array}/triangles"].reshape(-1, 3)
            parts.append(
                packed("POLYDATA", devices[name, "inner", inner], polydata_body(1e3 * vertices, triangles), seconds)
            )
    return b"".join(parts)


def relay(address: str, server: socket.socket) -> None:
    """Send a stream to all who connect to ``server``, until it ends."""
    clients: list[socket.socket] = []

    def accept() -> None:
        while True:
            try:
                client = server.accept()[0]
            except OSError:  # the server was closed
                return
            client.settimeout(PATIENCE)
            clients.append(client)

    threading.Thread(target=accept, daemon=True).start()
    scene: dict[str, Any] = {}
    for message in messages(address):
        if message["type"] == "scene":
            scene = message
            continue
        data = frame_messages(scene, message) if clients else b""
        for client in tuple(clients):
            try:
                client.sendall(data)
            except OSError:  # it has gone, or takes nothing
                clients.remove(client)
    server.close()
    for client in clients:
        client.close()


def main() -> None:
    """Send on what comes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("address", help="that morph printed, with the token")
    parser.add_argument("--port", type=int, default=PORT, help="to listen at (default: %(default)s)")
    arguments = parser.parse_args()
    try:
        server = socket.create_server(("127.0.0.1", arguments.port))
    except OSError as error:
        raise ConnectionError(
            f"port {arguments.port} cannot be listened at ({error.strerror}): give another one with --port"
        ) from error
    relay(arguments.address, server)


if __name__ == "__main__":
    run(main)
