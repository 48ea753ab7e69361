"""The boot seal's error against the number of modes, beside the paper's own curve.

The positions solved by examples/boot_seal/run.py are reduced by POD with Chebyshev polynomials and by sparse
PGD with Chebyshev polynomials and with hats. The error is the paper's: the mean over all nodes of their
distance from the solution, of positions that the reduction has not seen. What the example's output does not
hold is solved first: 104 positions take 6 minutes on two cores, 397 (--positions 397) about 20. Compression
is stated for the positions solved, and for the 397 that the paper's own figures imply. The paper's seal is
known from its description alone; ours has its size, mesh and motion.
Run: python benchmarks/reduction_boot_seal.py
"""

from __future__ import annotations

import argparse
import sys
import time
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

from matplotlib.figure import Figure

from morph_dslam.extend import run_and_report_errors
from morph_dslam.extend.reduction import compression_percent, read_reference_curve
from reduction_snapshots import SolvedStudy, solve_study

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "boot_seal"
#: The paper's figure of the mean error (mm) against the number of modes.
PAPER = read_reference_curve(EXAMPLE / "paper_errors.csv")
#: Positions that the paper's compression of 92.58 % with 29 modes implies.
PAPER_POSITIONS = 397
MOST_MODES = 12
#: Sparse PGD is fitted anew for each of these numbers of modes.
SPARSE_MODES = (1, 2, 3, 4, 5, 6, 8, 10, 12)
#: Hats of the lever's angle.
HATS = 12


def example() -> ModuleType:
    """The example's program as a module."""
    spec = spec_from_file_location("boot_seal_example", EXAMPLE / "run.py")
    assert spec
    assert spec.loader
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def pod_curve(positions: SolvedStudy) -> list[tuple[int, float]]:
    """Modes and mean error (mm) of POD cut to its first modes."""
    model = positions.displacements().reduce("pod", tolerance=1e-9, max_modes=MOST_MODES)
    return list(enumerate(model.certificate["displacement"]["mean_mm_by_modes"], start=1))


def sparse_pgd_curve(positions: SolvedStudy, basis: str, degree: int) -> list[tuple[int, float]]:
    """Modes and mean error (mm) of sparse PGD, fitted anew for each number of modes."""
    curve: dict[int, float] = {}
    for most in SPARSE_MODES:
        options = {"basis": basis, "max_modes": most, "max_degree": degree}
        model = positions.displacements().reduce("sparse_pgd", **options)
        curve[model.displacement.n_modes] = model.certificate["displacement"]["mean_mm"]
    return sorted(curve.items())


def draw(curves: dict[str, list[tuple[int, float]]], path: Path) -> None:
    """All curves in one picture."""
    figure = Figure(figsize=(7.5, 5.0), layout="constrained")
    axes = figure.subplots()
    axes.semilogy(PAPER.modes, PAPER.mean_mm, "k--", linewidth=2, label=PAPER.label)
    for (name, curve), marker in zip(curves.items(), "osv", strict=True):
        axes.semilogy(*zip(*curve, strict=True), marker + "-", markersize=4, label=name)
    axes.set(xlabel="modes", ylabel="mean error of the displacement / mm", xlim=(0, 30))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=110)


def print_curves(curves: dict[str, list[tuple[int, float]]]) -> None:
    """One line for each number of modes, errors in mm."""
    paper = dict(enumerate(PAPER.mean_mm.tolist(), start=1))
    columns = {"the paper": paper} | {n: dict(c) for n, c in curves.items()}
    print("modes " + " ".join(f"{name:>24s}" for name in columns))
    for modes in sorted(set().union(*(curve for name, curve in columns.items() if name != "the paper"))):
        cells = [f"{column[modes]:24.3g}" if modes in column else f"{'':24s}" for column in columns.values()]
        print(f"{modes:5d} " + " ".join(cells))


def run(arguments: argparse.Namespace) -> None:
    study = example().read_study(arguments.divisions, None, arguments.positions)
    positions = solve_study(study, arguments.output / "boot_seal.morph.snapshots")
    began = time.perf_counter()
    model = positions.reduce("pod")
    seconds = time.perf_counter() - began
    curves = {
        "POD, Chebyshev": pod_curve(positions),
        "sparse PGD, Chebyshev": sparse_pgd_curve(positions, "chebyshev", study.reduction.max_degree),
        "sparse PGD, hats": sparse_pgd_curve(positions, "hat", HATS - 1),
    }
    draw(curves, arguments.output / "error_by_modes.png")
    print_curves(curves)
    certificate = model.certificate
    solved = len(positions.training) + len(positions.held_out)
    print(
        f"positions={solved} held_out={len(positions.held_out)} modes={model.displacement.n_modes} "
        f"mean_mm={certificate['displacement']['mean_mm']:.6f} "
        f"max_mm={certificate['displacement']['max_mm']:.5f} "
        f"von_mises_error={certificate['stress_solid']['von_mises']['relative_l2']:.2e} "
        f"compression_percent={compression_percent(model, solved):.2f} "
        f"compression_of_{PAPER_POSITIONS}_percent={compression_percent(model, PAPER_POSITIONS):.2f} "
        f"reduction_seconds={seconds:.1f}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--positions", type=int, help="solved in all (default: those of the study, 104)")
    parser.add_argument("--divisions", type=int, nargs=3, metavar="N", help="a coarser mesh, as the example's")
    parser.add_argument("--output", type=Path, default=EXAMPLE / "output", help="folder (%(default)s)")
    return run_and_report_errors(run, parser.parse_args(), "the positions solved so far are kept")


if __name__ == "__main__":
    sys.exit(main())
