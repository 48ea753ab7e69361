"""A viscoelastic strip with time as a coordinate: how well a reduced model predicts its creep.

benchmarks/studies/creep.toml is solved on a grid of times and pulls, and at 59 held-out samples anywhere in
the box, which each follow time from the start. The same solutions are reduced by POD with splines over the
grid (Tucker) and by sparse PGD. Errors are relative in L2 over the held-out solutions, of the displacements
and of the von Mises stress. A picture shows the end's displacement over time for four pulls.

Solutions are kept in --output; a run that was stopped goes on where it was.
Run: python benchmarks/reduction_creep.py
"""

from __future__ import annotations

import argparse
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from morph_dslam import ReducedModel, make_study
from morph_dslam.extend import run_and_report_errors
from morph_dslam.extend.studies import SolidStudy
from reduction_snapshots import SolvedStudy, solve_study

STUDY = Path(__file__).resolve().parent / "studies" / "creep.toml"
OUTPUT = Path(__file__).resolve().parent / "output" / "reduction_creep"
METHODS: dict[str, dict[str, Any]] = {
    "pod": {},
    "sparse_pgd": {"basis": "cubic_spline", "max_modes": 30, "max_degree": 15},
}


def read_study(points: list[int] | None, held_out: int | None, divisions: list[int] | None) -> SolidStudy:
    """The study, if wished with another grid, number of held-out samples and mesh."""
    content = tomllib.loads(STUDY.read_text())
    sampling, mesh = content["sampling"], content["mesh"]
    sampling["points"] = points or sampling["points"]
    sampling["held_out"] = held_out or sampling["held_out"]
    mesh["divisions"] = divisions or mesh["divisions"]
    study = make_study(content, STUDY.parent, STUDY.name)
    assert isinstance(study, SolidStudy)
    return study


def reduce_and_report(solved: SolvedStudy, method: str) -> ReducedModel:
    """A model by one method, its figures printed."""
    began = time.perf_counter()
    model = solved.reduce(method, **METHODS[method])
    seconds = time.perf_counter() - began
    error, stress = errors_of(model)
    print(
        f"{method:11s} {model.displacement.n_modes:5d} {model.displacement.n_floats:8d} {error:8.1e} "
        f"{stress:8.1e} {seconds:6.0f}",
        flush=True,
    )
    return model


def errors_of(model: ReducedModel) -> tuple[float, float]:
    """Relative L2 errors of the displacement and of the von Mises stress."""
    certificate = model.certificate
    stress = certificate["stress_solid"]["von_mises"]["relative_l2"]
    return certificate["displacement"]["relative_l2"], stress


def draw(model: ReducedModel, solved: SolvedStudy, path: Path) -> None:
    """The end's displacement along the strip over time for four pulls, and all solved values of them."""
    figure = Figure(figsize=(7.5, 5.0), layout="constrained")
    axes = figure.subplots()
    end = np.flatnonzero(model.nodes[:, 2] > model.nodes[:, 2].max() - 1e-9)
    pulls = np.unique([snapshot.coordinates[1] for snapshot in solved.training])
    times = np.linspace(model.lower[0], model.upper[0], 200)
    for pull in pulls[np.linspace(0, len(pulls) - 1, 4).astype(int)]:
        line = [model.displacement.value(np.array([t, pull]))[end, 2].mean() for t in times]
        axes.plot(times, 1e3 * np.array(line), color="#2f6690")
        axes.annotate(f"{1e-3 * pull:.0f} kPa", (times[-1], 1e3 * line[-1]), (5, -3), textcoords="offset points")
        solutions = [s for s in solved.training if s.coordinates[1] == pull]
        means = [1e3 * s.fields["displacement"][end, 2].mean() for s in solutions]
        axes.plot([s.coordinates[0] for s in solutions], means, "k.", markersize=4)
    axes.plot([], [], "k.", label="solved")
    axes.plot([], [], color="#2f6690", label="reduced model")
    axes.set(xlabel="time / s", ylabel="displacement of the end / mm", xlim=(times[0], 1.12 * times[-1]))
    axes.legend(frameon=False, loc="upper left")
    figure.savefig(path, dpi=110)


def run(arguments: argparse.Namespace) -> None:
    study = read_study(arguments.points, arguments.held_out, arguments.divisions)
    solved = solve_study(study, arguments.output / "snapshots", arguments.workers)
    print(f"{len(solved.training)} training solutions, {len(solved.held_out)} held out, {solved.seconds:.0f} s")
    print(f"{'method':11s} {'modes':>5s} {'floats':>8s} {'error':>8s} {'Mises':>8s} {'s':>6s}")
    models = {method: reduce_and_report(solved, method) for method in METHODS}
    draw(models["pod"], solved, arguments.output / "creep.png")
    error, stress = errors_of(models["pod"])
    print(
        f"solves={len(solved.training)} held_out={len(solved.held_out)} modes={models['pod'].displacement.n_modes} "
        f"relative_error={error:.2e} von_mises_error={stress:.2e}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, nargs=2, metavar="N", help="of the grid, of times and of pulls")
    parser.add_argument("--held-out", type=int, help="solutions (default: those of the study, 59)")
    parser.add_argument("--divisions", type=int, nargs=3, metavar="N", help="cells along x, y and z")
    parser.add_argument("--workers", type=int, help="processes; one a core unless said otherwise")
    parser.add_argument("--output", type=Path, default=OUTPUT, help="folder (default %(default)s)")
    return run_and_report_errors(run, parser.parse_args(), "the solutions so far are kept")


if __name__ == "__main__":
    sys.exit(main())
