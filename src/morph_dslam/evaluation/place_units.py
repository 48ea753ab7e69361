"""Force curves over a parameter whose values are in another unit than their title says."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.evaluation.force_curves import ForceCurve
from morph_dslam.evaluation.frame_numbers import CLEARLY, FEWEST_FORCES, Correction, fit_columns
from morph_dslam.units import smaller_units

Array = NDArray[np.float64]


def place_scale(quantity: str, curve: ForceCurve, places: Array, modelled: Array, alike: float) -> Correction | None:
    """Whether a smaller unit of a curve's places explains a factor of its forces, and what that leaves.

    With it more of the curve is compared, which no noise and no other law makes straighter. A larger one is not tried:
    any short piece of a curve is straight. Most frames are then off the curve as it is given.

    Parameters
    ----------
    quantity : of the parameter that the curve is given by.
    places : (e,) the parameter in frames of the run.
    modelled : (e,) the model's force there.
    alike : a factor up to this, or its inverse, needs no explanation.
    """
    order = np.argsort(curve.places, kind="stable")
    known, forces = curve.places[order], curve.forces[order]
    found = []
    for scale in smaller_units(quantity):
        inside = (places >= scale * known[0]) & (places <= scale * known[-1])
        if inside.sum() < FEWEST_FORCES:
            continue
        (given, _), before = fit_columns(np.interp(places[inside], known, forces), modelled[inside])
        (factor, _), rms = fit_columns(np.interp(places[inside], scale * known, forces), modelled[inside])
        is_size = 1.0 / alike <= factor <= alike and not 1.0 / alike <= given <= alike
        if is_size and before > CLEARLY * rms:
            found.append(Correction(scale, float(factor), rms, before))
    return min(found, key=lambda each: each.rms, default=None)
