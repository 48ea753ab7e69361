"""A client of `morph track --stream ws` in a few lines: it needs numpy and websockets, and nothing of morph-dslam.

    python examples/streams/client.py 'http://127.0.0.1:8767/?token=...'

with the address that `morph` printed. It prints a line for each frame that it gets (docs/streams.md).
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect


def unpack(data: bytes) -> dict[str, Any]:
    """The head of a message, with its arrays by name under ``arrays``."""
    start = 4 + int.from_bytes(data[:4], "little")
    head, arrays = json.loads(data[4:start]), {}
    for name, kind, size in head["arrays"]:
        arrays[name] = np.frombuffer(data, kind, size, start)
        start += 4 * size
    return head | {"arrays": arrays}


def messages(address: str) -> Iterator[dict[str, Any]]:
    """The messages of a stream until it ends: the scene, then frames.

    Parameters
    ----------
    address : as `morph` printed it, with the token.
    """
    parts = urlsplit(address)
    with connect(f"ws://{parts.netloc}/stream?{parts.query}", max_size=None, compression=None) as socket:
        try:
            for data in socket:
                message = unpack(data)
                if message["type"] == "end":
                    return
                yield message
        except ConnectionClosed:
            return


def main() -> None:
    """Print what comes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("address", help="that morph printed, with the token")
    scene: dict[str, Any] = {}
    for message in messages(parser.parse_args().address):
        if message["type"] == "scene":
            scene = message
            continue
        for known, now in zip(scene["objects"], message["objects"], strict=True):
            values = [
                f"{one['name']}={value / one['shown_factor']:.4g} {one['shown_unit']}"
                for one, value in zip(known["parameters"], now["parameters"], strict=True)
                if value is not None
            ]
            scalar = message["arrays"].get(f"{now['name']}/scalar")
            if scalar is not None:
                shown = known["scalar"]
                largest = np.nanmax(scalar) / shown["shown_factor"]
                values.append(f"largest {shown['name']} {largest:.4g} {shown['shown_unit']}")
            print(f"frame {message['frame']}: {now['name']} {now['status']}", *values, flush=True)


if __name__ == "__main__":
    main()
