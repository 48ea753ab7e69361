"""Whether landmarks show the object at rest, as somebody says."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from morph_dslam.better_fit import chance_of_better_fit
from morph_dslam.registration.messages import NotAtRest
from morph_dslam.registration.outline_snap import EXCLUDED
from morph_dslam.tracking.estimator import BoundPoints, Estimate, Estimator, State

Array = NDArray[np.float64]
#: Landmarks that are right fit better by free parameters, as much as is said of, with this chance at most.
REST_CHANCE = 1e-4
#: Of landmarks that fit well at rest too, the surface must move by this share of the object's size: a lens or
#: dimensions that are slightly off move it by less.
MOVED_SHARE = 0.03


def not_at_rest(
    estimator: Estimator,
    bound: BoundPoints,
    pixels: Array,
    resting: Estimate,
    others: Iterable[State],
    click_px: float,
    least_share: float,
) -> NotAtRest | None:
    """That the object is hardly at rest, where landmarks fit better otherwise than by chance; None if it may be.

    The statistic is F of the parameters that are set free, given the error that the landmarks show then, or that of
    carefully set ones if that is larger.

    Parameters
    ----------
    estimator : of the object at rest.
    bound, pixels : the landmarks.
    resting : what they give at rest.
    others : states to start from beside that; they are made only if they are needed.
    click_px : standard deviation of a carefully set landmark.
    least_share : of the object's size, by which its surface must move.
    """
    model, d = estimator.model, len(estimator.model.study_parameters)
    freedom = 2 * len(bound) - 6 - d
    # The largest F, of free parameters that explain all of it, spares most fits the search.
    if not d or freedom < 1 or chance_of_better_fit(2.0 * resting.cost, 0.0, d, freedom, click_px) > REST_CHANCE:
        return None
    lower, upper = estimator.box.lower.copy(), estimator.box.upper.copy()
    lower[:d], upper[:d] = model.lower[:d], model.upper[:d]
    free = estimator.within(replace(estimator.box, lower=lower, upper=upper))
    found = free.estimate_from(bound, pixels, np.ones(len(bound)), [resting.state, *others])
    best = next((estimate for estimate in found if np.isfinite(estimate.residuals).all()), resting)
    chance = chance_of_better_fit(2.0 * resting.cost, 2.0 * best.cost, d, freedom, click_px)
    motion = model.positions(best.state.parameters) - model.positions(model.default)
    moved, size = np.linalg.norm(motion, axis=1).max(), np.linalg.norm(np.ptp(model.nodes, axis=0))
    if chance > REST_CHANCE or moved < least_share * size:
        return None
    away = (best.state.parameters - model.default)[:d] ** 2 > EXCLUDED * np.diag(best.covariance)[:d]
    values = zip(model.study_parameters, best.state.parameters[:d], away, strict=True)
    given = ", ".join(
        f"{p.name} = {p.display(v):.2g} {p.unit}".removesuffix(" 1") for p, v, is_away in values if is_away
    )
    if not given:
        return None
    return NotAtRest(resting.sigma_px, click_px, float(np.sqrt(2.0 * best.cost / freedom)), given)
