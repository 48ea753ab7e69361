"""What a reader of a run must know of its frames, in words: lost ones, their times, depth that was left aside."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from morph_dslam.slam.result import NoPose, SlamFrame, SlamReason, SlamStatus
from morph_dslam.slam.rolling_shutter import LEAST_GAP_S, MOST_GAP_S
from morph_dslam.slam.slam import Slam
from morph_dslam.sources.recorded import DEPTH_SCALE

#: So many frames are named, of more their number.
MOST_NAMED = 5
#: No camera waits so long between frames, seconds: the times are in another unit.
LONGEST_INTERVAL_S = 1e5
#: An estimated readout time may exceed the time between frames by this share: a sensor may read without a pause, and
#: the estimate has an error.
READOUT_ABOVE_INTERVAL = 0.1


def run_notes(slam: Slam, frames: Sequence[SlamFrame], after: Sequence[SlamFrame]) -> Iterator[str]:
    """What a reader of a run must know of its frames.

    Parameters
    ----------
    slam : what made the map
    frames : what each gave
    after : those from the first one on whose camera was found
    """
    n_lost = sum(frame.status is SlamStatus.LOST for frame in after)
    if n_lost:
        yield f"{_counted(n_lost, 'frame')} after the start {_were(n_lost)} lost: frames.csv says why"
    if slam.n_restarts:
        n = slam.n_restarts
        yield f"{_counted(n, 'young map')} {_were(n)} lost for too long and given up, with {_its(n)} poses"
    if (why := why_without_poses(slam, frames, after)) is not None:
        yield why
    if slam.n_depths_aside:
        yield (
            f"{_counted(slam.n_depths_aside, 'depth image')} not registered to the colour {_were(slam.n_depths_aside)} "
            "not used: docs/sources.md says how to register depth"
        )
    yield from time_notes(frames, slam.camera.readout_s)


def why_without_poses(slam: Slam, frames: Sequence[SlamFrame], after: Sequence[SlamFrame]) -> str | None:
    """Why no frame has a pose; None where one has. Parameters as of `run_notes`."""
    if after or not frames:
        return None
    what = "the camera was found in no frame of this map" if slam.knows_map else "no map was begun"
    return f"{what}: {frames[-1].reason}{_depth_advice(frames[-1].reason)}"


def time_notes(frames: Sequence[SlamFrame], readout_s: float = 0.0) -> Iterator[str]:
    """What is wrong with the times of frames, which velocities, a rolling shutter and comparisons rest on.

    Parameters
    ----------
    frames : in the order in which they came
    readout_s : of the camera
    """
    gaps = np.diff([frame.timestamp for frame in frames])
    if not len(gaps):
        return
    interval = float(np.median(gaps))
    if interval > LONGEST_INTERVAL_S:
        yield (
            f"the frames are {interval:.3g} s apart by their timestamps, which are seconds: divide nanoseconds by 1e9 "
            "and microseconds by 1e6"
        )
        return
    if readout_s and interval >= MOST_GAP_S:
        yield (
            f"readout_s of the camera file did not count: the frames are {interval:.3g} s apart by their timestamps, "
            f"which are seconds, and frames more than {MOST_GAP_S:g} s apart do not tell how fast the camera moves"
        )
    numbers = np.array([frame.index for frame in frames[1:]])
    same, back = np.abs(gaps) < LEAST_GAP_S, gaps <= -LEAST_GAP_S
    if same.any():
        yield (
            f"{_named(numbers[same])} {'has' if same.sum() == 1 else 'have'} the timestamp of the frame before: write "
            "timestamps with three decimals at least, or leave out frames that are there twice"
        )
    if back.any():
        yield f"the timestamps go back at {_named(numbers[back])}: the order of the frames is kept"
    if abs(readout_s) > (1.0 + READOUT_ABOVE_INTERVAL) * interval and interval > LEAST_GAP_S:
        yield (
            f"readout_s of the camera file, {abs(readout_s):g} s, is longer than the time between frames, "
            f"{interval:.3g} s, which no camera does: correct one of them"
        )


def _counted(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def _were(n: int) -> str:
    return "was" if n == 1 else "were"


def _its(n: int) -> str:
    return "its" if n == 1 else "their"


def _depth_advice(reason: NoPose | None) -> str:
    """What to do where the depths of a frame are too large, for the end of a sentence."""
    is_far = reason is not None and reason.cause is not None and reason.cause.reason is SlamReason.FAR_DEPTHS
    return f". If the scene is nearer, correct --depth-per-metre, {DEPTH_SCALE}" if is_far else ""


def _named(numbers: NDArray[np.integer]) -> str:
    """The first of them, and how many more there are."""
    more = len(numbers) - MOST_NAMED
    return (
        ("frame " if len(numbers) == 1 else "frames ")
        + ", ".join(str(number) for number in numbers[:MOST_NAMED])
        + (f" and {more} more" if more > 0 else "")
    )
