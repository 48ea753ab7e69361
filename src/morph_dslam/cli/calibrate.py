"""`morph calibrate`: a camera's intrinsics and distortion."""

import argparse
from pathlib import Path

from morph_dslam.cli.arguments import add_output

HELP = "find a camera's intrinsics and distortion from pictures of a checkerboard"
KEPT = "nothing was written"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "source",
        type=Path,
        nargs="+",
        metavar="SOURCE",
        help="images, a folder of images, or a video (docs/cameras.md)",
    )
    command.add_argument(
        "--board", required=True, metavar="CORNERS", help="inner corners, where four squares meet, each way: 9x6"
    )
    command.add_argument("--square", required=True, metavar="LENGTH", help="side of one square with its unit: '25 mm'")
    command.add_argument(
        "--lens",
        choices=("radial-tangential", "fisheye"),
        default="radial-tangential",
        help="lens model: fisheye for views of more than about 120 degrees",
    )
    add_output(command, "CAMERA", "camera file to write (.yaml)")


def run(arguments: argparse.Namespace) -> None:
    """Calibrate and print how well the corners fit."""
    from morph_dslam import Board, calibrate

    board = Board.parse(arguments.board, arguments.square)
    calibration = calibrate(arguments.source, board, arguments.output, arguments.lens)
    print(calibration.table())
    for remark in calibration.remarks():
        print(f"note: {remark}")
    print(f"wrote {arguments.output} and {calibration.picture}")
    print(calibration.line())
