"""Landmark files: points of the undeformed object and where they are seen in the reference frame.

Such a file is CSV, in millimetres and pixels: a first line ``x_mm,y_mm,z_mm,u_px,v_px``, then a line for each point.
Landmarks in the map of a scene have the number of their frame before it, in a first column ``frame``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from morph_dslam.errors import RegistrationError
from morph_dslam.io.text import read_csv

#: No millimetres or pixels are meant by what is larger.
LARGEST = 1e7
FRAME = "frame"
HEADER = ("x_mm", "y_mm", "z_mm", "u_px", "v_px")


@dataclass(frozen=True)
class Landmarks:
    """Points of an object and their pixels, as arrays or lists.

    Attributes
    ----------
    points : (k, 3) on the undeformed object in its frame, metres
    pixels : (k, 2) in the image as recorded
    frames : (k,) numbers of the frames in which they were set; None where all are of the reference frame

    Raises
    ------
    RegistrationError
        If these are no finite numbers, or not of as many landmarks, or a frame has no whole number from 0 on.
    """

    points: NDArray[np.float64]
    pixels: NDArray[np.float64]
    frames: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        for name, columns in (("points", 3), ("pixels", 2)):
            try:
                values = np.asarray(getattr(self, name), dtype=np.float64)
            except (TypeError, ValueError) as error:
                raise RegistrationError(f"{name} of landmarks are no numbers: {error}") from error
            if values.ndim != 2 or values.shape[1] != columns or len(values) != len(self.points):
                raise RegistrationError(
                    f"{name} of landmarks have the shape {values.shape}: give points (k, 3) in metres and as many "
                    "pixels (k, 2)"
                )
            unknown = np.flatnonzero(~np.isfinite(values).all(axis=1))
            if len(unknown):
                raise RegistrationError(
                    f"{name} of landmark {unknown[0] + 1} are {values[unknown[0]].tolist()}: give finite numbers, or "
                    "leave the landmark out"
                )
            object.__setattr__(self, name, values)
        if self.frames is not None:
            object.__setattr__(self, "frames", self._whole(self.frames))

    def _whole(self, frames: ArrayLike) -> NDArray[np.int64]:
        """Numbers of frames (k,), checked."""
        values = np.asarray(frames)
        if values.shape != (len(self.points),) or values.dtype.kind not in "iuf":
            raise RegistrationError(f"frames of landmarks are {frames}: give the number of each landmark's frame")
        wrong = np.flatnonzero(~((values >= 0) & (values < LARGEST) & (values == np.floor(values))))
        if len(wrong):
            raise RegistrationError(
                f"landmark {wrong[0] + 1} is of frame {values[wrong[0]]:g}: frames are counted 0, 1, 2, ..."
            )
        return values.astype(np.int64)


def load_landmarks(path: str | Path) -> Landmarks:
    """Read a landmark file.

    Raises RegistrationError if the file is missing, has another header, or a value is no number, or one that cannot be
    meant.
    """
    path = Path(path)
    rows = [cells for _, cells in read_csv(path, "landmarks", RegistrationError)]
    header = tuple(rows[0]) if rows else ()
    if header not in (HEADER, (FRAME, *HEADER)):
        raise RegistrationError(
            f"{path}: the first line of a landmark file is {','.join(HEADER)}, with {FRAME} before it in a map"
        )
    values = np.array([_values(path, number, row, header) for number, row in enumerate(rows[1:], start=1)])
    values = values.reshape(-1, len(header))
    frames = values[:, 0] if len(header) > len(HEADER) else None
    try:
        return Landmarks(1e-3 * values[:, -5:-2], np.ascontiguousarray(values[:, -2:]), frames)
    except RegistrationError as error:
        raise RegistrationError(f"{path}: {error}") from error


def _values(path: Path, number: int, row: list[str], header: tuple[str, ...]) -> list[float]:
    try:
        values = [float(cell) for cell in row]
    except ValueError:
        values = []
    if len(values) != len(header) or not (np.abs(values) < LARGEST).all():
        raise RegistrationError(
            f"{path}: landmark {number} is '{','.join(row)}'; give {len(header)} numbers: {','.join(header)}"
        )
    return values


def save_landmarks(path: str | Path, landmarks: Landmarks) -> None:
    """Write a landmark file that `load_landmarks` reads."""
    path = Path(path)
    lines = [
        ",".join([*(f"{1e3 * x:.6g}" for x in point), *(f"{x:.4f}" for x in pixel)])
        for point, pixel in zip(landmarks.points, landmarks.pixels, strict=True)
    ]
    header = ",".join(HEADER)
    if landmarks.frames is not None:
        header = f"{FRAME},{header}"
        lines = [f"{frame},{line}" for frame, line in zip(landmarks.frames, lines, strict=True)]
    path.write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")
