"""Commands that place an object in a mapped scene: `morph register`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path


def _register(arguments: argparse.Namespace) -> None:
    from morph_dslam.online.mesh_registration.run import registration_line, remarks, run_registration

    content = run_registration(arguments.map, arguments.model, arguments.camera, arguments.output)
    for remark in remarks(content):
        print(f"note: {remark}")
    print(f"wrote {arguments.output / 'registration.json'} and registration.jpg")
    print(registration_line(content))


def add_registration_commands(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add the command; ``add(name, action, kept, text)`` makes its parser."""
    register = add(
        "register",
        _register,
        "nothing was written",
        "find an undeformed object in the map of a scene, and the size of the map's unit",
    )
    register.add_argument("map", type=Path, help="map.h5 of a run of `morph slam`")
    register.add_argument("--model", type=Path, required=True, help="model file of the object")
    register.add_argument("--camera", type=Path, required=True, help="camera file of the map")
    register.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FOLDER", help="folder to write"
    )
