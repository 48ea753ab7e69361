"""A tracked sequence as it is evaluated: read back from a run folder, or made of results in memory."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import EvaluationError, check_kind
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.camera_files import load_camera
from morph_dslam.io.run_states import RESULT, opened_result
from morph_dslam.model import ReducedModel, load_model
from morph_dslam.model.discrepancy import Discrepancy, load_discrepancies
from morph_dslam.model.unknown_loads import with_unknown_loads

if TYPE_CHECKING:
    from morph_dslam.tracking.result import FrameResult

Array = NDArray[np.float64]
#: More frames than these are not named one by one in messages.
MOST_NAMED = 10


@dataclass(frozen=True)
class Run:
    """One tracked sequence.

    Attributes
    ----------
    model : that was tracked.
    camera : that saw the frames.
    frames : (f,) frame numbers.
    status : one text a frame; the state exists where it is "tracked".
    reasons : one text a frame.
    camera_from_object : (f, 4, 4), NaN where not tracked.
    parameters : (f, d), SI.
    stage_times : (f,) milliseconds by stage name.
    discrepancies : what the shapes have beyond the model's, by row; empty where it was not looked for.
    covariances : (f, d + 6, d + 6) of parameters, rotation vector and translation, SI, NaN where not tracked; None of
        a run that has not kept them.
    timestamps : (f,) seconds; None where they are not known. A rolling shutter needs them.
    motion_known : (f,) whether the tracker knew how the object moved while a rolling shutter recorded the frame; None
        of a run that does not say.
    """

    model: ReducedModel
    camera: Camera
    frames: NDArray[np.int64]
    status: tuple[str, ...]
    reasons: tuple[str, ...]
    camera_from_object: Array
    parameters: Array
    stage_times: dict[str, Array]
    discrepancies: dict[int, Discrepancy] = field(default_factory=dict)
    covariances: Array | None = None
    timestamps: Array | None = None
    motion_known: NDArray[np.bool_] | None = None

    @classmethod
    def of(
        cls, camera: Camera, results: Mapping[int, FrameResult], timestamps: Mapping[int, float] | None = None
    ) -> Run:
        """The run of results by frame number, as a `morph_dslam.Tracker` returns them.

        Parameters
        ----------
        camera : that saw the frames.
        results : by frame number.
        timestamps : seconds, by frame number; None where they are not known.

        Raises
        ------
        ArgumentError
            If the camera is none, or the results are not by frame number.
        EvaluationError
            If there is no result.
        """
        check_kind(camera, Camera, "camera", "the camera that load_camera reads from the file, or Camera(...)")
        check_kind(results, Mapping, "results", "the result of each frame by its number, {0: result}")
        if not results:
            raise EvaluationError("there are no results to make a run of: give that of at least one frame")
        found = list(results.values())
        lost, unknown = np.full((4, 4), np.nan), np.full(len(found[0].model.parameters), np.nan)
        return cls(
            model=found[0].model,
            camera=camera,
            frames=np.array(list(results), dtype=np.int64),
            status=tuple(str(result.status.value) for result in found),
            reasons=tuple(result.reason for result in found),
            camera_from_object=np.array([lost if r.pose is None else r.pose.matrix for r in found]),
            parameters=np.array([unknown if r.estimate is None else r.estimate.state.parameters for r in found]),
            stage_times={"total": np.array([result.total_ms for result in found])},
            discrepancies={row: r.discrepancy for row, r in enumerate(found) if r.discrepancy is not None},
            covariances=np.array([result.covariance for result in found]),
            timestamps=None if timestamps is None else np.array([timestamps[frame] for frame in results], dtype=float),
            motion_known=np.array([result.motion is not None for result in found]),
        )

    @property
    def tracked(self) -> NDArray[np.bool_]:
        """Frames (f,) whose pose and parameters are known."""
        known = np.isfinite(self.camera_from_object).all(axis=(1, 2)) & np.isfinite(self.parameters).all(axis=1)
        return known & (np.array(self.status) == "tracked")

    @property
    def frame_times(self) -> Array:
        """Time (f,) that each frame took in all, without drawing, milliseconds."""
        return self.stage_times["total"]

    def row(self, frame: int) -> int | None:
        """Where frame number ``frame`` is in the arrays, or None if the run does not have it."""
        found = np.flatnonzero(self.frames == frame)
        return int(found[0]) if found.size else None

    def camera_points(self, row: int) -> Array:
        """The estimated mesh nodes (n, 3) of one frame in the camera frame, metres."""
        pose = RigidTransform.from_matrix(self.camera_from_object[row])
        positions = self.model.positions(self.parameters[row])
        if row in self.discrepancies:
            positions = positions + self.discrepancies[row].displacement(self.model.nodes)
        return pose.apply(positions)


def _texts(file: h5py.File, name: str) -> tuple[str, ...]:
    dataset = file[name]
    assert isinstance(dataset, h5py.Dataset)
    return tuple(str(value) for value in dataset.asstr()[()])


def load_run(folder: str | Path) -> Run:
    """Read a run folder.

    Raises
    ------
    EvaluationError
        If the folder has no result, or one that is damaged or of another version.
    ModelFileError, CameraError
        If the copies of the model or of the camera file in it cannot be read.
    """
    folder = Path(folder)
    path = folder / RESULT
    if not path.is_file():
        raise EvaluationError(f"{folder} holds no {RESULT}: give a folder that `morph track -o` has written")
    model, camera = load_model(folder / "model.morph"), load_camera(folder / "camera.yaml")
    with opened_result(path, EvaluationError) as file:
        names = np.atleast_1d(np.asarray(file["timings_ms"].attrs["names"], dtype=str)).tolist()
        parameters = np.asarray(file["parameters"]).astype(float)
        if parameters.shape[1] > len(model.parameters):
            model = with_unknown_loads(model)
        run = Run(
            model=model,
            camera=camera,
            frames=np.asarray(file["frame"]).astype(np.int64),
            status=_texts(file, "status"),
            reasons=_texts(file, "reason"),
            camera_from_object=np.asarray(file["camera_from_object"]).astype(float).reshape(-1, 4, 4),
            parameters=parameters,
            stage_times=dict(zip(names, np.asarray(file["timings_ms"]).T, strict=True)),
            discrepancies=load_discrepancies(file),
            covariances=np.asarray(file["covariance"]).astype(float) if "covariance" in file else None,
            timestamps=np.asarray(file["timestamp"]).astype(float),
            motion_known=np.asarray(file["motion_known"]).astype(bool) if "motion_known" in file else None,
        )
    if not len(run.frames):
        raise EvaluationError(f"{path} holds no frames: track again")
    return run


def frames_in_words(frames: Iterable[int]) -> str:
    """Frame numbers, "0, 10 and 20" say; of many, how many there are and of what range."""
    numbers = sorted(map(int, frames))
    if not numbers:
        return "none"
    if len(numbers) > MOST_NAMED:
        return f"{len(numbers)} frames from {numbers[0]} to {numbers[-1]}"
    *others, last = map(str, numbers)
    return f"{', '.join(others)} and {last}" if others else last


def remarks(figures: Mapping[str, Any]) -> list[str]:
    """What a reader of the figures must know: truth that could not be compared."""
    lines = []
    if figures["truth_frames_not_tracked"]:
        missing = frames_in_words(figures["truth_frames_not_tracked"])
        lines.append(f"truth frames that were not tracked and so not compared: {missing}")
    if figures["truth_frames_outside_the_run"]:
        lines.append(f"truth frames outside the run: {frames_in_words(figures['truth_frames_outside_the_run'])}")
    if figures["points_not_bound"]:
        unseen = figures["n_points_unseen"]
        off = len(figures["points_not_bound"]) - unseen
        why = [f"{unseen} are hidden or not measured"] * bool(unseen)
        why += [f"{off} fall off the estimated surface"] * bool(off)
        lines.append(
            f"of {figures['n_points']} truth points {' and '.join(why)} in frame {figures['bind_frame']}: "
            "these were not compared"
        )
    if figures["n_points_bound_at_outline"]:
        lines.append(
            f"{figures['n_points_bound_at_outline']} truth points missed the surface by up to "
            f"{figures['outline_tolerance_px']:g} px and were bound to its outline"
        )
    return [*lines, *figures.get("notes", [])]


def alignment_line(figures: Mapping[str, Any]) -> str:
    """How much of the error is one rigid motion between truth and estimate, as commands print it."""
    together, single = figures["after_one_rigid_motion"], figures["after_one_in_each_frame"]
    turn = ", ".join(f"{angle:.2f}" for angle in together["rotation_deg"])
    return (
        f"after one rigid motion of all truth points (rotation {turn} degrees about x, y, z): mean "
        f"{together['mean_mm']:.3f} mm, median {together['median_mm']:.3f} mm; after one in each frame: mean "
        f"{single['mean_mm']:.3f} mm, median {single['median_mm']:.3f} mm"
    )


def result_line(figures: Mapping[str, Any]) -> str:
    """The last line that commands and examples print; ``rigid_mm`` is the mean after one rigid motion of the truth."""
    return (
        f"mean_mm={figures['mean_mm']:.3f} median_mm={figures['median_mm']:.3f} "
        f"p95_mm={figures['p95_mm']:.3f} "
        f"tracked={figures['n_frames_tracked']}/{figures['n_frames']} "
        f"median_ms={figures['median_ms']:.2f} p95_ms={figures['p95_ms']:.2f} "
        f"rigid_mm={figures['after_one_rigid_motion']['mean_mm']:.3f}"
    )


def depth_line(figures: Mapping[str, Any]) -> str:
    """The last line of an evaluation against depth images."""
    base = figures["base"]
    beside = f" base_mean_mm={base['mean_mm']:.3f}" if base and base["n_points"] else ""
    return (
        f"surface_mean_mm={figures['mean_mm']:.3f} surface_median_mm={figures['median_mm']:.3f} "
        f"surface_p95_mm={figures['p95_mm']:.3f}{beside} left_out_percent={figures['left_out_percent']:.1f} "
        f"frames={len(figures['frames_compared'])}/{figures['n_frames']}"
    )
