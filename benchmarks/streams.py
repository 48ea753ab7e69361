"""What streams cost: time per frame of tracking with and without them, in turn on the same frames.

    python benchmarks/streams.py [--rounds 5] [--frames 60]

The sheet of `make demo` is tracked as `morph track` does it: without a stream, with a WebSocket that nobody or one
client in another process listens to, and with a recording of rerun where it is installed. Every round tracks all of
them; ratios are to the run without a stream in the same round. Printed are medians over the rounds, and the smallest
ratio: by the clock, and in processor time, which other programs disturb less. Images are in memory, nothing is drawn or
written beside the stream.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np

import morph_dslam as md
from morph_dslam.extend import one_thread_for_algebra, run_and_report_errors
from morph_dslam.extend.streams import StreamSink

ROOT = Path(__file__).resolve().parents[1]
DEMO = ROOT / "demo"
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


class Measured:
    """The demo's recording, to be tracked again and again.

    Parameters
    ----------
    n_frames : how many of its frames.
    folder : for recordings of rerun.
    """

    def __init__(self, n_frames: int, folder: Path) -> None:
        sequence = DEMO / "sequence"
        self._model, self._camera = md.load_model(DEMO / "sheet.morph"), md.load_camera(sequence / "camera.yaml")
        self._start = md.register_landmarks(self._model, self._camera, sequence / "landmarks.csv")
        self._frames, self._folder = list(md.open_source(sequence / "frames"))[:n_frames], folder

    @one_thread_for_algebra
    def cost(self, kind: str) -> Cost:
        """Track the frames with a kind of stream."""
        clocks, count = (time.perf_counter, time.thread_time, time.process_time), len(self._frames)
        with ExitStack() as stack:
            sinks, client = [], None
            if kind != "none":
                destination = f"rerun:{self._folder / 'run.rrd'}" if kind == "rerun" else "ws:0"
                streams = stack.enter_context(StreamSink([destination]))
                sinks = [streams.begin({"sheet": self._model}, self._camera)]
                client = stack.enter_context(one_client(streams)) if kind == "ws, one client" else None
            tracker = md.Tracker(self._model, self._camera, self._start)
            session = md.Session({"sheet": tracker}, self._frames, sinks)
            begin = [clock() for clock in clocks]
            session.run()
            spent = [1e3 * (clock() - before) / count for clock, before in zip(clocks, begin, strict=True)]
            if client is None:
                return Cost(*spent)
            streams.close()
            assert client.stdout is not None
            return Cost(*spent, f", {len(client.stdout.read().splitlines())} of {count} frames received")


def run(arguments: argparse.Namespace) -> None:
    if not (DEMO / "sequence").is_dir():
        raise md.MorphError(f"there is no recording in {DEMO}: make it with `make demo` first")
    kinds = ["none", "ws, no client", "ws, one client", *(["rerun"] if find_spec("rerun") else [])]
    with tempfile.TemporaryDirectory() as folder:
        measured = Measured(arguments.frames, Path(folder))
        measured.cost("none")  # compiles
        rounds = [{kind: measured.cost(kind) for kind in kinds} for _ in range(arguments.rounds)]
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
