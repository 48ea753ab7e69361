"""What an identification found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from morph_dslam.evaluation.likeness import root_mean_square
from morph_dslam.identification.measured_forces import MeasuredForces
from morph_dslam.identification.measurements import Measurement
from morph_dslam.identification.values import FACTOR, Values
from morph_dslam.model import Parameter

if TYPE_CHECKING:
    from morph_dslam.identification.given_loads import GivenLoads

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Estimate:
    """One identified parameter, SI.

    Attributes
    ----------
    parameter : with its range; the factor of all moduli has one too.
    value : that fits best.
    std : standard deviation.
    model_std, run_std : the parts of it by the model's own errors, and by those of the states that a run found.
    interval : (2,), 95 %, cut off at the ends of the range; at a bound it does not hold.
    at_bound : whether it is at an end of its range.
    wide : whether the interval is as wide as the range.
    """

    parameter: Parameter
    value: float
    std: float
    model_std: float
    run_std: float
    interval: tuple[float, float]
    at_bound: bool
    wide: bool

    @property
    def identified(self) -> bool:
        """Whether the interval is narrower than the range, and the value inside of it."""
        return not (self.wide or self.at_bound)


@dataclass(frozen=True)
class Misfit:
    """What a measurement is missed by, SI.

    Attributes
    ----------
    measurement : see `measurements`.
    predicted : (n,) adjusted, as with the zero of the load cell.
    adjustment : (n,) what that added.
    slopes : (n, f) derivatives by the unknowns that are not at an end of their range.
    model_rms, run_rms : root mean square of the predictions' errors by the model, and by the states that a run found.
    by_range : (k,) root mean square of what each unknown changes the predictions by over its whole range.
    at : the values with which they were predicted.
    """

    measurement: Measurement
    predicted: Array
    adjustment: Array
    slopes: Array
    model_rms: float
    run_rms: float
    by_range: Array
    at: Values

    @property
    def missed(self) -> Array:
        """Predicted minus measured (n,)."""
        return self.predicted - self.measurement.values

    @property
    def changes(self) -> Array:
        """By how much the load changed the values (n,)."""
        return self.measurement.changes(self.predicted - self.adjustment)

    @property
    def rms(self) -> float:
        """Root mean square of what it is missed by."""
        return root_mean_square(self.missed)

    @property
    def own_rms(self) -> float:
        """Root mean square of the predictions' own errors."""
        return float(np.hypot(self.model_rms, self.run_rms))

    @property
    def offset(self) -> float:
        """The zero of a load cell that fits best; 0 where there is none."""
        return float(self.adjustment.mean())


@dataclass(frozen=True)
class Identification:
    """What was identified.

    Attributes
    ----------
    estimates : one for each parameter.
    correlation : (k, k) of the estimates.
    misfits : of each measurement.
    groups : number of groups of values whose errors count as independent.
    loads : of given size, beside a factor of all moduli; None where that was not identified.
    curve_std : relative standard deviation of the factors by which whole force curves differ; 0 where they agree.
    """

    estimates: tuple[Estimate, ...]
    correlation: Array
    misfits: tuple[Misfit, ...]
    groups: int
    loads: GivenLoads | None = None
    curve_std: float = 0.0

    def __getitem__(self, name: str) -> Estimate:
        return next(each for each in self.estimates if each.parameter.name == name)

    def size_factor(self, forces: MeasuredForces) -> float | None:
        """The common factor of all moduli as one of the size of forces; None where it was not identified.

        It is 1 where it divides loads too: a force that balances a load is as large as that, whatever the moduli are.
        """
        if self.loads is None:
            return None
        return 1.0 if self.loads.scaled and not forces.are_shown else self[FACTOR].value
