"""Commands that place an object: in a mapped scene (`morph register`), or help to (`morph board`)."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from morph_dslam.errors import RegistrationError


def _register(arguments: argparse.Namespace) -> None:
    from morph_dslam.registration.board_in_map import register_by_board
    from morph_dslam.registration.run import registration_line, remarks, run_registration

    if arguments.board is not None and arguments.beside:
        raise RegistrationError("a board says where the object is: leave out --beside")
    if arguments.board is not None:
        content = register_by_board(arguments.map, arguments.model, arguments.camera, arguments.board, arguments.output)
        print(f"wrote {arguments.output / 'registration.json'}")
        print(registration_line(content))
        return
    content = run_registration(arguments.map, arguments.model, arguments.camera, arguments.output, arguments.beside)
    for remark in remarks(content):
        print(f"note: {remark}")
    print(f"wrote {arguments.output / 'registration.json'} and registration.jpg")
    print(registration_line(content))


def _board(arguments: argparse.Namespace) -> None:
    from morph_dslam.registration.board import load_board, print_board

    board = load_board(arguments.board)
    print_board(board, arguments.output)
    width, height = (1e3 * side for side in board.size)
    print(f"wrote {arguments.output}: {width:g} x {height:g} mm without its margin; print it in its true size")


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
    register.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER", help="folder to write")
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
    board.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="PNG or PDF file to write")


# Commands for structures inside of a solid: `morph inner`.


def _inner(arguments: argparse.Namespace) -> None:
    from morph_dslam.model import load_model
    from morph_dslam.model.inner_structure import save_inner_structure
    from morph_dslam.studies.build import read_inner_structure

    model = load_model(arguments.model)
    name = arguments.name or arguments.surface.stem
    structure = read_inner_structure(model, name, arguments.surface, arguments.unit)
    save_inner_structure(arguments.output, structure)
    print(f"wrote {arguments.output}: '{name}', {len(structure.rest)} nodes inside of '{model.name}'")


def add_inner_commands(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add the command; ``add(name, action, kept, text)`` makes its parser."""
    inner = add(
        "inner",
        _inner,
        "nothing was written",
        "place a surface (a tumour, a vessel) inside of a solid, to be carried along by its model",
    )
    inner.add_argument("surface", type=Path, help=".stl, .obj or .ply file, drawn in the object's frame")
    inner.add_argument("--model", type=Path, required=True, help="model file of the solid")
    inner.add_argument("--unit", required=True, choices=("m", "cm", "mm"), help="unit of the file's coordinates")
    inner.add_argument("--name", help="shown in results and video (default: the file's name)")
    inner.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="file to write")
