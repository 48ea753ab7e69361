"""The files of a run of `morph slam`: path, map, tables, plots, and pictures with what was followed."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import meshio
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from morph_dslam.io.colmap import ColmapImage, write_colmap_model
from morph_dslam.io.trajectory import save_trajectory
from morph_dslam.slam.result import STAGES, SlamFrame
from morph_dslam.slam.rigid_map import GOOD
from morph_dslam.slam.scene import Scene
from morph_dslam.slam.scene_rigidity import SceneNotRigid

Array = NDArray[np.float64]
DPI = 110
PATH_COLOUR, POINT_COLOUR = "#b4530a", "#8fb3d9"
#: Blue, green, red of what the video shows.
INLIER, CANDIDATE, DISAGREEING = (80, 200, 60), (200, 150, 40), (40, 40, 230)


def write_run(folder: Path, scene: Scene, more: dict[str, Any], notes: Sequence[str] = ()) -> dict[str, Any]:
    """Write all files but the video; returns the content of ``summary.json``, which has ``more`` and the notes."""
    save_trajectory(folder / "trajectory.txt", scene.trajectory)
    meshio.Mesh(scene.points, []).write(folder / "map.ply")
    _write_colmap(folder / "colmap", scene)
    _write_csv(folder / "frames.csv", scene)
    scene.save(folder / "map.h5")
    plots = folder / "plots"
    plots.mkdir(exist_ok=True)
    _plot_trajectory(plots / "trajectory.png", scene)
    _plot_frames(plots / "frames.png", scene.frames)
    summary = scene.summary() | more
    summary["flags"] = [*notes, *summary["flags"]]
    (folder / "summary.json").write_text(json.dumps(summary, indent=2, default=str) + "\n", encoding="utf-8")
    return summary


def _write_colmap(folder: Path, scene: Scene) -> None:
    """The map's points and keyframes as a COLMAP model."""
    good = scene.map.state == GOOD
    rows = np.cumsum(good) - 1
    images = []
    for keyframe in scene.keyframes:
        seen = keyframe.seen[good[keyframe.point_ids]]
        name = f"{keyframe.index:06d}.png"
        images.append(ColmapImage(name, keyframe.camera_from_world, rows[seen.ids], seen.pixels))
    write_colmap_model(folder, scene.camera, images, scene.points)


def _write_csv(path: Path, scene: Scene) -> None:
    header = ["frame", "timestamp_s", "status", "reason", *"xyz", "qx", "qy", "qz", "qw"]
    header += ["position_std", "rotation_std_deg", "rms_px", "n_points", "n_candidates", "n_disagreeing"]
    header += ["is_keyframe", *(f"{stage}_ms" for stage in STAGES), "total_ms"]
    poses = dict(zip(scene.trajectory.indices.tolist(), scene.trajectory.world_from_camera, strict=True))
    # In a map that follows what moves, residuals of a frame do not tell how far its pose is off.
    unknown = any(isinstance(notice, SceneNotRigid) for notice in scene.notices)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        for frame in scene.frames:
            row: list[Any] = [frame.index, f"{frame.timestamp:.6f}", frame.status, frame.reason or ""]
            row += _pose_columns(poses[frame.index], frame, unknown) if frame.index in poses else [""] * 10
            row += [frame.n_points, frame.n_candidates, frame.n_disagreeing]
            row += [int(frame.is_keyframe), *(f"{frame.timings_ms[s]:.3f}" for s in STAGES)]
            writer.writerow([*row, f"{frame.total_ms:.3f}"])


def _pose_columns(world_from_camera: Array, frame: SlamFrame, unknown: bool) -> list[str]:
    assert frame.pose is not None
    variances = np.full(6, np.inf) if unknown else np.diag(frame.pose.covariance)
    quaternion = Rotation.from_matrix(world_from_camera[:3, :3]).as_quat(canonical=True)
    deviations = [np.sqrt(variances[3:].sum()), np.degrees(np.sqrt(variances[:3].sum()))]
    return [
        *(f"{value:.6f}" for value in (*world_from_camera[:3, 3], *quaternion)),
        *(f"{value:.3g}" for value in deviations),
        f"{frame.pose.rms_px:.4f}",
    ]


def _plot_trajectory(path: Path, scene: Scene) -> None:
    """The path and the map from above and from the side, as the first view stands."""
    points, unit = scene.points, "m" if scene.is_metric else "map unit"
    figure = Figure(figsize=(10.0, 4.6), layout="constrained")
    if len(points):
        # A few distant points would shrink everything else.
        low, high = np.percentile(points, [2, 98], axis=0)
        points = points[((points >= low) & (points <= high)).all(axis=1)]
    for axes, vertical, name in zip(figure.subplots(1, 2), (2, 1), ("from above", "from the front"), strict=True):
        axes.plot(points[:, 0], points[:, vertical], ".", color=POINT_COLOUR, markersize=2, label="map points")
        path_points = scene.trajectory.positions
        axes.plot(path_points[:, 0], path_points[:, vertical], color=PATH_COLOUR, linewidth=1.4, label="camera")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel(f"x [{unit}]")
        axes.set_ylabel(f"{'xyz'[vertical]} [{unit}]")
        axes.set_title(name, fontsize=10)
        if vertical == 1:
            axes.invert_yaxis()
    figure.axes[0].legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=DPI)


def _plot_frames(path: Path, frames: Sequence[SlamFrame]) -> None:
    """Points, errors and times of every frame."""
    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    counts, errors, times = figure.subplots(3, 1, sharex=True)
    numbers = [frame.index for frame in frames]
    counts.plot(numbers, [f.n_points for f in frames], color=PATH_COLOUR, label="map points")
    counts.plot(numbers, [f.n_candidates for f in frames], color=POINT_COLOUR, label="corners without depth")
    counts.set_ylabel("points followed")
    counts.legend(fontsize=8, frameon=False)
    errors.plot(numbers, [f.pose.rms_px if f.pose else np.nan for f in frames], color=PATH_COLOUR)
    errors.set_ylabel("RMS error [px]")
    times.plot(numbers, [f.total_ms for f in frames], color=POINT_COLOUR, linewidth=0.9)
    keyframes = [f for f in frames if f.is_keyframe]
    times.plot([f.index for f in keyframes], [f.total_ms for f in keyframes], ".", color=PATH_COLOUR)
    times.set_ylabel("time [ms]")
    times.legend(["frame", "keyframe"], fontsize=8, frameon=False)
    times.set_xlabel("frame")
    for axes in (counts, errors, times):
        axes.set_ylim(bottom=0.0)
        for frame in frames:
            if frame.pose is None:
                axes.axvspan(frame.index - 0.5, frame.index + 0.5, color="#d9534f", alpha=0.15, linewidth=0)
    figure.savefig(path, dpi=DPI)


def draw_frame(image: NDArray[np.uint8], frame: SlamFrame) -> NDArray[np.uint8]:
    """The undistorted image (h, w, 3) with map points green, corners blue, what disagrees red."""
    drawn = image.copy()
    size = max(1.0, image.shape[0] / 480)  # of what is drawn, so that it stays as large beside a larger picture
    for pixels, colour in (
        (frame.candidates, CANDIDATE),
        (frame.points.pixels, INLIER),
        (frame.disagreeing.pixels, DISAGREEING),
    ):
        for x, y in np.rint(pixels).astype(int).tolist():
            cv2.circle(drawn, (x, y), round(2 * size), colour, -1, cv2.LINE_AA)
    text, corner = f"{frame.index}  {frame.status}  {frame.reason or ''}", (round(8 * size), round(18 * size))
    for thickness, grey in ((3, 0), (1, 255)):
        width = round(thickness * size)
        cv2.putText(drawn, text, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.45 * size, (grey, grey, grey), width, cv2.LINE_AA)
    return drawn
