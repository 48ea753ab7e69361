"""What errors of measurement do to what is identified: how large they are, and how far they move it.

A table's noise is what its residuals show with the freedom that they have left: its values less what the unknowns, the
zero of a load cell or a rigid motion have taken of them (variance components by Helmert, which maximise the restricted
likelihood). A table with little freedom says little of its noise, and by chance it may seem to have none: it takes that
of all tables of its unit together, as if they were one.

Errors that belong together, as those of one state, may have any covariance. That of the estimates is M sum_g s_g s_g' M
with M = (J'J)^-1 and s_g = J_g' (1 - H_gg)^-1/2 r_g over groups g, H being the hat matrix: the factor makes good what
each group's own weight in the fit takes from its residuals (CR2 of Bell and McCaffrey, 2002). Intervals have the
degrees of freedom of their variance (Satterthwaite), which are few where few groups tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t

Array = NDArray[np.float64]
#: A table shows its own noise with so many degrees of freedom; with fewer, tables of its unit count as one.
ENOUGH_FREEDOM = 5.0
#: Directions of values that the fit takes whole, up to this part of their square: no residual shows their errors.
TAKEN = 1e-8
#: Singular values below this share of the largest are rounding.
ROUNDING = 1e-9


def directions(columns: Array) -> Array:
    """An orthonormal basis (n, rank) of what columns (n, q) span."""
    if not columns.size:
        return np.zeros((len(columns), 0))
    left, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(left[:, sizes > ROUNDING * max(float(sizes[0]), np.finfo(float).tiny)], dtype=np.float64)


def scaled_directions(columns: Array) -> Array:
    """`directions` of columns (n, q) whose sizes say nothing; those of rounding are left out."""
    lengths = np.linalg.norm(columns, axis=0)
    kept = lengths > np.finfo(float).tiny
    return directions(columns[:, kept] / lengths[kept])


@dataclass(frozen=True)
class Design:
    """The linear least squares that the fit is near its end, in units of the noise.

    Attributes
    ----------
    slopes : (n, k) derivatives of the measured values' residuals by the unknowns.
    known : (p, k) those of what was known before.
    loose : of each table, (n_j, q_j) orthonormal: what it does not know of itself, such as the zero of a load cell.
    groups : (n,) labels of values whose errors may belong together, from 0.
    """

    slopes: Array
    known: Array
    loose: Sequence[Array]
    groups: NDArray[np.int64]

    @cached_property
    def tables(self) -> list[slice]:
        """The values of each table."""
        ends = accumulate((len(part) for part in self.loose), initial=0)
        return [slice(*pair) for pair in pairwise(ends)]

    @cached_property
    def free(self) -> Array:
        """Derivatives (n, k) of what is left when the tables' own unknowns have taken their part."""
        parts = zip(self.tables, self.loose, strict=True)
        return np.vstack([np.zeros((0, self.slopes.shape[1])), *(without(self.slopes[rows], q) for rows, q in parts)])

    @cached_property
    def _eigen(self) -> tuple[Array, Array]:
        values, vectors = np.linalg.eigh(self.free.T @ self.free + self.known.T @ self.known)
        return values, vectors

    @property
    def _seen(self) -> NDArray[np.bool_]:
        values = self._eigen[0]
        # Of what the tables' own unknowns take whole, rounding is left.
        rounding = ROUNDING**2 * float(np.sum(self.slopes**2))
        return np.asarray(values > max(1e-12 * values.max(), rounding))

    @property
    def unseen(self) -> Array:
        """Directions (k, u) of the unknowns on which nothing depends."""
        return self._eigen[1][:, ~self._seen]

    @cached_property
    def root(self) -> Array:
        """(k, s) whose square with itself is the inverse M of J'J, in directions that something depends on."""
        values, vectors = self._eigen
        return np.asarray(vectors[:, self._seen] / np.sqrt(values[self._seen]), dtype=np.float64)

    @property
    def inverse(self) -> Array:
        """M (k, k)."""
        return np.asarray(self.root @ self.root.T)

    @cached_property
    def hat(self) -> Array:
        """(n, s + q) whose square with itself is the hat matrix."""
        own = np.zeros((len(self.slopes), sum(part.shape[1] for part in self.loose)))
        column = 0
        for rows, part in zip(self.tables, self.loose, strict=True):
            own[rows, column : column + part.shape[1]] = part
            column += part.shape[1]
        return np.hstack([self.free @ self.root, own])

    def freedom(self, table: int) -> float:
        """Degrees of freedom that the residuals of a table have left."""
        hat = self.hat[self.tables[table]]
        return len(hat) - float(np.sum(hat**2))

    def least_freedom(self, tables: Sequence[int]) -> int:
        """Those that they have left at least, whatever the weights are."""
        taken = sum(self.loose[at].shape[1] for at in tables)
        depends = np.any([self.slopes[self.tables[at]].any(axis=0) for at in tables], axis=0)
        return sum(len(self.loose[at]) for at in tables) - taken - int(depends.sum())


def joint_labels(parts: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Labels (n,), from 0, over all tables of those of each."""
    found = [np.zeros(0, dtype=np.int64)]
    for labels in parts:
        start = max((int(each.max()) + 1 for each in found if each.size), default=0)
        found.append(start + np.unique(labels, return_inverse=True)[1])
    return np.concatenate(found)


def without(values: Array, basis: Array) -> Array:
    """Columns (n, k) without what an orthonormal basis (n, q) spans."""
    return np.asarray(values - basis @ (basis.T @ values))


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the values of each table.

    Attributes
    ----------
    std : (m,) SI.
    shown_by : of each table, the tables whose residuals showed it; empty where none did.
    freedom : (m,) degrees of freedom with which they did.
    """

    std: Array
    shown_by: tuple[tuple[int, ...], ...]
    freedom: Array

    @classmethod
    def shown(cls, design: Design, missed: Sequence[Array], units: Sequence[str], sizes: Array) -> Noise:
        """What residuals show.

        Parameters
        ----------
        design : of the fit.
        missed : predicted minus measured values (n_j,) of each table, SI.
        units : of each table.
        sizes : (m,) by how much the load changed them, SI. Where neither a table nor others of its unit show their
            noise, it is the same share of this as in the others, and all of it where none shows any.
        """
        squares, freedom = np.array([float(part @ part) for part in missed]), np.zeros(len(missed))
        freedom[:] = [design.freedom(at) for at in range(len(missed))]
        std, shown_by, known = np.array(sizes, dtype=np.float64), [], np.ones(len(missed))
        everything = tuple(range(len(missed)))
        for at, unit in enumerate(units):
            alike = tuple(other for other in everything if units[other] == unit)
            by: tuple[int, ...] = (at,) if design.least_freedom((at,)) >= ENOUGH_FREEDOM else alike
            if design.least_freedom(by) > 0:
                known[at] = freedom[list(by)].sum()
                std[at] = np.sqrt(squares[list(by)].sum() / known[at])
            elif design.least_freedom(everything) > 0:
                by = ()
                std[at] *= np.sqrt(np.sum(squares / np.maximum(sizes, np.finfo(float).tiny) ** 2) / freedom.sum())
            else:
                by = ()
            shown_by.append(by)
        return cls(std, tuple(shown_by), known)


@dataclass(frozen=True)
class Scatter:
    """Of estimates, by errors of measurement.

    Attributes
    ----------
    covariance : (k, k).
    half : (k,) half the width of 95 % intervals.
    """

    covariance: Array
    half: Array

    @classmethod
    def of(cls, design: Design, residuals: Array, factors: Array, noise: Noise) -> Scatter:
        """That of groups of errors, and not less than that of independent ones.

        Parameters
        ----------
        design : of the fit.
        residuals : (n,) of the measured values.
        factors : (m,) variance of each table's residuals in the units that they have.
        noise : with its degrees of freedom.
        """
        if not len(residuals):
            return cls(np.zeros_like(design.inverse), np.zeros(len(design.inverse)))
        parts = [factor * _product(design, rows) for factor, rows in zip(factors, design.tables, strict=True)]
        covariance = np.sum(parts, axis=0)
        own = np.maximum(np.diag(covariance), np.finfo(float).tiny)
        by_scope = {by: np.zeros(len(own)) for by in noise.shown_by}
        for by, part in zip(noise.shown_by, parts, strict=True):
            by_scope[by] += np.diag(part)
        shown = dict(zip(noise.shown_by, noise.freedom, strict=True))
        of_independent = own**2 / np.maximum(
            np.sum([part**2 / shown[by] for by, part in by_scope.items()], axis=0), np.finfo(float).tiny
        )
        together, of_groups = _of_groups(design, residuals, own)
        half = np.maximum(
            _quantile(of_independent) * np.sqrt(np.diag(covariance)), _quantile(of_groups) * np.sqrt(together)
        )
        wider = np.sqrt(np.maximum(together / own, 1.0))
        return cls(covariance * np.outer(wider, wider), half)


def wider(one: Scatter, other: Scatter) -> Scatter:
    """Of two, whichever is wider for each estimate."""
    own, others = np.diag(one.covariance), np.diag(other.covariance)
    wider = np.sqrt(np.maximum(others / np.maximum(own, np.finfo(float).tiny), 1.0))
    return Scatter(one.covariance * np.outer(wider, wider), np.maximum(one.half, other.half))


def _quantile(freedom: Array) -> Array:
    return np.asarray(t.ppf(0.975, np.maximum(freedom, 1.0)))


def _product(design: Design, rows: slice) -> Array:
    """Covariance (k, k) of estimates by errors of one table, independent and of unit variance."""
    moves = design.free[rows] @ design.inverse
    return np.asarray(moves.T @ moves)


def _of_groups(design: Design, residuals: Array, own: Array) -> tuple[Array, Array]:
    """Variances (k,) of estimates by groups of errors, and their degrees of freedom (k,).

    What a group tells alone shows in no residual. It counts with the variance of independent errors, ``own`` (k,), and
    one degree of freedom.
    """
    k = design.slopes.shape[1]
    count = int(design.groups.max()) + 1
    scores, sizes, moved = np.zeros((count, k)), np.zeros((count, k)), np.zeros((count, k, design.hat.shape[1]))
    for group in range(count):
        rows = design.groups == group
        hat = design.hat[rows]
        weights = _unshrunk(hat, design.free[rows] @ design.inverse)
        scores[group], sizes[group] = weights.T @ residuals[rows], np.sum(weights**2, axis=0)
        moved[group] = weights.T @ hat
    variances, freedom = np.zeros(k), np.zeros(k)
    ideal = np.diag(sum((_product(design, rows) for rows in design.tables), np.zeros((k, k))))
    for i in range(k):
        # Covariance (count, count) of the groups' scores if errors are independent.
        expected = np.diag(sizes[:, i]) - moved[:, i] @ moved[:, i].T
        trace = float(np.trace(expected))
        hidden = max(1.0 - trace / ideal[i], 0.0) if ideal[i] > 0.0 else 0.0
        variances[i] = float(scores[:, i] @ scores[:, i]) + hidden * own[i]
        squared = float(np.sum(expected**2)) + (hidden * ideal[i]) ** 2
        freedom[i] = (trace + hidden * ideal[i]) ** 2 / squared if squared > 0.0 else 1.0
    return variances, freedom


def _unshrunk(hat: Array, moves: Array) -> Array:
    """(1 - H)^-1/2 of a group's hat matrix H = hat hat', of vectors (n, k); nothing is left of what the fit takes."""
    left, sizes, _ = np.linalg.svd(hat, full_matrices=False)
    spared = 1.0 - np.minimum(sizes, 1.0) ** 2
    factor = np.where(spared > TAKEN, 1.0 / np.sqrt(np.maximum(spared, TAKEN)), 0.0) - 1.0
    return np.asarray(moves + left @ (factor[:, None] * (left.T @ moves)))
