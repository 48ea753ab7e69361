"""`morph live`: as `morph track`, in frames as they come."""

from __future__ import annotations

import argparse

from morph_dslam.cli.arguments import positive_number
from morph_dslam.cli.track import add_tracking_arguments, drawing, object_arguments, other_objects, print_summary

HELP = "track an object in the frames of a webcam, or of a recording at its own pace, as they come"
KEPT = "everything until then is kept in the run folder"


def add_arguments(command: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    command.add_argument("source", metavar="SOURCE", help="webcam:0, or a recording (docs/sources.md)")
    add_tracking_arguments(command)
    command.add_argument(
        "--serve", type=int, metavar="PORT", help="show the pictures to browsers on this computer (0: any port)"
    )
    command.add_argument("--seconds", type=positive_number, metavar="S", help="how long (default: until it ends)")


def run(arguments: argparse.Namespace) -> None:
    """Track until the stream ends, and print the figures of each run folder."""
    from morph_dslam.tracking.run_live import LiveOptions, run_live
    from morph_dslam.tracking.setup import ObjectOptions

    first, last = arguments.range
    run_live(
        LiveOptions(
            source=arguments.source,
            output=arguments.output,
            of_object=ObjectOptions(**object_arguments(arguments)),
            drawing=drawing(arguments),
            others=other_objects(arguments),
            first=first,
            last=last,
            reregister_at=tuple(arguments.reregister_at),
            serve=arguments.serve,
            record=not arguments.no_video,
            seconds=arguments.seconds,
            overwrite=arguments.overwrite,
        ),
        print_summary,
    )
