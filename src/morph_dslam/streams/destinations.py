"""Where streams go: KIND or KIND:WHERE as the command line takes them, and what opens them."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from morph_dslam.errors import StreamError, how_to_install
from morph_dslam.io.access import HOST
from morph_dslam.streams.messages import Publisher

DEFAULT_PORT = 8767
_FORMS = "ws, ws:PORT or ws:ADDRESS:PORT"


def _address(where: str) -> tuple[str, int]:
    """Address and port of "", "PORT", "ADDRESS:PORT" or "[ADDRESS]:PORT"."""
    host, _, port = where.rpartition(":")
    if not where:
        return HOST, DEFAULT_PORT
    if not port.isdecimal() or int(port) > 65535 or re.search(r"[\s/@?#]", host):
        raise StreamError(f"'ws:{where}' says no port: write {_FORMS}, with a port from 0 (any) to 65535")
    return host.strip("[]") or HOST, int(port)


def _open_websocket(where: str) -> Publisher:
    from morph_dslam.streams.websocket import WebSocketPublisher

    return WebSocketPublisher(*_address(where))


def _prefix(where: str) -> str:
    """Beginning of topics in ROS 2."""
    if where and not re.fullmatch(r"(/[A-Za-z]\w*)+", where, flags=re.ASCII):
        raise StreamError(f"'ros2:{where}' is no beginning of topics: write ros2, or ros2:/cell/morph say")
    return where or "/morph"


def _open_ros2(where: str) -> Publisher:
    from morph_dslam.streams.ros2 import RosPublisher

    return RosPublisher(_prefix(where))


def _recording(where: str) -> str:
    """File or address of rerun."""
    if where and not where.startswith("rerun+http"):
        path = Path(where)
        if path.suffix != ".rrd" or not path.parent.is_dir():
            raise StreamError(
                f"'rerun:{where}' is no place: write rerun to start a viewer, rerun:FILE.rrd in a folder that exists, "
                "or rerun:rerun+http://... for a viewer that runs"
            )
    return where


def _open_rerun(where: str) -> Publisher:
    from morph_dslam.streams.rerun import RerunPublisher

    return RerunPublisher(_recording(where))


def _recorded_file(where: str) -> Path | None:
    """The file that a stream to rerun writes, if it is none to a viewer."""
    return Path(where) if where and not where.startswith("rerun+http") else None


@dataclass(frozen=True)
class _Kind:
    """A kind of stream.

    Attributes
    ----------
    module : that it needs.
    mend : what to do where the module is missing.
    check : raises StreamError for a place that makes no sense.
    open : begins the stream.
    file : the file that a stream to a place writes; None where it writes none.
    """

    module: str
    mend: str
    check: Callable[[str], object]
    open: Callable[[str], Publisher]
    file: Callable[[str], Path | None] = lambda where: None


_ROS_MISSING = "install ROS 2, `source /opt/ros/DISTRIBUTION/setup.bash`, and start `morph` there"
_KINDS: dict[str, _Kind] = {
    "ws": _Kind("websockets", how_to_install("stream"), _address, _open_websocket),
    "rerun": _Kind("rerun", how_to_install("rerun"), _recording, _open_rerun, _recorded_file),
    "ros2": _Kind("rclpy", _ROS_MISSING, _prefix, _open_ros2),
}


def check_destination(text: str, overwrite: bool = False) -> None:
    """Raise StreamError unless ``text`` can be opened on this computer, see `open_destination`."""
    _kind_and_place(text, overwrite)


def open_destination(text: str, overwrite: bool = False) -> Publisher:
    """Begin a stream.

    Parameters
    ----------
    text : KIND or KIND:WHERE (docs/streams.md).
    overwrite : whether to replace a file that holds an earlier recording.

    Raises
    ------
    StreamError
        If there is no such kind, what it needs is not installed, the place cannot be taken, or it is a file that is not
        to be replaced.
    """
    kind, where = _kind_and_place(text, overwrite)
    return kind.open(where)


def _kind_and_place(text: str, overwrite: bool) -> tuple[_Kind, str]:
    name, colon, where = text.partition(":")
    kind = _KINDS.get(name)
    if kind is None or (colon and not where):
        raise StreamError(
            f"'{text}' is no stream: write {', '.join(_KINDS)}, or one of them with :WHERE behind it; programs that "
            "send a stream on in another form, OpenIGTLink for one, are in examples/streams"
        )
    kind.check(where)
    if find_spec(kind.module) is None:
        raise StreamError(f"--stream {name} needs {kind.module}, which is not installed: {kind.mend}")
    file = kind.file(where)
    if file is not None and not overwrite and file.is_file() and file.stat().st_size:
        raise StreamError(
            f"{file} holds an earlier recording: name another file, move this one, or allow it to be replaced "
            "(`--overwrite`)"
        )
    return kind, where
