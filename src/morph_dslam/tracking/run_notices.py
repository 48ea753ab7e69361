"""What a reader of a run must know, as typed notices; all their texts are here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.stated_errors import doubtful_errors, errors_in_words, unknown_mesh_error
from morph_dslam.model.unknown_loads import supports_beside_loads
from morph_dslam.notices import Notice
from morph_dslam.tracking.displacement_jumps import largest_jump
from morph_dslam.tracking.observability import UNOBSERVABLE_SHARE, statement, unobservable_in_run, with_deviation
from morph_dslam.tracking.outcomes import (
    BlurredByMotion,
    CameraIgnored,
    CameraLost,
    CamerasDisagree,
    DepthNotUsed,
    FewPointsAgree,
    KnownRefuted,
    ModelDoesNotExplain,
    ObjectMoved,
    ReadoutNotUsed,
    ReferenceBlurred,
    SamePlace,
    Status,
    TiltAmbiguous,
    TimeOutside,
    TrackingWarning,
)
from morph_dslam.tracking.reference_misfit import CLEARLY_WORSE, FLOOR_PX, REFUTED, UNEXPLAINED_PX
from morph_dslam.tracking.run_results import RunResults, contradictions

_Warning = TypeVar("_Warning", bound=TrackingWarning)


class RunWarning(StrEnum):
    """What may be wrong with a run; the texts are filled in by `RunNotice`."""

    LOST = "{count} of {n_frames} frames {were} lost; their reasons are in frames.csv"
    HIDDEN = (
        "the object was hidden in {count} of {n_frames} frames: its pose there is the map's, as if nobody had moved or "
        "taken it, and its parameters are not known"
    )
    BY_OUTLINE = (
        "the object was followed by its outline alone in {count} of {n_frames} frames, as asked for (--no-texture): "
        "what moves along the outline, or inside of it, is not seen"
    )
    FEW_CORNERS = (
        "the object was followed by its outline alone in {count} of {n_frames} frames, since its texture shows "
        "{corners} corners in the reference and {needed} are needed: what moves along the outline, or inside of it, is "
        "not seen"
    )
    DEFORMED_AT_REST = (
        "by its outline alone the object has {values} in frame {frame}, in which it was said to be at rest "
        "(--at-rest): the part and its drawing differ, or a load acts there. Values count from the drawing, not from "
        "that frame: take these off for what has happened since, and measure the part"
    )
    MOVED = (
        "the object has moved from its place in the map in {count} {frames}, first in frame {first}: there its points "
        "alone give its pose; register it again to use the map"
    )
    FEW_AGREE = (
        "few points agree, and less closely than usual, or most of them far less closely, in {count} of {n_frames} "
        "frames, first in frame {first}: something is before the object, it deforms otherwise than the model, it was "
        "taken for what looks like it, or its points are dust or reflections on a plain surface (then take its outline "
        "alone: --outline --no-texture); do not rely on these frames"
    )
    TILT_AMBIGUOUS = (
        "in {count} of {n_frames} frames, first in frame {first}, the object may as well be tilted to the other side, "
        "by up to {largest_deg:.0f} degrees from the pose found: a flat object far away looks alike; deviations there "
        "hold that; film it from nearer, or with depth"
    )
    BLURRED_BY_MOTION = (
        "motion blurs the pictures in {count} of {n_frames} frames, first in frame {first}, over paths of up to "
        "{largest_px:.0f} px: deviations there hold that points are measured anywhere on these; for exact ones film "
        "with more light and a shorter exposure, or a slower motion"
    )
    REFERENCE_BLURRED = (
        "motion blurs the reference picture, over paths of up to {largest_px:.0f} px, as {count} of {n_frames} frames "
        "show that are sharper, first in frame {first}; all frames are measured against it and may be off by "
        "more than their deviations: take a sharp frame for it (--reference-frame, landmarks in that one)"
    )
    SAME_PLACE = (
        "it stands where '{other}' stands in {count} of {n_frames} frames, first in frame {first}: one of both was "
        "taken for the other, which looks like it; do not rely on these frames of either"
    )
    KNOWN_REFUTED = (
        "the images refute the known values of '{parameter}' in {count} of {n_frames} frames, first in frame {first}, "
        "by up to {largest:.0f} standard deviations: check the sensor's zero, its unit, its clock and its deviation, "
        "and the registration; estimates there hold to the sensor, and what it does not fit is left in the images"
    )
    TIME_BEFORE = (
        "{count} of {n_frames} frames, first in frame {first}, are before the time at which the model's begins: "
        "'{parameter}' counts as unknown there, and nothing should act yet"
    )
    TIME_OUTSIDE = (
        "{count} of {n_frames} frames, first in frame {first}, are before the time at which the model's begins, or "
        "after the end of its range: '{parameter}' counts as unknown there; check --time-zero, or build with a longer "
        "range"
    )
    MODEL_FAILS = (
        "the model leaves up to {largest_px:.1f} px that neighbouring points have in common in {count} of {n_frames} "
        "frames, first in frame {first}: there the object deforms otherwise, as by something that touches it and is "
        "not in the study (try --unknown-loads, or --discrepancy), by another law, support or shape, a crack or a "
        "slip, or the camera is another one, or, with --still, it or the support was moved or the registration is off; "
        "what is not seen may be off by much more than its deviations"
    )
    SHIFTED = (
        "the model leaves up to {largest_px:.1f} px that neighbouring points have in common in {count} of {n_frames} "
        "frames, first in frame {first}, mostly one shift of all points, by up to {shift_px:.1f} px: there the camera "
        "or the support was moved, or a clamp slips, or the registration is off, which --still keeps in all frames, or "
        "else the object deforms otherwise, as by another law or shape; track the frames before and after a move apart "
        "(--range), or leave out --still"
    )
    RIGID_FAILS = (
        "up to {largest_px:.1f} px that neighbouring points have in common are left in {count} of {n_frames} frames, "
        "first in frame {first}: the mesh, its place in the map or the camera file is off by as much"
    )
    CAMERAS_DISAGREE = (
        "in {count} of {n_frames} frames the cameras do not agree with each other, first in frame {first}: up to "
        "{largest_px:.1f} px that neighbouring points have in common are left; the poses of the cameras are wrong "
        "(`morph calibrate --with`), or frames of one number are not of one instant"
    )
    CAMERA_LOST = (
        "the camera was not found in the map in {count} of {n_frames} frames, first in frame {first}: there the "
        "object's points alone give its pose"
    )
    CAMERA_IGNORED = (
        "camera {camera} does not count in {count} of {n_frames} frames, first in frame {first}; the reasons are in "
        "frames.csv"
    )
    SURFACE_JUMPS = (
        "from frame {first} on the surface opens or slips along a line, as at a crack, which the model does not have: "
        "by up to {where}; stress near it does not hold and is drawn grey (plots/jumps.png)"
    )
    DEPTH_NOT_USED = (
        "the depth images did not count in {count} of {n_frames} frames, first in frame {first}, where they show "
        "nothing of the object or put it elsewhere; check --depth-per-metre, or register with the depth image of the "
        "reference frame too (--depth); the reasons are in frames.csv"
    )
    READOUT_NOT_USED = (
        "readout_s of the camera file did not count in {count} of {n_frames} frames, which have no times in seconds "
        "that tell how the object moves (frames.csv): correct their times, or film with more frames a second"
    )
    DOUBTFUL_FIELDS = (
        "the model misses {errors} at held-out solutions of its study: do not rely on these here, "
        "whatever their deviations"
    )
    MESH_ERROR_UNKNOWN = (
        "the error of the model's mesh was not estimated ({reason}), and no deviation contains it: parameters and what "
        "follows from them may be off by more than stated; build with sampling.refined = 1, or compare with a model of "
        "smaller cells"
    )
    LOADS_BESIDE_SUPPORT = (
        "unknown loads are sought up to the edge of {supports}, which the study moves: what acts on both sides of such "
        "an edge looks alike, so that forces of either may be off by much more than their deviations; leave a margin "
        "about it out of the surface of [unknown_loads], or do not rely on these forces"
    )
    REFERENCE_WIDENED = (
        "deviations are {factor:.1f} times wider than the registration alone would have them: the frames ask for that, "
        "where landmarks are less exact than stated, or where something acts that the study lacks, a contact, a load "
        "or another support, or the law is off; these errors may be larger still"
    )
    AT_BOUND = (
        "parameter '{parameter}' is at the {side} bound of its range ({bound}) in {count} {frames}: the object may be "
        "outside what the model covers; widen the range in the study and build again"
    )
    NOT_ONE_VALUE = (
        "'{parameter}' is not one value over the sequence: it is {before} up to frame {last}, and {after} from frame "
        "{first} on; it changes (leave out --per-sequence), something acts that the study lacks, or the clock is off "
        "(--fps, --time-zero)"
    )
    UNOBSERVABLE = "{statement}"
    REREGISTERED = "registered anew in frame {frame}"
    NOT_REREGISTERED = "not registered anew in frame {frame}: {why}"
    SAME_PICTURE = (
        "the camera delivered exactly the same picture again in {count} {frames}, first in frame {first}, for up to "
        "{longest_s:.1f} s: it, or what sends its pictures, may have been frozen; results there say nothing of the "
        "object"
    )
    UNEQUAL_RECORDINGS = (
        "the cameras have not recorded the same frames: of {instants}, {missing}; there the others count alone"
    )


@dataclass(frozen=True)
class RunNotice(Notice):
    """A warning about a run.

    Attributes
    ----------
    warning : what it is about.
    data : the figures in it, by name.
    """

    warning: RunWarning
    data: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, warning: RunWarning, **data: Any) -> RunNotice:
        """A notice with these figures."""
        return cls(warning, data)

    @property
    def kind(self) -> str:
        return self.warning.name.lower()

    @property
    def text(self) -> str:
        one = self.data.get("count") == 1
        frames, were = ("frame", "was") if one else ("frames", "were")
        return self.warning.value.format(**self.data, frames=frames, were=were)

    def content(self) -> dict[str, Any]:
        return {"kind": self.kind, **self.data, "text": self.text}


def _by_outline(run: RunResults) -> list[RunNotice]:
    """That the outline is all that was seen in some frames, and why."""
    by_outline = [result for result in run.results if result.by_outline]
    if not by_outline:
        return []
    data = {"count": len(by_outline), "n_frames": len(run)}
    if (few := by_outline[-1].few_corners) is None:
        return [RunNotice.of(RunWarning.BY_OUTLINE, **data)]
    return [RunNotice.of(RunWarning.FEW_CORNERS, **data, corners=few[0], needed=few[1])]


def _deformed_at_rest(run: RunResults) -> list[RunNotice]:
    """That the outline alone, which counts from the drawing, has an object deformed that was said to be at rest."""
    if not run.at_rest or run.reference_frame not in run.frames:
        return []
    row = run.frames.index(run.reference_frame)
    estimate, model = run.results[row].estimate, run.model
    if estimate is None or not run.results[row].by_outline:
        return []
    pairs = zip(estimate.state.parameters, model.default, estimate.parameter_std, strict=True)
    values = [
        f"{parameter.name} = {with_deviation(parameter, value, deviation)}"
        for parameter, (value, default, deviation) in zip(model.study_parameters, pairs, strict=False)
        if parameter.name not in run.per_sequence and abs(value - default) > REFUTED * deviation
    ]
    data = {"frame": run.reference_frame, "values": ", ".join(values)}
    return [RunNotice.of(RunWarning.DEFORMED_AT_REST, **data)] if values else []


def notices_of(run: RunResults) -> list[RunNotice]:
    """What a reader of the results must know."""
    held = held_at_bound(run)
    found, of, n_frames = _at_bound(run, held), RunNotice.of, len(run)
    lost = sum(result.status is Status.LOST for result in run.results)
    if lost:
        found.append(of(RunWarning.LOST, count=lost, n_frames=n_frames))
    if run.hidden.any():
        found.append(of(RunWarning.HIDDEN, count=int(run.hidden.sum()), n_frames=n_frames))
    found += [*_by_outline(run), *_deformed_at_rest(run), *_of_frames(run)]
    torn = [(frame, r) for frame, r in zip(run.frames, run.results, strict=True) if r.jumps]
    if torn:
        found.append(of(RunWarning.SURFACE_JUMPS, first=torn[0][0], where=largest_jump(torn[-1][1].jumps).text))
    # Frames beyond the model's range ask for more whatever the law and the landmarks: they have a notice of their own.
    factor = float(np.max(run.reference_factors()[~held.any(axis=1)], initial=1.0))
    if factor > CLEARLY_WORSE:
        found.append(of(RunWarning.REFERENCE_WIDENED, factor=factor))
    beside = supports_beside_loads(run.model)
    if beside:
        found.append(of(RunWarning.LOADS_BESIDE_SUPPORT, supports=" and ".join(f"'{name}'" for name in beside)))
    doubtful = doubtful_errors(run.model)
    if doubtful:
        found.append(of(RunWarning.DOUBTFUL_FIELDS, relative=doubtful, errors=errors_in_words(doubtful)))
    mesh = unknown_mesh_error(run.model)
    if mesh is not None:
        found.append(of(RunWarning.MESH_ERROR_UNKNOWN, reason=mesh))
    return [*found, *_not_one_value(run), *_unobservable(run, held)]


def _of_frames(run: RunResults) -> list[RunNotice]:
    """In how many frames something was warned of, and in which first."""
    found, kind = list[RunNotice](), RunWarning

    def tell(warned: list[tuple[int, _Warning]], warning: RunWarning, **data: Any) -> None:
        if warned:
            found.append(RunNotice.of(warning, count=len(warned), n_frames=len(run), first=warned[0][0], **data))

    tell(_warned(run, ObjectMoved), kind.MOVED)
    tell(_warned(run, CameraLost), kind.CAMERA_LOST)
    # Of pictures that were not recorded `SynchronizedFrames` tells.
    ignored = [pair for pair in _warned(run, CameraIgnored) if not pair[1].has_no_picture]
    for number in sorted({warning.camera for _, warning in ignored}):
        tell(
            [(frame, warning) for frame, warning in ignored if warning.camera == number],
            kind.CAMERA_IGNORED,
            camera=number,
        )
    tell(_warned(run, DepthNotUsed), kind.DEPTH_NOT_USED)
    without_rows = _warned(run, ReadoutNotUsed)
    if 2 * len(without_rows) > len(run):
        tell(without_rows, kind.READOUT_NOT_USED)
    tell(_warned(run, FewPointsAgree), kind.FEW_AGREE)
    tilted = _warned(run, TiltAmbiguous)
    tell(tilted, kind.TILT_AMBIGUOUS, largest_deg=max((warning.angle_deg for _, warning in tilted), default=0.0))
    blurred = _warned(run, BlurredByMotion)
    longest = max((warning.path_px for _, warning in blurred), default=0.0)
    tell(blurred, kind.BLURRED_BY_MOTION, largest_px=longest)
    soft = _warned(run, ReferenceBlurred)
    tell(soft, kind.REFERENCE_BLURRED, largest_px=max((warning.path_px for _, warning in soft), default=0.0))
    same = _warned(run, SamePlace)
    for other in sorted({warning.other for _, warning in same}):
        tell([(frame, w) for frame, w in same if w.other == other], kind.SAME_PLACE, other=other)
    outside = _warned(run, TimeOutside)
    time = outside[0][1].parameter if outside else ""
    # A recording may well begin before the load does, but not end then.
    if len(outside) < len(run):
        tell([one for one in outside if one[1].is_before], kind.TIME_BEFORE, parameter=time)
        outside = [one for one in outside if not one[1].is_before]
    tell(outside, kind.TIME_OUTSIDE, parameter=time)
    refuted = _warned(run, KnownRefuted)
    for name in dict.fromkeys(warning.parameter for _, warning in refuted):
        of_one = [(frame, warning) for frame, warning in refuted if warning.parameter == name]
        largest = max(warning.deviations for _, warning in of_one)
        tell(of_one, kind.KNOWN_REFUTED, parameter=name, largest=largest)
    largest = float(np.nanmax(run.unexplained_px(), initial=0.0))
    unexplained = _warned(run, ModelDoesNotExplain)
    shifts = [warning.shift_px for _, warning in unexplained if warning.shift_px]
    if 2 * len(shifts) > len(unexplained):
        tell(unexplained, kind.SHIFTED, largest_px=largest, shift_px=max(shifts))
    else:
        fails = kind.MODEL_FAILS if run.model.parameters else kind.RIGID_FAILS
        tell(unexplained, fails, largest_px=largest)
    apart = _warned(run, CamerasDisagree)
    tell(apart, kind.CAMERAS_DISAGREE, largest_px=max((warning.residual_px for _, warning in apart), default=0.0))
    return found


def _warned(run: RunResults, kind: type[_Warning]) -> list[tuple[int, _Warning]]:
    """The warnings of a kind, with the frames that they are of."""
    pairs = zip(run.frames, run.results, strict=True)
    return [(frame, warning) for frame, result in pairs for warning in result.warnings if isinstance(warning, kind)]


def flags_of(notices: Sequence[Notice]) -> list[str]:
    """Notices in words: a line for all parameters that are unobservable in frames, and one for all combinations."""
    merged = [n for n in notices if isinstance(n, RunNotice) and n.data.get("over_the_sequence") is False]
    said = [notice.text for notice in notices if notice not in merged]
    alone = [notice for notice in merged if len(notice.data["parameters"]) == 1]
    together = sorted((n for n in merged if n not in alone), key=lambda n: -n.data["count"])
    if len(alone) > 1:
        parts = [f"'{notice.data['parameters'][0]}' in {_frames(notice.data['count'])}" for notice in alone]
        said.append(f"parameters are unobservable in some frames: {', '.join(parts)}")
    elif alone:
        said.append(alone[0].text)
    if together:
        first, *others = together
        said.append(first.text)
        if others:
            count = sum(notice.data["count"] for notice in others)
            said[-1] += f"; likewise {len(others)} other combination{'s' * (len(others) > 1)}, in {_frames(count)}"
    return said


def _frames(count: int) -> str:
    return f"{count} frame{'s' * (count != 1)}"


def held_at_bound(run: RunResults) -> NDArray[np.bool_]:
    """Where (f, d) the images put a parameter to an end of its range, unless the undeformed object has it there.

    A deviation as wide as the range leaves open where the parameter is. But the farther the object is outside of the
    range, the more the residuals widen the deviations: where they do, those that the noise alone would leave count.
    """
    d = len(run.model.study_parameters)
    of_widths = UNOBSERVABLE_SHARE * (run.model.upper - run.model.lower)
    with np.errstate(invalid="ignore"):
        widened = (run.unexplained_px() > CLEARLY_WORSE * FLOOR_PX) | (run.reference_factors() > CLEARLY_WORSE)
        deviations = np.where(widened[:, None], _std_by_noise(run, widened), run.parameter_std())
        at_bound = (run.at_bound() & (deviations < of_widths))[:, :d]
    ends = np.where(_upper_side(run), run.model.upper[:d], run.model.lower[:d])
    return np.asarray(at_bound & (ends != run.model.default[:d]))


def _std_by_noise(run: RunResults, widened: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Standard deviations of the parameters (f, d) if the residuals were as small as in frames (f,) not ``widened``."""
    sigmas = run.sigmas_px()
    others = sigmas[~widened & run.tracked]
    noise = min(float(np.median(others)), UNEXPLAINED_PX) if len(others) else UNEXPLAINED_PX
    return np.asarray(run.stated_std() * np.minimum(noise / sigmas, 1.0)[:, None])


def _upper_side(run: RunResults) -> NDArray[np.bool_]:
    """Where (f, d) a parameter is nearer to the upper end of its range than to the lower one."""
    d, model = len(run.model.study_parameters), run.model
    return np.asarray(run.parameters()[:, :d] > 0.5 * (model.lower + model.upper)[:d])


def _at_bound(run: RunResults, held: NDArray[np.bool_]) -> list[RunNotice]:
    """Of each parameter and end of its range, in how many frames it is ``held`` (f, d) there."""
    found, upper = [], _upper_side(run)
    for k, parameter in enumerate(run.model.study_parameters):
        unit = "" if parameter.quantity == "ratio" else f" {parameter.unit}"
        for bound, side, rows in ((parameter.lower, "lower", ~upper), (parameter.upper, "upper", upper)):
            count = int((held & rows)[:, k].sum())
            if count:
                shown = f"{parameter.display(bound):.4g}{unit}"
                found.append(
                    RunNotice.of(RunWarning.AT_BOUND, parameter=parameter.name, side=side, bound=shown, count=count)
                )
    return found


def _not_one_value(run: RunResults) -> list[RunNotice]:
    """Of which per-sequence parameters frames contradict each other."""
    found = []
    for one in contradictions(run):
        parameter = run.model.study_parameters[one.parameter]
        before, after = (with_deviation(parameter, *value) for value in (one.before, one.after))
        data = {"parameter": parameter.name, "before": before, "after": after, "last": one.last, "first": one.first}
        found.append(RunNotice.of(RunWarning.NOT_ONE_VALUE, **data))
    return found


def _unobservable(run: RunResults, held: NDArray[np.bool_]) -> list[RunNotice]:
    """What the images do not give, but for what is ``held`` (f, d) at an end of its range.

    Of per-sequence parameters only what they do not give after the last frame.
    """
    parameters = run.model.study_parameters
    estimates = [(r.estimate, rows) for r, rows in zip(run.results, held, strict=True) if r.estimate]
    constant, found = {k for k, p in enumerate(parameters) if p.name in run.per_sequence}, list[RunNotice]()
    for part_of_run, is_last in ((estimates, False), (estimates[-1:], True)):
        for indices, (count, part) in unobservable_in_run(parameters, part_of_run).items():
            if constant.issuperset(indices) is is_last:
                text = statement(parameters, part, "over the whole sequence" if is_last else f"in {_frames(count)}")
                data = {"parameters": [parameters[k].name for k in indices], "count": count, "statement": text}
                found.append(RunNotice.of(RunWarning.UNOBSERVABLE, **data, over_the_sequence=is_last))
    return found
