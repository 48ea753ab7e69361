"""The dual norm of a separated solution's residual: the stopping measure of PGD."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.offline.reduction.separable_problem import SeparableProblem, factorise

Array = NDArray[np.float64]


class DualResidual:
    """sqrt(int r(mu)^T K0^-1 r(mu) dmu), K0 the problem's metric.

    It equals the energy norm of the error where the operator is K0 for all parameters, and is equivalent to
    it otherwise. As the residual is a sum of products, its norm needs only the Gram matrices of its space
    vectors and of its functions of each parameter. These cancel, so relative values below about 1e-7 mean no
    more than "small".
    """

    def __init__(self, problem: SeparableProblem) -> None:
        self._problem = problem
        self._inverse = factorise(problem.metric, True)
        self._lifted = self._inverse.solve(problem.loads)
        self.load_norm = self._norm(problem.loads, self._lifted, list(problem.load_functions))

    def _norm(self, vectors: Array, lifted: Array, functions: list[Array]) -> float:
        """Of sum_s vectors[:, s] prod_k functions[k][s], with ``lifted`` = K0^-1 vectors."""
        product = vectors.T @ lifted
        for axis, values in zip(self._problem.axes, functions, strict=True):
            product = product * ((values * axis.weights) @ values.T)
        return float(np.sqrt(max(np.sum(product), 0.0)))

    def relative(self, modes: Array, coefficients: list[Array]) -> float:
        """Residual of the sum with ``modes`` (n, m) and ``coefficients`` [(n_free, m)], over that of zero."""
        problem = self._problem
        images = np.concatenate([matrix @ modes for matrix in problem.matrices], axis=1)
        functions = [
            np.concatenate([g, np.swapaxes(image @ c, 1, 2).reshape(images.shape[1], -1)])
            for g, image, c in zip(problem.load_functions, problem.images, coefficients, strict=True)
        ]
        vectors = np.concatenate([problem.loads, -images], axis=1)
        lifted = np.concatenate([self._lifted, -self._inverse.solve(images)], axis=1)
        return self._norm(vectors, lifted, functions) / self.load_norm
