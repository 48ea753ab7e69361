"""What streams cost: time per frame of tracking with and without them, in turn on the same frames.

    python benchmarks/streams.py [--rounds 5] [--frames 60]

The boot seal's recording (`examples/boot_seal/track.py`) is tracked as `morph track` does it: without a stream, with a
WebSocket that nobody or one client in another process listens to, and with a recording of rerun where it is installed.
Every round tracks all of them; ratios are to the run without a stream in the same round. Printed are medians over the
rounds, and the smallest ratio: by the clock, and in processor time, which other programs disturb less. Images are in
memory, nothing is drawn or written beside the stream.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from morph_dslam import Frame, MorphError, TrackOptions, open_source
from morph_dslam.extend import run_and_report_errors
from morph_dslam.extend.streams import StreamSink
from morph_dslam.threads import one_thread_for_algebra
from morph_dslam.tracking.placement import PlacedObject
from morph_dslam.tracking.track import new_session, prepare, warm_up

ROOT = Path(__file__).resolve().parents[1]
OUTPUT = ROOT / "examples" / "boot_seal" / "output"
CLIENT = ROOT / "examples" / "streams" / "client.py"


@contextmanager
def one_client(streams: StreamSink) -> Iterator[subprocess.Popen[str]]:
    """A program that takes the frames of a WebSocket."""
    command = [sys.executable, str(CLIENT), streams.publishers[0].place]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as client:
        try:
            while not streams.publishers[0].is_watched:
                time.sleep(0.01)
            yield client
        finally:
            streams.publishers[0].close()


@dataclass(frozen=True)
class Cost:
    """Of one frame, milliseconds.

    Attributes
    ----------
    wall : by the clock.
    thread : processor time of the thread that tracks.
    process : processor time of the whole program, without the client.
    received : what the client got.
    """

    wall: float
    thread: float
    process: float
    received: str = ""


@one_thread_for_algebra
def cost(placed: list[PlacedObject], frames: Sequence[Frame], kind: str, folder: Path) -> Cost:
    """Track the frames with a kind of stream."""
    (seal,) = placed
    clocks = (time.perf_counter, time.thread_time, time.process_time)
    with ExitStack() as stack:
        sinks, client = [], None
        if kind != "none":
            destination = f"rerun:{folder / 'run.rrd'}" if kind == "rerun" else "ws:0"
            streams = stack.enter_context(StreamSink([destination]))
            sinks = [streams.begin({seal.name: seal.model}, seal.camera)]
            client = stack.enter_context(one_client(streams)) if kind == "ws, one client" else None
        session = new_session(placed, frames, sinks)
        begin = [clock() for clock in clocks]
        session.run()
        spent = [1e3 * (clock() - before) / len(frames) for clock, before in zip(clocks, begin, strict=True)]
        if client is None:
            return Cost(*spent)
        streams.publishers[0].close()
        assert client.stdout is not None
        return Cost(*spent, f", {len(client.stdout.read().splitlines())} of {len(frames)} frames received")


def run(arguments: argparse.Namespace) -> None:
    place, recording = OUTPUT / "registration" / "registration.json", OUTPUT / "recording"
    if not place.is_file():
        raise MorphError(f"there is no {place}: make it with examples/boot_seal/run.py and track.py first")
    options = TrackOptions(
        frames=recording / "frames",
        model=OUTPUT / "boot_seal.morph",
        camera=recording / "camera.yaml",
        registration=place,
        map_path=OUTPUT / "scan" / "map.h5",
        output=OUTPUT,
    )
    kinds = ["none", "ws, no client", "ws, one client", *(["rerun"] if find_spec("rerun") else [])]
    with ExitStack() as stack:
        placed = prepare(options, stack)[2]
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        first = placed[0].frame
        frames = list(open_source(recording / "frames", first, first + arguments.frames - 1))
        warm_up(placed)
        cost(placed, frames, "none", folder)
        rounds = [{kind: cost(placed, frames, kind, folder) for kind in kinds} for _ in range(arguments.rounds)]
    print(f"{'':<16}{'clock':>24}{'tracking thread':>24}{'program':>24}")
    for kind in kinds:
        columns = []
        for what in ("wall", "thread", "process"):
            values = [getattr(one[kind], what) for one in rounds]
            ratios = [value / getattr(one["none"], what) for value, one in zip(values, rounds, strict=True)]
            columns.append(f"{np.median(values):7.2f} ms {np.median(ratios):5.2f} ({min(ratios):.2f})".rjust(24))
        print(f"{kind:<16}{''.join(columns)}{rounds[-1][kind].received}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5, help="how often (default: %(default)s)")
    parser.add_argument("--frames", type=int, default=60, help="of the recording (default: %(default)s)")
    return run_and_report_errors(run, parser.parse_args(), "nothing was written")


if __name__ == "__main__":
    sys.exit(main())
