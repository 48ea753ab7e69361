"""What a study leaves open: its method of reduction and its scheme of sampling."""

from __future__ import annotations

from typing import get_args

from morph_dslam.errors import StudyError
from morph_dslam.offline.external import ExternalStudy
from morph_dslam.offline.reduction.galerkin_method import MOST_GRID_PARAMETERS
from morph_dslam.offline.studies.sheet_study import SheetStudy
from morph_dslam.offline.studies.study import Study
from morph_dslam.offline.studies.study_sections import (
    BasisName,
    FormatName,
    MethodName,
    ReductionSection,
    Section,
)

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
    by_dimension: tuple[MethodName, ...] = (
        ("pod", "galerkin") if len(study.parameters) == 1 else ("galerkin", "pod")
    )
    return (*by_dimension, "reduced_basis", "sparse_pgd", "pgd"), ""


def with_choices(study: Study) -> Study:
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


def offered_functions(
    method: MethodName, dimension: int
) -> tuple[tuple[FormatName, ...], tuple[BasisName, ...]]:
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
        raise StudyError(
            'reduction.format = "polynomial" has Chebyshev polynomials: leave out reduction.basis'
        )
    if method in ("sparse_pgd", "pgd"):
        for key, default in (("components", "together"), ("inner_product", "mass")):
            if getattr(options, key) != default:
                raise StudyError(
                    f'reduction.{key} is for modes of solutions, and method "{method}" has products of its '
                    'own: leave it out, or use method "galerkin" or "pod"'
                )
