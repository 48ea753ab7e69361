"""Point clouds in PLY files, which MeshLab, CloudCompare, Blender and Open3D read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray


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
