"""Functions through paths in time: cubic splines along each path, polynomials of the other parameters across them.

Every path has samples at the same instants. At each of them polynomials are fitted to the values of all paths, of one
total degree throughout; a spline in time goes through their coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import Parameter
from morph_dslam.model.basis_functions import chebyshev_basis, cubic_spline_basis, hat_basis
from morph_dslam.model.tensor_functions import TensorTrainFunctions
from morph_dslam.reduction.regression import fit_functions
from morph_dslam.reduction.sparse_expansion import expansion_train
from morph_dslam.studies.sections import BasisName

Array = NDArray[np.float64]
#: Least instants that cubic splines can interpolate.
LEAST = 4
#: Part of the samples that must lie on whole paths.
MOSTLY = 0.5


@dataclass(frozen=True)
class TimePaths:
    """Samples that lie on paths in time.

    Attributes
    ----------
    clock : index of the time.
    instants : (t,) rising, s.
    rows : (p, t) the sample of each path at each instant.
    """

    clock: int
    instants: Array
    rows: NDArray[np.int64]

    @staticmethod
    def of(samples: Array, parameters: Sequence[Parameter]) -> TimePaths | None:
        """The paths among samples (n, d), whole ones alone; None if most samples are on none, or no time is varied.

        Where several parameters measure time, as relaxation times do, the clock is the one that paths run along.
        """
        if len(parameters) < 2:
            return None
        clocks = [k for k, parameter in enumerate(parameters) if parameter.quantity == "time"]
        found = (TimePaths._along(clock, samples, parameters[clock]) for clock in clocks)
        return next((paths for paths in found if paths is not None), None)

    @staticmethod
    def _along(clock: int, samples: Array, parameter: Parameter) -> TimePaths | None:
        """The paths along one parameter."""
        times, others = samples[:, clock], np.delete(samples, clock, axis=1)
        instants = np.unique(times)
        _, path = np.unique(others, axis=0, return_inverse=True)
        path = path.ravel()
        rows = np.full((path.max() + 1, len(instants)), -1)
        rows[path, np.searchsorted(instants, times)] = np.arange(len(samples))
        whole = rows[(rows >= 0).all(axis=1)]
        ends = [parameter.lower, parameter.upper]
        covers = np.allclose(instants[[0, -1]], ends, rtol=0.0, atol=1e-9 * (ends[1] - ends[0]))
        if len(instants) < LEAST or not covers or whole.size < MOSTLY * len(samples):
            return None
        return TimePaths(clock, instants, whole)


def fit_paths(
    paths: TimePaths,
    samples: Array,
    values: Array,
    box: Array,
    max_degree: int,
    weights: Array,
    tolerance: float,
    basis: BasisName | None = None,
) -> tuple[TensorTrainFunctions, dict[int, float]]:
    """The functions, and by total degree the relative error of cross-validation, which leaves out whole paths.

    Parameters
    ----------
    samples : (n, d).
    values : (n, n_functions) there.
    box : (d, 2).
    max_degree : of the polynomials.
    weights : (n,) of the samples.
    tolerance : of the tensor train, relative.
    basis : "hat" for straight lines in time in place of splines.
    """
    others = np.delete(samples[paths.rows[:, 0]], paths.clock, axis=1)
    lower, upper = np.delete(box, paths.clock, axis=0).T
    n_paths, n_instants = paths.rows.shape
    fitted, errors = fit_functions(
        others,
        values[paths.rows].reshape(n_paths, -1),
        None,
        lower,
        upper,
        max_degree,
        np.arange(n_paths),
        raise_single=True,
        weights=weights[paths.rows[:, 0]],
    )
    in_time = hat_basis(paths.instants) if basis == "hat" else cubic_spline_basis(paths.instants)
    # (instants, terms, functions) at the instants, and as coefficients of the spline.
    at_instants = np.moveaxis(fitted.coefficients.reshape(len(fitted.multi_indices), n_instants, -1), 1, 0)
    through: Array = np.asarray(
        np.linalg.solve(in_time.evaluate(paths.instants), at_instants.reshape(n_instants, -1)), dtype=np.float64
    )
    indices = np.repeat(fitted.multi_indices[None], n_instants, axis=0)
    moments = np.broadcast_to(np.arange(n_instants)[:, None], indices.shape[:2])
    indices = np.insert(indices, paths.clock, moments, axis=2).reshape(-1, len(box))
    degrees = iter(fitted.multi_indices.max(axis=0))
    bases = tuple(
        in_time if k == paths.clock else chebyshev_basis(low, high, int(next(degrees)))
        for k, (low, high) in enumerate(box)
    )
    return expansion_train(indices, through.reshape(len(indices), -1), bases, tolerance), errors
