"""Materials that a mesh file brings along: an .inp's *MATERIAL cards, placed by its *SOLID SECTION cards."""

from __future__ import annotations

from collections.abc import Collection
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from morph_dslam.errors import StudyError
from morph_dslam.io.inp_file import InpFile, Section, read_inp
from morph_dslam.mechanics.materials.anisotropic import Orthotropic
from morph_dslam.mechanics.materials.base import Material
from morph_dslam.mechanics.materials.library import material_from_card
from morph_dslam.studies.solid_sections import FileMesh, file_stamp


def file_materials(mesh: Any, given: Collection[str]) -> dict[str, Material]:
    """The materials of a mesh file by element set, SI; none where the mesh is no .inp file.

    The mesh's unit fixes that of stress: MPa with mm, Pa with m. Sections whose elements all have a material
    of the study are passed over, and all of them are if the study gives one to "all".

    Parameters
    ----------
    mesh : a `mesh_section.MeshSection`. given : cell sets to which the study gives materials.

    Raises
    ------
    StudyError
        Naming file and line, if a section's set or material is not there, only some of its elements have a
        material of the study, its axes are turned, or the material cannot be had in SI.
    """
    if not isinstance(mesh, FileMesh) or mesh.file.suffix.lower() != ".inp" or "all" in given:
        return {}
    file = _read(mesh.file, file_stamp(mesh.file))
    taken = np.concatenate([np.zeros(0, np.int64), *(file.element_sets.get(name, []) for name in given)])
    spelled = {name.upper(): name for name in file.element_sets}
    result: dict[str, Material] = {}
    for section in file.sections:
        name = spelled.get(section.element_set.upper())
        if name is None:
            raise section.line.error(f"there is no element set '{section.element_set}' for the section")
        if section.thickness is not None or _is_taken(file, section, name, taken):
            continue
        if name in result:
            raise section.line.error(f"'{name}' has a section already; give each element set one")
        result[name] = _material(file, section, name, mesh.unit)
    return result


@lru_cache(maxsize=2)
def _read(path: Path, stamp: tuple[int, int]) -> InpFile:
    """The file, read once for all that is asked of it, as long as it has this stamp."""
    return read_inp(path)


def _is_taken(file: InpFile, section: Section, name: str, taken: Any) -> bool:
    """Whether the study gives a material to the elements of a section; StudyError if only to some."""
    inside = np.isin(file.element_sets[name], taken)
    if inside.any() and not inside.all():
        raise section.line.error(
            f"{int(inside.sum())} of the {len(inside)} elements of '{name}' have a material of the study "
            "too; give one to the others as well, or to all"
        )
    return bool(inside.any())


def _material(file: InpFile, section: Section, name: str, unit: str) -> Material:
    cards = {name.upper(): card for name, card in file.materials.items()}
    card = cards.get(section.material.upper())
    if card is None:
        known = ", ".join(file.materials) or "none"
        raise section.line.error(
            f"there is no *MATERIAL '{section.material}' for '{name}' (the file has: {known}); "
            "add it, or give the set a material in the study"
        )
    material = material_from_card(card, unit)
    if section.orientation and isinstance(material, Orthotropic):
        raise section.line.error(
            f"ORIENTATION={section.orientation} turns the axes of {card.name}, which is not read; give "
            f"'{name}' a material with axis_1 and axis_2 in the study"
        )
    return material


def require_materials(mesh: Any, materials: Collection[Any]) -> None:
    """Raise StudyError if neither the study nor its mesh file has a material."""
    if not materials:
        where = f"{mesh.file} has none in a *SOLID SECTION" if isinstance(mesh, FileMesh) else "a generator has none"
        raise StudyError(f"materials is missing: add a [materials.NAME] section ({where})")
