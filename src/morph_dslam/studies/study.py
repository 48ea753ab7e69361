"""Reading study files: which kind of study a file describes, and what is wrong with it.

A file with a [sheet] is a sheet in two grips, one with a [shell] a shell, one with [external] names solutions of
another program, and every other one is a solid.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from morph_dslam.errors import StudyError
from morph_dslam.io.file_kinds import file_kind
from morph_dslam.io.sections import explain
from morph_dslam.io.text import read_toml
from morph_dslam.meshing.mesh_files import load_mesh
from morph_dslam.meshing.mesh_notes import file_deviation, file_notes
from morph_dslam.meshing.meshes import Mesh
from morph_dslam.studies.external import ExternalStudy
from morph_dslam.studies.external_table import SolutionTable
from morph_dslam.studies.material_sections import MaterialSection
from morph_dslam.studies.set_sections import with_sets
from morph_dslam.studies.sheet_study import SheetStudy
from morph_dslam.studies.shell_sections import shell_mesh
from morph_dslam.studies.shell_study import ShellStudy
from morph_dslam.studies.solid_sections import make_mesh
from morph_dslam.studies.solid_study import SolidStudy
from morph_dslam.units import to_si

Study = SheetStudy | ShellStudy | SolidStudy | ExternalStudy


def study_file(path: str | Path) -> Path:
    """The file of a study that is named by its file, or by the folder of a file study.toml."""
    path = Path(path)
    return path / "study.toml" if path.is_dir() else path


def load_study(path: str | Path) -> Study:
    """Read a study file, or the file study.toml of a folder; paths in it are relative to it.

    Raises
    ------
    StudyError
        If it is missing, is not TOML, has an unknown or missing key, or a value that cannot be.
    """
    path = study_file(path)
    return make_study(read_toml(path, "study file", StudyError), path.parent, str(path))


def make_study(content: Mapping[str, Any], folder: str | Path = Path(), where: str = "the study") -> Study:
    """A study from the content of a study file.

    Parameters
    ----------
    content : sections and keys as in a study file.
    folder : what paths in it are relative to.
    where : what messages call it.

    Raises
    ------
    StudyError
        As `load_study`.
    """
    kind = _kind(content)
    try:
        return kind.model_validate(dict(content), context={"folder": Path(folder)})
    except ValidationError as error:
        raise StudyError(f"{where}: {explain(kind, error, content)}") from error


def input_files(study: Study) -> list[Path]:
    """The files that a study names, and those of its solutions where it has a table of them.

    Raises StudyError if such a table cannot be read.
    """
    files = list(_named_files(study))
    if isinstance(study, ExternalStudy):
        table = SolutionTable(study.external.table)
        solutions = [table.path.parent / row["file"] for row in table.rows]
        beside = [path.with_suffix(".h5") for path in solutions if file_kind(path) == ".xdmf"]
        files += [*solutions, *beside]
    return files


def _named_files(part: object) -> Iterator[Path]:
    """All paths in a part of a study."""
    if isinstance(part, Path):
        yield part
    elif isinstance(part, Mapping):
        yield from _named_files(tuple(part.values()))
    elif isinstance(part, list | tuple):
        for each in part:
            yield from _named_files(each)
    elif isinstance(part, BaseModel):
        if isinstance(part, MaterialSection) and part.file is not None:
            yield part.file
        for _, value in part:
            yield from _named_files(value)


def mesh_of_file(path: str | Path, unit: str, size: float | None = None) -> Mesh:
    """The mesh of a study file with the sets that it makes, whichever it names, or of a mesh file.

    Raises StudyError as `load_study` and `load_mesh`, or if a study has no mesh.

    Parameters
    ----------
    path : study file (.toml) or mesh file.
    unit : of a mesh file's coordinates.
    size : longest edge of a cell in that unit, where Netgen meshes a mesh file's volume.
    """
    path = Path(path)
    if path.suffix != ".toml":
        return load_mesh(path, unit, None if size is None else to_si(size, unit, "length"))
    study = load_study(path)
    if isinstance(study, SolidStudy):
        return with_sets(make_mesh(study.mesh), study.sets)
    if isinstance(study, ShellStudy):
        return with_sets(shell_mesh(study.mesh), study.sets)
    raise StudyError(f"{path} has no [mesh]: sheets in grips and solutions of other programs have no sets to name")


def mesh_notes(path: str | Path, unit: str, size: float | None, mesh: Mesh) -> list[str]:
    """Sentences on the ``mesh`` that `mesh_of_file` has made: how far it is from its file, what was mended.

    Parameters
    ----------
    path, unit, size : those of `mesh_of_file`.
    mesh : the result.
    """
    path = Path(path)
    if path.suffix != ".toml":
        return file_notes(mesh, path, unit, None if size is None else to_si(size, unit, "length"))
    study = load_study(path)
    return study_mesh_notes(study, mesh) if isinstance(study, SolidStudy | ShellStudy) else []


def study_mesh_notes(study: SolidStudy | ShellStudy, mesh: Mesh) -> list[str]:
    """The same of the ``mesh`` of a study; none where a generator makes it."""
    section: Any = study.mesh
    if getattr(section, "file", None) is None:
        return []
    return file_notes(mesh, section.file, section.unit, getattr(section, "size", None))


def study_mesh_deviation(study: SolidStudy | ShellStudy, mesh: Mesh) -> dict[str, float] | None:
    """How far the ``mesh`` of a study is off the surface of its file (`file_deviation`)."""
    section: Any = study.mesh
    if getattr(section, "file", None) is None:
        return None
    return file_deviation(mesh, section.file, section.unit, getattr(section, "size", None))


def _kind(content: Mapping[str, Any]) -> type[Study]:
    kinds: dict[str, type[Study]] = {"external": ExternalStudy, "sheet": SheetStudy, "shell": ShellStudy}
    return next((kind for section, kind in kinds.items() if section in content), SolidStudy)
