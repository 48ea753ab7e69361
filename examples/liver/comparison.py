"""Compares a tracked run with the truth of its rendered recording: tumour, whole organ and parameters."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import morph_dslam as md
from morph_dslam.extend.geometry import RigidTransform
from morph_dslam.extend.models import CarriedStructure

Array = NDArray[np.float64]
#: Colours of the plots: estimated, true, compared with.
ESTIMATED, TRUE, OTHER = "#1f4e79", "#d9822b", "#888888"


@dataclass(frozen=True)
class Comparison:
    """Errors by tracked frame, metres, in the camera frame without alignment.

    Attributes
    ----------
    frames : (f,) numbers.
    deformed : (f,) in which frames the organ is deformed.
    tumour : (f,) mean over the tumour's nodes.
    organ : (f,) mean over all nodes of the organ.
    undeformed : (f,) the tumour's error if the organ were placed rightly and taken for undeformed.
    centre, centre_std : (f, 3) error of the tumour's centre, and its predicted standard deviation.
    parameters, parameter_std, truth : (f, d) SI.
    """

    frames: NDArray[np.int64]
    deformed: NDArray[np.bool_]
    tumour: Array
    organ: Array
    undeformed: Array
    centre: Array
    centre_std: Array
    parameters: Array
    parameter_std: Array
    truth: Array

    def normalised(self) -> float:
        """The 95th percentile of the centre's errors over their standard deviations."""
        ratio = np.abs(self.centre[self.deformed]) / self.centre_std[self.deformed]
        return float(np.percentile(ratio, 95))


def _distance(first: Array, second: Array) -> float:
    return float(np.linalg.norm(first - second, axis=1).mean())


def compare(run: Path, sequence: Path, model: md.ReducedModel, tumour: CarriedStructure) -> Comparison:
    """Compare all tracked frames of a run.

    Raises
    ------
    MorphError
        If no frame that shows the organ deformed was tracked.
    """
    truth = np.load(sequence / "truth.npz")
    with h5py.File(run / "result.h5") as file:
        frames, poses = np.asarray(file["frame"]), np.asarray(file["camera_from_object"])
        parameters, deviations = np.asarray(file["parameters"]), np.asarray(file["parameter_std"])
        group = file[f"inner/{tumour.name}"]
        centres, centre_std = np.asarray(group["centre"]), np.asarray(group["centre_std"])  # type: ignore[index]
    tracked = np.flatnonzero(np.isfinite(parameters).all(axis=1))
    mus, errors = truth["parameters"][frames[tracked]], []
    deformed = (np.abs(mus - model.default) > 0.1 * (model.upper - model.lower)).any(axis=1)
    if not deformed.any():
        raise md.MorphError("no tracked frame shows the organ deformed, so there is nothing to compare")
    for row, mu in zip(tracked, mus, strict=True):
        pose = RigidTransform.from_matrix(poses[row])
        true_pose = RigidTransform.from_matrix(truth["camera_from_object"][frames[row]])
        inside = true_pose.apply(tumour.nodes(mu))
        errors.append(
            (
                _distance(pose.apply(tumour.nodes(parameters[row])), inside),
                _distance(pose.apply(model.positions(parameters[row])), true_pose.apply(model.positions(mu))),
                _distance(true_pose.apply(tumour.rest), inside),
                *(centres[row] - inside.mean(axis=0)),
            )
        )
    table = np.array(errors)
    return Comparison(
        frames[tracked],
        deformed,
        tumour=table[:, 0],
        organ=table[:, 1],
        undeformed=table[:, 2],
        centre=table[:, 3:],
        centre_std=centre_std[tracked],
        parameters=parameters[tracked],
        parameter_std=deviations[tracked],
        truth=mus,
    )


def result_line(found: Comparison, summary: dict) -> str:
    """How well it went, over the frames in which the organ is deformed."""
    tumour, organ = 1e3 * found.tumour[found.deformed], 1e3 * found.organ[found.deformed]
    return (
        f"tumour_mean_mm={tumour.mean():.3f} tumour_max_mm={tumour.max():.3f} mean_mm={organ.mean():.3f} "
        f"tracked={summary['n_tracked']}/{summary['n_frames']} median_ms={summary['median_ms']:.2f}"
    )


def plot(path: Path, found: Comparison, parameters: tuple[md.Parameter, ...]) -> None:
    """The tumour's error, then each parameter as estimated and in truth, with two standard deviations."""
    figure = Figure(figsize=(9.0, 3.0 + 1.7 * len(parameters)), layout="constrained")
    top, *others = figure.subplots(1 + len(parameters), 1, sharex=True, height_ratios=[1.6, *(1.0 for _ in parameters)])
    predicted = 2e3 * np.linalg.norm(found.centre_std, axis=1)
    top.fill_between(
        found.frames, 0.0, predicted, color=ESTIMATED, alpha=0.2, linewidth=0, label="2 predicted deviations"
    )
    top.plot(found.frames, 1e3 * found.tumour, color=ESTIMATED, label="error of the tumour")
    top.plot(found.frames, 1e3 * found.undeformed, color=OTHER, linestyle="--", label="organ taken for rigid")
    top.axhline(2.0, color="#d9534f", linewidth=0.8, label="2 mm")
    top.set_yscale("log")
    top.set_ylim(0.02, 15.0)
    top.set_ylabel("distance [mm]")
    top.legend(fontsize=8, ncols=2)
    for k, (axes, parameter) in enumerate(zip(others, parameters, strict=True)):
        unit = parameter.display(1.0)
        value, band = unit * found.parameters[:, k], 2.0 * unit * found.parameter_std[:, k]
        axes.fill_between(found.frames, value - band, value + band, color=ESTIMATED, alpha=0.25, linewidth=0)
        axes.plot(found.frames, value, color=ESTIMATED, label="estimated, ±2 deviations")
        axes.plot(found.frames, unit * found.truth[:, k], color=TRUE, linestyle="--", label="true")
        axes.set_ylabel(f"{parameter.name} [{parameter.unit}]")
    others[0].legend(fontsize=8)
    others[-1].set_xlabel("frame")
    figure.savefig(path, dpi=110)
