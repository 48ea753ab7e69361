"""Structures of a few dofs with known solutions, as `Equations` of the offline solver."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp

from morph_dslam.mechanics.solvers.linear_solver import AssembledLinearisation, LinearSolver

Function = Callable[[np.ndarray, np.ndarray], np.ndarray]


class SmallSystem:
    """Dense residual and tangent of a few dofs, with the last parameter-dependent value prescribed if any.

    Parameters
    ----------
    residual : (x, mu) -> (n,)
    tangent : (x, mu) -> (n, n)
    slopes : (x, mu) -> (d, n), of the residual by mu.
    prescribed_dof : dof equal to mu[0], or None.
    """

    def __init__(
        self, n_dofs: int, residual: Function, tangent: Function, slopes: Function, prescribed_dof: int | None = None
    ) -> None:
        self.n_dofs, self.scale = n_dofs, 1.0
        self.free = np.ones(n_dofs, dtype=bool)
        self.prescribed_dof = prescribed_dof
        if prescribed_dof is not None:
            self.free[prescribed_dof] = False
        self.residual, self.tangent, self.residual_slopes = residual, tangent, slopes
        self._solver = LinearSolver(self.free, symmetric=True)

    def prescribed(self, mu: np.ndarray) -> np.ndarray:
        values = np.zeros(self.n_dofs)
        if self.prescribed_dof is not None:
            values[self.prescribed_dof] = mu[0]
        return values

    def prescribed_slopes(self, mu: np.ndarray) -> np.ndarray:
        slopes = np.zeros((len(mu), self.n_dofs))
        if self.prescribed_dof is not None:
            slopes[0, self.prescribed_dof] = 1.0
        return slopes

    def linearise(self, x: np.ndarray, mu: np.ndarray) -> AssembledLinearisation:
        matrix = sp.csr_matrix(np.tril(self.tangent(x, mu)))
        return AssembledLinearisation(self.residual(x, mu), matrix, self._solver)


def von_mises_truss(height: float, moved: bool = False) -> SmallSystem:
    """Two bars of half span 1 and stiffness EA = 1, Green-Lagrange strain, under a load mu at the apex.

    With depth w of the apex: P = w (2h - w) (h - w) / l^3 (each bar's strain is (w^2 - 2hw) / 2l^2), whose
    limit points are at w = h (1 -+ 1 / sqrt 3) and P = +- 2 h^3 / (3 sqrt 3 l^3).

    Parameters
    ----------
    moved : the load parameter pulls a spring of stiffness 1 whose other end is the prescribed dof, so that
        the parameter is a displacement.
    """
    cube = (1.0 + height**2) ** 1.5

    def force(w: float) -> float:
        return w * (2.0 * height - w) * (height - w) / cube

    def stiffness(w: float) -> float:
        return (2.0 * height**2 - 6.0 * height * w + 3.0 * w**2) / cube

    if not moved:
        return SmallSystem(
            1,
            lambda x, mu: np.array([force(x[0]) - mu[0]]),
            lambda x, _: np.array([[stiffness(x[0])]]),
            lambda _, __: np.array([[-1.0]]),
        )
    spring = 1.0
    return SmallSystem(
        2,
        lambda x, _: np.array([force(x[0]) + spring * (x[0] - x[1]), spring * (x[1] - x[0])]),
        lambda x, _: np.array([[stiffness(x[0]) + spring, -spring], [-spring, spring]]),
        lambda _, mu: np.zeros((len(mu), 2)),
        prescribed_dof=1,
    )


def spring_column(imperfection: float = 0.0) -> SmallSystem:
    """A rigid column of length 1 on a rotational spring of stiffness 1, turned by x under the dead weight mu.

    x - x0 = mu sin x: the upright column bifurcates at mu = 1; with an imperfection x0 the path stays stable.
    """
    return SmallSystem(
        1,
        lambda x, mu: np.array([x[0] - imperfection - mu[0] * np.sin(x[0])]),
        lambda x, mu: np.array([[1.0 - mu[0] * np.cos(x[0])]]),
        lambda x, _: np.array([[-np.sin(x[0])]]),
    )


def link_chain(stiffness: float, length: float) -> SmallSystem:
    """Three rigid links in line on lateral springs at the two joints, pressed by mu, for small deflections.

    It buckles at mu = k L / 3 with the joints on opposite sides, and at k L with both on one side.
    """
    springs = stiffness * np.eye(2)
    geometric = np.array([[2.0, -1.0], [-1.0, 2.0]]) / length
    return SmallSystem(
        2,
        lambda x, mu: (springs - mu[0] * geometric) @ x,
        lambda _, mu: springs - mu[0] * geometric,
        lambda x, _: -(geometric @ x)[None],
    )
