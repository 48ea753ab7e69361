"""`morph register`: an undeformed object in the map of a scene."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "find an undeformed object in the map of a scene, and the size of the map's unit"
KEPT = "nothing was written"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("map", type=Path, help="map.h5 of a run of `morph slam`")
    command.add_argument("--model", type=Path, required=True, help="model file of the object")
    command.add_argument("--camera", type=Path, required=True, help="camera file of the map")
    command.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER", help="folder to write")
    command.add_argument(
        "--board",
        type=Path,
        metavar="TOML",
        help="register the object, and find the map's unit, by a board that stands in the scene",
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
    from morph_dslam.extend.registration import registration_line, run_registration

    registration = run_registration(
        arguments.map, arguments.model, arguments.camera, arguments.output, arguments.beside, arguments.board
    )
    for warning in registration.warnings:
        print(f"note: {warning.text}")
    picture = "" if arguments.board else " and registration.jpg"
    print(f"wrote {arguments.output / 'registration.json'}{picture}")
    print(registration_line(registration))
