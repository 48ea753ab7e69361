"""`morph board`: a board of markers to print."""

import argparse

from morph_dslam.cli.arguments import add_file, add_output

HELP = "print a board of markers that places an object"
KEPT = "nothing was written"


def add_arguments(command: argparse.ArgumentParser) -> None:
    add_file(command, "board", "board file (docs/registration-aids.md)")
    add_output(command, "FILE", "PNG or PDF file to write")


def run(arguments: argparse.Namespace) -> None:
    from morph_dslam.extend.registration import load_board, print_board

    board = load_board(arguments.board)
    print_board(board, arguments.output)
    width, height = (1e3 * side for side in board.size)
    print(f"wrote {arguments.output}: {width:g} x {height:g} mm without its margin; print it in its true size")
