"""Forces on a support, measured by frame of a run or by a known parameter, and what a model predicts of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import IdentificationError
from morph_dslam.evaluation.force import ReactionInDirection
from morph_dslam.evaluation.force_curves import ForceCurve
from morph_dslam.evaluation.run_folder import Run
from morph_dslam.identification.common_errors import state_errors
from morph_dslam.identification.values import Values
from morph_dslam.model import Parameter, ReducedModel
from morph_dslam.model.separated import Outside
from morph_dslam.model.stated_errors import force_error, reduction_force_error
from morph_dslam.units import smaller_units

Array = NDArray[np.float64]
#: A force curve counts as so many stretches whose errors are independent of each other.
STRETCHES = 8
#: A parameter that changes by less than this share of its range a frame is one over the sequence.
LEAST_RATE = 1e-6
#: Fewer forces determine no offset and anything else.
FEWEST_FORCES = 4
#: Repeated forces that differ by more than this share of the curve's change are not of one curve.
MOST_REPEATED = 0.1


@dataclass(frozen=True)
class MeasuredForces:
    """Forces on a support, by frame of a run or by a known parameter.

    Attributes
    ----------
    model : of the object.
    curve : the measured forces.
    reaction : the model's force in the direction in which they were measured; without a sign of its own, it has the one
        in which it grows with the measured force, at known parameters and the defaults of all others.
    run : whose frames the curve is given by, and whose estimates are the parameters that are not identified; None for a
        curve over a parameter.
    free_zero : whether the zero of the load cell is an unknown offset.

    Raises
    ------
    IdentificationError
        If forces by frame have no run, or one with unknown loads that the model does not have
        (`model.unknown_loads.with_unknown_loads`); if too few forces are
        left to compare, or several in one place contradict each other.
    """

    model: ReducedModel
    curve: ForceCurve
    reaction: ReactionInDirection
    run: Run | None = None
    free_zero: bool = True
    unit = "N"
    scale = 1.0

    def __post_init__(self) -> None:
        if self.curve.against == "frame" and self.run is None:
            raise IdentificationError("forces by frame need the run that tracked these frames: give --run")
        if self.run is not None and self.are_shown and self.run.model.energy is not None and self.model.energy is None:
            raise IdentificationError(
                "the run was tracked with --unknown-loads, and the model has none here: identify --moduli alone, with "
                "the model of the run, or track again without --unknown-loads"
            )
        if len(self.values) < FEWEST_FORCES:
            raise IdentificationError(
                f"{len(self.values)} forces of {self.name} are left to compare, and {FEWEST_FORCES} are needed: "
                f"the others are {self.why_left_out}"
            )
        self._check_repeated()

    def _check_repeated(self) -> None:
        """Refuse forces that are very different in one place: one line is wrong, or they are of two branches."""
        for place in np.unique(self.places):
            here = self.values[self.places == place]
            if np.ptp(here) > MOST_REPEATED * np.ptp(self.values):
                where = f"frame {place:g}" if self._against is None else f"{self._against.name} = "
                where += "" if self._against is None else self._against.text(float(place))
                raise IdentificationError(
                    f"{self.name} is {here.min():.4g} N and {here.max():.4g} N at {where}: give one branch of the "
                    "curve, or the forces by frame (first column frame)"
                )

    @property
    def name(self) -> str:
        return self.curve.name

    @property
    def given(self) -> frozenset[str]:
        return frozenset(self._known[0])

    @property
    def are_shown(self) -> bool:
        """Whether pictures show the states in which they were measured."""
        return self.curve.against == "frame"

    @cached_property
    def _against(self) -> Parameter | None:
        """The parameter that the curve is given by; None where it is given by frame."""
        return next((p for p in self.model.parameters if p.name == self.curve.against), None)

    @cached_property
    def _rows(self) -> NDArray[np.int64]:
        """Of the curve: those in tracked frames, or where the model has solutions."""
        if self._against is not None:
            # Beyond its range a model only repeats its last state.
            return np.flatnonzero([self._against.in_range(place) for place in self.curve.places])
        if self.run is None:
            return np.arange(len(self.curve.places))
        return np.flatnonzero(np.isin(self.curve.places, self.run.frames[self.run.tracked]))

    @property
    def left_out(self) -> int:
        """How many forces of the curve are not compared."""
        return len(self.curve.places) - len(self._rows)

    @property
    def smaller_unit(self) -> float | None:
        """What the places have to be multiplied by to lie in the model's range all, where most of them do not; None if
        no smaller unit does that.
        """
        if self._against is None or 2 * self.left_out <= len(self.curve.places):
            return None
        # The largest first: a unit that leaves them all near zero would do as well.
        for scale in reversed(smaller_units(self._against.quantity)):
            if all(self._against.in_range(scale * place) for place in self.curve.places):
                return scale
        return None

    @property
    def why_left_out(self) -> str:
        """What those are, for people."""
        if self._against is None:
            return "in frames that were not tracked"
        return f"outside of the model's range of {self._against.name}, {self._against.range_text}"

    @property
    def values(self) -> Array:
        return self.curve.forces[self._rows]

    @property
    def places(self) -> Array:
        """Where on the curve they are (n,)."""
        return self.curve.places[self._rows]

    @property
    def groups(self) -> NDArray[np.int64]:
        count = len(self._rows)
        groups = np.empty(count, dtype=np.int64)
        groups[np.argsort(self.places, kind="stable")] = np.arange(count) * min(STRETCHES, count) // count
        return groups

    @cached_property
    def compared(self) -> ReactionInDirection:
        """The reaction with its sign."""
        along = np.array([self.reaction(self.model.vector(known)) for known in self._known])
        return self.reaction.following(along, self.values)

    def changes(self, predicted: Array) -> Array:
        return self.values - self.values.mean() if self.free_zero else self.values

    @property
    def share_of_range(self) -> float | None:
        """How much of the model's range of the parameter that it is given by the curve covers."""
        own = self._against
        return None if own is None else float(np.ptp(self.places)) / (own.upper - own.lower)

    @property
    def mesh_error_stated(self) -> bool:
        stated = force_error(self.model, self.reaction.support)
        return stated is not None and stated[1]

    def predict(self, unknowns: Values) -> Array:
        return self.compared.sign * self._forces(unknowns)[:, self.compared.axis]

    def _forces(self, unknowns: Values) -> Array:
        """On the support (n, 3), N."""
        # A search by the factor may leave the range of loads, where the same state for all would end it.
        outside: Outside = "bounded" if self.are_shown else "linear"
        states = [unknowns.vector(known, self.are_shown) for known in self._known]
        return unknowns.factor * np.array([self.compared.field.value(mu, outside)[0] for mu in states])

    def adjusted(self, predicted: Array) -> Array:
        return predicted + float(np.mean(self.values - predicted)) if self.free_zero else predicted

    def loose(self, predicted: Array) -> Array:
        return np.ones((len(predicted), int(self.free_zero)))

    def model_errors(self, unknowns: Values) -> Array:
        stated = force_error(self.model, self.reaction.support)
        if stated is None:
            return np.zeros((0, len(self.values)))
        forces = self._forces(unknowns)
        # Of the whole force, where that along an axis is a small part.
        sizes = np.linalg.norm(forces, axis=1) * np.sign(self.compared.sign * forces[:, self.compared.axis])
        # Like a factor of all forces; functions that were fitted also err as a wave along the curve.
        groups = self.groups
        by_reduction = (reduction_force_error(self.model, self.reaction.support) or 0.0) * sizes
        return np.array([stated[0] * sizes, *(np.where(groups == k, by_reduction, 0.0) for k in np.unique(groups))])

    def state_errors(self, unknowns: Values) -> Array:
        run = self.run
        if run is None or not self.are_shown:
            return np.zeros((0, len(self.values)))

        def slopes(mu: Array) -> Array:
            of_force = self.compared.field.value_and_sensitivities(mu)[1][:, 0, self.compared.axis]
            return np.asarray(unknowns.factor * self.compared.sign * of_force)

        return state_errors(run, self._run_rows, lambda known: unknowns.vector(known, shown=True), slopes)

    @cached_property
    def _known(self) -> list[dict[str, float]]:
        """The parameters of each force that are not identified."""
        if self.curve.against != "frame" or self.run is None:
            return [{self.curve.against: float(place)} for place in self.places]
        names = [parameter.name for parameter in self.run.model.parameters]
        return [dict(zip(names, self.run.parameters[row].tolist(), strict=True)) for row in self._run_rows]

    @property
    def _run_rows(self) -> list[int]:
        """Of each force by frame, where its frame is in the run."""
        assert self.run is not None
        row_of = {int(frame): row for row, frame in enumerate(self.run.frames)}
        return [row_of[int(place)] for place in self.places]

    @property
    def loading_rates(self) -> dict[str, float]:
        """How much the parameters that change change from frame to frame, SI; empty where no run tells.

        The rate of each is the slope of a straight line through its estimates.
        """
        if self.curve.against != "frame" or self.run is None:
            return {}
        rates = {
            name: float(np.polyfit(self.places, [known[name] for known in self._known], 1)[0])
            for name in self._known[0]
        }
        return {
            p.name: rates[p.name]
            for p in self.run.model.study_parameters
            if abs(rates[p.name]) > LEAST_RATE * (p.upper - p.lower)
        }
