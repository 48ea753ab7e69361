"""`morph board`: a board of markers to print."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "print a board of markers that places an object"
KEPT = "nothing was written"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("board", type=Path, help="board file (docs/registration-aids.md)")
    command.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="PNG or PDF file to write")


def run(arguments: argparse.Namespace) -> None:
    from morph_dslam.registration.board import load_board, print_board

    board = load_board(arguments.board)
    print_board(board, arguments.output)
    width, height = (1e3 * side for side in board.size)
    print(f"wrote {arguments.output}: {width:g} x {height:g} mm without its margin; print it in its true size")
