"""TOML files that users write, with the errors that reading one can meet."""

from __future__ import annotations

import csv
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import MorphError, RegistrationError


def read_toml(path: Path, what: str, error_class: type[MorphError]) -> dict[str, Any]:
    """The content of a TOML file.

    Parameters
    ----------
    what : what the file is, for the message: "study file" say.

    Raises
    ------
    error_class
        If the file cannot be read or is not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise error_class(f"cannot read the {what} {path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise error_class(f"{path} is not a TOML file: {error}") from error


# Landmark files: points of the undeformed object and where they are seen in the reference frame.
# x_mm,y_mm,z_mm,u_px,v_px
# -210,148.5,0,172.1,74.2


Array = NDArray[np.float64]
#: No millimetres or pixels are meant by what is larger.
LARGEST = 1e7
HEADER = ("x_mm", "y_mm", "z_mm", "u_px", "v_px")


@dataclass(frozen=True)
class Landmarks:
    """``points`` (k, 3) on the undeformed object in its frame, metres; ``pixels`` (k, 2) in the image as
    recorded."""

    points: Array
    pixels: Array


def load_landmarks(path: Path) -> Landmarks:
    """Read a landmark file.

    Raises
    ------
    RegistrationError
        If the file is missing, has another header, or a value is no number, or one that cannot be meant.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if any(cell.strip() for cell in row)]
    except OSError as error:
        raise RegistrationError(f"cannot read the landmarks {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise RegistrationError(f"{path} is not a text file of landmarks") from error
    if not rows or tuple(cell.strip() for cell in rows[0]) != HEADER:
        raise RegistrationError(f"{path}: the first line of a landmark file is {','.join(HEADER)}")
    values = np.array([_values(path, number, row) for number, row in enumerate(rows[1:], start=1)])
    values = values.reshape(-1, len(HEADER))
    return Landmarks(1e-3 * values[:, :3], np.ascontiguousarray(values[:, 3:]))


def _values(path: Path, number: int, row: list[str]) -> list[float]:
    try:
        values = [float(cell) for cell in row]
    except ValueError:
        values = []
    if len(values) != len(HEADER) or not (np.abs(values) < LARGEST).all():
        raise RegistrationError(
            f"{path}: landmark {number} is '{','.join(row)}'; give {len(HEADER)} numbers: {','.join(HEADER)}"
        )
    return values


def save_landmarks(path: Path, landmarks: Landmarks) -> None:
    """Write a landmark file that `load_landmarks` reads."""
    lines = [
        ",".join([*(f"{1e3 * x:.6g}" for x in point), *(f"{x:.4f}" for x in pixel)])
        for point, pixel in zip(landmarks.points, landmarks.pixels, strict=True)
    ]
    path.write_text("\n".join([",".join(HEADER), *lines]) + "\n")


# Point clouds in PLY files, which MeshLab, CloudCompare, Blender and Open3D read.


def save_ply(path: Path, points: NDArray[np.float64]) -> None:
    """Write points (n, 3) as a binary little-endian PLY file."""
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(points)}",
        *(f"property float {axis}" for axis in "xyz"),
        "end_header",
    ]
    path.write_bytes("\n".join(header).encode() + b"\n" + points.astype("<f4").tobytes())
