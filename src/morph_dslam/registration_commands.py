"""Commands that place an object: in a mapped scene (`morph register`), or help to (`morph board`)."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from morph_dslam.errors import RegistrationError


def _register(arguments: argparse.Namespace) -> None:
    from morph_dslam.online.aids.board_in_map import register_by_board
    from morph_dslam.online.mesh_registration.run import registration_line, remarks, run_registration

    if arguments.board is not None and arguments.beside:
        raise RegistrationError("a board says where the object is: leave out --beside")
    if arguments.board is not None:
        content = register_by_board(
            arguments.map, arguments.model, arguments.camera, arguments.board, arguments.output
        )
        print(f"wrote {arguments.output / 'registration.json'}")
        print(registration_line(content))
        return
    content = run_registration(
        arguments.map, arguments.model, arguments.camera, arguments.output, arguments.beside
    )
    for remark in remarks(content):
        print(f"note: {remark}")
    print(f"wrote {arguments.output / 'registration.json'} and registration.jpg")
    print(registration_line(content))


def _board(arguments: argparse.Namespace) -> None:
    from morph_dslam.online.aids.board import load_board, print_board

    board = load_board(arguments.board)
    print_board(board, arguments.output)
    width, height = (1e3 * side for side in board.size)
    print(
        f"wrote {arguments.output}: {width:g} x {height:g} mm without its margin; print it in its true size"
    )


def add_registration_commands(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add the commands; ``add(name, action, kept, text)`` makes its parser."""
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
    register.add_argument(
        "--board",
        type=Path,
        metavar="TOML",
        help="place the object, and find the map's unit, by a board that stands in the scene",
    )
    register.add_argument(
        "--beside",
        type=Path,
        action="append",
        default=[],
        metavar="JSON",
        help="registration.json of another object in this map, to which its points are left; may be repeated",
    )
    board = add("board", _board, "nothing was written", "print a board of markers that places an object")
    board.add_argument("board", type=Path, help="board file (docs/registration-aids.md)")
    board.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="PNG or PDF file to write"
    )
