"""Whether force curves disagree as a whole: each has a factor of its own, of its specimen, section or load cell.

Such factors are random effects: what is identified is that of the population they come from, and curves, not stretches
of them, are what is independent. Their variance is that with which the weighted sum of squares is as large as its
degrees of freedom (Paule and Mandel, 1982). It is asked for only where curves disagree more than their own scatter
explains, by an F test: intervals by few curves are wide, as they have to be, and curves that agree tell more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import root_scalar

from morph_dslam.better_fit import chance_of_better_fit
from morph_dslam.identification.scatter import Design, Noise, scaled_directions, without

Array = NDArray[np.float64]
#: Curves that agree are believed to disagree with this chance.
CHANCE = 0.01
#: Standard deviation of the factors at most.
LARGEST = 10.0


@dataclass(frozen=True)
class CurveFactors:
    """Factors of whole curves.

    Attributes
    ----------
    std : relative standard deviation of one; 0 where curves agree.
    ways : of each table (n_j,), what a factor of it changes its values by, SI; zeros of what is no curve. Nothing that
        the table does not know of itself, such as a zero of the load cell, is in them.
    """

    std: float
    ways: Sequence[Array]

    def whitened(self, table: int, values: Array, noise: float) -> Array:
        """Values (n_j, ...) of a table, SI, scaled so that errors by noise and its factor are independent of size 1."""
        way = self.ways[table]
        size = float(way @ way)
        if self.std == 0.0 or size == 0.0:
            return values / noise
        kept = 1.0 / np.sqrt(1.0 + size * (self.std / noise) ** 2)
        return np.asarray((values - (1.0 - kept) / size * np.multiply.outer(way, way @ values)) / noise)


def curve_factors(
    design: Design, missed: Sequence[Array], ways: Sequence[Array], stated: float, errors: Array, noise: Noise
) -> CurveFactors:
    """How far curves disagree beyond their own scatter.

    Parameters
    ----------
    design : with slopes in units of the noise, without factors of curves.
    missed : predicted minus measured values (n_j,) of each table, SI.
    ways : as those of `CurveFactors`.
    stated : relative standard deviation of such factors that is known, as that of the model's forces.
    errors : (e, n) that tables have in common, in units of the noise, which may make curves disagree too.
    noise : of each table within itself, see `noise_within`.
    """
    agree, scaled = CurveFactors(0.0, ways), [way / std for way, std in zip(ways, noise.std, strict=True)]
    if np.count_nonzero([way.any() for way in ways]) < 2:
        return agree
    residuals = np.concatenate([part / std for part, std in zip(missed, noise.std, strict=True)])
    own = np.hstack([design.slopes, np.asarray(block_diag(*design.loose)), residuals[:, None]])
    columns = np.hstack([np.asarray(block_diag(*(way[:, None] for way in scaled))), errors.T, own])

    def whitened(values: Array, std: float) -> Array:
        factors = CurveFactors(std, scaled)
        return np.vstack([factors.whitened(at, values[rows], 1.0) for at, rows in enumerate(design.tables)])

    if _chance(whitened(columns, stated), len(ways), design, noise) >= CHANCE:
        return agree

    def beyond(std: float) -> float:
        """Of the sum of squares with such factors, what it has beyond its degrees of freedom."""
        values = whitened(own, std)
        basis = scaled_directions(values[:, :-1])
        return float(np.sum(without(values[:, -1:], basis) ** 2)) - (len(values) - basis.shape[1])

    if beyond(stated) <= 0.0:
        return agree
    if beyond(LARGEST) >= 0.0:
        return CurveFactors(LARGEST, ways)
    return CurveFactors(float(root_scalar(beyond, bracket=(stated, LARGEST), xtol=1e-6).root), ways)


def _chance(columns: Array, count: int, design: Design, noise: Noise) -> float:
    """The chance with which curves that agree differ so much.

    Where each curve shows its own noise, it is that of Welch's test (1951, https://doi.org/10.1093/biomet/38.3-4.330),
    with the leverages of the factors for the weights of means. Where all show it together, it is that of the F test.

    Parameters
    ----------
    columns : (n, q) what factors of the ``count`` tables change, what else may explain it, and the residuals.
    """
    null, full = scaled_directions(columns[:, count:-1]), scaled_directions(columns[:, :-1])
    freed = full.shape[1] - null.shape[1]
    if freed < 1:
        return 1.0
    better = float(np.sum(without(columns[:, -1:], null) ** 2) - np.sum(without(columns[:, -1:], full) ** 2))
    leverages = [float(np.sum(full[rows] ** 2) - np.sum(null[rows] ** 2)) for rows in design.tables]
    scopes = dict(zip(noise.shown_by, noise.freedom, strict=True))
    shares = {by: sum(h for h, other in zip(leverages, noise.shown_by, strict=True) if other == by) for by in scopes}
    known = sum(share**2 / max(scopes[by], 1.0) for by, share in shares.items())
    if len(scopes) == 1:
        return chance_of_better_fit(better, 0.0, freed, max(scopes[noise.shown_by[0]], 1.0), 1.0)
    factor = 1.0 + 2.0 * (freed - 1.0) / (freed * (freed + 2.0)) * known
    freedom = freed * (freed + 2.0) / (3.0 * known)
    return chance_of_better_fit(better, 0.0, freed, freedom, float(np.sqrt(factor)))


def noise_within(
    design: Design, missed: Sequence[Array], ways: Sequence[Array], units: Sequence[str], sizes: Array, noise: Array
) -> Noise:
    """The noise of tables when each curve has its own factor, as `Noise.shown` has it.

    Parameters
    ----------
    design : with slopes in units of the ``noise`` (m,), without factors of curves.
    missed, ways, units, sizes : as there, and as in `curve_factors`.
    """
    residuals = np.concatenate([part / std for part, std in zip(missed, noise, strict=True)])
    loose = [scaled_directions(np.column_stack([q, way])) for q, way in zip(design.loose, ways, strict=True)]
    basis = scaled_directions(np.hstack([design.slopes, np.asarray(block_diag(*loose))]))
    left = residuals - basis @ (basis.T @ residuals)
    parts = [std * left[rows] for rows, std in zip(design.tables, noise, strict=True)]
    return Noise.shown(Design(design.slopes, design.known, loose, design.groups), parts, units, sizes)
