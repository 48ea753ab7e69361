"""The time of a material's law, known by the times of frames: from the instant at which the model's time begins."""

from __future__ import annotations

from dataclasses import dataclass

from morph_dslam.errors import TrackingError
from morph_dslam.model import Parameter, ReducedModel
from morph_dslam.tracking.outcomes import TimeOutside

#: A time is known to half of the interval since the frame before, and to this part of its range at most.
USUAL_STD = 1e-3


@dataclass
class KnownTime:
    """The one parameter of a model that measures time.

    Attributes
    ----------
    index : of the parameter.
    parameter : itself.
    zero : time of the recording at which it is zero, seconds.
    before : time of the frame before, seconds; None in the first.
    """

    index: int
    parameter: Parameter
    zero: float
    before: float | None = None

    @classmethod
    def of(cls, model: ReducedModel, zero: float) -> KnownTime:
        """That of a model.

        Raises
        ------
        TrackingError
            If none of its parameters measures time, or several and its study does not say which one is the time.
        """
        clocks = [(k, model.parameters[k]) for k in model.clocks]
        if len(clocks) != 1:
            named = ", ".join(p.name for _, p in clocks)
            raise TrackingError(
                f"--time-zero (time_zero): the model '{model.name}' has "
                + (
                    f"several parameters that measure time ({named}): give theirs by --known"
                    if clocks
                    else "no parameter that measures time: leave it out"
                )
            )
        return cls(*clocks[0], zero)

    def at(self, timestamp: float) -> tuple[float, float] | TimeOutside:
        """Time and its standard deviation in a frame of this time, seconds; or that it is outside of its range."""
        parameter, time = self.parameter, timestamp - self.zero
        most = USUAL_STD * (parameter.upper - parameter.lower)
        interval = 2.0 * most if self.before is None else timestamp - self.before
        self.before = timestamp
        if not parameter.lower <= time <= parameter.upper:
            is_before = time < parameter.lower
            return TimeOutside(parameter.name, parameter.text(time), parameter.range_text, is_before)
        return time, min(0.5 * interval, most) if interval > 0.0 else most
