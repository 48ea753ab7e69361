"""What a study leaves open: its method of reduction and its scheme of sampling."""

from __future__ import annotations

import hashlib
import platform
import types
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, get_args

import numpy as np
from pydantic import BaseModel, ValidationError

from morph_dslam.errors import StudyError
from morph_dslam.io.tables import read_toml
from morph_dslam.mechanics.solid_materials import NEARLY_INCOMPRESSIBLE
from morph_dslam.mechanics.solvers.linear_solver import default_engine
from morph_dslam.model import ReducedModel
from morph_dslam.reduction.galerkin_method import MOST_GRID_PARAMETERS
from morph_dslam.studies.affine import read_affine
from morph_dslam.studies.external import ExternalStudy
from morph_dslam.studies.sections import BasisName, FormatName, MethodName, ReductionSection, Section
from morph_dslam.studies.sheet_study import SheetStudy
from morph_dslam.studies.solid_study import SolidStudy

#: Methods that sample adaptively unless the study has another scheme.
ADAPTIVE = ("galerkin", "reduced_basis")

#: Solves that greedy sampling starts with, beside one for each parameter.
FEWEST = 4


def usable_methods(study: Study) -> tuple[tuple[MethodName, ...], str]:
    """The methods that suit a study, its default first, and why there are no others."""
    if isinstance(study, ExternalStudy):
        return ("pod", "sparse_pgd"), "the equations behind another program's solutions are not known"
    if isinstance(study, SheetStudy):
        return ("pod", "sparse_pgd"), "a sheet's solutions lie on branches that no projection follows"
    if study.time is not None:
        return ("pod", "sparse_pgd"), "what a viscoelastic solid remembers is not projected"
    by_dimension: tuple[MethodName, ...] = ("pod", "galerkin") if len(study.parameters) == 1 else ("galerkin", "pod")
    return (*by_dimension, "reduced_basis", "sparse_pgd", "pgd"), ""


def resolve_defaults(study: Study) -> Study:
    """The study with method and sampling scheme said.

    Solids with several parameters are reduced by "galerkin", everything else by "pod"; Galerkin models are
    sampled adaptively, up to ``sampling.training`` solves, unless the study has another scheme. The greedy
    sampling of "reduced_basis" starts with as few solves as can be, since each choice knows all before it.

    Raises
    ------
    StudyError
        If the study asks for a method that does not suit it.
    """
    methods, reason = usable_methods(study)
    method = study.reduction.method or methods[0]
    if method not in methods:
        usable = " or ".join(f'"{name}"' for name in methods)
        raise StudyError(f'reduction.method = "{method}" does not suit this study: {reason}. Use {usable}')
    if not isinstance(study, ExternalStudy):
        _check_functions(study.reduction, method, len(study.model_parameters()))
    update: dict[str, Section] = {"reduction": study.reduction.model_copy(update={"method": method})}
    if not isinstance(study, ExternalStudy):
        sampling = study.sampling
        scheme = sampling.scheme or ("adaptive" if method in ADAPTIVE else "sobol")
        if scheme == "adaptive" and method not in ADAPTIVE:
            raise StudyError(
                f'sampling.scheme = "adaptive" needs an estimate of the error, which method "{method}" '
                'lacks: use scheme = "sobol"' + (', or method = "galerkin"' if "galerkin" in methods else "")
            )
        first = sampling.first
        if method == "reduced_basis" and "first" not in sampling.model_fields_set:
            first = len(study.model_parameters()) + FEWEST
        first = min(first, sampling.training)
        update["sampling"] = sampling.model_copy(update={"scheme": scheme, "first": first})
    return study.model_copy(update=update)


def offered_functions(method: MethodName, dimension: int) -> tuple[tuple[FormatName, ...], tuple[BasisName, ...]]:
    """The formats and bases that a method has for so many parameters, its default format first."""
    if method in ("sparse_pgd", "pgd"):
        return ("cp",), get_args(BasisName)
    if method == "pod":
        return ("polynomial", "tucker", "tensor_train", "cp"), ("chebyshev", "cubic_spline", "hat")
    if dimension <= MOST_GRID_PARAMETERS:
        return ("tucker", "tensor_train", "cp", "polynomial"), ("chebyshev", "cubic_spline", "hat", "fourier")
    return ("tensor_train", "polynomial"), ("chebyshev",)


def _check_functions(options: ReductionSection, method: MethodName, dimension: int) -> None:
    """Refuse a format, a basis or modes that a method does not have (StudyError)."""
    formats, bases = offered_functions(method, dimension)
    for key, asked, offered in (("format", options.format, formats), ("basis", options.basis, bases)):
        if asked is not None and asked not in offered:
            usable = ", ".join(f'"{name}"' for name in offered)
            raise StudyError(
                f'reduction.{key} = "{asked}" is none that method "{method}" has for {dimension} parameter'
                f"{'s' if dimension > 1 else ''}: leave it out, or use one of {usable}"
            )
    if options.format == "polynomial" and method in ADAPTIVE and options.basis not in (None, "chebyshev"):
        raise StudyError('reduction.format = "polynomial" has Chebyshev polynomials: leave out reduction.basis')
    if method in ("sparse_pgd", "pgd"):
        for key, default in (("components", "together"), ("inner_product", "mass")):
            if getattr(options, key) != default:
                raise StudyError(
                    f'reduction.{key} is for modes of solutions, and method "{method}" has products of its '
                    'own: leave it out, or use method "galerkin" or "pod"'
                )


# Where a model comes from: the study, the mesh, the programs. Nothing in it changes from run to run.


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


# Reading study files: which kind of study a file describes, and what is wrong with it.
# A file with a [sheet] is a sheet in two grips, one with [external] names solutions of another program, and
# every other one is a solid.


Study = SheetStudy | SolidStudy | ExternalStudy


def load_study(path: Path) -> Study:
    """Read a study file; paths in it are relative to it.

    Raises
    ------
    StudyError
        If it is missing, is not TOML, has an unknown or missing key, or a value that cannot be.
    """
    return make_study(read_toml(path, "study file", StudyError), path.parent, str(path))


def make_study(content: Mapping[str, Any], folder: Path = Path(), where: str = "the study") -> Study:
    """A study from the content of a study file.

    Parameters
    ----------
    content : sections and keys as in a study file. folder : what paths in it are relative to.
    where : what messages call it.

    Raises
    ------
    StudyError
        As `load_study`.
    """
    kind = _kind(content)
    try:
        return kind.model_validate(dict(content), context={"folder": folder})
    except ValidationError as error:
        explained = dict.fromkeys(_explain(kind, entry) for entry in error.errors())
        raise StudyError(f"{where}: " + "; ".join(explained)) from error


def _kind(content: Mapping[str, Any]) -> type[Study]:
    if "external" in content:
        return ExternalStudy
    return SheetStudy if "sheet" in content else SolidStudy


def _explain(kind: type[BaseModel], entry: Any) -> str:
    location, section = _without_tags(kind, entry["loc"])
    where = ".".join(str(part) for part in location) or "study"
    if entry["type"] == "extra_forbidden":
        return f"unknown key {where}; known here: {', '.join(section.model_fields)}"
    if entry["type"] == "missing":
        return f"{where} is missing"
    return f"{where}: {entry['msg'].removeprefix('Value error, ')}"


def _without_tags(section: type[BaseModel], location: tuple[int | str, ...]) -> tuple[list[int | str], type[BaseModel]]:
    """The keys of a pydantic error's location as they stand in the file, and the section of the last one.

    Where a section is one of several kinds, pydantic puts the tag of its kind in between.
    """
    keys: list[int | str] = []
    kinds: dict[str, type[BaseModel]] = {}
    for position, part in enumerate(location):
        if part in kinds:
            section, kinds = kinds[str(part)], {}
            continue
        keys.append(part)
        if isinstance(part, str) and part in section.model_fields and position < len(location) - 1:
            kinds = _kinds(section.model_fields[part].annotation)
            section = next(iter(kinds.values()), section)
    return keys, section


def _kinds(annotation: Any) -> dict[str, type[BaseModel]]:
    """The sections that an annotation allows, by the tag of their kind."""
    found: dict[str, type[BaseModel]] = {}
    pending = [annotation]
    while pending:
        item = pending.pop(0)
        if isinstance(item, type) and not isinstance(item, types.GenericAlias) and issubclass(item, BaseModel):
            tag = item.model_fields.get("kind") or item.model_fields.get("generator")
            found[get_args(tag.annotation)[0] if tag else "file"] = item
        pending += get_args(item)
    return found


# What could be wrong with a study's solutions: elements that lock on nearly incompressible materials.


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
    mixed = study.solver.formulation == "mixed"
    return [
        f"the material {name} is nearly incompressible (Poisson's ratio {law.equivalent_poisson:.4f}) in "
        f"displacement elements, which lock: {_advice(mixed)}"
        for name, law in materials.items()
        if not (mixed and law.volumetric_modulus is not None) and law.equivalent_poisson >= NEARLY_INCOMPRESSIBLE
    ]


def _advice(mixed: bool) -> str:
    if mixed:
        return "give it a law with a volumetric part, which mixed elements need"
    return 'set solver.formulation = "mixed"'
