"""What a reduced model costs, and how well it predicts, from one to six parameters.

benchmarks/studies/bar.toml is a clamped neo-Hookean bar of 3 435 degrees of freedom in large bending. Its
first one, two, ... six parameters are freed in turn; for each the training solutions below and 59 held-out
ones are solved, and the same solutions are reduced by each method. Errors are those on the held-out ones:
relative in L2 (over all, and of the worst one over the root mean square of all), of the sensitivities (by the
worst parameter) and of the von Mises stress. "Floats" are the numbers that the displacement's model stores.

Solutions are kept in --output; a run that was stopped goes on where it was.
Run: python benchmarks/reduction_growth.py
"""

from __future__ import annotations

import argparse
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from morph_dslam import ReducedModel, make_study
from morph_dslam.extend import run_and_report_errors
from morph_dslam.extend.studies import SolidStudy
from reduction_snapshots import SolvedStudy, solve_study

STUDIES = Path(__file__).resolve().parent / "studies"
OUTPUT = Path(__file__).resolve().parent / "output" / "reduction_growth"
#: Training solutions by the number of parameters.
TRAINING = {1: 8, 2: 24, 3: 64, 4: 128, 5: 200, 6: 300}
#: Points along each parameter of the full grid that is stated for comparison.
GRID_POINTS = 20
#: Tolerance of Galerkin models by the number of parameters, well below the errors asked of them.
TOLERANCE = {1: 3e-4, 2: 3e-4, 3: 3e-4, 4: 5e-4, 5: 5e-4, 6: 5e-4}
METHODS: dict[str, dict[str, Any]] = {
    "galerkin": {},
    "pod": {"tolerance": 1e-5, "max_modes": 40, "max_degree": 12},
    "sparse_pgd": {"max_modes": 30, "max_degree": 8},
}


def freed(content: dict[str, Any], count: int) -> dict[str, Any]:
    """A study's content with its first ``count`` parameters; the others become their defaults."""
    names = list(content["parameters"])
    fixed = {name: content["parameters"][name]["default"] for name in names[count:]}

    def replaced(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: replaced(entry) for key, entry in value.items()}
        if isinstance(value, list):
            return [replaced(entry) for entry in value]
        return fixed.get(value, value) if isinstance(value, str) else value

    kept = {name: content["parameters"][name] for name in names[:count]}
    return {key: replaced(entry) for key, entry in content.items() if key != "parameters"} | {"parameters": kept}


def study_of(count: int, training: int, held_out: int) -> SolidStudy:
    """The bar with its first ``count`` parameters."""
    content = freed(tomllib.loads((STUDIES / "bar.toml").read_text()), count)
    content["sampling"] = {"training": training, "held_out": held_out}
    study = make_study(content, STUDIES, "bar.toml")
    assert isinstance(study, SolidStudy)
    return study


def worst_error(model: ReducedModel, solved: SolvedStudy) -> float:
    """Largest L2 error of a held-out solution over the root mean square of all their norms."""
    truths = [snapshot.fields["displacement"].astype(np.float64) for snapshot in solved.held_out]
    missed = [
        np.linalg.norm(model.displacement.value(snapshot.coordinates) - truth)
        for snapshot, truth in zip(solved.held_out, truths, strict=True)
    ]
    return float(np.max(missed) / np.sqrt(np.mean([np.sum(truth**2) for truth in truths])))


def row(count: int, method: str, solved: SolvedStudy, **options: Any) -> tuple[str, float]:
    """A line of the table, and the relative error."""
    began = time.perf_counter()
    model = solved.reduce(method, **options)
    seconds = time.perf_counter() - began
    certificate = model.certificate
    error = certificate["displacement"]["relative_l2"]
    slopes = max(entry["relative_l2"] for entry in certificate["sensitivity"].values())
    stress = certificate["stress_solid"]["von_mises"]["relative_l2"]
    line = (
        f"{count:2d} {len(solved.training):6d} {solved.seconds:7.0f} {method:11s} {seconds:7.0f} "
        f"{model.displacement.n_modes:5d} {model.displacement.n_floats:8d} {error:8.1e} "
        f"{worst_error(model, solved):8.1e} {slopes:8.1e} {stress:8.1e}"
    )
    return line, error


HEAD = (
    f"{'d':>2s} {'solves':>6s} {'s':>7s} {'method':11s} {'s':>7s} {'modes':>5s} {'floats':>8s} "
    f"{'error':>8s} {'worst':>8s} {'sensit.':>8s} {'Mises':>8s}"
)


def run(arguments: argparse.Namespace) -> None:
    print(HEAD, flush=True)
    errors = {}
    for count in arguments.parameters:
        training = arguments.training or TRAINING[count]
        study = study_of(count, training, arguments.held_out)
        folder = arguments.output / f"bar_{count}"
        solved = solve_study(study, folder, arguments.workers)
        for method in arguments.methods:
            options = METHODS[method] or {"tolerance": TOLERANCE[count]}
            line, errors[count, method] = row(count, method, solved, **options)
            print(line, flush=True)
        print(f"   a full grid of {GRID_POINTS} values needs {GRID_POINTS**count} solves", flush=True)
    print(" ".join(f"{method}_{count}={error:.2e}" for (count, method), error in errors.items()))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--parameters", type=int, nargs="+", choices=TRAINING, default=list(TRAINING), help="numbers of them"
    )
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--training", type=int, help="solutions, in place of the numbers in the table")
    parser.add_argument("--held-out", type=int, default=59, help="solutions (default %(default)s)")
    parser.add_argument("--workers", type=int, help="processes; one a core unless said otherwise")
    parser.add_argument("--output", type=Path, default=OUTPUT, help="folder (default %(default)s)")
    return run_and_report_errors(run, parser.parse_args(), "the solutions so far are kept")


if __name__ == "__main__":
    sys.exit(main())
