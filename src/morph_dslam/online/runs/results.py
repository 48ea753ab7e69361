"""The run folder: everything a run found, in files that other programs read (docs/run-folder.md)."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel
from morph_dslam.model.discrepancy import largest_deformation, save_discrepancies
from morph_dslam.online.estimation.estimator import Estimate, State
from morph_dslam.online.frame_result import STAGES, FrameResult
from morph_dslam.online.measuring.binding import DrawnSurface
from morph_dslam.online.runs.run_flags import flags
from morph_dslam.online.uncertainty.confidence import largest_displacement, largest_von_mises
from morph_dslam.online.uncertainty.observability import one_value

Array = NDArray[np.float64]
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
        return np.array([result.status == "hidden" for result in self.results], dtype=bool)

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
