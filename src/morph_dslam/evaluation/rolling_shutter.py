"""Where the rows of a rolling shutter show the surface: each is recorded at an instant of its own, while all moves on.

A state is that of the middle row's instant, where the tracker knew how the object moves; else it is as the picture
shows the object. How the surface moves follows from the frames before and after: a parabola through its places in the
image.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from morph_dslam.evaluation.run_folder import Run, frames_in_words
from morph_dslam.slam.rolling_shutter import LEAST_GAP_S, MOST_GAP_S, row_times

Array = NDArray[np.float64]
#: Rounds in which the row that shows a node is found, from that where it is at the middle row's instant.
ROUNDS = 4


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


def neighbours(run: Run, row: int) -> list[int]:
    """Up to two frames near a frame that tell how what its rows show has moved on from the middle row's instant.

    None of a global shutter, nor where the state is as the picture shows the object; other such states count last.
    """
    times, tracked, known = run.timestamps, run.tracked, run.motion_known
    if not run.camera.readout_s or times is None or known is None or not known[row]:
        return []
    beside: list[int] = []
    near = [one for one in (row - 1, row + 1, row - 2, row + 2) if 0 <= one < len(times) and tracked[one]]
    for one in sorted(near, key=lambda one: not known[one]):
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
    why = (
        f"the tracker found the object anew there, had no frame with a time of its own less than {MOST_GAP_S:g} s "
        "before, or tracked it in none of the frames beside"
    )
    if run.timestamps is None or run.motion_known is None:
        why = "the run has no times, or does not say where the tracker knew"
    return [
        "the camera records its rows one after the other, and it is not known how the object moved meanwhile in "
        f"{frames_in_words(still)}: {why}. Tracks of what moves are off there, and everywhere if they are bound there: "
        "--bind-frame chooses another frame"
    ]
