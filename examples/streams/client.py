"""A client of `morph track --stream ws` in a few lines: it needs numpy and websockets, and nothing of morph-dslam.

    python examples/streams/client.py 'http://127.0.0.1:8767/?token=...'

with the address that `morph` printed. It prints a line for each frame that it gets (docs/streams.md).
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidURI
from websockets.sync.client import ClientConnection, connect

#: Seconds that a stream is waited for which nobody sends yet, and between two attempts.
PATIENCE, PAUSE = 10.0, 0.2


def unpack(data: bytes) -> dict[str, Any]:
    """The head of a message, with its arrays by name under ``arrays``."""
    start = 4 + int.from_bytes(data[:4], "little")
    head, arrays = json.loads(data[4:start]), {}
    for name, kind, size in head["arrays"]:
        arrays[name] = np.frombuffer(data, kind, size, start)
        start += 4 * size
    return head | {"arrays": arrays}


def connected(stack: ExitStack, address: str, patience: float = PATIENCE) -> ClientConnection:
    """A connection to a stream, which the stack closes; `morph` may begin to listen after this program has started.

    Raises
    ------
    ConnectionError
        If nothing listens at the address within so many seconds, or there is no stream at it.
    """
    parts, end = urlsplit(address), time.monotonic() + patience
    while True:
        try:
            url = f"ws://{parts.netloc}/stream?{parts.query}"
            return stack.enter_context(connect(url, max_size=None, compression=None))
        except OSError as error:
            if time.monotonic() > end:
                raise ConnectionError(
                    f"nothing listens at {parts.netloc} ({error.strerror or error}): start `morph` with --stream ws, "
                    "and give the address that it prints"
                ) from error
        except (InvalidHandshake, InvalidURI) as error:
            raise ConnectionError(
                f"there is no stream at this address ({error}): give the one that `morph` printed, with its token, in "
                "quotes"
            ) from error
        time.sleep(PAUSE)


def messages(address: str, patience: float = PATIENCE) -> Iterator[dict[str, Any]]:
    """The messages of a stream until it ends: the scene, then frames.

    Parameters
    ----------
    address : as `morph` printed it, with the token.
    patience : how many seconds it is waited for.

    Raises
    ------
    ConnectionError
        As `connected` does.
    """
    with ExitStack() as stack:
        socket = connected(stack, address, patience)
        try:
            for data in socket:
                message = unpack(data)
                if message["type"] == "end":
                    return
                yield message
        except ConnectionClosed:
            return


def run(main: Callable[[], None]) -> None:
    """Run a program; where there is no stream, one line says why, and the exit status is 2."""
    try:
        main()
    except ConnectionError as error:
        print(error, file=sys.stderr)
        raise SystemExit(2) from None


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
    run(main)
