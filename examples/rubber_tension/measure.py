"""Where discs and speckles of the rubber specimens are in the pictures, found without the tracker or any mechanics.

Discs: the centroid of what is brighter than its surroundings once the speckles are smoothed away. Speckles: optical
flow from each frame to the next (Lucas and Kanade 1981), checked backwards. Both give tracks: rows of frame, id, u, v.
This file shares no code with morph-dslam.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
#: Width of the median that takes the speckles off a disc, half the window around it, pixels, and grey levels by which
#: it is brighter than the rubber.
SPECKLE, WINDOW_DISC, LEAST_CONTRAST = 15, 36, 20.0
#: Speckles that are followed, side of their windows, and the largest distance between there and back, pixels.
SPECKLES, WINDOW, LARGEST_GAP = 600, 31, 0.3


@dataclass(frozen=True)
class Tracks:
    """Image points over time.

    Attributes
    ----------
    pixels : (f, n, 2), column and row in the recorded pictures; NaN where a point was not found.
    """

    pixels: Array

    def write(self, path: Path) -> None:
        """Write the rows frame, id, u, v."""
        with path.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["frame", "id", "u", "v"])
            for frame, number in zip(*np.nonzero(np.isfinite(self.pixels[:, :, 0])), strict=True):
                u, v = self.pixels[frame, number]
                writer.writerow([frame, number, f"{u:.3f}", f"{v:.3f}"])


def pictures(video: Path, last: int) -> Iterator[Image]:
    """The grey pictures (h, w) up to a frame."""
    capture = cv2.VideoCapture(str(video))
    for _ in range(last + 1):
        found, picture = capture.read()
        if not found:
            break
        yield cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    capture.release()


def disc_tracks(video: Path, centres: Array, last: int) -> Tracks:
    """Centroids of bright discs.

    Parameters
    ----------
    video : the recording.
    centres : (n, 2) about where the discs are in the first frame, pixels.
    last : frame to end with.
    """
    found, guesses = [], np.array(centres, dtype=np.float64)
    for picture in pictures(video, last):
        smooth = cv2.medianBlur(picture, SPECKLE).astype(np.float64)
        now = np.array([_centroid(smooth, guess) for guess in guesses])
        guesses = np.where(np.isfinite(now), now, guesses)
        found.append(now)
    return Tracks(np.array(found))


def _centroid(smooth: Array, guess: Array) -> Array:
    """The centroid (2,) of the disc around a guess, as a grey value between its surroundings and its middle weighs
    it; NaN where there is no disc, or it is partly outside."""
    centre, rows_columns = guess, np.mgrid[-WINDOW_DISC : WINDOW_DISC + 1, -WINDOW_DISC : WINDOW_DISC + 1]
    distance = np.hypot(*rows_columns)
    for _ in range(20):
        column, row = np.round(centre).astype(int)
        part = smooth[
            row - WINDOW_DISC : row + WINDOW_DISC + 1, max(column - WINDOW_DISC, 0) : column + WINDOW_DISC + 1
        ]
        if part.shape != distance.shape:
            return np.full(2, np.nan)
        low = np.percentile(part[distance > WINDOW_DISC - 8], 30)
        high = np.median(part[distance < 0.25 * WINDOW_DISC])
        if high - low < LEAST_CONTRAST:
            return np.full(2, np.nan)
        share = np.clip((part - low) / (high - low), 0.0, 1.0)
        _, parts = cv2.connectedComponents((share > 0.5).astype(np.uint8))
        own = cv2.dilate((parts == parts[WINDOW_DISC, WINDOW_DISC]).astype(np.uint8), np.ones((3, 3), dtype=np.uint8))
        weights = np.where((own > 0) & (distance < WINDOW_DISC), share, 0.0)
        rows, columns = rows_columns
        new = np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum() + [column, row]
        step, centre = float(np.linalg.norm(new - centre)), new
        if step < 0.01:
            break
    return np.asarray(centre)


def speckle_tracks(video: Path, last: int, left_out: NDArray[np.bool_] | None = None) -> Tracks:
    """Speckles followed from frame to frame.

    Parameters
    ----------
    video : the recording.
    last : frame to end with.
    left_out : (h, w), where none are chosen.
    """
    source = pictures(video, last)
    before = next(source)
    dark = cv2.GaussianBlur(before, (0, 0), 8.0) < 120
    inside = cv2.erode(dark.astype(np.uint8), np.ones((2 * WINDOW + 1,) * 2, dtype=np.uint8))
    if left_out is not None:
        inside[left_out] = 0
    corners = cv2.goodFeaturesToTrack(before, SPECKLES, 0.02, 20.0, mask=inside, blockSize=9)
    points = corners.reshape(-1, 1, 2).astype(np.float32)
    found, kept = [points[:, 0].astype(float)], np.ones(len(points), dtype=bool)
    for picture in source:
        there, ok, _ = cv2.calcOpticalFlowPyrLK(before, picture, points, None, winSize=(WINDOW, WINDOW), maxLevel=3)
        back, _, _ = cv2.calcOpticalFlowPyrLK(picture, before, there, None, winSize=(WINDOW, WINDOW), maxLevel=3)
        gap = np.linalg.norm(back - points, axis=2)[:, 0]
        kept &= (ok[:, 0] == 1) & (gap < LARGEST_GAP)
        points, before = there, picture
        found.append(np.where(kept[:, None], points[:, 0].astype(float), np.nan))
    return Tracks(np.array(found))
