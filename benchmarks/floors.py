"""Times of tracking as multiples of a floor measured in the same run, so that machines can be compared.

    python benchmarks/floors.py [--data DIR] [--frames N] [--beside COMMIT]

The floor F is the median time of grey conversion and OpenCV's `calcOpticalFlowPyrLK` of 300 corners (17x17
window, 3 levels above the image, forward only, one thread) between successive pictures of 7-Scenes, 640x480.
Each frame of a workload is followed by one measurement of the floor and of decoding a picture, so that whatever
else the machine does meets all alike. `cpu` is the processor time of this process, `wall` the time on the clock;
the last line gives medians of processor time. The workloads are

- mapping and localising: the recording of 7-Scenes, then back through it with the map frozen;
- seal: the anchored boot seal, camera and solid (made by examples/boot_seal/track.py);
- sheet: the recorded sheet of paper, free, with its outline and discrepancy (made by examples/kinect_paper/run.py).

One whose files have not been made is left out: its figure is nan. Then the seal's recording is tracked from its files
by one thread and by two that work on successive frames, in turn: `throughput` is the frames of two a second over those
of one, and the latency that from when a frame was read to its result. With --beside the workloads are also run with
the package of another commit, in a worktree and a process of its own, frame by frame in turn; `ratio` is this
version's time over the other's.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import cycle, islice
from pathlib import Path
from typing import Any

# As `morph live` does it; only before numpy is loaded has it an effect.
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"))

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

import cv2
import numpy as np
from tqdm import tqdm

from morph_dslam import (
    Camera,
    Frame,
    MorphError,
    Session,
    Tracker,
    TrackerOptions,
    load_camera,
    load_model,
    load_registration,
    load_scene,
    open_source,
    register_landmarks,
)
from morph_dslam.extend import run_and_report_errors, threads_side_by_side
from morph_dslam.extend.slam import Slam, warm_up as warm_up_slam
from support import data_folder

ROOT = Path(__file__).resolve().parents[1]
SCENES, SHEET = "7scenes_redkitchen", "kinect_paper"
#: The frame of the sheet in which its landmarks were set.
REFERENCE_FRAME = 9
SCENES_CAMERA = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)
#: Corners that the floor follows.
N_CORNERS = 300
WORKLOADS = ("mapping", "localising", "seal", "sheet")
#: Processor and wall time of each thing done for one frame, ms.
Times = dict[str, tuple[float, float]]


def timed(call: Callable[[], object]) -> tuple[float, float]:
    """Processor and wall time of a call, ms."""
    wall, cpu = time.perf_counter(), time.process_time()
    call()
    return 1e3 * (time.process_time() - cpu), 1e3 * (time.perf_counter() - wall)


class Floor:
    """The floor and decoding, measured on one pair of successive pictures after the other."""

    def __init__(self, folder: Path) -> None:
        paths = sorted(folder.glob("*.color.jpg"))
        if len(paths) < 2:
            raise MorphError(f"there is no recording of 7-Scenes in {folder}: give its parent folder with --data")
        self._pairs = cycle(zip(paths[:-1:5], paths[1::5], strict=False))

    def measure(self) -> Times:
        first, second = (path.read_bytes() for path in next(self._pairs))
        before = cv2.cvtColor(self._decoded(first), cv2.COLOR_BGR2GRAY)
        picture = self._decoded(second)
        corners = cv2.goodFeaturesToTrack(before, N_CORNERS, 0.001, 7.0)
        assert corners is not None

        def follow() -> None:
            grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
            cv2.calcOpticalFlowPyrLK(before, grey, corners, None, winSize=(17, 17), maxLevel=3)  # type: ignore[call-overload]

        follow()  # the second call finds its images in the cache, as in a program that does nothing else
        return {"floor": timed(follow), "decoding": timed(lambda: self._decoded(second))}

    @staticmethod
    def _decoded(packed: bytes) -> np.ndarray:
        image = cv2.imdecode(np.frombuffer(packed, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        return image


def camera_workload(data: Path, n_frames: int) -> Iterator[Times]:
    """Mapping from the first frame with a map on, then localising back through the same frames."""
    recorded = list(islice(open_source(data / SCENES), n_frames))
    warm_up_slam()
    slam = Slam(SCENES_CAMERA)
    for frame in recorded:
        spent = timed(lambda frame=frame: slam.process_frame(frame.image, frame.index, frame.timestamp))
        yield {"mapping": spent} if slam.map.keyframes else {}
    slam.freeze()
    for number, frame in enumerate(recorded[::-1], start=recorded[-1].index + 1):
        spent = timed(lambda frame=frame, number=number: slam.process_frame(frame.image, number, number / 30.0))
        yield {"localising": spent}


def tracked_workload(name: str, new_tracker: Callable[[], Tracker], frames: list[Frame]) -> Iterator[Times]:
    """An object in a recording, frame by frame."""
    before = new_tracker()
    for frame in frames[:2]:
        before.track(frame)  # compiles what it needs
    tracker = new_tracker()
    for frame in frames:
        yield {name: timed(lambda frame=frame: tracker.track(frame))}


def anchored_seal() -> tuple[Callable[[], Tracker], Iterable[Frame]]:
    """The camera in the map of the scan, and the seal in it, and the frames from where the scan ends."""
    folder = ROOT / "examples" / "boot_seal" / "output"
    camera, model = load_camera(folder / "recording" / "camera.yaml"), load_model(folder / "boot_seal.morph")
    scene = load_scene(folder / "scan" / "map.h5", camera)
    start = load_registration(folder / "registration" / "registration.json", model, scene)
    return lambda: Tracker(model, camera, start), open_source(folder / "recording" / "frames", start.frame)


def seal_workload(data: Path, n_frames: int) -> Iterator[Times]:
    """`anchored_seal`, frame by frame."""
    new_tracker, source = anchored_seal()
    return tracked_workload("seal", new_tracker, list(islice(source, n_frames)))


def sheet_workload(data: Path, n_frames: int) -> Iterator[Times]:
    """A sheet in two hands, by its print, its outline, and what its shape has beyond the model's."""
    folder, options = ROOT / "examples" / SHEET, TrackerOptions(use_outline=True, use_discrepancy=True)
    camera, model = load_camera(folder / "camera.yaml"), load_model(folder / "output" / "sheet.morph")
    frames = list(islice(open_source(data / SHEET / "rgb", REFERENCE_FRAME), n_frames))
    start = register_landmarks(model, camera, folder / "landmarks.csv")
    return tracked_workload("sheet", lambda: Tracker(model, camera, start, options, reference=frames[0].image), frames)


def all_workloads(data: Path, n_frames: int) -> Iterator[Times]:
    """The times of each frame of all workloads, with those of the floor and of decoding."""
    floor = Floor(data / SCENES)
    for workload in (camera_workload, seal_workload, sheet_workload):
        try:
            for spent in workload(data, n_frames):
                yield spent | floor.measure()
        except MorphError as missing:
            print(f"left out: {missing}", file=sys.stderr)


class Clocked:
    """A recording that notes when each frame was read."""

    def __init__(self, source: Iterable[Frame]) -> None:
        self._source = source
        self.read: list[float] = []

    def __iter__(self) -> Iterator[Frame]:
        for frame in self._source:
            self.read.append(time.perf_counter())
            yield frame


def paced(new_tracker: Callable[[], Tracker], source: Iterable[Frame], two_threads: bool) -> tuple[float, float]:
    """Wall time of a frame, and the median latency from when it was read to its result; ms."""
    clocked, done = Clocked(source), []
    session = Session({"seal": new_tracker()}, clocked)
    begin = time.perf_counter()
    if two_threads:
        done = [time.perf_counter() for _ in session]
    else:
        for frame in clocked:
            session.track((frame,), session.locate((frame,)))
            done.append(time.perf_counter())
    latency = np.median(np.subtract(done, clocked.read))
    return 1e3 * (done[-1] - begin) / len(done), 1e3 * float(latency)


def two_threads(rounds: int = 5) -> str:
    """What two threads on successive frames gain over one, and what it costs in latency; in turn."""
    new_tracker, source = anchored_seal()
    with threads_side_by_side():
        paced(new_tracker, source, False)
        figures = np.array([[paced(new_tracker, source, both) for both in (False, True)] for _ in range(rounds)])
    (one, waits), (two, waits_too) = np.median(figures, axis=0)
    return (
        f"one_thread_ms={one:.2f} two_threads_ms={two:.2f} throughput={one / two:.2f} "
        f"one_thread_latency_ms={waits:.2f} two_threads_latency_ms={waits_too:.2f}"
    )


class Other:
    """The workloads in a process with the package of a commit, one frame at a time."""

    def __init__(self, source: Path, data: Path, n_frames: int) -> None:
        paths = os.pathsep.join([str(source), str(ROOT)])
        command = [sys.executable, __file__, "--worker", "--data", str(data), "--frames", str(n_frames)]
        self._process = subprocess.Popen(
            command, env=os.environ | {"PYTHONPATH": paths}, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def __iter__(self) -> Iterator[Times]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        while True:
            self._process.stdin.write("\n")
            self._process.stdin.flush()
            line = self._process.stdout.readline()
            if not line:
                return
            yield json.loads(line)

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()


def work(data: Path, n_frames: int) -> None:
    """Do one frame for each line that comes, and answer with its times."""
    frames = all_workloads(data, n_frames)
    for _ in sys.stdin:
        spent = next(frames, None)
        if spent is None:
            return
        print(json.dumps(spent), flush=True)


@contextmanager
def worktree_of(commit: str) -> Iterator[Path]:
    """A worktree of a commit, for as long as the block runs."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "other"
        git = ["git", "-C", str(ROOT), "worktree"]
        try:
            subprocess.run([*git, "add", "--detach", str(tree), commit], check=True, capture_output=True, text=True)
        except subprocess.CalledProcessError as error:
            raise MorphError(f"there is no worktree of {commit}: {error.stderr.strip()}") from error
        try:
            yield tree
        finally:
            subprocess.run([*git, "remove", "--force", str(tree)], check=True, capture_output=True)


class Gathered:
    """Times of all frames, by what was done."""

    def __init__(self) -> None:
        self._times: dict[str, list[tuple[float, float]]] = defaultdict(list)
        #: Floors measured beside each workload: the machine's pace changes.
        self._floors: dict[str, list[tuple[float, float]]] = defaultdict(list)

    def add(self, spent: Times) -> None:
        for name, times in spent.items():
            self._times[name].append(times)
            self._floors[name].append(spent["floor"])

    def median(self, name: str, column: int = 0) -> float:
        """Median time, ms: of the processor, or on the clock."""
        return self.percentile(name, 50, column)

    def percentile(self, name: str, percent: float, column: int = 0) -> float:
        return float(np.percentile([times[column] for times in self._times[name]], percent)) if name in self else np.nan

    def floor(self, name: str, column: int = 0) -> float:
        """The floor while this was measured, ms."""
        return float(np.median([times[column] for times in self._floors[name]])) if name in self else np.nan

    def in_floors(self, name: str, percent: float = 50, column: int = 0) -> float:
        return self.percentile(name, percent, column) / self.floor(name, column)

    def __contains__(self, name: str) -> bool:
        return bool(self._times.get(name))


def table(ours: Gathered, other: Gathered | None) -> Iterator[str]:
    """A row of each workload: processor and wall time, median and 95th percentile, in milliseconds and floors."""
    heads = ("cpu ms", "wall ms", "cpu F", "wall F", "p95 F", "wall p95 F")
    yield f"{'':<12}" + "".join(f"{head:>12}" for head in (*heads, *(("other F", "ratio") if other else ())))
    for name in ("floor", "decoding", *WORKLOADS):
        if name not in ours:
            continue
        figures = [ours.median(name, column) for column in (0, 1)]
        figures += [ours.in_floors(name, percent, column) for percent in (50, 95) for column in (0, 1)]
        if other is not None:
            figures += [other.in_floors(name), ours.in_floors(name) / other.in_floors(name)]
        yield f"{name:<12}" + "".join(f"{figure:>12.2f}" for figure in figures)


def run(arguments: argparse.Namespace) -> None:
    cv2.setNumThreads(1)
    data, n_frames = arguments.data, arguments.frames
    if arguments.worker:
        work(data, n_frames)
        return
    ours, other = Gathered(), None
    frames: Iterable[Any] = ((spent, None) for spent in all_workloads(data, n_frames))
    with ExitStack() as stack:
        if arguments.beside:
            other = Gathered()
            tree = stack.enter_context(worktree_of(arguments.beside))
            pair = [Other(source, data, n_frames) for source in (ROOT / "src", tree / "src")]
            for process in pair:
                stack.callback(process.close)
            frames = zip(*pair, strict=True)
        for mine, theirs in tqdm(frames, unit="frame"):
            ours.add(mine)
            if other is not None:
                other.add(theirs)
    print("\n".join(table(ours, other)))
    if "seal" in ours:
        print(two_threads())
    print(f"floor_ms={ours.median('floor'):.2f} " + " ".join(f"{n}_F={ours.in_floors(n):.2f}" for n in WORKLOADS))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=data_folder(""), help="folder of the recordings (%(default)s)")
    parser.add_argument("--frames", type=int, default=250, help="frames of each workload at most (%(default)s)")
    parser.add_argument("--beside", metavar="COMMIT", help="run another version in turn")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    return run_and_report_errors(run, parser.parse_args(), "nothing was written")


if __name__ == "__main__":
    sys.exit(main())
