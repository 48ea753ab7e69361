"""What shows that measured forces are not those that a model describes: another unit, other frames, another law."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from morph_dslam.evaluation.force_curves import FORCE_UNITS, ForceCurve, newtons_of
from morph_dslam.evaluation.frame_numbers import (
    CLEARLY,
    FEWEST_FORCES,
    HOW_FRAMES_COUNT,
    fit_columns,
    force_shift,
    in_words,
)
from morph_dslam.evaluation.likeness import Likeness, likeness, root_mean_square
from morph_dslam.notices import Notice
from morph_dslam.units import smaller_units

Array = NDArray[np.float64]
#: Forces that change by more than so many times as much as the model's, or less than its inverse, are others. In the
#: unit that is meant, they change as the model's do up to the other factor: its moduli may be wrong.
MOST_FACTOR, ALIKE = 10.0, 2.0
#: From here on a unit is offered, if only one would do: kgf and lbf lie within the other limit.
DOUBTED_FACTOR = 3.0
#: How likely independent residuals may be as alike as those of which it is said. Residuals below the last part of what
#: the load changed are not looked at.
LEAST_PROBABILITY, LEAST_MISSED = 1e-3, 1e-3


@dataclass(frozen=True)
class ForceNotice(Notice):
    """Of measured forces.

    Attributes
    ----------
    name : of their column.
    """

    name: str


@dataclass(frozen=True)
class OtherSize(ForceNotice):
    """They change by far more or less than the model's, or by a factor that one other unit explains.

    Attributes
    ----------
    factor : by how many times as much.
    unit : with which they would change as the model's do; empty if none is known.
    factor_with_unit : by how many times as much then.
    """

    template: ClassVar[str] = (
        "{finding}: check the unit in the title of its column, --reaction, and the moduli of the model"
    )
    factor: float
    unit: str
    factor_with_unit: float

    @classmethod
    def of(cls, name: str, factor: float) -> OtherSize | None:
        """The notice of a factor, if it needs one."""
        if not factor > 0.0 or 1.0 / DOUBTED_FACTOR <= factor <= DOUBTED_FACTOR:
            return None
        factors = {unit: factor * newtons / newtons_of(name) for unit, newtons in FORCE_UNITS.items()}
        unit = min(factors, key=lambda unit: (abs(np.log(factors[unit])), len(unit)))
        meant = {FORCE_UNITS[unit] for unit, with_unit in factors.items() if 1.0 / ALIKE <= with_unit <= ALIKE}
        found = cls(name, factor, unit if meant else "", factors[unit] if meant else factor)
        return found if found.is_far or len(meant) == 1 else None

    @property
    def is_far(self) -> bool:
        """Whether moduli do not explain the factor either; a model of placeholder moduli may have a smaller one."""
        return not 1.0 / MOST_FACTOR <= self.factor <= MOST_FACTOR

    @property
    def finding(self) -> str:
        """What it says, without what to do."""
        other = f"; with values in {self.unit} it would be {self.factor_with_unit:.3g} times" if self.unit else ""
        return f"{self.name} changes by {self.factor:.4g} times what the model's force changes by{other}"

    @property
    def text(self) -> str:
        if not self.is_far:
            return f"{self.finding}: that unit may be meant, or the moduli of the model are others"
        return self.template.format(finding=self.finding)


@dataclass(frozen=True)
class OtherFrameNumbers(ForceNotice):
    """Other frame numbers explain most of what is left.

    Attributes
    ----------
    shift : what each number lacks, -1 or 1.
    factor : of the model's forces, with right numbers.
    rms, rms_as_given : of what the factor and an offset leave with right numbers, and with those given, newtons.
    """

    template: ClassVar[str] = (
        "with {shift} in each frame number of {name} a factor of {factor:.4g} and an offset leave {rms:.3g} N rms, not "
        "{rms_as_given:.3g}: {how}"
    )
    shift: int
    factor: float
    rms: float
    rms_as_given: float

    @property
    def text(self) -> str:
        return self.template.format(**{**vars(self), "shift": in_words(self.shift), "how": HOW_FRAMES_COUNT})

    @classmethod
    def of(cls, name: str, frames: Array, modelled: Array, places: Array, measured: Array) -> OtherFrameNumbers | None:
        """The notice that forces need, if they do; see `force_shift`."""
        found = force_shift(frames, modelled, places, measured)
        return None if found is None else cls(name, *found)


@dataclass(frozen=True)
class OtherPlaceUnit(ForceNotice):
    """A smaller unit of the parameter that a curve is given by explains what is left.

    Attributes
    ----------
    parameter : its name.
    scale : what its values have to be multiplied by.
    factor : of the model's forces then.
    rms, rms_as_given : of what the factor and an offset leave then, and as it is given, newtons.
    """

    template: ClassVar[str] = (
        "with {scale:.4g} times the values of {parameter}, {name} is {factor:.4g} times the model's force and an "
        "offset but for {rms:.3g} N rms, not {rms_as_given:.3g}: is the unit in the title of the first column right?"
    )
    parameter: str
    scale: float
    factor: float
    rms: float
    rms_as_given: float

    @classmethod
    def of(cls, quantity: str, curve: ForceCurve, places: Array, modelled: Array) -> OtherPlaceUnit | None:
        """The notice that a curve needs, if a smaller unit of its places explains a factor of its forces.

        A factor up to `ALIKE`, or its inverse, needs no explanation. With a smaller unit more of the curve is compared,
        which no noise and no other law makes straighter. A larger one is not tried: any short piece of a curve is
        straight. Most frames are then off the curve as it is given.

        Parameters
        ----------
        quantity : of the parameter that the curve is given by.
        places : (e,) the parameter in frames of the run.
        modelled : (e,) the model's force there.
        """
        order = np.argsort(curve.places, kind="stable")
        known, forces = curve.places[order], curve.forces[order]
        found = list[OtherPlaceUnit]()
        for scale in smaller_units(quantity):
            inside = (places >= scale * known[0]) & (places <= scale * known[-1])
            if inside.sum() < FEWEST_FORCES:
                continue
            (given, _), before = fit_columns(np.interp(places[inside], known, forces), modelled[inside])
            (factor, _), rms = fit_columns(np.interp(places[inside], scale * known, forces), modelled[inside])
            is_size = 1.0 / ALIKE <= factor <= ALIKE and not 1.0 / ALIKE <= given <= ALIKE
            if is_size and before > CLEARLY * rms:
                found.append(cls(curve.name, curve.against, scale, float(factor), rms, before))
        return min(found, key=lambda each: each.rms, default=None)


@dataclass(frozen=True)
class NeighboursAlike(ForceNotice):
    """Neighbouring residuals are alike.

    Attributes
    ----------
    durbin_watson : 2 if they are independent, less if they are alike.
    picture : that shows them.
    """

    template: ClassVar[str] = (
        "neighbouring residuals of {name} are alike (Durbin-Watson {durbin_watson:.2g}; 2 if independent): the law, "
        "the loading or the support differs from the model's, or errors of the load cell last over many readings; "
        "intervals and deviations do not contain it in full; see {picture}"
    )
    durbin_watson: float
    picture: str


def force_notices(
    name: str,
    factor: float | None,
    places: Array,
    measured: Array,
    fitted: Array,
    slopes: Array,
    own_rms: float,
    explained: ForceNotice | None,
    picture: str,
) -> tuple[Likeness | None, list[ForceNotice]]:
    """How alike neighbouring residuals are, and what must be known of the forces.

    Parameters
    ----------
    name : of the column of measured forces; its unit is at its end.
    factor : by how many times as much they change as the model's; None if those do not change.
    places : (n,) where on the curve they are.
    measured : (n,) newtons.
    fitted : (n,) the model's, as they fit best.
    slopes : (n, f) derivatives of these by what was fitted.
    own_rms : of what the model's own errors, and those of the estimates, do to its forces: smaller residuals tell
        nothing.
    explained : what explains residuals if they are no smaller.
    picture : that shows the residuals.
    """
    order = np.argsort(places, kind="stable")
    alike = likeness((fitted - measured)[order], slopes[order])
    size = None if factor is None else OtherSize.of(name, factor)
    found: list[ForceNotice] = [] if size is None else [size]
    least = max(own_rms, LEAST_MISSED * root_mean_square(measured - measured.mean()))
    if root_mean_square(fitted - measured) <= least:
        return alike, found
    if explained is not None:
        # With places in the unit that is meant the factor needs no other one.
        return alike, [explained] if isinstance(explained, OtherPlaceUnit) else [*found, explained]
    if alike is not None and alike.probability < LEAST_PROBABILITY and alike.rms > least:
        found.append(NeighboursAlike(name, alike.durbin_watson, picture))
    return alike, found
