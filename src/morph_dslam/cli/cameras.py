"""Commands about a camera alone: where it moved (`morph slam`), what it is (`morph calibrate`)."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from morph_dslam.cli.arguments import frame_number, frame_range


def _slam(arguments: argparse.Namespace) -> None:
    from morph_dslam.slam.run import SlamRunOptions, run_slam

    first, last = arguments.range
    summary = run_slam(
        SlamRunOptions(
            source=arguments.source,
            camera=arguments.camera,
            output=arguments.output,
            first=first,
            last=last,
            map_path=arguments.map,
            trajectory=arguments.trajectory,
            images=arguments.images,
            extend=arguments.extend,
            freeze_at=arguments.freeze_at,
            freeze_when_deforming=arguments.freeze_when_deforming,
            use_depth=not arguments.no_depth,
            video=not arguments.no_video,
            overwrite=arguments.overwrite,
        )
    )
    for flag in summary["flags"]:
        print(f"note: {flag}")
    print(f"wrote {arguments.output}")
    print(
        f"start={summary['start_frame']} tracked={summary['n_tracked']}/{summary['n_after_start']} "
        f"median_ms={summary['median_ms']:.2f} p95_ms={summary['p95_ms']:.2f}"
    )


def _calibrate(arguments: argparse.Namespace) -> None:
    from morph_dslam.calibration.board import parse_board
    from morph_dslam.calibration.calibrate import calibrate, picture_path

    board = parse_board(arguments.board, arguments.square)
    calibration = calibrate(arguments.source, board, arguments.output, arguments.lens)
    print(calibration.table())
    for remark in calibration.remarks():
        print(f"note: {remark}")
    print(f"wrote {arguments.output} and {picture_path(arguments.output)}")
    print(calibration.line())


def add_camera_commands(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add both commands; ``add(name, action, kept, text)`` makes the parser of one."""
    _add_slam(add)
    _add_calibrate(add)


def _add_slam(add: Callable[..., argparse.ArgumentParser]) -> None:
    slam = add(
        "slam",
        _slam,
        "the frames tracked so far and their map are kept in the run folder",
        "find the path of a camera through a rigid scene, and a map of the scene",
    )
    slam.add_argument("source", type=Path, help="recording (docs/sources.md), or webcam:0")
    slam.add_argument(
        "--camera",
        type=Path,
        required=True,
        help="camera file: size, intrinsics, distortion; a Kalibr camchain or EuRoC folder for a stereo pair",
    )
    slam.add_argument("-o", "--output", type=Path, required=True, metavar="RUN", help="run folder to write")
    slam.add_argument("--range", type=frame_range, default=(None, None), metavar="FIRST-LAST", help="frames to track")
    slam.add_argument(
        "--map",
        type=Path,
        metavar="MAP",
        help="map.h5 of an earlier run, or the folder of a COLMAP text model, to find the camera in",
    )
    slam.add_argument(
        "--trajectory",
        type=Path,
        metavar="FILE",
        help="make the map with these poses, of whatever program (TUM's format), and find the camera in it",
    )
    slam.add_argument(
        "--images",
        type=Path,
        metavar="RECORDING",
        help="recording that the COLMAP model or the poses are of, where it is not the one to track",
    )
    slam.add_argument(
        "--extend",
        action="store_true",
        help="with --map or --trajectory: let the map grow, instead of keeping it as it is",
    )
    slam.add_argument(
        "--freeze-at", type=frame_number, metavar="N", help="from this frame on keep the map and only find the camera"
    )
    slam.add_argument(
        "--freeze-when-deforming",
        action="store_true",
        help="keep the map from when a part of the scene begins to move or to deform",
    )
    slam.add_argument("--no-depth", action="store_true", help="leave the depth images of the recording aside")
    slam.add_argument("--overwrite", action="store_true", help="replace a run that is in the run folder")
    slam.add_argument("--no-video", action="store_true", help="do not draw the video with tracked points")


def _add_calibrate(add: Callable[..., argparse.ArgumentParser]) -> None:
    calibrate = add(
        "calibrate",
        _calibrate,
        "nothing was written",
        "find a camera's intrinsics and distortion from pictures of a checkerboard",
    )
    calibrate.add_argument(
        "source", type=Path, nargs="+", help="images, a folder of images, or a video (docs/cameras.md)"
    )
    calibrate.add_argument(
        "--board", required=True, metavar="9x6", help="inner corners, where four squares meet, each way"
    )
    calibrate.add_argument("--square", required=True, metavar="'25 mm'", help="side of one square, with its unit")
    calibrate.add_argument(
        "--lens",
        choices=("radial-tangential", "fisheye"),
        default="radial-tangential",
        help="lens model: fisheye for views of more than about 120 degrees",
    )
    calibrate.add_argument(
        "-o", "--output", type=Path, required=True, metavar="CAMERA", help="camera file to write (.yaml)"
    )
