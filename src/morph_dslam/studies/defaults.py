"""What a study leaves open: its method of reduction and its scheme of sampling."""

from __future__ import annotations

from itertools import count

from morph_dslam.errors import StudyError
from morph_dslam.model.functions import total_degree_indices
from morph_dslam.reduction.registry import ReductionMethod, reduction_method, reduction_methods
from morph_dslam.reduction.regression import FOLDS
from morph_dslam.studies.body_study import BodyStudy
from morph_dslam.studies.external import ExternalStudy
from morph_dslam.studies.sections import ReductionSection, SamplingSection, Section
from morph_dslam.studies.sheet_study import SheetStudy
from morph_dslam.studies.shell_study import ShellStudy
from morph_dslam.studies.solid_study import SolidStudy
from morph_dslam.studies.study import Study

#: Solves that greedy sampling starts with, beside one for each parameter.
FEWEST = 4
#: Solves that bisection starts with, and held-out ones beside it: with 95 % confidence they bound 82.9 % of the range.
FIRST, HELD_OUT = 5, 16
#: Paths in time for one other parameter and for two; for more, as many as scattered samples.
PATHS = {1: 24, 2: 128}


def resolve_defaults(study: Study) -> Study:
    """The study with its method of reduction and its scheme of sampling chosen.

    Solids with several parameters are reduced by "galerkin" where their equations can be projected, everything else by
    "pod". Galerkin models, and those of one parameter, are sampled adaptively, up to ``sampling.training`` solves,
    where the study has no other scheme.

    Raises
    ------
    StudyError
        If the study asks for a method that does not suit it, or for functions or samples that the method lacks.
    """
    method = _method(study)
    update: dict[str, Section] = {"reduction": study.reduction.model_copy(update={"method": method.name})}
    if not isinstance(study, ExternalStudy):
        dimension = len(study.model_parameters())
        _check_functions(study.reduction, method, dimension)
        in_time = isinstance(study, SolidStudy) and study.time is not None
        sampling = _sampling(study.sampling, method, dimension, _why_no_equations(study) is None, in_time)
        if isinstance(study, BodyStudy) and method.name == "pod" and sampling.scheme in ("sobol", "paths"):
            others = dimension - (sampling.scheme == "paths")
            _check_count(sampling.training, others, _has_slopes(study), study.reduction.max_degree)
        update["sampling"] = sampling
    return study.model_copy(update=update)


def _has_slopes(study: BodyStudy) -> bool:
    """Whether all fields that are reduced have derivatives by the parameters.

    Those of viscoelastic solids are unknown, and those of what holds a shell.
    """
    if isinstance(study, SolidStudy):
        return study.time is None
    return isinstance(study, ShellStudy) and all(support.kind == "foundation" for support in study.supports)


def _check_count(training: int, dimension: int, slopes: bool, max_degree: int) -> None:
    """Refuse fewer samples than a polynomial is fitted to, which shows when all are solved only.

    It is of second degree, or of ``max_degree`` where that is 1.
    """
    rows, terms = 1 + dimension if slopes else 1, len(total_degree_indices(dimension, min(2, max_degree)))
    # What `regression.fit_functions` asks for with one of the parts left out.
    fewest = next(n for n in count(1) if terms <= 0.8 * rows * (n - -(-n // FOLDS)))
    if training < fewest:
        raise StudyError(
            f"sampling.training: {training} samples are too few for {dimension} parameters: give {fewest} at least"
        )


def _why_no_equations(study: Study) -> str | None:
    """Why no method can use the equations of a study; None where one can."""
    if isinstance(study, ExternalStudy):
        return "the equations behind another program's solutions are not known"
    if isinstance(study, SheetStudy):
        return "a sheet's solutions lie on branches that no projection follows"
    if isinstance(study, ShellStudy):
        return "the equations of shells are not projected"
    if study.couplings:
        return "the rigid motions of couplings are not projected"
    if study.contacts:
        return "where points begin to touch, projected equations need not converge"
    return None if study.time is None else "the memory of a viscoelastic solid is not projected"


def _method(study: Study) -> ReductionMethod:
    """The method that the study asks for, or the default for its kind."""
    reason = _why_no_equations(study)
    several = reason is None and len(study.model_parameters()) > 1  # type: ignore[union-attr]
    method = reduction_method(study.reduction.method or ("galerkin" if several else "pod"))
    if method.equations and reason is not None:
        usable = " or ".join(f'"{name}"' for name, known in reduction_methods().items() if not known.equations)
        raise StudyError(f'reduction.method = "{method.name}" does not suit this study: {reason}. Use {usable}')
    return method


def _sampling(
    sampling: SamplingSection, method: ReductionMethod, dimension: int, equations: bool, in_time: bool
) -> SamplingSection:
    bisects = method.bisects and dimension == 1
    follows = in_time and method.name == "pod" and dimension > 1
    scheme = sampling.scheme or ("adaptive" if method.adaptive or bisects else "paths" if follows else "sobol")
    if scheme == "paths" and not follows:
        raise StudyError(
            'sampling.scheme = "paths" is for studies with [time], other parameters besides it, and method = "pod": '
            "leave it out"
        )
    if scheme == "adaptive" and not (method.adaptive or bisects):
        raise StudyError(
            f'sampling.scheme = "adaptive" needs an estimate of the error, which method "{method.name}" '
            'lacks: use scheme = "sobol"' + (', or method = "galerkin"' if equations else "")
        )
    defaults = {"first": sampling.first, "held_out": sampling.held_out}
    if bisects and scheme == "adaptive":
        defaults = {"first": FIRST, "held_out": HELD_OUT}
    elif scheme == "paths":
        defaults["training"] = PATHS.get(dimension - 1, sampling.training)
    elif method.greedy:
        defaults["first"] = dimension + FEWEST  # each choice knows all before it
    chosen = {name: value for name, value in defaults.items() if name not in sampling.model_fields_set}
    chosen["first"] = min(chosen.get("first", sampling.first), chosen.get("training", sampling.training))
    return sampling.model_copy(update={"scheme": scheme, **chosen})


def _check_functions(options: ReductionSection, method: ReductionMethod, dimension: int) -> None:
    """Refuse a format or a basis that a method does not have (StudyError)."""
    formats, bases = method.functions(dimension) if method.functions else (None, None)
    for key, asked, offered in (("format", options.format, formats), ("basis", options.basis, bases)):
        if asked is not None and offered is not None and asked not in offered:
            usable = ", ".join(f'"{name}"' for name in offered)
            raise StudyError(
                f'reduction.{key} = "{asked}" is none that method "{method.name}" has for {dimension} parameter'
                f"{'s' if dimension > 1 else ''}: leave it out, or use one of {usable}"
            )
    if options.format == "polynomial" and method.adaptive and options.basis not in (None, "chebyshev"):
        raise StudyError('reduction.format = "polynomial" has Chebyshev polynomials: leave out reduction.basis')
