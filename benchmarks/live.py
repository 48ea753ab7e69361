"""How fast live tracking is with everything on: frames a second, drops, latency, memory.

    python benchmarks/live.py [--minutes 10] [--size 640x480|1280x720]

The boot seal's recording (`examples/boot_seal/track.py`, from its last keyframe on) plays back and forth from
memory at 30 frames a second: the camera is found in the map of the scan, the seal in it, its stress drawn
over the picture, and the picture recorded. The latency is that from a frame's capture to its finished
picture. ``at_start`` of the dropped frames came while the first one was being found in the map. The memory is the most
that the process held, ``film_MB`` of recorded frames among it, which a camera does not need. ``floor_ms`` is F of
floors.py, measured before; nan without the recording of 7-Scenes. Processor time by thread says what a frame costs
where other programs disturb the clock. For 1280x720 the scene is rendered, scanned and registered once more at that
size, and kept in benchmarks/output/live.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from multiprocessing import get_context
from pathlib import Path

# As `morph live` does it; only before numpy is loaded has it an effect.
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"))

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

import numpy as np
from numpy.typing import NDArray

from floors import SCENES, Floor
from morph_dslam import Frame, MorphError, TrackOptions, open_source
from morph_dslam.extend import run_and_report_errors, threads_side_by_side
from morph_dslam.extend.registration import run_registration
from morph_dslam.io.video import VideoWriter
from morph_dslam.sources.live import PacedRecording
from morph_dslam.tracking.drawing import AugmentedPicture, AugmentedView
from morph_dslam.tracking.sinks import LiveTimes, TrackedFrame, VideoSink
from morph_dslam.tracking.track import new_session, prepare, warm_up
from support import data_folder, keep, keep_sequence

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "boot_seal"
FPS, SCANNED, FLOORS = 30.0, 150, 200


class BackAndForth:
    """Frames from memory, forwards and backwards in turn, at 30 a second."""

    name, fps = "the boot seal's recording", FPS

    def __init__(self, images: list[NDArray[np.uint8]], minutes: float) -> None:
        self._images, self._count = images, round(60.0 * FPS * minutes)

    def __iter__(self) -> Iterator[Frame]:
        there_and_back = [*range(len(self._images)), *range(len(self._images) - 2, 0, -1)]
        for number in range(self._count):
            image = self._images[there_and_back[number % len(there_and_back)]]
            yield Frame(number, number / FPS, image)


class Timed:
    """Processor time that calls of a function take in the thread that they run in."""

    def __init__(self, call: Callable) -> None:
        self.milliseconds: list[float] = []
        self._call = call

    def __call__(self, *arguments):
        begin = time.thread_time()
        try:
            return self._call(*arguments)
        finally:
            self.milliseconds.append(1e3 * (time.thread_time() - begin))


def large_scene(folder: Path) -> Path:
    """The example's scene file for 1280x720: seen a little closer."""
    text = (EXAMPLE / "scene.toml").read_text()
    wanted = {
        'model = "output/boot_seal.morph"': f'model = "{EXAMPLE / "output" / "boot_seal.morph"}"',
        "width = 640": "width = 1280",
        "height = 480": "height = 720",
        "fx = 560.0": "fx = 950.0",
        "fy = 560.0": "fy = 950.0",
        "cx = 320.0": "cx = 640.0",
        "cy = 240.0": "cy = 360.0",
    }
    for before, after in wanted.items():
        if before not in text:
            raise MorphError(f"{EXAMPLE / 'scene.toml'} has changed: it does not say '{before}'")
        text = text.replace(before, after)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "scene.toml"
    path.write_text(text)
    return path


def make_large(folder: Path, model: Path) -> None:
    """Render, scan and register at 1280x720, unless it was done before."""
    from morph_dslam.extend.slam import run_slam

    sequence = folder / "recording"
    keep_sequence(large_scene(folder), model, sequence)
    camera = sequence / "camera.yaml"

    def scan() -> None:
        run_slam(
            source=sequence / "frames",
            camera=camera,
            output=folder / "scan",
            first=0,
            last=SCANNED,
            overwrite=True,
            video=False,
        )
        run_registration(folder / "scan" / "map.h5", model, camera, folder / "registration", overwrite=True)

    keep(folder / "scan", [folder / "scene.toml", model], scan)


def measured_floor(folder: Path) -> float:
    """F of floors.py, ms; nan without the recording."""
    if not folder.is_dir():
        return np.nan
    floor = Floor(folder)
    with threads_side_by_side():
        return float(np.median([floor.measure()["floor"][0] for _ in range(FLOORS)]))


def run(arguments: argparse.Namespace) -> None:
    model = EXAMPLE / "output" / "boot_seal.morph"
    folder = EXAMPLE / "output"
    if not model.is_file():
        raise MorphError(f"there is no {model}: make it with examples/boot_seal/run.py first")
    if arguments.size == "1280x720":
        folder = ROOT / "benchmarks" / "output" / "live"
        # In a process of its own, whose memory does not count.
        making = get_context("spawn").Process(target=make_large, args=(folder, model))
        making.start()
        making.join()
        if making.exitcode:
            raise MorphError("the scene of 1280x720 could not be made: what is above says why")
    place = folder / "registration" / "registration.json"
    if not place.is_file():
        raise MorphError(f"there is no {place}: make it with examples/boot_seal/track.py first")
    recording = folder / "recording"
    options = TrackOptions(
        frames=recording / "frames",
        model=model,
        camera=recording / "camera.yaml",
        registration=place,
        map_path=folder / "scan" / "map.h5",
        output=folder,
    )
    floor_ms = measured_floor(data_folder(SCENES))
    with ExitStack() as stack:
        placed = prepare(options, stack)[2]
        (seal,) = placed
        images = [frame.image for frame in open_source(recording / "frames", seal.frame)]
        warm_up(placed)
        stream = PacedRecording(BackAndForth(images, arguments.minutes))
        video = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "augmented.mp4"
        writer = stack.enter_context(VideoWriter(video, FPS, (seal.camera.width, seal.camera.height)))
        record, times = Timed(VideoSink(writer, FPS)), LiveTimes()
        # Not the results, whose memory would grow with the minutes.
        counts, stages, numbers = Counter[str](), defaultdict[str, list[float]](list), list[int]()

        def note(tracked: TrackedFrame) -> None:
            result = tracked.results[seal.name]
            counts[str(result.status)] += 1
            if len(numbers) < 2:
                numbers.append(tracked.frame.index)
            for stage, milliseconds in result.timings_ms.items():
                stages[stage].append(milliseconds)

        picture = AugmentedPicture(seal.camera, {seal.name: AugmentedView(seal.model, seal.camera)})
        session = new_session(placed, stream, [times, record, note], picture=picture)
        picture.draw, session.locate, session.track = map(Timed, (picture.draw, session.locate, session.track))
        begin = time.process_time()
        session.run()
        spent = 1e3 * (time.process_time() - begin)
    timed = {"locate": session.locate, "track": session.track, "draw": picture.draw, "record": record}
    report(times, timed, spent)
    print(
        "wall time by stage [ms]: " + ", ".join(f"{k} {m:.1f}" for k, v in stages.items() if (m := np.median(v)) > 0.05)
    )
    print(f"drawn frames: {len(times.frames)}, {dict(counts)}")
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    film = sum(image.nbytes for image in images) / 2**20
    print(
        f"fps={times.fps:.2f} dropped={session.n_dropped} at_start={np.diff(numbers).sum() - 1} "
        f"latency_median_ms={times.latency_ms(50):.1f} latency_p95_ms={times.latency_ms(95):.1f} "
        f"memory_MB={memory:.0f} film_MB={film:.0f} floor_ms={floor_ms:.2f}"
    )


def report(times: LiveTimes, timed: dict[str, Timed], spent: float) -> None:
    """Print processor time by thread."""
    print(f"\n{'processor time [ms]':<22}{'median':>8}{'p95':>8}")
    for name, one in timed.items():
        print(f"{name:<22}{np.median(one.milliseconds):>8.1f}{np.percentile(one.milliseconds, 95):>8.1f}")
    print(f"{'all, a drawn frame':<22}{spent / max(len(times.frames), 1):>8.1f}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=1.0, help="how long (default: %(default)s)")
    parser.add_argument("--size", choices=("640x480", "1280x720"), default="640x480")
    return run_and_report_errors(run, parser.parse_args(), "nothing was written")


if __name__ == "__main__":
    sys.exit(main())
