"""`morph studio`: from a mesh and a video to stress, in the browser."""

import argparse
from importlib.util import find_spec
from pathlib import Path

from morph_dslam.cli.arguments import add_flag
from morph_dslam.errors import StudioError, how_to_install

HELP = "build, place and track your own object by clicks in the browser"
KEPT = "the files of the project are kept"
#: What the extra installs, by the name to import.
_EXTRA = ("cryptography", "starlette", "tomlkit", "uvicorn", "websockets")


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "folder", type=Path, nargs="?", default=Path(), metavar="FOLDER", help="project folder (default: this one)"
    )
    command.add_argument("--port", type=int, default=8766, metavar="N", help="0: any (default: %(default)s)")
    command.add_argument(
        "--host", default="127.0.0.1", metavar="ADDRESS", help="listen at this address (default: this computer only)"
    )
    add_flag(
        command, "--phone", "let a phone in the network record, or be the live camera, over HTTPS at the next port"
    )
    add_flag(command, "--open", "open the browser at once")


def run(arguments: argparse.Namespace) -> None:
    missing = [name for name in _EXTRA if find_spec(name) is None]
    if missing:
        raise StudioError(
            f"morph studio needs {', '.join(missing)}, which is not installed: {how_to_install('studio')}"
        )
    from morph_dslam import open_studio

    open_studio(arguments.folder, arguments.port, arguments.host, arguments.open, arguments.phone)
