"""Where the rows of a rolling shutter show the surface: each is recorded at an instant of its own, while all moves on.

A state is that of the middle row's instant, where the frame before told the tracker how the object moves; else it is as
the picture shows the object. How the surface moves follows from the frames before and after: a parabola through its
places in the image.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from morph_dslam.evaluation.run_folder import Run, frames_in_words
from morph_dslam.slam.rolling_shutter import LEAST_GAP_S, MOST_GAP_S, row_times
from morph_dslam.tracking.outcomes import Status

Array = NDArray[np.float64]
#: Rounds in which the row that shows a node is found, from that where it is at the middle row's instant.
ROUNDS = 4
#: Statuses of frames after which the tracker knows how the object moves.
PLACED = frozenset({Status.TRACKED, Status.HIDDEN})


class RecordedNodes:
    """The mesh nodes of a run's frames as the recorded images show them.

    Parameters
    ----------
    run : with its times, if its camera has a rolling shutter.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._at_middle_row = lru_cache(maxsize=5)(run.camera_points)  # a frame is its neighbours' neighbour

    def points(self, row: int) -> Array:
        """Nodes (n, 3) in the camera frame, metres, of a tracked frame.

        Each is moved across its sight line to where its row shows it, if the state is that of the middle row's instant
        and the frames beside this one tell how it moves.
        """
        nodes, beside = self._at_middle_row(row), neighbours(self._run, row)
        camera, times = self._run.camera, self._run.timestamps
        if not beside or times is None:
            return nodes
        rows = [row, *beside]
        places = np.array([camera.project(self._at_middle_row(one)) for one in rows])
        powers = np.vander(times[rows] - times[row], increasing=True)
        here, *slopes = np.linalg.solve(powers, places.reshape(len(rows), -1)).reshape(places.shape)
        pixels = here
        for _ in range(ROUNDS):
            seconds = camera.readout_s * row_times(camera.distort_pixels(pixels)[:, 1:], camera)
            pixels = here + sum(slope * seconds**power for power, slope in enumerate(slopes, start=1))
        moved = nodes[:, 2:] * camera.rays(pixels)
        return np.where(np.isfinite(moved), moved, nodes)  # what is behind the camera has no pixel


def is_at_middle_row(run: Run, row: int) -> bool:
    """Whether the frame before told the tracker how the object moves in a frame, as for `StateHistory`."""
    if row == 0 or run.timestamps is None or run.status[row - 1] not in PLACED:
        return False
    return bool(LEAST_GAP_S <= run.timestamps[row] - run.timestamps[row - 1] < MOST_GAP_S)


def neighbours(run: Run, row: int) -> list[int]:
    """Up to two frames near a frame that tell how what its rows show has moved on from the middle row's instant.

    None of a global shutter, nor where the state is as the picture shows the object; other such states count last.
    """
    times, tracked = run.timestamps, run.tracked
    if not run.camera.readout_s or times is None or not is_at_middle_row(run, row):
        return []
    beside: list[int] = []
    near = [one for one in (row - 1, row + 1, row - 2, row + 2) if 0 <= one < len(times) and tracked[one]]
    for one in sorted(near, key=lambda one: not is_at_middle_row(run, one)):
        if len(beside) < 2:
            gaps = np.abs(times[one] - times[[row, *beside]])
            if gaps.min() >= LEAST_GAP_S and gaps[0] < MOST_GAP_S:
                beside.append(one)
    return beside


def shutter_notes(run: Run, frames: Iterable[int]) -> list[str]:
    """What a reader must know of the frames that were compared: where states are as the picture shows the object."""
    if not run.camera.readout_s:
        return []
    rows = {frame: run.row(frame) for frame in frames}
    still = [frame for frame, row in rows.items() if row is not None and not neighbours(run, row)]
    if not still:
        return []
    return [
        "the camera records its rows one after the other, and the tracker did not know how the object moved meanwhile "
        f"in {frames_in_words(still)}: the frame before is not tracked, or has no time of its own less than "
        f"{MOST_GAP_S:g} s before. Tracks of what moves are off there, and everywhere if they are bound there: "
        "--bind-frame chooses another frame"
    ]
