"""Camera tracking and mapping on a recording of 7-Scenes: start, frames tracked, error, time a frame.

    python benchmarks/slam_7scenes.py [--data DIR] [--live]

The focal length is 525 px, as is common practice for the colour camera of these recordings. The error is the
root mean square distance of the camera centres after Sim(3) alignment, over all tracked frames; the truth
itself is good to about a centimetre. Times are of one frame, decoding excluded, one thread, mapping included.
A line before tells what localising takes: back through the same frames, the map frozen.

Other programs must not disturb the times. On Linux, `chrt --fifo 1 python benchmarks/...`, as root, keeps the
processors for this one while it runs; `nice` does not where each session gets the same share.

With --live frames come at 30 a second, as from a camera, those that come while another is worked on are
dropped, and the map is made in a thread beside them. Last come how many were dropped, the median time of a
frame while the thread worked and while it did not, and what a frame waited at most for the mapper, and at the
99th percentile (`benchmarks/slam_long.py` says what counts).
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from morph_dslam import Camera, Frame, MorphError, open_source
from morph_dslam.evaluation.trajectory import absolute_error, match
from morph_dslam.extend import threads_side_by_side
from morph_dslam.extend.slam import Slam, SlamFrame, load_trajectory, trajectory_of, warm_up

ROOT = Path(__file__).parents[2]
FPS = 30.0
CAMERA = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)


def default_data() -> Path:
    return Path(os.environ.get("MORPH_DATA", ROOT / "shared" / "data")) / "7scenes_redkitchen"


def follow(slam: Slam, recorded: list[Frame]) -> list[SlamFrame]:
    """All frames, one after the other."""
    return [
        slam.process_frame(frame.image, frame.index, frame.timestamp)
        for frame in tqdm(recorded, desc="tracking", unit="frame")
    ]


def localise(slam: Slam, frames: list[Frame]) -> str:
    """What a frame takes in the map, which is frozen; those seen last come first."""
    slam.freeze()
    found = [
        slam.process_frame(frame.image, frames[-1].index + number, frames[-1].timestamp + number / FPS)
        for number, frame in enumerate(tqdm(frames[::-1], desc="localising", unit="frame"), start=1)
    ]
    times = [frame.total_ms for frame in found]
    return (
        f"localising: points={np.median([frame.n_points for frame in found]):.0f} "
        f"median_ms={np.median(times):.2f} p95_ms={np.percentile(times, 95):.2f}"
    )


@threads_side_by_side()
def follow_live(slam: Slam, recorded: list[Frame]) -> tuple[list[SlamFrame], str]:
    """The frames that are there in time, and what came of mapping beside them."""
    frames, while_mapping, start = [], [], time.perf_counter()
    while (newest := int((time.perf_counter() - start) * FPS)) < len(recorded):
        if frames and recorded[newest].index == frames[-1].index:
            time.sleep(0.001)
            continue
        frame = recorded[newest]
        while_mapping.append(slam.is_mapping)
        frames.append(slam.process_frame(frame.image, frame.index, frame.timestamp))
    times, busy = np.array([frame.total_ms for frame in frames]), np.array(while_mapping)
    waited = np.array([frame.waited_ms for frame in frames])
    return frames, (
        f" dropped={len(recorded) - len(frames)} mapping_ms={np.median(times[busy]):.2f} "
        f"resting_ms={np.median(times[~busy]):.2f} longest_wait_ms={waited.max():.2f} "
        f"p99_wait_ms={np.percentile(waited, 99):.2f}"
    )


def benchmark(folder: Path, live: bool) -> str:
    """The line of results."""
    warm_up()
    slam, source, more = Slam(CAMERA, threaded=live), open_source(folder), ""
    recorded = list(tqdm(source, total=len(source), desc="loading", unit="frame"))
    if live:
        frames, more = follow_live(slam, recorded)
    else:
        frames = follow(slam, recorded)
    frames = slam.refine_map(frames)
    found = [frame for frame in frames if frame.pose is not None]
    if not found:
        return f"start=inf tracked=0/0 (no map: {frames[-1].reason})"
    estimate, truth = match(trajectory_of(slam, frames), load_trajectory(folder))
    error = np.sqrt(np.mean(absolute_error(estimate, truth, with_scale=True).distances ** 2))
    after = [frame.total_ms for frame in frames if frame.index > found[0].index]
    n_after = sum(frame.index >= found[0].index for frame in frames)
    seen_in_map = [frame for frame in recorded if frame.index >= found[0].index]
    print(localise(slam, seen_in_map))
    print(f"{len(slam.map.keyframes)} keyframes, {len(slam.map.good)} map points", file=sys.stderr)
    return (
        f"start={found[0].index} tracked={len(found)}/{n_after} ate_mm={1e3 * error:.1f} "
        f"median_ms={np.median(after):.2f} p95_ms={np.percentile(after, 95):.2f}{more}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=default_data(), help="folder of a 7-Scenes recording")
    parser.add_argument("--live", action="store_true", help="at the pace of a camera, mapping in a thread")
    arguments = parser.parse_args()
    data = arguments.data
    if not data.is_dir():
        print(f"slam_7scenes: there is no recording {data}; give one with --data", file=sys.stderr)
        # Without --data a missing recording is no mistake: `make bench` goes on.
        return 2 if "--data" in " ".join(sys.argv) else 0
    cv2.setNumThreads(1)
    try:
        print(benchmark(data, arguments.live))
    except MorphError as error:
        print(f"slam_7scenes: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
