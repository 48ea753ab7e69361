"""What shows that forces are not those that the model describes: another unit, another axis, another law."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import IdentificationError
from morph_dslam.evaluation.force_notices import ForceNotice, OtherFrameNumbers, OtherSize, force_notices
from morph_dslam.evaluation.likeness import Likeness
from morph_dslam.identification.measured_forces import MeasuredForces

Array = NDArray[np.float64]
#: Changes of a force below this share of it are rounding.
ROUNDING = 1e-9


def size_factor(forces: MeasuredForces, predicted: Array) -> float | None:
    """The factor of predictions (n,) that would fit best; None of those that do not change."""
    modelled = predicted - predicted.mean() if forces.free_zero else predicted
    size = float(modelled @ modelled)
    if size <= (ROUNDING * float(np.abs(predicted).max())) ** 2 * len(predicted):
        return None
    return float(modelled @ forces.changes(predicted)) / size


def check_size(forces: MeasuredForces, predicted: Array, moduli: float = 1.0, at_end: bool = False) -> None:
    """Refuse forces that change by far more or less than predicted ones (n,), those that fit best.

    ``moduli`` is the common factor of all moduli in the predictions, and ``at_end`` whether it is at an end of its
    range: then it has taken up what it could.

    Raises
    ------
    IdentificationError
        If a factor of the prediction that would fit is far, as `OtherSize` has it.
    """
    factor = size_factor(forces, predicted)
    if factor is None:
        return
    of_model = OtherSize.of(forces.name, moduli * factor)
    other = of_model if at_end else OtherSize.of(forces.name, factor)
    if other is not None and other.is_far:
        of_model = of_model or other
        raise IdentificationError(
            f"{of_model.finding}, and nothing in the model's ranges explains it: check the units of its columns and "
            "--reaction, or build the model with wider ranges"
        )


def notices(
    forces: MeasuredForces, predicted: Array, slopes: Array, own_rms: float, moduli: float | None
) -> tuple[Likeness | None, list[ForceNotice]]:
    """How alike neighbouring residuals are, and what must be known of forces beside predicted ones (n,).

    Parameters
    ----------
    slopes : (n, f) derivatives by what was identified.
    own_rms : root mean square of the predictions' own errors, by the model and by the states of a run.
    moduli : the common factor of all moduli by which predictions grow; None where it was not identified.
    """
    factor = size_factor(forces, predicted)
    # At an end of its range the factor has no slope.
    scaled = predicted[:, None] if moduli is not None else np.empty((len(predicted), 0))
    return force_notices(
        forces.name,
        None if factor is None else factor * (1.0 if moduli is None else moduli),
        forces.places,
        forces.values,
        predicted,
        np.hstack([slopes, scaled, np.ones((len(slopes), int(forces.free_zero)))]),
        own_rms=own_rms,
        explained=OtherFrameNumbers.of(forces.name, forces.places, predicted, forces.places, forces.values)
        if forces.curve.against == "frame"
        else None,
        picture="identification.png",
    )
