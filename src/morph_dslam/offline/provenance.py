"""Where a model comes from: the study, the mesh, the programs. Nothing in it changes from run to run."""

from __future__ import annotations

import hashlib
import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from morph_dslam.model import ReducedModel
from morph_dslam.offline.external import ExternalStudy
from morph_dslam.offline.solvers.linear_solver import default_engine
from morph_dslam.offline.studies.sheet_study import SheetStudy
from morph_dslam.offline.studies.study import Study

#: Packages whose release may change a model; one that is not installed is left out.
PACKAGES = ("morph-dslam", "ngsolve", "pypardiso", "mkl", "numba", "numpy", "scipy")


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
    return {
        "study": study_text,
        "mesh_sha256": mesh_hash(model),
        "linear_solver": linear_solver(study),
        "versions": _versions(),
    }


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
