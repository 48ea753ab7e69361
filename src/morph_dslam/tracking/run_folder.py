"""The run folder: everything a run found, in files that other programs read (docs/run-folder.md)."""

from __future__ import annotations

import csv
import json
import platform
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, TypeVar

import cv2
import h5py
import numba
import numpy as np
from numpy.typing import NDArray

from morph_dslam._version import __version__
from morph_dslam.camera import Camera
from morph_dslam.errors import TrackingError
from morph_dslam.geometry import cross_matrix, rotation_log
from morph_dslam.io.camera_files import save_camera
from morph_dslam.io.folders import clear_run_folder, make_run_folder
from morph_dslam.io.hdf5_writing import member_name, written_hdf5
from morph_dslam.io.run_states import FORMAT, VERSION
from morph_dslam.io.trajectory import Trajectory, save_trajectory
from morph_dslam.io.writing import writing
from morph_dslam.model import Parameter, save_model
from morph_dslam.model.discrepancy import Discrepancy, save_discrepancies
from morph_dslam.model.inner_structure import CarriedStructure
from morph_dslam.model.stated_errors import force_error, uncounted
from morph_dslam.notices import Notice
from morph_dslam.tracking.estimator import Estimate
from morph_dslam.tracking.observability import one_value
from morph_dslam.tracking.reactions import Reaction, VectorEstimate
from morph_dslam.tracking.repeated_pictures import RepeatedPictures
from morph_dslam.tracking.result import STAGES, FrameResult
from morph_dslam.tracking.run_notices import flags_of, held_at_bound, notices_of
from morph_dslam.tracking.run_results import RunResults, contradictions
from morph_dslam.tracking.sinks import TrackedFrame

Array = NDArray[np.float64]


class RunFolder:
    """A sink that collects the results of one object of a session, and writes its run folder.

    Parameters
    ----------
    path : of the folder; it is made.
    name : of the object in the session.
    results : of no frame so far.
    camera : the first one.
    inner : structures inside of the object.
    overwrite : whether to replace a run that is in the folder.
    more : names of files that others write into the folder during the run, as the video.

    Attributes
    ----------
    overwrite : as given.

    Raises
    ------
    MorphError
        If the folder cannot be made, or holds a run that is not to be replaced.
    """

    def __init__(
        self,
        path: Path,
        name: str,
        results: RunResults,
        camera: Camera,
        inner: Sequence[CarriedStructure] = (),
        overwrite: bool = False,
        more: Sequence[str] = (),
    ) -> None:
        make_run_folder(path, overwrite, more=more)
        self.path, self.name, self.results, self.overwrite = path, name, results, overwrite
        self._camera, self._inner, self._repeated = camera, inner, RepeatedPictures()
        self._centres = InnerCentres(inner)

    def __call__(self, tracked: TrackedFrame) -> None:
        """Take in a frame; from the first one on the run takes the place of an earlier one."""
        if not len(self.results):
            clear_run_folder(self.path)
        if tracked.frame.captured is not None:
            self._repeated.add(tracked.frame)
        self.results.add(tracked.frame.index, tracked.frame.timestamp, tracked.results[self.name])
        self._centres.add(tracked.results[self.name])

    def start_again(self, results: RunResults, camera: Camera) -> None:
        """Take in the frames of another pass in place of those so far, by the camera as it is known now."""
        self.results, self._camera, self._centres = results, camera, InnerCentres(self._inner)

    def write(self, facts: dict[str, Any] | None = None, notices: Sequence[Notice] = ()) -> dict[str, Any]:
        """Write tables, summary, plots, model and camera; returns the summary.

        Parameters
        ----------
        facts : more for the summary.
        notices : what a reader must know beside what the results show.

        Raises
        ------
        TrackingError
            If a file cannot be written.
        """
        with writing(TrackingError, self.path):
            return self._write(facts or {}, notices)

    def _write(self, facts: dict[str, Any], notices: Sequence[Notice]) -> dict[str, Any]:
        run, path, notices = self.results, self.path, [*notices, *self._repeated.notices()]
        # The small files first: a full disk keeps these at least.
        write_csv(path / "frames.csv", run)
        save_trajectory(path / "trajectory.txt", camera_path(run))
        save_camera(path / "camera.yaml", self._camera)
        write_hdf5(path / "result.h5", run, self._centres)
        save_model(path / "model.morph", run.model.without_loads)
        summary = summarise(run, notices) | facts | {"versions": _versions()}
        (path / "summary.json").write_text(json.dumps(summary, indent=2, default=str) + "\n", encoding="utf-8")
        from morph_dslam.tracking.run_plots import write_plots  # matplotlib takes long to load

        write_plots(path / "plots", run)
        return summary


def camera_path(run: RunResults) -> Trajectory:
    """The camera's poses in the object's frame, in the frames in which the object was found or its place was known."""
    poses = run.poses()
    known = np.isfinite(poses).all(axis=(1, 2))
    from_camera = np.asarray(np.linalg.inv(poses[known]), dtype=np.float64)
    return Trajectory(np.array(run.timestamps)[known], from_camera, np.array(run.frames, dtype=np.int64)[known])


def _versions() -> dict[str, Any]:
    return {
        "morph-dslam": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "numba": numba.__version__,
        "opencv_threads": cv2.getNumThreads(),
    }


def write_hdf5(path: Path, run: RunResults, centres: InnerCentres | None = None) -> None:
    """Write ``result.h5``, with the ``centres`` of structures inside."""
    text = h5py.string_dtype()
    with written_hdf5(path) as file:
        file.attrs.update({"format": FORMAT, "version": VERSION, "reference_frame": run.reference_frame})
        file.attrs.update({"first_frame": run.frames[0], "last_frame": run.frames[-1]})
        file["frame"], file["timestamp"] = np.array(run.frames, dtype=np.int64), np.array(run.timestamps)
        file["status"] = np.array([result.status for result in run.results], dtype=text)
        file["reason"] = np.array([result.reason for result in run.results], dtype=text)
        file["camera_from_object"], file["parameters"] = run.poses(), run.parameters()
        file["pose_from"] = np.array([result.pose_from for result in run.results], dtype=text)
        file["pose_std"] = run.pose_std()
        file["motion_known"] = np.array([result.motion is not None for result in run.results])
        file["parameter_std"], file["at_bound"] = run.parameter_std(), run.at_bound()
        file.create_dataset("covariance", data=run.covariances(), compression="gzip")
        file["largest_displacement"], file["largest_displacement_std"] = run.largest_displacements().T
        if run.model.stresses:
            file["largest_von_mises"], file["largest_von_mises_std"] = run.largest_stresses().T
        _write_reactions(file, run)
        _write_points(file, run)
        file["residual_rms_px"], file["unexplained_px"] = run.residuals_px(), run.unexplained_px()
        file["n_points"], file["n_inliers"] = run.counts().T
        file["timings_ms"] = run.timings_ms()
        file["timings_ms"].attrs["names"] = [*STAGES, "total"]
        save_discrepancies(file, [result.discrepancy for result in run.results])
        if centres is not None:
            centres.write(file)


def _write_reactions(file: h5py.File, run: RunResults) -> None:
    """``reactions/SET/force`` and so on (f, 3), NaN where the object was hidden or lost."""
    lost = np.full((5, 3), np.nan)
    for name, frames in run.reactions().items():
        rows = [lost if one is None else np.array([one.point, *_parts_of(one)]) for one in frames]
        parts = np.moveaxis(np.array(rows), 1, 0)
        for part, values in zip(("point", "force", "force_std", "moment", "moment_std"), parts, strict=True):
            file[f"reactions/{member_name(name)}/{part}"] = values


def _write_points(file: h5py.File, run: RunResults) -> None:
    """``points/NAME/rest`` (3,), ``displacement``, ``rotation`` and their ``_std`` (f, 3), NaN where hidden or lost."""
    turns = run.point_turns()
    for k, (name, frames) in enumerate(run.point_displacements().items()):
        assert run.points is not None
        file[f"points/{name}/rest"] = run.points.rest[k]
        for kind, vectors in (("displacement", frames), ("rotation", turns[name])):
            parts = np.array([_with_deviations(one) for one in vectors])
            file[f"points/{name}/{kind}"], file[f"points/{name}/{kind}_std"] = parts[:, :3], parts[:, 3:]


def _with_deviations(vector: VectorEstimate | None) -> Array:
    """Components and their standard deviations (6,), NaN without a vector."""
    return np.full(6, np.nan) if vector is None else np.concatenate([vector.value, vector.std])


def _point_columns(run: RunResults) -> tuple[list[str], list[list[str]]]:
    """Names of the columns with displacements and rotations of points, and what is in them in each frame."""
    names: list[str] = []
    rows: list[list[str]] = [[] for _ in run.frames]
    turns = run.point_turns()
    for point, moved in run.point_displacements().items():
        for kind, unit, factor, frames in (
            ("displacement", "mm", 1e3, moved),
            ("rotation", "deg", np.degrees(1.0), turns[point]),
        ):
            names += [f"{kind}_{point}_{axis}{std}_{unit}" for std in ("", "_std") for axis in "xyz"]
            for row, vector in zip(rows, frames, strict=True):
                values = factor * _with_deviations(vector)
                row += ["" if np.isnan(v) else f"{v:.4f}" for v in values[:3]]
                row += ["" if np.isnan(v) else f"{v:.3g}" for v in values[3:]]
    return names, rows


def _parts_of(reaction: Reaction) -> tuple[Array, Array, Array, Array]:
    """Force (N), moment (N m), each with its deviations."""
    return reaction.force.value, reaction.force.std, reaction.moment.value, reaction.moment.std


def _reaction_columns(run: RunResults) -> tuple[list[str], list[list[str]]]:
    """Names of the columns with reactions, and what is in them in each frame: newtons and newton millimetres."""
    names: list[str] = []
    rows: list[list[str]] = [[] for _ in run.frames]
    for support, frames in run.reactions().items():
        for kind, unit in (("force", "N"), ("moment", "Nmm")):
            title = support.replace(" ", "_")
            names += [f"{kind}_{title}_{axis}{std}_{unit}" for std in ("", "_std") for axis in "xyz"]
        for row, reaction in zip(rows, frames, strict=True):
            values = np.full(12, np.nan) if reaction is None else np.concatenate(_parts_of(reaction))
            row += ["" if np.isnan(v) else f"{v:.5g}" for v in values * np.repeat([1.0, 1e3], 6)]
    return names, rows


#: Columns of ``frames.csv`` before and behind those of the parameters.
_FIRST = ("frame", "timestamp_s", "status", "reason", "pose_from")
_LAST = (
    *("largest_displacement_mm", "largest_displacement_std_mm"),
    *("x_mm", "y_mm", "z_mm", "rotation_x_deg", "rotation_y_deg", "rotation_z_deg"),
    *("residual_rms_px", "unexplained_px", "n_points", "n_inliers", "time_ms"),
)


def _parameter_titles(parameters: Sequence[Parameter], others: set[str]) -> list[str]:
    """Three columns for each: ``bend_deg``, or ``x [mm]`` where ``x_mm`` is another column."""
    taken, titles = set(others), list[str]()
    for p in parameters:
        three = [f"{p.name}_{p.unit}", f"{p.name}_std_{p.unit}", f"{p.name}_at_bound"]
        if not taken.isdisjoint(three):
            three = [f"{p.name} [{p.unit}]", f"{p.name}_std [{p.unit}]", f"{p.name} at_bound"]
        taken.update(three)
        titles += three
    return titles


def write_csv(path: Path, run: RunResults) -> None:
    """Write ``frames.csv``: millimetres, degrees, milliseconds, and parameters in their own units."""
    parameters = run.model.study_parameters
    (of_reactions, reactions), (of_points, points) = _reaction_columns(run), _point_columns(run)
    header = [*_FIRST, *_parameter_titles(parameters, {*_FIRST, *_LAST, *of_reactions, *of_points}), *_LAST]
    largests = 1e3 * run.largest_displacements()
    more = [[*forces, *displacements] for forces, displacements in zip(reactions, points, strict=True)]
    rows = zip(run.frames, run.timestamps, run.results, run.at_bound(), largests, more, strict=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header + of_reactions + of_points)
        for frame, timestamp, result, at_bound, largest, last in rows:
            row: list[Any] = [frame, f"{timestamp:.6f}", result.status, result.reason, result.pose_from]
            if result.estimate is None:
                row += [""] * (3 * len(parameters) + 10)
            else:
                state, std = result.estimate.state, result.estimate.parameter_std
                for k, p in enumerate(parameters):
                    row += [f"{p.display(state.parameters[k]):.6g}", f"{p.display(std[k]):.3g}"]
                    row.append(int(at_bound[k]))
                row += [f"{largest[0]:.4f}", f"{largest[1]:.3g}"]
                pose = state.camera_from_object
                row += [f"{1e3 * value:.4f}" for value in pose.translation]
                row += [f"{value:.4f}" for value in np.degrees(rotation_log(pose.rotation))]
                row += [f"{result.residual_rms_px:.4f}", f"{result.unexplained_px:.4f}"]
            writer.writerow([*row, result.n_points, result.n_inliers, f"{result.total_ms:.3f}", *last])


def summarise(run: RunResults, notices: Sequence[Notice] = ()) -> dict[str, Any]:
    """Counts and medians of the run, and what a reader must know: ``flags`` in words, ``notices`` typed."""
    tracked, times = run.tracked, run.timings_ms()
    medians = np.median(times, axis=0)
    summary: dict[str, Any] = {
        "model": run.model.name,
        "n_frames": len(run),
        "n_tracked": int(tracked.sum()),
        "n_hidden": int(run.hidden.sum()),
        "n_lost": int((~tracked & ~run.hidden).sum()),
        "n_skipped": run.frames[-1] - run.frames[0] + 1 - len(run),
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
    summary["largest_forces"] = largest_forces(run, held_at_bound(run))
    summary["points"] = largest_of_points(run)
    summary["one_over_the_sequence"] = values_over_the_sequence(run)
    notices = [*notices, *notices_of(run)]
    summary["flags"] = flags_of(notices)
    summary["notices"] = [notice.content() for notice in notices]
    return summary


_Value = TypeVar("_Value")
#: A force is at least its length less so many standard deviations; where that is not positive, it may be zero.
CERTAIN = 2.0


def largest_forces(run: RunResults, at_bound: NDArray[np.bool_]) -> list[dict[str, Any]]:
    """Of each support the force that is largest for certain, its standard deviation and frame; the largest one first.

    Where none differs from zero it is the largest one with a finite deviation, as so much may have acted; supports of
    which that holds come last. Frames that are not to be relied on, or in which the surface is torn, count only if
    there are no others.

    The model's own error, which that deviation does not contain, stands beside it where its certificate states it: of
    the reduction, and where it was estimated of the discretisation too. So do the parameters that are held at an end of
    their range in that frame, ``at_bound`` (f, d): the object may be beyond it, and the force another.
    """
    found: list[dict[str, Any]] = []
    doubtful = run.mistaken_frames | run.torn_frames
    for name, frames in run.reactions().items():
        if known := _known(frames, run, doubtful):
            # A length that consists of what is not determined is no force.
            largest, frame = max(
                ((reaction.force, frame) for reaction, frame in known), key=lambda one: _certainty(one[0])
            )
            figures = {"on": name, "force_N": largest.size, "standard_deviation_N": largest.size_std, "frame": frame}
            figures["differs_from_zero"], *_ = _certainty(largest)
            held = zip(run.model.study_parameters, at_bound[run.frames.index(frame)], strict=True)
            figures["at_bound"] = [parameter.name for parameter, is_held in held if is_held]
            figures["not_counted"] = uncounted(run.model)
            error = force_error(run.model, name)
            if error is not None:
                figures |= {"model_error": error[0], "model_error_of": "all" if error[1] else "reduction"}
            found.append(figures)
    return sorted(found, key=lambda figures: (not figures["differs_from_zero"], -float(figures["force_N"])))


def _known(values: Sequence[_Value | None], run: RunResults, doubtful: Collection[int]) -> list[tuple[_Value, int]]:
    """Those values (f,) of frames that are known, each with its frame; of ``doubtful`` ones if there are no others."""
    known = [(value, frame) for value, frame in zip(values, run.frames, strict=True) if value is not None]
    return [one for one in known if one[1] not in doubtful] or known


def _certainty(force: VectorEstimate) -> tuple[bool, bool, float]:
    """Whether a force differs from zero, whether it is determined, and its size by that: the largest has the most."""
    least = force.size - CERTAIN * force.size_std
    if least > 0.0:
        return True, True, least
    # Of forces that may be zero, ``least`` would choose the least deviation, whatever the force.
    return False, bool(np.isfinite(force.size_std)), force.size


def largest_of_points(run: RunResults) -> list[dict[str, Any]]:
    """Of each named point its place, and its largest displacement and rotation, millimetres and degrees.

    Frames that are not to be relied on count only if there are no others.
    """
    found: list[dict[str, Any]] = []
    turns = run.point_turns()
    # A discrepancy is what the object has beyond the model, whatever that comes from.
    not_counted = [] if any(result.discrepancy for result in run.results) else uncounted(run.model)
    for k, (name, moved) in enumerate(run.point_displacements().items()):
        assert run.points is not None
        figures: dict[str, Any] = {"name": name, "at_mm": (1e3 * run.points.rest[k]).tolist()}
        figures |= _largest(moved, run, 1e3, ("displacement_mm", "standard_deviation_mm", "frame"))
        names = ("rotation_deg", "rotation_standard_deviation_deg", "rotation_frame")
        figures |= _largest(turns[name], run, float(np.degrees(1.0)), names)
        figures["not_counted"] = not_counted
        found.append(figures)
    return found


def _largest(
    vectors: Sequence[VectorEstimate | None], run: RunResults, factor: float, names: tuple[str, str, str]
) -> dict[str, Any]:
    """The length, its deviation and the frame of the longest vector, by these names; nothing where there is none."""
    known = _known(vectors, run, run.mistaken_frames)
    if not known:
        return {}
    largest, frame = max(known, key=lambda one: one[0].size)
    return dict(zip(names, (factor * largest.size, factor * largest.size_std, frame), strict=True))


def values_over_the_sequence(run: RunResults) -> list[dict[str, object]]:
    """Value, standard deviation and 95 % interval of each parameter that is one over the sequence.

    Where frames contradict each other in it, the value is that of the last frames.
    """
    apart = {one.parameter for one in contradictions(run)}
    last = next((r.estimate for r in reversed(run.results) if r.estimate), None)
    if last is None:
        return []
    return [
        one_value(parameter, last.state.parameters[k], last.parameter_std[k], k not in apart)
        for k, parameter in enumerate(run.model.study_parameters)
        if parameter.name in run.per_sequence
    ]


def centre_and_std(
    structure: CarriedStructure, estimate: Estimate, discrepancy: Discrepancy | None = None
) -> tuple[Array, Array]:
    """Centre of a structure (3,) in the camera frame and its standard deviations (3,), metres.

    With c = R p(mu) + t and the pose's increment on the left, the derivatives by parameters, rotation vector
    and translation are R dp/dmu, -[R p]x and 1; the covariance is carried through them to first order. What the
    model's own errors add to displacements is added. The centre is moved by ``discrepancy`` too, and its deviation
    inside is added.
    """
    state = estimate.state
    centre, sensitivities = structure.centre_and_sensitivities(state.parameters)
    if discrepancy is not None:
        centre = centre + discrepancy.displacement(structure.rest).mean(axis=0)
    rotation = state.camera_from_object.rotation
    arm = rotation @ centre
    jacobian = np.hstack([rotation @ sensitivities.T, -cross_matrix(arm), np.eye(3)])
    if not np.isfinite(estimate.covariance).all():
        return arm + state.camera_from_object.translation, np.full(3, np.inf)
    variance = np.maximum(np.einsum("xi,ij,xj->x", jacobian, estimate.image_covariance, jacobian), 0.0)
    variance = variance + estimate.model_displacement**2 / 3.0
    if discrepancy is not None:
        # No mean varies by more than what it is of, on average.
        beyond = discrepancy.covariances(structure.rest).mean(axis=0)
        variance = variance + np.maximum(np.diag(rotation @ beyond @ rotation.T), 0.0)
    return arm + state.camera_from_object.translation, np.sqrt(variance)


class InnerCentres:
    """Where the centres of structures inside are, frame by frame.

    Parameters
    ----------
    structures : in the object.
    """

    def __init__(self, structures: Sequence[CarriedStructure]) -> None:
        self._structures = structures
        self._rows: list[list[tuple[Array, Array]]] = []

    def add(self, result: FrameResult) -> None:
        """Take in a frame."""
        found, lost = result.estimate, (np.full(3, np.nan), np.full(3, np.nan))
        self._rows.append(
            [lost if found is None else centre_and_std(one, found, result.discrepancy) for one in self._structures]
        )

    def write(self, file: h5py.File) -> None:
        """Add ``inner/NAME/centre`` and ``centre_std`` (f, 3), metres, NaN where lost, to ``result.h5``."""
        for k, structure in enumerate(self._structures):
            group = file.create_group(f"inner/{structure.name}")
            group["centre"], group["centre_std"] = np.array([row[k] for row in self._rows]).swapaxes(0, 1)
