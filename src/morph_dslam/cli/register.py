"""`morph register`: an undeformed object in the map of a scene."""

from __future__ import annotations

import argparse
from pathlib import Path

from morph_dslam.errors import RegistrationError

HELP = "find an undeformed object in the map of a scene, and the size of the map's unit"
KEPT = "nothing was written"


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    command.add_argument("map", type=Path, help="map.h5 of a run of `morph slam`")
    command.add_argument("--model", type=Path, required=True, help="model file of the object")
    command.add_argument("--camera", type=Path, required=True, help="camera file of the map")
    command.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER", help="folder to write")
    command.add_argument(
        "--board",
        type=Path,
        metavar="TOML",
        help="place the object, and find the map's unit, by a board that stands in the scene",
    )
    command.add_argument(
        "--beside",
        type=Path,
        action="append",
        default=[],
        metavar="JSON",
        help="registration.json of another object in this map, to which its points are left; may be repeated",
    )


def run(arguments: argparse.Namespace) -> None:
    """Register the object and print how well it fits."""
    from morph_dslam.registration.board_in_map import register_by_board
    from morph_dslam.registration.run import registration_line, remarks, run_registration

    inputs = (arguments.map, arguments.model, arguments.camera)
    if arguments.board is not None:
        if arguments.beside:
            raise RegistrationError("a board says where the object is: leave out --beside")
        content, picture = register_by_board(*inputs, arguments.board, arguments.output), ""
    else:
        content, picture = run_registration(*inputs, arguments.output, arguments.beside), " and registration.jpg"
        for remark in remarks(content):
            print(f"note: {remark}")
    print(f"wrote {arguments.output / 'registration.json'}{picture}")
    print(registration_line(content))
