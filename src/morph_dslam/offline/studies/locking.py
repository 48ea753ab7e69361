"""What could be wrong with a study's solutions: elements that lock on nearly incompressible materials."""

from __future__ import annotations

from typing import Any

import numpy as np

from morph_dslam.offline.mechanics.solid_materials import NEARLY_INCOMPRESSIBLE
from morph_dslam.offline.studies.affine import read_affine
from morph_dslam.offline.studies.file_materials import file_materials
from morph_dslam.offline.studies.solid_study import SolidStudy
from morph_dslam.offline.studies.study import Study


def locking_warnings(study: Study) -> list[str]:
    """A sentence for each material that is nearly incompressible in displacement elements.

    Constants that are parameters count with their defaults. Mixed elements lock neither; materials without a
    volumetric part stay in displacement elements in a mixed study too.
    """
    if not isinstance(study, SolidStudy):
        return []
    parameters = study.model_parameters()
    defaults = np.array([parameter.default for parameter in parameters])

    def read(value: Any, quantity: str | None) -> float:
        return read_affine(value, quantity, parameters)(defaults)

    materials = {f"'{name}'": section.make(read) for name, section in study.materials.items()}
    given = [section.on for section in study.materials.values()]
    materials |= {f"of '{cells}'": law for cells, law in file_materials(study.mesh, given).items()}
    mixed = study.solver.formulation == "mixed"
    return [
        f"the material {name} is nearly incompressible (Poisson's ratio {law.equivalent_poisson:.4f}) in "
        f"displacement elements, which lock: {_advice(mixed)}"
        for name, law in materials.items()
        if not (mixed and law.volumetric_modulus is not None)
        and law.equivalent_poisson >= NEARLY_INCOMPRESSIBLE
    ]


def _advice(mixed: bool) -> str:
    if mixed:
        return "give it a law with a volumetric part, which mixed elements need"
    return 'set solver.formulation = "mixed"'
