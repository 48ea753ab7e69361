"""Where a model comes from, and what could be wrong with its elements. Nothing in it changes from run to run."""

from __future__ import annotations

import hashlib
import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from morph_dslam.mechanics.enhanced_strain import takes_enhanced_strain
from morph_dslam.mechanics.solid_materials import NEARLY_INCOMPRESSIBLE, can_be_mixed
from morph_dslam.mechanics.solvers.linear_solver import default_engine
from morph_dslam.mechanics.spaces import default_order, has_mixed_form
from morph_dslam.model import ReducedModel
from morph_dslam.studies.body_study import BodyStudy
from morph_dslam.studies.external import ExternalStudy
from morph_dslam.studies.sheet_study import SheetStudy
from morph_dslam.studies.shell_study import ShellStudy
from morph_dslam.studies.solid_study import SolidStudy
from morph_dslam.studies.study import Study
from morph_dslam.studies.weights import density_doubts

#: Packages whose release may change a model; one that is not installed is left out.
PACKAGES = ("morph-dslam", "ngsolve", "pypardiso", "mkl", "numba", "numpy", "scipy", "trimesh")


def mesh_hash(model: ReducedModel) -> str:
    """SHA-256 of the mesh: nodes, triangles and cells as they are in memory (float64 and int64)."""
    digest = hashlib.sha256(model.nodes.tobytes() + model.triangles.tobytes())
    for cell_type, connectivity in sorted(model.cells.items()):
        digest.update(cell_type.encode() + connectivity.tobytes())
    return digest.hexdigest()


def linear_solver(study: Study) -> str | None:
    """What factorised the tangents of a study's solves; None for solutions of another program."""
    if isinstance(study, ExternalStudy):
        return None
    return "sparsecholesky" if isinstance(study, SheetStudy) else default_engine()


def provenance(study_text: str, study: Study, model: ReducedModel) -> dict[str, Any]:
    """What a model file says of its origin, in plain JSON types; ``study_text`` is the file's."""
    clock = study.time.parameter if isinstance(study, SolidStudy) and study.time else None
    return {
        "study": study_text,
        "mesh_sha256": mesh_hash(model),
        "linear_solver": linear_solver(study),
        **({"time_parameter": clock} if clock else {}),
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """Releases of what makes a model, by package."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def study_warnings(study: Study) -> list[str]:
    """Sentences on what a study asks for that its elements do not serve, or that is probably not meant."""
    weighed = density_doubts(study) if isinstance(study, SolidStudy | ShellStudy) else []
    return [*_locking(study), *study.doubts(), *weighed] if isinstance(study, BodyStudy) else []


def _locking(study: BodyStudy) -> list[str]:
    """A sentence for each material that is nearly incompressible in displacement elements.

    Constants that are parameters count with their defaults. Mixed elements and the default ones of hex8 cells do not
    lock; materials without a volumetric part, and linear tetrahedra asked for by name, have no mixed form.
    """
    if not isinstance(study, SolidStudy):
        return []
    read = study.variables().reader()
    materials = {f"'{name}'": section.make(read) for name, section in study.materials.items()}
    mesh, solver = study.solid_mesh(), study.solver
    order = solver.order or default_order(mesh)
    if solver.formulation == "automatic" and takes_enhanced_strain(mesh, order):
        return []
    served = has_mixed_form(mesh, order)
    if solver.formulation == "displacement":
        served, advice = False, 'leave out solver.formulation = "displacement"'
    elif not served:
        advice = "leave out solver.order = 1"
    else:
        advice = "give it a law with a volumetric part that does not relax, which mixed elements need"
    return [
        f"the material {name} is nearly incompressible (Poisson's ratio {law.equivalent_poisson:.4f}) in "
        f"displacement elements, which lock: {advice}"
        for name, law in materials.items()
        if not (served and can_be_mixed(law)) and law.equivalent_poisson >= NEARLY_INCOMPRESSIBLE
    ]
