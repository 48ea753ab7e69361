"""Measured forces against a reaction of the model that was tracked.

Images determine shapes, not forces: a model whose stiffnesses are all wrong by one factor tracks as well as a right
one. A measured force gives that factor. It is fitted with an offset, the zero of the load cell, by least squares.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import EvaluationError
from morph_dslam.evaluation.force_curves import LEAST, ForceCurve
from morph_dslam.evaluation.force_notices import ForceNotice, OtherFrameNumbers, OtherPlaceUnit, force_notices
from morph_dslam.evaluation.likeness import root_mean_square
from morph_dslam.evaluation.run_folder import Run
from morph_dslam.model import ReducedModel, SeparatedField
from morph_dslam.model.reduced_model import FORCE
from morph_dslam.model.stated_errors import force_error as stated_force_error, largest_force_error

Array = NDArray[np.float64]
#: Changes of a force below this share of it are rounding.
ROUNDING = 1e-9
#: A component below this share of a support's largest force is rounding, as where models are built; in so many states
#: beside the default.
NEGLIGIBLE, SAMPLES = 1e-6, 32
#: Frames that cover less than this share of a curve are worth a note: the unit of its places may be wrong.
SMALL_SHARE = 0.02
_REACTION = re.compile(r"(?P<support>.+?)(?::(?P<sign>[+-]?)(?P<axis>[xyz]))?")


@dataclass(frozen=True)
class ReactionInDirection:
    """The force of a model on a support, in a direction of the object frame.

    Attributes
    ----------
    support : the set that it holds.
    field : the force, N.
    axis : 0, 1 or 2.
    sign : 1 or -1.
    literal : whether the sign was given; otherwise `following` finds that in which the force grows with a measured one.
    """

    support: str
    field: SeparatedField
    axis: int
    sign: float = 1.0
    literal: bool = True

    def __call__(self, mu: Array) -> float:
        """Newtons at parameters (d,), SI."""
        return self.sign * float(self.field.value(mu)[0, self.axis])

    @property
    def direction(self) -> str:
        """As in reports: "x", "-z" and so on."""
        return ("-" if self.sign < 0.0 else "") + "xyz"[self.axis]

    def rms_by_estimates(self, states: Array, covariances: Array) -> float:
        """Standard deviation, root mean square over states (e, d), if their covariances are (e, d, d)."""
        slopes = np.array([self.field.value_and_sensitivities(mu)[1][:, 0, self.axis] for mu in states])
        variances = np.einsum("ed,edc,ec->e", slopes, covariances, slopes)
        return float(np.sqrt(max(np.mean(variances), 0.0)))

    def following(self, along: Array, measured: Array) -> ReactionInDirection:
        """This reaction with its sign, if forces (e,) ``along`` its axis are compared with measured ones (e,)."""
        return self if self.literal else replace(self, sign=-1.0 if _growth(along, measured) < 0.0 else 1.0)

    def check_growth(self, modelled: Array, measured: Array) -> None:
        """Raise EvaluationError if values (e,) of this reaction fall where the measured ones (e,) grow."""
        if _growth(modelled, measured) < 0.0:
            other = f"{self.support}:{'-+'[self.sign < 0.0]}{'xyz'[self.axis]}"
            raise EvaluationError(
                f"the model's force on '{self.support}' in direction {self.direction} falls where the measured force "
                f"grows: write --reaction {other}"
            )


def _growth(modelled: Array, measured: Array) -> float:
    """Positive if a force (e,) grows with the measured one (e,), negative if it falls, 0 where that is rounding."""
    centred = measured - measured.mean()
    together = float((modelled - modelled.mean()) @ centred)
    size = float(np.linalg.norm(centred)) * float(np.abs(modelled).max()) * np.sqrt(len(modelled))
    return together if abs(together) > ROUNDING * size else 0.0


def reaction_in_direction(model: ReducedModel, text: str) -> ReactionInDirection:
    """The reaction that "SET:x", "SET:+x" or "SET:-x" names; without a sign, it follows the measured force.

    Raises
    ------
    EvaluationError
        If the model has no force on this support or none in this direction, or the text names no direction.
    """
    asked = _REACTION.fullmatch(text)
    if asked is None or not asked["axis"]:
        raise EvaluationError(f"'{text}' names no direction: write SET:x, SET:-x, SET:y and so on, in the object frame")
    return _reaction(model, asked["support"], asked["axis"], asked["sign"])


def _reaction(model: ReducedModel, support: str, axis: str, sign: str | None) -> ReactionInDirection:
    """The force on a support along "x", "y" or "z" with sign "+", "-", or that of the measured force."""
    field = _force_field(model, support)
    largest = np.abs(_values(field, model.spread_parameters(SAMPLES))).max(axis=0)
    at, most = "xyz".index(axis), int(largest.argmax())
    # Unknown loads act along any axis, and the samples have none.
    if not model.n_loads and largest[at] < NEGLIGIBLE * largest[most]:
        raise EvaluationError(
            f"the force on '{support}' along {axis} is zero in this model; it acts along {'xyz'[most]}: write "
            f"--reaction {support}:{'xyz'[most]}"
        )
    return ReactionInDirection(support, field, at, -1.0 if sign == "-" else 1.0, literal=bool(sign))


@dataclass(frozen=True)
class ForceError:
    """Measured forces and those of the model, in newtons.

    Attributes
    ----------
    support : whose reaction is compared.
    direction : "x", "-z" and so on, in the object frame.
    curve : the measurement.
    frames : (e,) the frames compared.
    places : (e,) where on the curve they are.
    measured : (e,) the measured force there.
    modelled : (e,) the reaction of the model in the estimated state.
    factor, offset : that make ``factor * modelled + offset`` fit the measurement best.
    factor_std : standard deviation of the factor, from what the fit leaves.
    left_out : tracked frames that the curve does not have, or not in its range.
    own_error : a smaller change of the model's force may be its own error; 0 if the model states none.
    notices : what speaks against the measurement being that of the model's force.
    axis : factor from ``places`` to what a plot shows, and its label.
    """

    support: str
    direction: str
    curve: ForceCurve
    frames: NDArray[np.int64]
    places: Array
    measured: Array
    modelled: Array
    factor: float
    offset: float
    factor_std: float
    left_out: tuple[int, ...]
    own_error: float = 0.0
    notices: tuple[ForceNotice, ...] = ()
    axis: tuple[float, str] = (1.0, "frame")

    @property
    def residuals(self) -> Array:
        """Fitted minus measured force (e,)."""
        return self.factor * self.modelled + self.offset - self.measured


def force_error(run: Run, curve: ForceCurve, reaction: str | None = None) -> ForceError:
    """Compare the reaction of every tracked frame on the curve, and fit factor and offset.

    Parameters
    ----------
    reaction : "SET", "SET:x", "SET:+x" or "SET:-x": the support and the direction. Without a support that of the
        largest force in the frames compared; without a direction that axis of the object along which its force is
        largest; without a sign the one in which it grows with the measured force.

    Raises
    ------
    EvaluationError
        If fewer than three tracked frames lie on the curve, the measured force does not change, or the model has no
        such force, one that does not change or changes by less than the model errs, or one that falls where the
        measured force grows.
    """
    rows = np.flatnonzero(run.tracked)
    places, measured = _on_curve(run, curve, rows)
    kept = np.isfinite(measured)
    if kept.sum() < LEAST:
        raise EvaluationError(
            f"{int(kept.sum())} of the tracked frames lie on the curve, and at least {LEAST} must: it covers "
            f"{_range(run, curve.against, curve.places)}, the run {_range(run, curve.against, places)}"
        )
    _check_spanned(run, curve, places[kept])
    rows, left_out = rows[kept], run.frames[rows[~kept]]
    compared, modelled, size = _modelled(run, rows, measured[kept], reaction)
    factor, offset, deviation = _fit(modelled, measured[kept], size)
    error = ForceError(
        support=compared.support,
        direction=compared.direction,
        curve=curve,
        frames=run.frames[rows],
        places=places[kept],
        measured=measured[kept],
        modelled=modelled,
        factor=factor,
        offset=offset,
        factor_std=deviation,
        left_out=tuple(left_out.tolist()),
        own_error=_own_error(run.model, compared.support),
        axis=_axis(run.model, curve.against),
    )
    return replace(error, notices=_notices(run, rows, compared, error))


def _notices(
    run: Run, rows: NDArray[np.integer], compared: ReactionInDirection, error: ForceError
) -> tuple[ForceNotice, ...]:
    """What a reader must know of forces compared in rows of the run."""
    count = len(run.model.parameters)
    stated = stated_force_error(run.model, compared.support)
    own = (
        0.0
        if stated is None
        else stated[0] * root_mean_square(np.linalg.norm(_values(compared.field, run.parameters[rows]), axis=1))
    )
    if run.covariances is not None:
        covariances = run.covariances[rows, :count, :count]
        own = float(np.hypot(own, compared.rms_by_estimates(run.parameters[rows], covariances)))
    _, notices = force_notices(
        error.curve.name,
        error.factor,
        error.places,
        error.measured,
        error.factor * error.modelled + error.offset,
        np.column_stack([error.modelled, np.ones(len(rows))]),
        own_rms=abs(error.factor) * own,
        explained=_explained(run, compared, error),
        picture="force_evaluation.png",
    )
    return tuple(notices)


def _explained(run: Run, compared: ReactionInDirection, error: ForceError) -> ForceNotice | None:
    """Other frame numbers, or another unit of a curve's places, if they explain what is left."""
    every = np.flatnonzero(run.tracked)
    along = compared.sign * _values(compared.field, run.parameters[every])[:, compared.axis]
    for k, parameter in enumerate(run.model.parameters):
        if parameter.name == error.curve.against:
            return OtherPlaceUnit.of(parameter.quantity, error.curve, run.parameters[every, k], along)
    frames = run.frames[every].astype(float)
    return OtherFrameNumbers.of(error.curve.name, frames, along, error.places, error.measured)


def _axis(model: ReducedModel, against: str) -> tuple[float, str]:
    for parameter in model.parameters:
        if parameter.name == against:
            return parameter.display(1.0), f"{against} [{parameter.unit}]"
    return 1.0, "frame"


def _on_curve(run: Run, curve: ForceCurve, rows: NDArray[np.integer]) -> tuple[Array, Array]:
    """Where on the curve rows of the run are, and the forces there, NaN off the curve."""
    order = np.argsort(curve.places, kind="stable")
    known, forces = curve.places[order], curve.forces[order]
    if (np.diff(known) <= 0.0).any():
        twice = _range(run, curve.against, known[1:][np.diff(known) <= 0.0][:1])
        raise EvaluationError(
            f"the curve '{curve.name}' has {twice} more than once: give one branch of it, or the forces by frame "
            "(first column frame)"
        )
    if curve.against == "frame":
        places = run.frames[rows].astype(float)
        found = np.isin(places, known)
    else:
        index = [parameter.name for parameter in run.model.parameters].index(curve.against)
        places = run.parameters[rows, index]
        found = (places >= known[0]) & (places <= known[-1])
    return places, np.where(found, np.interp(places, known, forces), np.nan)


def _check_spanned(run: Run, curve: ForceCurve, places: Array) -> None:
    """Raise EvaluationError if all places (e,) compared are between two neighbouring rows of the curve."""
    if curve.against == "frame":
        return
    known = np.sort(curve.places)
    first = np.searchsorted(known, places.min(), side="right") - 1
    last = np.searchsorted(known, places.max(), side="left")
    if last - first + 1 < LEAST:
        raise EvaluationError(
            f"all {len(places)} frames that lie on the curve are between two neighbouring rows of it, so that nothing "
            f"of its course is compared: it covers {_range(run, curve.against, known)}, the run "
            f"{_range(run, curve.against, places)}. Is the unit in the name of its first column right? Else give more "
            "rows there"
        )


def _range(run: Run, against: str, places: Array) -> str:
    """Smallest and largest place in words, "stroke [mm] 0 to 7" say."""
    scale, label = _axis(run.model, against)
    ends = [] if not len(places) else sorted({scale * float(places.min()), scale * float(places.max())})
    return f"{label} {' to '.join(f'{end:.6g}' for end in ends) or 'nowhere'}"


def _modelled(
    run: Run, rows: NDArray[np.integer], measured: Array, text: str | None
) -> tuple[ReactionInDirection, Array, float]:
    """The reaction compared, its values (e,), and the largest force on its support in any direction."""
    asked = _REACTION.fullmatch(text or "")
    support, axis, sign = asked.group("support", "axis", "sign") if asked else (_most_loaded(run, rows), None, None)
    force = _values(_force_field(run.model, support), run.parameters[rows])
    largest = "xyz"[int(np.abs(force).max(axis=0).argmax())]
    reaction = _reaction(run.model, support, axis or largest, sign)
    reaction = reaction.following(force[:, reaction.axis], measured)
    modelled = reaction.sign * force[:, reaction.axis]
    _check_change(reaction, np.ptp(force, axis=0), _own_error(run.model, support))
    reaction.check_growth(modelled, measured)
    return reaction, modelled, float(np.linalg.norm(force, axis=1).max())


def _own_error(model: ReducedModel, support: str) -> float:
    """What a force on a support may change by from nothing but error: that of both states, as stated."""
    return 2.0 * largest_force_error(model, support)


def _check_change(reaction: ReactionInDirection, changes: Array, own_error: float) -> None:
    """Refuse an axis along which a force with changes (3,) may change by error alone, where another one has more."""
    change, most = changes[reaction.axis], int(changes.argmax())
    if change < own_error <= changes[most]:
        axis, other = "xyz"[reaction.axis], f"{reaction.support}:{'xyz'[most]}"
        raise EvaluationError(
            f"the model's force on '{reaction.support}' along {axis} changes by {change:.3g} N in the frames compared, "
            f"and may be off by {own_error:.3g} N by the model's own error: no factor can be found. It changes by "
            f"{changes[most]:.3g} N along {'xyz'[most]}: write --reaction {other}"
        )


def _most_loaded(run: Run, rows: NDArray[np.integer]) -> str:
    """The support with the largest force in rows of the run."""
    fields = _force_fields(run.model)
    return max(fields, key=lambda name: float(np.abs(_values(fields[name], run.parameters[rows])).max()))


def _values(field: SeparatedField, states: Array) -> Array:
    """A force (e, 3) at parameters (e, d)."""
    return np.array([field.value(mu)[0] for mu in states])


def _force_field(model: ReducedModel, support: str) -> SeparatedField:
    """The force on a support; EvaluationError if the model has none."""
    fields = _force_fields(model)
    if support not in fields:
        raise EvaluationError(f"the model has no force on '{support}'; it has those on {', '.join(fields)}")
    return fields[support]


def _force_fields(model: ReducedModel) -> dict[str, SeparatedField]:
    """The force on each support; EvaluationError if the model has no reactions."""
    fields = {name[len(FORCE) :]: f for name, f in model.reactions.items() if name.startswith(FORCE)}
    if not fields:
        raise EvaluationError(
            f"the model '{model.name}' holds no reaction of a support. Models do, unless they were turned about the "
            "axis of a body of revolution, come from solutions of another program without [external.reactions], or all "
            "forces on their supports are rounding"
        )
    return fields


def _fit(modelled: Array, measured: Array, size: float) -> tuple[float, float, float]:
    """Factor, offset and the factor's standard deviation of the line through ``measured`` (e,) by ``modelled`` (e,).

    ``size`` is the support's largest force: what changes by less than its rounding does not change.
    """
    if not np.ptp(measured) > ROUNDING * np.abs(measured).max():
        raise EvaluationError(
            f"the measured force is {measured[0]:.6g} N in all frames compared: no factor can be found. Compare frames "
            "in which the load grows, or name another column of forces (--force FILE:COLUMN)"
        )
    centred = modelled - modelled.mean()
    spread = float(centred @ centred)
    if not spread > (ROUNDING * size) ** 2 * len(modelled):
        raise EvaluationError(
            "the model's force is the same in all frames compared: no factor can be found. Compare frames in which "
            "the load grows, or name another support or direction (--reaction)"
        )
    factor = float(centred @ measured) / spread
    offset = float(measured.mean() - factor * modelled.mean())
    left = factor * modelled + offset - measured
    return factor, offset, float(np.sqrt(left @ left / max(len(left) - 2, 1) / spread))


def summarise_force(error: ForceError) -> dict[str, Any]:
    """The figures of ``force_evaluation.json``, newtons, plain JSON."""
    rms = root_mean_square(error.residuals)
    return {
        "support": error.support,
        "direction": error.direction,
        "column": error.curve.name,
        "against": error.curve.against,
        "share_of_curve": _share_of_curve(error),
        "factor": error.factor,
        "factor_std": error.factor_std,
        "offset_N": error.offset,
        "rms_N": rms,
        "relative_rms": rms / max(float(np.ptp(error.measured)), 1e-300),
        "largest_N": float(np.abs(error.residuals).max()),
        "rms_without_fit_N": root_mean_square(error.modelled - error.measured),
        "change_of_model_N": float(np.ptp(error.modelled)),
        "own_error_of_model_N": error.own_error,
        "notices": [notice.content() for notice in error.notices],
        "largest_measured_N": float(np.abs(error.measured).max()),
        "frames_compared": error.frames.tolist(),
        "tracked_frames_off_the_curve": list(error.left_out),
        "per_frame": {
            str(frame): {"measured_N": measured, "model_N": modelled, "fitted_minus_measured_N": residual}
            for frame, measured, modelled, residual in zip(
                error.frames.tolist(),
                error.measured.tolist(),
                error.modelled.tolist(),
                error.residuals.tolist(),
                strict=True,
            )
        },
    }


def _share_of_curve(error: ForceError) -> float | None:
    """The part of the curve's range that the frames compared cover; None where the curve is given by frame."""
    if error.curve.against == "frame":
        return None
    return float(np.ptp(error.places) / np.ptp(error.curve.places))


def force_remarks(figures: Mapping[str, Any]) -> list[str]:
    """What a reader of the figures must know: which reaction it is, and frames that were not compared."""
    lines = [reaction_remark(figures)]
    if figures["change_of_model_N"] < figures["own_error_of_model_N"]:
        lines.append(
            f"the model's force changes by {figures['change_of_model_N']:.3g} N in the frames compared, and may be off "
            f"by {figures['own_error_of_model_N']:.3g} N by the model's own error: the factor says little"
        )
    share = figures["share_of_curve"]
    if share is not None and share < SMALL_SHARE:
        lines.append(
            f"the frames compared cover {100.0 * share:.2g} % of the curve's range of {figures['against']}: is the "
            "unit in the name of its first column right?"
        )
    if frames := figures["tracked_frames_off_the_curve"]:
        lines.append(f"{len(frames)} tracked frames are not on the curve and were not compared: {_some(frames)}")
    return [*lines, *noticed(figures)]


def noticed(figures: Mapping[str, Any]) -> list[str]:
    """What speaks against measured forces being those of the model, in words."""
    return [notice["text"] for notice in figures.get("notices", [])]


def reaction_remark(figures: Mapping[str, Any]) -> str:
    """Which reaction of the model measured forces are compared with."""
    return f"the force on '{figures['support']}' in direction {figures['direction']} of the object frame"


def _some(frames: Sequence[int]) -> str:
    return ", ".join(map(str, frames[:10])) + (" ..." if len(frames) > 10 else "")


def force_line(figures: Mapping[str, Any]) -> str:
    """The last line of an evaluation against a force curve, newtons."""
    return (
        f"factor={figures['factor']:.4f} offset={figures['offset_N']:.4f} rms={figures['rms_N']:.4f} "
        f"relative_rms={figures['relative_rms']:.4f} frames={len(figures['frames_compared'])}/{figures['n_frames']} "
        f"tracked={figures['n_frames_tracked']}/{figures['n_frames']}"
    )
