"""`morph live`: as `morph track`, in frames as they come."""

import argparse

from morph_dslam.cli.arguments import add_file, positive_number
from morph_dslam.cli.track import add_tracking_arguments, print_summary, run_options

HELP = "track an object in the frames of a webcam, or of a recording at its own pace, as they come"
KEPT = "everything until then is kept in the run folder"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("source", metavar="SOURCE", help="webcam:0, or a recording (docs/sources.md)")
    add_tracking_arguments(command)
    add_file(
        command,
        "--reference-image",
        "image of this camera that the landmarks, or another start, belong to (default: the first frame that comes)",
    )
    command.add_argument(
        "--serve", type=int, metavar="PORT", help="show the pictures to browsers on this computer (0: any port)"
    )
    command.add_argument("--seconds", type=positive_number, metavar="S", help="how long (default: until it ends)")


def run(arguments: argparse.Namespace) -> None:
    """Track until the stream ends, and print the figures of each run folder."""
    from morph_dslam import track

    options = run_options(
        arguments,
        frames=arguments.source,
        live=True,
        serve=arguments.serve,
        seconds=arguments.seconds,
        reference_image=arguments.reference_image,
    )
    track(options, print_summary)
