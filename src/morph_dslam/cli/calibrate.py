"""`morph calibrate`: intrinsics and distortion of a camera, or of those of a rig, and where these are."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from morph_dslam.cli.arguments import add_output, add_repeated
from morph_dslam.errors import CameraError

if TYPE_CHECKING:
    from morph_dslam import Board
    from morph_dslam.extend.registration import FiducialBoard

HELP = "find a camera's intrinsics and distortion from pictures of a board"
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
        "--board",
        required=True,
        metavar="BOARD",
        help="inner corners of a checkerboard, where four squares meet, each way: 9x6; or the board file of a board of "
        "markers (docs/registration-aids.md), of which pictures may show parts",
    )
    command.add_argument(
        "--square", metavar="LENGTH", help="side of one square of a checkerboard with its unit: '25 mm'"
    )
    command.add_argument(
        "--lens",
        choices=("radial-tangential", "fisheye"),
        default="radial-tangential",
        help="lens model: fisheye for views of more than about 120 degrees",
    )
    add_repeated(
        command,
        "--with",
        "what the next camera of a rig saw, with the same frame numbers: a folder of images or a video; the file to "
        "write is then a Kalibr camchain",
        "SOURCE",
        Path,
    )
    add_output(command, "CAMERA", "camera file to write (.yaml)")


def run(arguments: argparse.Namespace) -> None:
    """Calibrate and print how well the corners fit."""
    from morph_dslam import calibrate

    others = vars(arguments)["with"]  # a keyword of the language
    if others:
        _run_rig(arguments, [arguments.source, *([source] for source in others)])
        return
    calibration = calibrate(arguments.source, _board(arguments), arguments.output, arguments.lens)
    print(calibration.table())
    for remark in calibration.remarks():
        print(f"note: {remark}")
    print(f"wrote {arguments.output} and {calibration.picture}")
    print(calibration.line())


def _run_rig(arguments: argparse.Namespace, sources: list[list[Path]]) -> None:
    """Calibrate several cameras, and print how well each is known and where it is."""
    from morph_dslam.extend.calibration import calibrate_rig

    rig = calibrate_rig(sources, _board(arguments), arguments.output, arguments.lens)
    for number, calibration in enumerate(rig.cameras):
        print(f"cam{number}: {calibration.line()}")
        for remark in calibration.remarks():
            print(f"note: cam{number}: {remark}")
    print(rig.table())
    for remark in rig.remarks():
        print(f"note: {remark}")
    pictures = ", ".join(str(calibration.picture) for calibration in rig.cameras)
    print(f"wrote {arguments.output} and {pictures}")
    print(rig.line())


def _board(arguments: argparse.Namespace) -> Board | FiducialBoard:
    """The board of a file, or the checkerboard that ``--board`` and ``--square`` describe."""
    from morph_dslam import Board
    from morph_dslam.extend.registration import load_board

    if Path(arguments.board).suffix == ".toml":
        if arguments.square is not None:
            raise CameraError(f"--square is for a checkerboard: {arguments.board} says its sizes itself")
        return load_board(Path(arguments.board))
    if arguments.square is None:
        raise CameraError("say how large a square of the checkerboard is, --square '25 mm', or give a board file")
    return Board.parse(arguments.board, arguments.square)
