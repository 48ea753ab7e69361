"""`morph live`: as `morph track`, in frames as they come."""

import argparse

from morph_dslam.cli.arguments import add_file, positive_number
from morph_dslam.cli.track import run_options, track_and_print
from morph_dslam.cli.tracking_arguments import add_tracking_arguments

HELP = "track an object in the frames of a webcam, or of a recording at its own pace, as they come"
KEPT = "everything until then is kept in the run folder"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "source", metavar="SOURCE", help="webcam:0, /dev/video0, a camera's URL, or a recording (docs/sources.md)"
    )
    groups = add_tracking_arguments(command)
    add_file(
        groups.start,
        "--reference-image",
        "image of this camera that the landmarks, or another start, belong to (default: the first frame that comes)",
        "IMAGE",
    )
    groups.output.add_argument(
        "--serve", type=int, metavar="PORT", help="show the pictures to browsers on this computer (0: any port)"
    )
    groups.output.add_argument(
        "--seconds", type=positive_number, metavar="SECONDS", help="how long (default: until it ends)"
    )


def run(arguments: argparse.Namespace) -> None:
    """Track until the stream ends, and print the figures of each run folder."""
    options = run_options(
        arguments,
        frames=arguments.source,
        live=True,
        serve=arguments.serve,
        seconds=arguments.seconds,
        reference_image=arguments.reference_image,
    )
    track_and_print(options)
