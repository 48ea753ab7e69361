"""Fields at the nodes of a mesh from files of other programs: VTU, VTK, XDMF."""

from __future__ import annotations

from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.io.file_kinds import file_kind
from morph_dslam.meshing.left_out_cells import left_out_cells, why_unread

Array = NDArray[np.float64]
#: Of meshio, by what the file is: `meshio.read` itself ends the program where a file is damaged.
_READERS = {".vtu": meshio.vtu.read, ".vtk": meshio.vtk.read, ".xdmf": meshio.xdmf.read}
#: Nodes may differ by so much of the mesh's size from file to file, which is written in single precision.
SAME = 1e-5


def read_solution(path: Path, step: str | None = None, whole: bool = True) -> meshio.Mesh:
    """A file's mesh and point data; of an XDMF series those of one step.

    Raises StudyError if it is missing, damaged or of another kind, it has no such step, or, where it must be ``whole``,
    it has cells that meshio does not know and leaves out, such as voxels; polylines beside solids may be, save in
    legacy VTK files older than version 5.1, which meshio refuses then.
    """
    if step is not None and not step.isdecimal():
        raise StudyError(f"step '{step}' of {path} is no whole number from 0 on")
    read = _READERS.get(file_kind(path))
    if read is None:
        raise StudyError(f"{path} is no solution that can be read; use {', '.join(_READERS)}")
    try:
        if step is None:
            with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
                content = read(str(path))
            if whole and (left_out := left_out_cells(path, content)):
                raise StudyError(f"{path} holds {left_out}")
            return content
        with meshio.xdmf.TimeSeriesReader(path) as reader:
            if int(step) >= reader.num_steps:
                raise StudyError(f"{path} has no step {step}: its steps are 0 to {reader.num_steps - 1}")
            points, cells = reader.read_points_cells()
            _, point_data, _ = reader.read_data(int(step))
            return meshio.Mesh(np.asarray(points), cells, point_data=point_data)
    except StudyError:
        raise
    except OSError as error:
        raise StudyError(f"cannot read the solution {path}: {error.strerror or error}") from error
    except Exception as error:  # meshio raises whatever its parsers meet
        raise StudyError(f"{path} {why_unread(path, error)}") from error


def points_in_space(content: meshio.Mesh) -> Array:
    """Coordinates (n, 3) of a file's points; those of a plane file lie at z = 0."""
    points = np.zeros((len(content.points), 3))
    points[:, : content.points.shape[1]] = content.points
    return points


def point_data(
    content: meshio.Mesh, name: str, widths: tuple[int, ...], path: Path, used: NDArray[np.bool_] | None = None
) -> Array:
    """Point data by its name.

    Parameters
    ----------
    content : of the file.
    name : of the data.
    widths : numbers of components that it may have.
    path : of the file, for messages.
    used : (n,) nodes to take; all if absent.

    Returns
    -------
    (m, c) values at the nodes taken.

    Raises
    ------
    StudyError
        If there is none of the name, or it has other components or, at nodes taken, values that are not finite.
    """
    if name not in content.point_data:
        if name in content.cell_data:
            raise StudyError(
                f"{path} has '{name}' as cell data, and values at the points are needed: average it to the points "
                "(ParaView: the filter Cell Data to Point Data)"
            )
        known = ", ".join(content.point_data) or "none"
        raise StudyError(f"{path} has no point data '{name}'; it has: {known}")
    values: Any = np.asarray(content.point_data[name], dtype=np.float64)
    values = values.reshape(len(content.points), -1)
    if values.shape[1] not in widths:
        wanted = " or ".join(str(width) for width in widths)
        raise StudyError(f"{path}: '{name}' has {values.shape[1]} components in place of {wanted}")
    values = values if used is None else values[used]
    if not np.isfinite(values).all():
        raise StudyError(f"{path}: '{name}' holds values that are not finite")
    return values
