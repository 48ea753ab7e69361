"""Finding the cell face that has given corner nodes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.offline.meshing.meshes import Mesh

Indices = NDArray[np.int64]


def _packed(corners: Indices) -> NDArray[np.void]:
    """Rows of sorted corners as single comparable values; rows of three corners end in -1."""
    padded = np.full((len(corners), 4), -1, dtype=np.int64)
    padded[:, : corners.shape[1]] = corners
    padded = np.ascontiguousarray(np.sort(padded, axis=1))
    return padded.view(np.dtype((np.void, padded.dtype.itemsize * 4))).ravel()


def find_faces(mesh: Mesh, corners: Indices) -> Indices:
    """Faces (f, 2), cell and local face number, that have the given corners (f, 3 or 4) in any order.

    Between two cells it is the first one's face; where no cell has such a face the row is -1.
    """
    faces = mesh.all_faces()
    known = _packed(mesh.face_nodes(faces, corners_only=True))
    wanted = _packed(np.asarray(corners, dtype=np.int64))
    values, first = np.unique(known, return_index=True)
    if not len(values):
        return np.full((len(wanted), 2), -1, dtype=np.int64)
    place = np.minimum(np.searchsorted(values, wanted), len(values) - 1)
    found = values[place] == wanted
    return np.where(found[:, None], faces[first[place]], -1)
