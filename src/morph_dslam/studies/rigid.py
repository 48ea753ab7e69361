"""Rigid objects: models of a surface alone, without parameters, study or solutions."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from morph_dslam.errors import StudyError
from morph_dslam.io.writing import check_no_input, writing
from morph_dslam.meshing.mesh_checks import check_extent
from morph_dslam.meshing.mesh_notes import small_extent_note
from morph_dslam.meshing.netgen_meshing import read_surface
from morph_dslam.meshing.surface_repair import refined_surface, repaired_surface
from morph_dslam.model import ReducedModel, SeparatedField, save_model
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.studies.problem import announce
from morph_dslam.studies.provenance import mesh_hash, versions
from morph_dslam.units import to_si

#: Edges of the model are at most this share of the diagonal long: a picture is drawn as flat within each triangle.
LONGEST_EDGE = 1.0 / 24.0


def build_rigid(surface: str | Path, unit: str, output: str | Path | None = None) -> ReducedModel:
    """The model of a rigid object, of which tracking estimates the pose alone.

    Its frame is the file's. Long edges are halved until none is longer than a 24th of the diagonal. What was mended in
    the surface is in ``provenance["repairs"]``, counts by name.

    Parameters
    ----------
    surface : .stl, .obj or .ply file.
    unit : of its coordinates: "m", "cm", "mm" or "um".
    output : the model file to write; None to write none.

    Raises
    ------
    StudyError
        If the file cannot be read, describes no surface, or the unit is not one of length, or so that no object has
        this size.
    """
    path, scale = Path(surface), to_si(1.0, unit, "length")
    if output is not None:
        check_no_input([Path(output)], [path], StudyError)
    found = read_surface(path)
    extent = scale * np.ptp(found.points, axis=0)
    check_extent(extent, str(path))
    try:
        points, triangles, repairs = repaired_surface(found.points, found.triangles)
    except StudyError as error:
        raise StudyError(f"{path} describes no surface: {error}; save it again as a triangulated surface") from error
    for note in small_extent_note(extent, path, unit):
        announce(f"warning: {note}")
    points, triangles = refined_surface(points, triangles, LONGEST_EDGE * float(np.linalg.norm(np.ptp(points, axis=0))))
    none = np.empty(0)
    constant = ParameterFunctions(none, none, np.zeros((1, 0), dtype=np.int64), np.ones((1, 1)))
    model = ReducedModel(
        name=path.stem,
        nodes=scale * points,
        triangles=triangles,
        parameters=(),
        displacement=SeparatedField(np.zeros((1, len(points), 3)), constant),
        provenance={"surface": path.name, "unit": unit, "repairs": repairs},
    )
    model.provenance.update(mesh_sha256=mesh_hash(model), versions=versions())
    if output is not None:
        output = Path(output)
        if not output.parent.is_dir():
            raise StudyError(f"the folder {output.parent} for the model file does not exist: make it first")
        with writing(StudyError, output):
            save_model(output, model)
    return model
