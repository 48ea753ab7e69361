"""Camera tracking for a long time: noise without end, memory, and what frames wait for the mapper.

    python benchmarks/slam_long.py [--minutes M] [--noise-frames N] [--data DIR]

Three parts, on rendered films:

- Frames of noise. There has to be a reason for waiting in each, and memory has to stay as it is.
- A video of so many minutes at 30 frames a second, a film of a room that is seen forth and back, in the
  first half with a growing map, in the second with a frozen one. Frames are kept as `morph slam` keeps them.
  Printed are the resident memory at most, the film (``film_mb``) and the interpreter included, and in the
  second half at its beginning, at its end, and its slope. With --data the film is a recording instead.
- A round trip at the pace of a camera, the map made beside the frames: what a frame waited at most for the
  mapper, and at the 99th percentile. That is the time of its own steps, and all time in which its thread did
  not run while the mapper's did: on a busy machine that of other programs, too. ``queued_ms`` is the part of
  the longest wait in which it stood in line for a processor, where Linux tells.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.support.rendered_room import CAMERA, RoomFilm, closed_room, hand_held, round_trip

from morph_dslam import Camera, MorphError, open_source
from morph_dslam.extend import threads_side_by_side
from morph_dslam.extend.slam import Slam, SlamFrame, warm_up

Image = NDArray[np.uint8]

FPS = 30
#: Of the round trip, in which drift then grows until there is a loop to close.
SMALL_CAMERA = Camera(480, 360, 380.0, 380.0, 239.5, 179.5)
#: Frames of the rendered film, and between two looks at the memory.
FILM_FRAMES, LOOK_EVERY = 400, 50
SCHEDULE = Path("/proc/thread-self/schedstat")


def resident_mb() -> float:
    """Memory of this process that is in use now, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def forth_and_back(images: list[Image], n: int) -> Iterator[Image]:
    period = [*range(len(images)), *range(len(images) - 2, 0, -1)]
    return (images[period[i % len(period)]] for i in range(n))


def noise(n: int) -> str:
    """Frames of noise; what came of them."""
    rng, slam, status, memory = np.random.default_rng(0), Slam(CAMERA), Counter(), []
    for index in tqdm(range(n), desc="noise", unit="frame"):
        frame = slam.process_frame(rng.integers(0, 256, (480, 640), np.uint8), index, index / FPS)
        status[frame.status if frame.reason else f"{frame.status} without a reason"] += 1
        if index % LOOK_EVERY == 0:
            memory.append(resident_mb())
    settled = memory[len(memory) // 10 :]
    counts = ",".join(f"{name}:{count}" for name, count in status.items())
    return f"noise_frames={n} noise_status={counts} noise_mb={settled[0]:.0f}..{settled[-1]:.0f}"


def video(images: list[Image], camera: Camera, minutes: float) -> str:
    """A growing map for half of the time, a frozen one for the other half."""
    n = int(60 * FPS * minutes)
    slam, records, times = Slam(camera), [], []
    memory: list[tuple[int, float]] = []
    for index, image in enumerate(tqdm(forth_and_back(images, n), total=n, desc="video", unit="frame")):
        if index == n // 2:
            slam.freeze()
        start = time.process_time()
        frame = slam.process_frame(image, index, index / FPS)
        times.append(1e3 * (time.process_time() - start))
        records.append(frame.record(is_final=slam.is_frozen))
        if index % LOOK_EVERY == 0:
            memory.append((index, resident_mb()))
    film_mb, peak_mb = sum(image.nbytes for image in images) / 1e6, max(mb for _, mb in memory)
    late = np.array([look for look in memory if look[0] >= n // 2])
    slope = np.polyfit(late[:, 0] / (60 * FPS), late[:, 1], 1)[0] if len(late) > 2 else np.nan
    return (
        f"minutes={minutes:g} {_counts(records)} keyframes={len(slam.map.kept_keyframes)} "
        f"film_mb={film_mb:.0f} peak_mb={peak_mb:.0f} "
        f"localising_mb={late[0, 1]:.0f}..{late[-1, 1]:.0f} slope_mb_per_minute={slope:.1f} "
        f"mapping_cpu_ms={_figures(times[: n // 2])} localising_cpu_ms={_figures(times[n // 2 :])}"
    )


def _counts(frames: list[SlamFrame]) -> str:
    start = next((i for i, frame in enumerate(frames) if frame.pose is not None), len(frames))
    found = sum(frame.pose is not None for frame in frames)
    return f"start={start} tracked={found}/{len(frames) - start}"


def _figures(times: list[float]) -> str:
    return f"{np.median(times):.1f}/{np.percentile(times, 95):.1f}"


@threads_side_by_side()
def waits() -> str:
    """What frames wait for the mapper, at the pace of a camera, in a round trip that closes a loop."""
    film = RoomFilm(seed=4, scene=closed_room, camera=SMALL_CAMERA, prints=4)
    places = round_trip(200)
    images = [film.frame(place) for place in tqdm(places, desc="rendering", unit="frame")]
    slam, frames, queued, start = Slam(SMALL_CAMERA, threaded=True), [], [], time.perf_counter()
    for index, image in enumerate(tqdm(images, desc="round trip", unit="frame")):
        while time.perf_counter() - start < index / FPS:
            time.sleep(0.001)
        before = _queued_ms()
        frames.append(slam.process_frame(image, index, index / FPS))
        queued.append(_queued_ms() - before)
    waited = np.array([frame.waited_ms for frame in frames])
    steps = [frame.timings_ms["map"] for frame in frames]
    frames = slam.refine_map(frames)
    return (
        f"live_{_counts(frames)} loops={slam.n_loops} longest_step_ms={max(steps):.2f} "
        f"longest_wait_ms={waited.max():.2f} queued_ms={queued[int(waited.argmax())]:.2f} "
        f"p99_wait_ms={np.percentile(waited, 99):.2f} median_wait_ms={np.median(waited[waited > 0]):.2f}"
    )


def _queued_ms() -> float:
    """How long this thread has stood in line for a processor so far."""
    return int(SCHEDULE.read_text().split()[1]) / 1e6 if SCHEDULE.exists() else 0.0


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0, help="length of the video")
    parser.add_argument("--noise-frames", type=int, default=10_000)
    parser.add_argument("--data", type=Path, help="recording of 640x480 at 525 px to see forth and back")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    try:
        if arguments.data is None:
            film, path = RoomFilm(seed=1), hand_held(FILM_FRAMES, seed=1, reach=0.8)
            images = [film.frame(place) for place in tqdm(path, desc="rendering", unit="frame")]
        else:
            recorded = islice(open_source(arguments.data), FILM_FRAMES)
            images = [np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY), np.uint8) for frame in recorded]
        warm_up()
        parts = [noise(arguments.noise_frames), video(images, CAMERA, arguments.minutes), waits()]
    except MorphError as error:
        print(f"slam_long: {error}", file=sys.stderr)
        return 2
    print(" ".join(parts))
    return 0


if __name__ == "__main__":
    sys.exit(main())
