"""A cantilever under a moving load, solved once for all positions of the load by a-priori PGD.

The paper's introductory example (its section "How PGD works"), with its figure of modes in space and in the
load's position. The separated solution is compared with direct solves and with the best separation there is,
the singular value decomposition of all of them; then the stiffness of the outer half is made a second
parameter. Figures and results are left in output/.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from cantilever import STIFFNESS_RATIO, Cantilever, build_cantilever, moving_load, moving_load_and_stiffness
from figures import draw_errors, draw_modes
from numpy.typing import NDArray

from morph_dslam.extend import run_and_report_errors
from morph_dslam.extend.reduction import PgdSolution, factorise, khatri_rao, solve_pgd

Array = NDArray[np.float64]

HERE = Path(__file__).resolve().parent
OUTPUT = HERE / "output"
MODE_COUNTS = (1, 3, 5, 10, 20)
STIFFNESS_MODES = 40
#: The tail of nearly equal singular values asks for more iterations than the default spends.
TIGHT: dict[str, Any] = {"tolerance": 0.0, "inner_tolerance": 1e-4, "inner_iterations": 60}
#: Stiffness ratios of the direct solves that the two-parameter solution is compared with.
HELD_OUT = np.geomspace(*STIFFNESS_RATIO, 40)


def on_grid(solution: PgdSolution, *grids: Array) -> Array:
    """The separated solution (n, g_1, ..., g_d) at all points of the grids."""
    tables = tuple(
        basis.evaluate(grid) @ factor
        for basis, factor, grid in zip(solution.functions.bases, solution.functions.factors, grids, strict=True)
    )
    return (solution.modes.T @ khatri_rao(tables).T).reshape(-1, *(len(grid) for grid in grids))


def norm(fields: Array, metric: sp.csc_array) -> float:
    """Root of the sum over fields (n, m) of their squared norms."""
    return float(np.sqrt(np.sum(fields * (metric @ fields))))


def singular_values(fields: Array, metric: sp.csc_array) -> Array:
    """Of all fields (n, m) in the inner product of ``metric``: their tails are the least possible errors."""
    return np.sqrt(np.maximum(np.linalg.eigvalsh(fields.T @ (metric @ fields))[::-1], 0.0))


def compare_one_parameter(beam: Cantilever) -> tuple[PgdSolution, dict[str, list[float]]]:
    """Errors of PGD, of the optimum, and the dual residual, at each number of modes."""
    problem = moving_load(beam)
    stiffness = problem.metric
    exact = factorise(stiffness).solve(beam.loads)
    tails = {
        name: [float(np.linalg.norm(s[count:]) / np.linalg.norm(s)) for count in MODE_COUNTS]
        for name, metric in (("energy", stiffness), ("l2", beam.mass))
        for s in [singular_values(exact, metric)]
    }
    results: dict[str, list[float]] = {key: [] for key in ("energy", "l2", "dual")}
    solution = None
    for count in MODE_COUNTS:
        solution = solve_pgd(problem, count, **TIGHT)
        error = on_grid(solution, beam.positions) - exact
        results["energy"].append(norm(error, stiffness) / norm(exact, stiffness))
        results["l2"].append(norm(error, beam.mass) / norm(exact, beam.mass))
        results["dual"].append(float(solution.residuals[-1]))
    assert solution is not None
    return solution, {**results, "best_energy": tails["energy"], "best_l2": tails["l2"]}


def compare_two_parameters(beam: Cantilever) -> float:
    """Relative L2 error of the solution with a stiffness parameter, over positions and held-out ratios."""
    solution = solve_pgd(moving_load_and_stiffness(beam), STIFFNESS_MODES, tolerance=0.0)
    missed = total = 0.0
    found = on_grid(solution, beam.positions, np.log(HELD_OUT))
    for i, ratio in enumerate(HELD_OUT):
        exact = factorise(sp.csc_array(beam.inner + ratio * beam.outer)).solve(beam.loads)
        missed += norm(found[:, :, i] - exact, beam.mass) ** 2
        total += norm(exact, beam.mass) ** 2
    return float(np.sqrt(missed / total))


def run(_: argparse.Namespace) -> None:
    OUTPUT.mkdir(exist_ok=True)
    beam = build_cantilever()
    print(f"{beam.loads.shape[0]} degrees of freedom, {beam.loads.shape[1]} positions of the load", flush=True)
    solution, results = compare_one_parameter(beam)
    print("modes  energy error (best, dual residual)      L2 error (best)")
    for i, count in enumerate(MODE_COUNTS):
        energy = f"{results['energy'][i]:.3e} ({results['best_energy'][i]:.3e}, {results['dual'][i]:.3e})"
        print(f"{count:5d}  {energy:39s} {results['l2'][i]:.3e} ({results['best_l2'][i]:.3e})")
    draw_modes(beam, solution, OUTPUT / "modes.png")
    draw_errors(MODE_COUNTS, results, OUTPUT / "errors.png")
    two = compare_two_parameters(beam)
    (OUTPUT / "results.json").write_text(json.dumps({"modes": MODE_COUNTS, **results, "two": two}, indent=1))
    print(f"figures and results: {OUTPUT}")
    print(f"with_stiffness_modes={STIFFNESS_MODES} relative_error={two:.2e}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    return run_and_report_errors(run, parser.parse_args(), "nothing was kept")


if __name__ == "__main__":
    sys.exit(main())
