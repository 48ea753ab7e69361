"""What a study leaves open: its method of reduction and its scheme of sampling."""

from __future__ import annotations

from morph_dslam.errors import StudyError
from morph_dslam.offline.external import ExternalStudy
from morph_dslam.offline.studies.sheet_study import SheetStudy
from morph_dslam.offline.studies.study import Study
from morph_dslam.offline.studies.study_sections import MethodName, Section

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
