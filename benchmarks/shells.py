"""Shells from study files against the published tables of Sze, Liu and Lo (2004).

    python benchmarks/shells.py [cantilever hemisphere slit_plate pinched]

Each line is a load, as a part of the largest, with displacements here, those published, and the difference in percent.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from time import perf_counter

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.support.shells import (
    CANTILEVER,
    CANTILEVER_STUDY,
    HEMISPHERE,
    HEMISPHERE_STUDY,
    PINCHED,
    PINCHED_STUDY,
    SLIT_PLATE,
    SLIT_PLATE_STUDY,
    SolvedShell,
    solved_shell,
)


def cantilever(shell: SolvedShell) -> tuple[float, ...]:
    """-U and W of the tip in thickness units of the table."""
    along, _, up = 100.0 * shell.displacement("x_max")
    return -along, up


def hemisphere(shell: SolvedShell) -> tuple[float, ...]:
    """Displacement under the outward and under the inward force, mm."""
    return 1e3 * shell.displacement("outwards")[0], -1e3 * shell.displacement("inwards")[1]


def slit_plate(shell: SolvedShell) -> tuple[float, ...]:
    """Deflection of the inner and of the outer corner of the loaded end, mm."""
    end = shell.problem.mesh.set_nodes("end")
    radius = np.linalg.norm(shell.problem.mesh.nodes[end], axis=1)
    inner, outer = 1e3 * shell.field("displacement")[end[[np.argmin(radius), np.argmax(radius)]], 2]
    return inner, outer


def pinched(shell: SolvedShell) -> tuple[float, ...]:
    """Deflection under the force, mm."""
    return (-1e3 * shell.displacement("middle")[1],)


#: Study, published values, and what of a solution they are.
CASES: dict[str, tuple[str, Mapping[float, float | tuple[float, ...]], Callable[[SolvedShell], tuple[float, ...]]]] = {
    "cantilever": (CANTILEVER_STUDY.format(n=16, cells="quad9"), CANTILEVER, cantilever),
    "hemisphere": (HEMISPHERE_STUDY.format(n=16, cells="quad9"), HEMISPHERE, hemisphere),
    "slit_plate": (SLIT_PLATE_STUDY.format(across=6, around=48, cells="quad9"), SLIT_PLATE, slit_plate),
    "pinched": (PINCHED_STUDY.format(along=16, around=16, cells="quad9"), PINCHED, pinched),
}


def compare(name: str) -> float:
    """Print one table; returns the largest difference at its last load, percent."""
    text, published, measure = CASES[name]
    begin, shell, differences = perf_counter(), solved_shell(text), np.zeros(1)
    print(f"\n{name}: {shell.problem.n_dofs} unknowns\n  load  here / published / %")
    for part, reference in published.items():
        shell = shell.at(part)
        found = np.array(measure(shell))
        differences = 100.0 * (found / np.array(reference) - 1.0)
        columns = zip(found, np.atleast_1d(reference), differences, strict=True)
        print(f"  {part:4.2f}  " + "   ".join(f"{f:8.3f} / {r:8.3f} / {d:+.2f}" for f, r, d in columns), flush=True)
    print(f"  {perf_counter() - begin:.0f} s")
    return float(np.abs(differences).max())


def main() -> None:
    names = sys.argv[1:] or list(CASES)
    largest = {name: compare(name) for name in names}
    print("\n" + " ".join(f"{name}_percent={value:.2f}" for name, value in largest.items()))


if __name__ == "__main__":
    main()
