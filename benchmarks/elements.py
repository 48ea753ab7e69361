"""Hexahedra of first and second order on the same nodes, against finer ones: the table of docs/how/mechanics.md.

Half of the boot seal, cut at its plane of symmetry, with the lever turned by 52 degrees. `hex8` with and without
enhanced strains and `hex27` share their nodes; the reference is `hex27` with twice as many cells along the folds.
Displacements are compared at the nodes, von Mises stresses at the quadrature points of the `hex8` cells (relative L2).
Run: python benchmarks/elements.py (10 minutes)
"""

from __future__ import annotations

import time
import tomllib
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import ngsolve as ngs
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

import morph_dslam as md
from morph_dslam.extend.mechanics import SolidOptions, State, loaded_state

STUDY = Path(__file__).resolve().parents[1] / "examples" / "boot_seal" / "study.toml"
#: hex8 cells along the wall, through it and around half of it.
DIVISIONS = (92, 2, 40)
#: The lever's angle, degrees.
TURNED = 52.0
#: Shear modulus of the study's rubber, Pa.
SHEAR = 3e6 / (2.0 * 1.45)
#: Quadrature points of a cell from 0 to 1, from its middle.
GAUSS = 0.5 / np.sqrt(3.0)
Array = NDArray[np.float64]


@dataclass
class Solution:
    """A deformed half of the seal.

    Attributes
    ----------
    nodes, displacement : (n, 3), m.
    points : (m, 8, 3) quadrature points of the hex8 cells, m.
    von_mises : (m, 8) there, Pa.
    """

    nodes: Array
    displacement: Array
    points: Array
    von_mises: Array


def half_seal(cells: str, divisions: tuple[int, int, int], layers: int) -> Any:
    """The study, in so many ``cells`` along the wall, through it and around half of it, and ``layers`` of collars."""
    content = tomllib.loads(STUDY.read_text())
    # Collars end where meshes of half as many cells have nodes too.
    collars = [
        {"start": start / 46, "stop": stop / 46, "thickness": "0.75 mm", "layers": layers}
        for start, stop in ((0, 18), (35, 46))
    ]
    content["mesh"] |= {
        "cells": cells,
        "divisions": list(divisions),
        "angles": ["0 deg", "180 deg"],
        "collars": collars,
    }
    content["supports"] += [{"kind": "displacement", "on": name, "y": "0 mm"} for name in ("start", "end")]
    return md.make_study(content)


def solve(cells: str, counts: tuple[int, int, int], formulation: str = "automatic") -> Solution:
    """A solution at the end of the path; each cell covers ``counts`` of the hex8 cells."""
    start = time.perf_counter()
    divisions = tuple(n // c for n, c in zip(DIVISIONS, counts, strict=True))
    study = half_seal(cells, divisions, 2 // counts[1])
    mixed = None if formulation == "automatic" else False
    problem = study.problem(SolidOptions(mixed=mixed))
    state = loaded_state(problem, np.array([np.radians(TURNED)]))
    points, stress = at_points(problem, state, counts)
    print(f"{cells}, {formulation}: {problem.mesh.n_nodes} nodes, {time.perf_counter() - start:.0f} s", flush=True)
    return Solution(problem.mesh.nodes, problem.nodal_displacement(state.dofs), points, stress)


def at_points(problem: md.SolidProblem, state: State, counts: tuple[int, int, int]) -> tuple[Array, Array]:
    """Undeformed positions (m, 8, 3) and von Mises stresses (m, 8) of neo-Hookean rubber, from F alone.

    The Cauchy stress is mu / J (F F' - 1) + p 1.
    """
    corners = product(*(range(n) for n in counts))
    points = [
        tuple((np.array(corner) + 0.5 + np.array(point)) / counts)
        for corner in corners
        for point in product((-GAUSS, GAUSS), repeat=3)
    ]
    rule = ngs.IntegrationRule(points, [1.0] * len(points))
    mesh = problem.displacements.geometry.ngs
    at = mesh.MapToAllElements(rule, ngs.VOL)
    place = np.column_stack([np.ravel(x(at)) for x in (ngs.x, ngs.y, ngs.z)])
    F = np.asarray(problem.recovery.deformation_gradient(state.dofs)(at)).reshape(-1, 3, 3)
    stress = SHEAR * (F @ np.swapaxes(F, 1, 2)) / np.linalg.det(F)[:, None, None]
    deviator = stress - np.trace(stress, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3)
    return place.reshape(-1, 8, 3), np.sqrt(1.5 * np.sum(deviator**2, axis=(1, 2))).reshape(-1, 8)


def paired_points(solution: Solution, reference: Solution) -> NDArray[np.int64]:
    """The reference's quadrature point (q,) at each of the solution's.

    Cells of second order are curved, so that cells are paired first, then the points in them.
    """
    _, cell = KDTree(reference.points.mean(axis=1)).query(solution.points.mean(axis=1))
    assert len(np.unique(cell)) == len(cell), "each cell has one of the reference's"
    own, others = (p - p.mean(axis=1, keepdims=True) for p in (solution.points, reference.points[cell]))
    point = np.linalg.norm(own[:, :, None] - others[:, None], axis=3).argmin(axis=2)
    assert np.all(np.sort(point, axis=1) == np.arange(8)), "each point has one of the reference's"
    return (8 * cell[:, None] + point).ravel()


def report(name: str, solution: Solution, reference: Solution) -> None:
    """Print how far a solution is from another one."""
    distance, node = KDTree(reference.nodes).query(solution.nodes)
    assert distance.max() < 1e-6, "the reference has all nodes"
    off = 1e3 * np.linalg.norm(solution.displacement - reference.displacement[node], axis=1)
    there = reference.von_mises.ravel()[paired_points(solution, reference)]
    relative = np.linalg.norm(solution.von_mises.ravel() - there) / np.linalg.norm(there)
    print(f"{name}: mean_mm={off.mean():.3f} largest_mm={off.max():.3f} von_mises_percent={100 * relative:.1f}")


def main() -> None:
    reference = solve("hex27", (1, 2, 2))
    coarse = solve("hex27", (2, 2, 2))
    enhanced, plain = solve("hex8", (1, 1, 1)), solve("hex8", (1, 1, 1), "displacement")
    report("enhanced hex8 against hex27 on the same nodes", enhanced, coarse)
    report("hex8 against hex27 on the same nodes", plain, coarse)
    report("enhanced hex8 against finer hex27", enhanced, reference)
    report("hex8 against finer hex27", plain, reference)
    report("hex27 on the same nodes against finer hex27", coarse, reference)


if __name__ == "__main__":
    main()
