"""A separable linear problem by pyMOR: benchmarks/reduction_peers.py runs it in an environment of its own.

Usage: python pymor_reduction.py problem.npz result.npz. POD with Galerkin projection from the training
parameters, and the reduced-basis method's weak greedy algorithm with its residual estimator over the same.
"""

from __future__ import annotations

import sys
import time

import numpy as np
import scipy.sparse as sp
from pymor.algorithms.greedy import rb_greedy
from pymor.algorithms.pod import pod
from pymor.basic import set_log_levels
from pymor.models.basic import StationaryModel
from pymor.operators.constructions import LincombOperator, VectorOperator
from pymor.operators.numpy import NumpyMatrixOperator
from pymor.parameters.functionals import ProjectionParameterFunctional
from pymor.reductors.basic import StationaryRBReductor
from pymor.reductors.coercive import CoerciveRBReductor


def full_model(problem: np.lib.npyio.NpzFile) -> StationaryModel:
    """sum_q a_q K_q u = sum_j f_j h_j with the functions' values a and f as parameters."""
    n = len(problem["loads"])
    matrices = [sp.csc_array((d, problem["indices"], problem["indptr"]), shape=(n, n)) for d in problem["stiffness"]]
    operators = [NumpyMatrixOperator(sp.csc_matrix(matrix)) for matrix in matrices]
    stiffness = [ProjectionParameterFunctional("a", len(operators), q) for q in range(len(operators))]
    vectors = [VectorOperator(operators[0].source.from_numpy(column)) for column in problem["loads"].T]
    load = [ProjectionParameterFunctional("f", len(vectors), j) for j in range(len(vectors))]
    middle = sp.csc_array((problem["middle"], problem["indices"], problem["indptr"]), shape=(n, n))
    products = {"energy": NumpyMatrixOperator(sp.csc_matrix(middle))}
    return StationaryModel(LincombOperator(operators, stiffness), LincombOperator(vectors, load), products=products)


def main() -> None:
    set_log_levels({"pymor": "ERROR"})
    with np.load(sys.argv[1]) as problem:
        model = full_model(problem)
        training = [{"a": a, "f": f} for a, f in zip(problem["training_a"], problem["training_f"], strict=True)]
        unseen = [{"a": a, "f": f} for a, f in zip(problem["unseen_a"], problem["unseen_f"], strict=True)]
        counts = [int(count) for count in problem["modes"]]
    energy = model.products["energy"]
    result: dict[str, np.ndarray] = {}

    def record(name: str, reductor: StationaryRBReductor, solves: int, began: float) -> None:
        largest = reductor.reduce()
        result[f"{name}_seconds"], result[f"{name}_solves"] = (np.array(time.process_time() - began), np.array(solves))
        for count in counts:
            reduced = reductor.reduce(count) if count < len(reductor.bases["RB"]) else largest
            asked = time.process_time()
            found = [reductor.reconstruct(reduced.solve(mu)).to_numpy().ravel() for mu in unseen]
            result[f"{name}_{count}_query"] = np.array((time.process_time() - asked) / len(unseen))
            result[f"{name}_{count}"] = np.array(found)

    began = time.process_time()
    snapshots = model.solution_space.empty()
    for mu in training:
        snapshots.append(model.solve(mu))
    modes, _ = pod(snapshots, product=energy, modes=max(counts))
    record("pod", StationaryRBReductor(model, RB=modes, product=energy), len(training), began)
    began = time.process_time()
    greedy = CoerciveRBReductor(model, product=energy)
    found = rb_greedy(model, greedy, [model.parameters.parse(mu) for mu in training], max_extensions=max(counts))
    record("greedy", greedy, found["extensions"], began)
    np.savez(sys.argv[2], **result)


if __name__ == "__main__":
    main()
