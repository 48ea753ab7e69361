"""The boot seal's path with felupe: benchmarks/boot_seal.py runs it in an environment of its own.

Usage: python felupe_path.py problem.npz result.json. The Newton iteration is felupe's usual one with a
linearised predictor; the linear solver is the project's, so that assembly is what is compared.
"""

from __future__ import annotations

import json
import resource
import sys
import time

import felupe
import numpy as np
from scipy.sparse import csr_matrix

from morph_dslam.mechanics.solvers.linear_solver import LinearSolver

MAX_ITERATIONS = 20


def rotation_about_y(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


class Body:
    """A felupe solid body with its residual and tangent at given nodal displacements."""

    def __init__(self, nodes: np.ndarray, hexes: np.ndarray, shear: float, lame: float) -> None:
        mesh = felupe.Mesh(nodes, hexes, "hexahedron")
        self.field = felupe.FieldContainer([felupe.Field(felupe.RegionHexahedron(mesh), dim=3)])
        self.body = felupe.SolidBody(felupe.NeoHookeCompressible(mu=shear, lmbda=lame), self.field)

    def assemble(self, displacement: np.ndarray) -> tuple[csr_matrix, np.ndarray]:
        self.field[0].values[:] = displacement
        matrix = csr_matrix(self.body.assemble.matrix(self.field, parallel=True))
        matrix.sort_indices()
        vector = self.body.assemble.vector(self.field, parallel=True)
        return matrix, np.asarray(vector.todense()).ravel()


def main() -> None:
    problem = np.load(sys.argv[1])
    nodes, bottom, top = problem["nodes"], problem["bottom"], problem["top"]
    body = Body(nodes, problem["hexes"], float(problem["shear_modulus"]), float(problem["lame_lambda"]))
    free = np.ones(nodes.shape, dtype=bool)
    free[np.concatenate([bottom, top])] = False
    free[problem["symmetry"], 1] = False
    free_dofs = free.ravel()
    solver = LinearSolver(free_dofs, symmetric=True)
    displacement = np.zeros_like(nodes)
    pivot, tolerance = problem["pivot"], float(problem["tolerance"])
    iterations, start, processor = [], time.perf_counter(), time.process_time()
    force = np.zeros(nodes.size)
    for angle in problem["angles"]:
        target = np.zeros_like(nodes)
        target[top] = (nodes[top] - pivot) @ rotation_about_y(angle).T + pivot - nodes[top]
        change = np.where(free, 0.0, target - displacement)
        for iteration in range(MAX_ITERATIONS):
            matrix, force = body.assemble(displacement)
            if iteration and np.linalg.norm(force[free_dofs]) <= tolerance * np.linalg.norm(force[~free_dofs]):
                break
            right = -force
            if iteration == 0:
                right = right - matrix @ change.ravel()
            factors = solver.factorise(matrix.data, matrix.indices, matrix.indptr)
            displacement = displacement + factors.solve(right).reshape(-1, 3)
            if iteration == 0:
                displacement = displacement + change
        iterations.append(iteration)
    seconds, processor = time.perf_counter() - start, time.process_time() - processor
    arms = nodes[top] + displacement[top] - pivot
    moment = np.cross(arms, force.reshape(-1, 3)[top]).sum(axis=0)
    result = {
        "seconds": seconds,
        "processor_seconds": processor,
        "iterations": iterations,
        "moment": float(moment[1]),
        "largest": float(np.abs(displacement).max()),
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    }
    with open(sys.argv[2], "w") as file:
        json.dump(result, file)


if __name__ == "__main__":
    main()
