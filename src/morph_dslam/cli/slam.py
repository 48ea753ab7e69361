"""`morph slam`: the path of a camera, and a map of the scene."""

import argparse

from morph_dslam.cli.arguments import (
    add_depth_per_metre,
    add_file,
    add_flag,
    add_output,
    add_range,
    add_rate,
    frame_number,
)
from morph_dslam.errors import MapError

HELP = "find the path of a camera through a rigid scene, and a map of the scene"
TERMS = ("focal", "centre", "radial", "tangential", "readout")
KEPT = "the frames seen so far, if any, and their map are kept in the run folder"


def add_arguments(command: argparse.ArgumentParser) -> None:
    add_file(command, "source", "recording (docs/sources.md), or a camera: webcam:0, /dev/video0 or a URL")
    add_file(
        command,
        "--camera",
        "camera file: size, intrinsics, distortion; a Kalibr camchain or EuRoC folder for a stereo pair",
        required=True,
    )
    add_output(command, "RUN", "run folder to write")
    add_range(command, "frames to track")
    add_file(
        command, "--map", "map.h5 of an earlier run, or the folder of a COLMAP text model, to find the camera in", "MAP"
    )
    add_file(
        command,
        "--trajectory",
        "make the map with these poses, of whatever program (TUM's format), and find the camera in it",
        "FILE",
    )
    add_file(
        command,
        "--images",
        "recording that the COLMAP model or the poses are of, where it is not the one to track",
        "RECORDING",
    )
    add_flag(command, "--extend", "with --map or --trajectory: let the map grow, instead of keeping it as it is")
    command.add_argument(
        "--freeze-at", type=frame_number, metavar="N", help="from this frame on keep the map and only find the camera"
    )
    add_flag(
        command, "--freeze-when-deforming", "keep the map from when a part of the scene begins to move or to deform"
    )
    command.add_argument(
        "--refine-camera",
        action="append",
        default=[],
        nargs="?",
        const="all",
        choices=(*TERMS, "all"),
        help="estimate the focal length, the principal point, radial or tangential terms of the lens, the readout time "
        "of a rolling shutter, or all of them first, and write camera.yaml into the run folder; may be repeated",
    )
    add_rate(command)
    add_depth_per_metre(command)
    add_flag(command, "--no-depth", "leave the depth images of the recording aside")
    add_flag(command, "--overwrite", "replace a run that is in the run folder")
    add_flag(command, "--no-video", "do not draw the video with tracked points")


def run(arguments: argparse.Namespace) -> None:
    """Map the scene and print the figures.

    Raises
    ------
    MorphError
        As `run_slam`; MapError if no frame has a pose, once the run folder is complete.
    """
    from morph_dslam import SlamOptions
    from morph_dslam.extend.slam import run_slam

    summary = run_slam(
        arguments.source,
        arguments.camera,
        arguments.output,
        *arguments.range,
        options=SlamOptions(
            use_depth=not arguments.no_depth,
            extend=arguments.extend,
            freeze_at=arguments.freeze_at,
            freeze_when_deforming=arguments.freeze_when_deforming,
        ),
        map_path=arguments.map,
        trajectory=arguments.trajectory,
        images=arguments.images,
        refine=TERMS if "all" in arguments.refine_camera else tuple(dict.fromkeys(arguments.refine_camera)),
        depth_per_metre=arguments.depth_per_metre,
        fps=arguments.fps,
        video=not arguments.no_video,
        overwrite=arguments.overwrite,
    )
    for term, found in summary.get("refined_camera", {}).items():
        given, values, std = (", ".join(f"{v:.4g}" for v in found[key]) for key in ("given", "estimated", "std"))
        shown = "not refuted" if found["is_observable"] else "unobservable here"
        kept = f"; {shown}, kept as given" if found["is_kept"] else ""
        print(f"{term}: {values} (standard deviation {std}), was {given}{kept}")
    why = summary["why_without_poses"]
    for flag in summary["flags"]:
        if flag == why:  # it is said last, as the error
            continue
        print(f"note: {flag}")
    print(f"wrote {arguments.output}")
    depth = "" if summary["median_depth_m"] is None else f" median_depth_m={summary['median_depth_m']:.3g}"
    print(
        f"start={summary['start_frame']} tracked={summary['n_tracked']}/{summary['n_frames']} "
        f"median_ms={summary['median_ms']:.2f} p95_ms={summary['p95_ms']:.2f}{depth}"
    )
    if why is not None:
        raise MapError(f"{why}; {arguments.output / 'frames.csv'} has the reason of each frame")
