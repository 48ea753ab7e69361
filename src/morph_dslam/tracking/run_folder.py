"""The folders that runs and registrations are written to, made before the long work begins."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import MorphError, TrackingError
from morph_dslam.model import Parameter, ReducedModel
from morph_dslam.model.discrepancy import Discrepancy, largest_deformation, save_discrepancies
from morph_dslam.model.inner_structure import CarriedStructure
from morph_dslam.tracking.binding import DrawnSurface
from morph_dslam.tracking.estimator import Estimate, State
from morph_dslam.tracking.observability import (
    UNOBSERVABLE_SHARE,
    largest_displacement,
    largest_von_mises,
    one_value,
    statement,
    unobservable_in_run,
)
from morph_dslam.tracking.outcomes import ModelDoesNotExplain, ObjectMoved, Status
from morph_dslam.tracking.result import STAGES, FrameResult
from morph_dslam.tracking.systematic_errors import CLEARLY_WORSE


def make_folder(folder: Path, what: str, error_class: type[MorphError]) -> None:
    """Make a folder and those above it, unless it is there.

    Parameters
    ----------
    what : is to be written there, for the message: "the registration" say.

    Raises
    ------
    error_class
        If it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise error_class(f"cannot write {what} to {folder}: {error.strerror}") from error


def check_run_folder(folder: Path, overwrite: bool, sign: str = "result.h5") -> None:
    """Make the run folder.

    Parameters
    ----------
    sign : the file by which a run that is there already is known.

    Raises
    ------
    TrackingError
        If it cannot be made, or holds a run already that is not to be overwritten.
    """
    if (folder / sign).exists() and not overwrite:
        raise TrackingError(
            f"{folder} holds a run already: choose another folder, or allow it to be overwritten (`--overwrite`)"
        )
    make_folder(folder, "the run", TrackingError)


# Where inner structures are in every frame of a run, and how well that is known.


Array = NDArray[np.float64]


def centre_and_std(
    structure: CarriedStructure, estimate: Estimate, discrepancy: Discrepancy | None = None
) -> tuple[Array, Array]:
    """Centre of a structure (3,) in the camera frame and its standard deviations (3,), metres.

    With c = R p(mu) + t and the pose's increment on the left, the derivatives by parameters, rotation vector
    and translation are R dp/dmu, -[R p]x and 1; the covariance is carried through them to first order. It
    is that of the images' noise: it holds neither the model's error nor that of the registration. The centre
    is moved by ``discrepancy`` too.
    """
    state = estimate.state
    centre, sensitivities = structure.centre_and_sensitivities(state.parameters)
    if discrepancy is not None:
        centre = centre + discrepancy.displacement(structure.rest).mean(axis=0)
    rotation = state.camera_from_object.rotation
    arm = rotation @ centre
    turning = np.array([[0.0, arm[2], -arm[1]], [-arm[2], 0.0, arm[0]], [arm[1], -arm[0], 0.0]])
    jacobian = np.hstack([rotation @ sensitivities.T, turning, np.eye(3)])
    if not np.isfinite(estimate.covariance).all():
        return arm + state.camera_from_object.translation, np.full(3, np.inf)
    variance = np.einsum("xi,ij,xj->x", jacobian, estimate.covariance, jacobian)
    return arm + state.camera_from_object.translation, np.sqrt(np.maximum(variance, 0.0))


def write_inner_positions(path: Path, run: RunResults, structures: Sequence[CarriedStructure]) -> None:
    """Add ``inner/NAME/centre`` and ``centre_std`` (f, 3), metres, NaN where lost, to ``result.h5``."""
    lost = (np.full(3, np.nan), np.full(3, np.nan))
    with h5py.File(path, "a") as file:
        for structure in structures:
            rows = [
                lost if result.estimate is None else centre_and_std(structure, result.estimate, result.discrepancy)
                for result in run.results
            ]
            group = file.create_group(f"inner/{structure.name}")
            group["centre"], group["centre_std"] = (np.array(column) for column in zip(*rows, strict=True))


# The run folder: everything a run found, in files that other programs read (docs/run-folder.md).


FORMAT = "morph-dslam run"

VERSION = 1


@dataclass
class RunResults:
    """The results of all frames so far, in order.

    Attributes
    ----------
    refined : the reference state was refined over them. per_sequence : names of the parameters that are one
        over the sequence.
    """

    model: ReducedModel
    reference_frame: int
    refined: bool = False
    per_sequence: tuple[str, ...] = ()
    frames: list[int] = field(default_factory=list)
    timestamps: list[float] = field(default_factory=list)
    results: list[FrameResult] = field(default_factory=list)
    _largest: list[tuple[float, float]] = field(default_factory=list, repr=False)
    _stressed: list[tuple[float, float]] = field(default_factory=list, repr=False)

    def add(self, frame: int, timestamp: float, result: FrameResult) -> None:
        self.frames.append(frame)
        self.timestamps.append(timestamp)
        self.results.append(result)

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def tracked(self) -> NDArray[np.bool_]:
        """Frames (f,) that have an estimate."""
        return np.array([result.estimate is not None for result in self.results], dtype=bool)

    @property
    def hidden(self) -> NDArray[np.bool_]:
        """Frames (f,) in which only the pose is known, from the map."""
        return np.array([result.status is Status.HIDDEN for result in self.results], dtype=bool)

    def states(self) -> list[State | None]:
        """The state of every frame, None where it was hidden or lost."""
        return [result.estimate.state if result.estimate else None for result in self.results]

    def poses(self) -> Array:
        """camera_from_object (f, 4, 4), NaN where lost."""
        lost = np.full((4, 4), np.nan)
        poses = [result.pose for result in self.results]
        return np.array([lost if pose is None else pose.matrix for pose in poses])

    def pose_std(self) -> Array:
        """(f, 6) of the rotation vector (rad) and the translation (m) of the pose, NaN where lost."""
        return np.array([result.pose_std for result in self.results]).reshape(-1, 6)

    def parameters(self) -> Array:
        """(f, d), SI, NaN where lost."""
        lost = np.full(len(self.model.parameters), np.nan)
        return np.array([s.parameters if s else lost for s in self.states()])

    def parameter_std(self) -> Array:
        """(f, d), SI, NaN where lost."""
        lost = np.full(len(self.model.parameters), np.nan)
        return np.array([r.estimate.parameter_std if r.estimate else lost for r in self.results])

    def at_bound(self) -> NDArray[np.bool_]:
        """(f, d), false where lost."""
        lost = np.zeros(len(self.model.parameters), dtype=bool)
        return np.array([r.estimate.at_bound if r.estimate else lost for r in self.results])

    def largest_displacements(self) -> Array:
        """The largest displacement of a node of the surface and its standard deviation (f, 2), metres."""
        return self._added_to(self._largest, largest_displacement, DrawnSurface.of(self.model).model)

    def largest_stresses(self) -> Array:
        """The largest von Mises stress of a node of the surface and its standard deviation (f, 2), pascals.

        NaN where lost, and in models without stresses.
        """
        used = np.unique(self.model.triangles)
        stresses = {place: f.with_modes(f.modes[:, used]) for place, f in self.model.stresses.items()}
        return self._added_to(self._stressed, largest_von_mises, replace(self.model, stresses=stresses))

    def _added_to(
        self,
        known: list[tuple[float, float]],
        largest: Callable[[ReducedModel, Estimate], tuple[float, float]],
        surface: ReducedModel,
    ) -> Array:
        """What is ``known`` of the frames so far (f, 2), added to by what is ``largest`` in those since."""
        for result in self.results[len(known) :]:
            found = result.estimate
            known.append((np.nan, np.nan) if found is None else largest(surface, found))
        return np.array(known).reshape(-1, 2)

    def timings_ms(self) -> Array:
        """(f, len(STAGES) + 1): each stage, then the whole frame."""
        return np.array([[*(r.timings_ms[s] for s in STAGES), r.total_ms] for r in self.results])

    def residuals_px(self) -> Array:
        """Root mean square residual (f,), NaN where lost."""
        return np.array([result.residual_rms_px for result in self.results])

    def unexplained_px(self) -> Array:
        """What the model leaves of the residuals (f,), see `systematic_errors`; NaN where lost."""
        return np.array([result.unexplained_px for result in self.results])

    def beyond_model(self) -> Array:
        """Largest displacement (f,) of a node of the surface beyond the model's and a rigid motion, metres.

        NaN where it was not looked for.
        """
        nodes = self.model.nodes[np.unique(self.model.triangles)]
        found = [result.discrepancy for result in self.results]
        return np.array([np.nan if d is None else largest_deformation(nodes, d) for d in found])

    def counts(self) -> NDArray[np.int64]:
        """(f, 2): points that could be seen, and those that support the estimate."""
        return np.array([(r.n_points, r.n_inliers) for r in self.results], dtype=np.int64).reshape(-1, 2)


def write_hdf5(path: Path, run: RunResults) -> None:
    """Write ``result.h5``."""
    text = h5py.string_dtype()
    with h5py.File(path, "w") as file:
        file.attrs.update({"format": FORMAT, "version": VERSION, "reference_frame": run.reference_frame})
        file.attrs.update({"first_frame": run.frames[0], "last_frame": run.frames[-1]})
        file["frame"], file["timestamp"] = np.array(run.frames, dtype=np.int64), np.array(run.timestamps)
        file["status"] = np.array([result.status for result in run.results], dtype=text)
        file["reason"] = np.array([result.reason for result in run.results], dtype=text)
        file["camera_from_object"], file["parameters"] = run.poses(), run.parameters()
        file["pose_from"] = np.array([result.pose_from for result in run.results], dtype=text)
        file["pose_std"] = run.pose_std()
        file["parameter_std"], file["at_bound"] = run.parameter_std(), run.at_bound()
        file["largest_displacement"], file["largest_displacement_std"] = run.largest_displacements().T
        if run.model.stresses:
            file["largest_von_mises"], file["largest_von_mises_std"] = run.largest_stresses().T
        file["residual_rms_px"], file["unexplained_px"] = run.residuals_px(), run.unexplained_px()
        file["n_points"], file["n_inliers"] = run.counts().T
        file["timings_ms"] = run.timings_ms()
        file["timings_ms"].attrs["names"] = [*STAGES, "total"]
        save_discrepancies(file, [result.discrepancy for result in run.results])


def write_csv(path: Path, run: RunResults) -> None:
    """Write ``frames.csv``: millimetres, degrees, milliseconds, and parameters in their own units."""
    from morph_dslam.geometry import rotation_log

    parameters = run.model.parameters
    header = ["frame", "timestamp_s", "status", "reason", "pose_from"]
    for p in parameters:
        header += [f"{p.name}_{p.unit}", f"{p.name}_std_{p.unit}", f"{p.name}_at_bound"]
    header += ["largest_displacement_mm", "largest_displacement_std_mm"]
    header += ["x_mm", "y_mm", "z_mm", "rotation_x_deg", "rotation_y_deg", "rotation_z_deg"]
    header += ["residual_rms_px", "unexplained_px", "n_points", "n_inliers", "time_ms"]
    rows = zip(run.frames, run.timestamps, run.results, 1e3 * run.largest_displacements(), strict=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        for frame, timestamp, result, largest in rows:
            row: list[Any] = [frame, f"{timestamp:.6f}", result.status, result.reason, result.pose_from]
            if result.estimate is None:
                row += [""] * (3 * len(parameters) + 10)
            else:
                state, std = result.estimate.state, result.estimate.parameter_std
                for k, p in enumerate(parameters):
                    row += [f"{p.display(state.parameters[k]):.6g}", f"{p.display(std[k]):.3g}"]
                    row.append(int(result.estimate.at_bound[k]))
                row += [f"{largest[0]:.4f}", f"{largest[1]:.3g}"]
                pose = state.camera_from_object
                row += [f"{1e3 * value:.4f}" for value in pose.translation]
                row += [f"{value:.4f}" for value in np.degrees(rotation_log(pose.rotation))]
                row += [f"{result.residual_rms_px:.4f}", f"{result.unexplained_px:.4f}"]
            writer.writerow([*row, result.n_points, result.n_inliers, f"{result.total_ms:.3f}"])


def summarise(run: RunResults) -> dict[str, Any]:
    """Counts and medians of the run, with what could be wrong with it as ``flags``."""
    tracked, times = run.tracked, run.timings_ms()
    medians = np.median(times, axis=0)
    summary: dict[str, Any] = {
        "model": run.model.name,
        "n_frames": len(run),
        "n_tracked": int(tracked.sum()),
        "n_hidden": int(run.hidden.sum()),
        "n_lost": int((~tracked & ~run.hidden).sum()),
        "n_recovered": sum(result.recovered for result in run.results),
        "first_frame": run.frames[0],
        "last_frame": run.frames[-1],
        "reference_frame": run.reference_frame,
        "median_ms": float(medians[-1]),
        "p95_ms": float(np.percentile(times[:, -1], 95)),
        "stage_median_ms": dict(zip(STAGES, medians[:-1].tolist(), strict=True)),
    }
    if tracked.any():
        summary["median_residual_rms_px"] = float(np.median(run.residuals_px()[tracked]))
        summary["median_n_inliers"] = float(np.median(run.counts()[tracked, 1]))
    beyond = run.beyond_model()
    if np.isfinite(beyond).any():
        summary["beyond_model_mm"] = {
            "median": 1e3 * float(np.nanmedian(beyond)),
            "largest": 1e3 * float(np.nanmax(beyond)),
        }
    summary["one_over_the_sequence"] = values_over_the_sequence(run)
    return summary | {"flags": flags(run)}


def values_over_the_sequence(run: RunResults) -> list[dict[str, object]]:
    """Value, standard deviation and 95 % interval of each parameter that is one over the sequence."""
    last = next((r.estimate for r in reversed(run.results) if r.estimate), None)
    if last is None:
        return []
    return [
        one_value(parameter, last.state.parameters[k], last.parameter_std[k])
        for k, parameter in enumerate(run.model.parameters)
        if parameter.name in run.per_sequence
    ]


def write_summary(path: Path, run: RunResults, extra: dict[str, Any]) -> dict[str, Any]:
    """Write ``summary.json``: `summarise`, then what the caller adds; its ``flags`` are joined."""
    summary = summarise(run)
    joined = [*extra.pop("flags", []), *summary["flags"]]
    summary |= extra | {"flags": joined}
    path.write_text(json.dumps(summary, indent=2, default=str) + "\n")
    return summary


# What could be wrong with a run, in words.


def flags(run: RunResults) -> list[str]:
    """What a reader of the results must know."""
    found = []
    lost = sum(result.status is Status.LOST for result in run.results)
    if lost:
        found.append(f"{lost} of {len(run)} frames were lost; their reasons are in frames.csv")
    found += _flags_of_place(run)
    failed = sum(result.warning(ModelDoesNotExplain) is not None for result in run.results)
    if failed:
        largest = float(np.nanmax(run.unexplained_px()))
        found.append(
            f"the model does not explain the images in {failed} of {len(run)} frames: up to {largest:.1f} px are left "
            "that neighbouring points have in common; it may be a model of something else, or too stiff, or "
            "a wrong camera file"
        )
    worse = max((result.reference_factor for result in run.results), default=1.0)
    if worse > CLEARLY_WORSE:
        found.append(
            f"the frames contradict the reference state: {worse:.1f} times its stated deviation, and all deviations "
            "are that much wider; check the landmarks and whether the object has the model's dimensions"
        )
    found += _at_bound(run)
    return found + _unobservable(run)


def _at_bound(run: RunResults) -> list[str]:
    """Parameters that the images put to an end of their range."""
    found = []
    with np.errstate(invalid="ignore"):
        determined = run.parameter_std() < UNOBSERVABLE_SHARE * (run.model.upper - run.model.lower)
    at_bound, values = run.at_bound() & determined, run.parameters()
    for k, parameter in enumerate(run.model.parameters):
        upper = values[:, k] > 0.5 * (parameter.lower + parameter.upper)
        for bound, name, side in ((parameter.lower, "lower", ~upper), (parameter.upper, "upper", upper)):
            count = int((at_bound[:, k] & side).sum())
            if count:
                rests = "rests there, or is" if bound == parameter.default else "may be"
                found.append(
                    f"parameter '{parameter.name}' is at the {name} bound of its range "
                    f"({_shown(parameter, bound)}) in {count} frames: the object {rests} outside what the "
                    "model covers"
                )
    return found


def _shown(parameter: Parameter, value: float) -> str:
    unit = "" if parameter.quantity == "ratio" else f" {parameter.unit}"
    return f"{parameter.display(value):.4g}{unit}"


def _unobservable(run: RunResults) -> list[str]:
    """Unobservable parameters; of those that are one per sequence, only after the last frame."""
    parameters, estimates = run.model.parameters, [r.estimate for r in run.results if r.estimate]
    constant = {k for k, p in enumerate(parameters) if p.name in run.per_sequence}
    found = [
        statement(parameters, part, f"in {count} frames")
        for indices, (count, part) in unobservable_in_run(parameters, estimates).items()
        if not constant.issuperset(indices)
    ]
    for indices, (_, part) in unobservable_in_run(parameters, estimates[-1:]).items():
        if constant.issuperset(indices):
            found.append(statement(parameters, part, "over the whole sequence"))
    return found


def _flags_of_place(run: RunResults) -> list[str]:
    """What a reader must know of an anchored object."""
    found, hidden = [], int(run.hidden.sum())
    if hidden:
        found.append(
            f"the object was hidden in {hidden} of {len(run)} frames: its pose there is the map's, its "
            "parameters are not known"
        )
    moved = [frame for frame, r in zip(run.frames, run.results, strict=True) if r.warning(ObjectMoved)]
    if moved:
        found.append(
            f"the object has moved from its place in the map in {len(moved)} frames, first in frame {moved[0]}: "
            "there its points alone give "
            "its pose; register it again to use the map"
        )
    return found
