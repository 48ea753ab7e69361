"""Whether unknowns that are set free make a fit better than errors of right measurements do."""

from __future__ import annotations

from scipy.special import fdtrc


def chance_of_better_fit(before: float, after: float, n_freed: int, freedom: float, least_std: float) -> float:
    """The chance with which errors alone make the residuals of further unknowns so much smaller (F test).

    Parameters
    ----------
    before, after : sums of squared residuals without and with the further unknowns.
    n_freed : how many these are.
    freedom : values less all unknowns.
    least_std : standard deviation of a value that is believed if the residuals show a smaller one; may be zero.
    """
    variance = max(after / freedom, least_std**2)
    ratio = max(before - after, 0.0) / n_freed / variance if variance > 0.0 else 0.0
    return float(fdtrc(n_freed, freedom, ratio))
