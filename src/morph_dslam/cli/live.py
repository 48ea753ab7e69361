"""The command that follows an object in a live stream: `morph live`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from morph_dslam.cli.arguments import frame_range, positive_number
from morph_dslam.cli.track import add_object_arguments, drawing, object_arguments, other_objects


def _live(arguments: argparse.Namespace) -> None:
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
        _tell,
    )


def _tell(output: Path, summary: dict[str, Any]) -> None:
    """Print what came of a session; Ctrl-C is its usual end."""
    if not summary:
        print("no frame was tracked: nothing was written")
        return
    for flag in summary["flags"]:
        print(f"note: {flag}")
    print(f"wrote {output}")
    figures = summary["live"]
    print(
        f"tracked={summary['n_tracked']}/{summary['n_frames']} fps={figures['fps']:.1f} "
        f"dropped={figures['n_dropped']} latency_median_ms={figures['latency_median_ms']:.1f} "
        f"latency_p95_ms={figures['latency_p95_ms']:.1f}"
    )


def add_live_commands(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add the command; ``add(name, action, kept, text)`` makes its parser."""
    live = add(
        "live",
        _live,
        "everything until then is kept in the run folder",
        "track an object in the pictures of a webcam, or of a recording at its own pace, as they come",
    )
    live.add_argument("source", metavar="SOURCE", help="webcam:0, or a recording (docs/sources.md)")
    add_object_arguments(live)
    live.add_argument(
        "--serve", type=int, metavar="PORT", help="show the pictures to browsers on this computer (0: any port)"
    )
    live.add_argument("--seconds", type=positive_number, metavar="S", help="how long (default: until it ends)")
    live.add_argument(
        "--range", type=frame_range, default=(None, None), metavar="FIRST-LAST", help="frames of a recording to play"
    )
    live.add_argument("--no-video", action="store_true", help="do not record the augmented video")
