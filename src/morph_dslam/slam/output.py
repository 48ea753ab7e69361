"""Whether another focal length would explain the map clearly better: then the calibration is suspect.

Keyframes and points are adjusted once more for each of some focal lengths. With the right one, errors are
those of following corners; with a wrong one, a camera that turns and moves leaves more. Where the camera
hardly turned, any focal length fits about as well, and then nothing is said.
"""

from __future__ import annotations

import csv
import json
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from morph_dslam.io.colmap import ColmapImage, write_colmap_model
from morph_dslam.io.tables import save_ply
from morph_dslam.io.trajectory import Trajectory, save_trajectory
from morph_dslam.slam.bundle_adjustment import Observations, adjust
from morph_dslam.slam.frame_images import STAGES, SlamFrame
from morph_dslam.slam.map_files import save_map
from morph_dslam.slam.pose import inverse
from morph_dslam.slam.rigid_map import GOOD, RigidMap
from morph_dslam.slam.slam import Slam

Array = NDArray[np.float64]

#: Factors of the focal length that are tried; the ends mean that it may lie beyond.
FACTORS = np.exp(np.linspace(np.log(0.7), np.log(1.43), 9))

#: Keyframes that are adjusted, and the fewest that say anything.
MOST_KEYFRAMES, LEAST_KEYFRAMES = 12, 5

#: The cost with the best factor has to be this part of the given one's, and the factor this far from 1.
MOST_COST, LEAST_DEVIATION = 0.7, 0.04


def suspected_focal_factor(rigid_map: RigidMap, intrinsics: Array) -> float | None:
    """By what the focal length would have to be multiplied; None where the given one is as good as any.

    Parameters
    ----------
    intrinsics : (4,) fx, fy, cx, cy that the map was made with.
    """
    if len(rigid_map.keyframes) < LEAST_KEYFRAMES:
        return None
    costs = np.array([_cost(rigid_map, intrinsics, factor) for factor in (1.0, *FACTORS)])
    given, tried = costs[0], costs[1:]
    best = int(tried.argmin())
    if tried[best] > MOST_COST * given:
        return None
    factor = float(FACTORS[best])
    if 0 < best < len(FACTORS) - 1:
        # The factor at the bottom of the parabola through the three costs around the least, over equal steps.
        left, middle, right = tried[best - 1 : best + 2]
        shift = 0.5 * (left - right) / (left - 2.0 * middle + right)
        factor *= float((FACTORS[1] / FACTORS[0]) ** shift)
    return factor if abs(factor - 1.0) > LEAST_DEVIATION else None


def _cost(rigid_map: RigidMap, intrinsics: Array, factor: float) -> float:
    """Huber cost, px^2, of keyframes spread over the map after adjustment with another focal length."""
    kept = rigid_map.kept_keyframes
    chosen = np.unique(np.linspace(0, len(kept) - 1, min(len(kept), MOST_KEYFRAMES)).astype(int))
    keyframes = [rigid_map.keyframes[k] for k in kept[chosen]]
    counts = np.zeros(len(rigid_map.state), dtype=int)
    for keyframe in keyframes:
        counts[keyframe.point_ids] += 1
    wanted = (counts >= 2) & (rigid_map.state == GOOD)
    local = np.cumsum(wanted) - 1
    rows_of = [wanted[keyframe.point_ids] for keyframe in keyframes]
    seen = [(local[k.point_ids[rows]], k.pixels[rows]) for k, rows in zip(keyframes, rows_of, strict=True)]
    observations = Observations(
        np.repeat(np.arange(len(keyframes)), [len(ids) for ids, _ in seen]),
        np.concatenate([ids for ids, _ in seen]),
        np.concatenate([pixels for _, pixels in seen]),
    )
    poses = np.array([keyframe.camera_from_world for keyframe in keyframes])
    scaled = intrinsics * [factor, factor, 1.0, 1.0]
    held = np.arange(len(keyframes)) == 0
    points = rigid_map.positions[wanted]
    return adjust(poses, points, observations, scaled, held, huber_px=1.0, iterations=25, tolerance=1e-4).cost


# What a run of camera tracking leaves behind (docs/slam.md).


DPI = 110

PATH_COLOUR, POINT_COLOUR = "#b4530a", "#8fb3d9"

#: Blue, green, red of what the video shows.
INLIER, CANDIDATE, DISAGREEING = (80, 200, 60), (200, 150, 40), (40, 40, 230)


def trajectory_of(slam: Slam, frames: list[SlamFrame]) -> Trajectory:
    """The camera's path through all frames that have a pose, by the final map."""
    timed = [(frame.timestamp, slam.camera_from_world(frame)) for frame in frames]
    found = [(time, inverse(pose)) for time, pose in timed if pose is not None]
    times, poses = [time for time, _ in found], [pose for _, pose in found]
    return Trajectory(np.array(times), np.array(poses).reshape(-1, 4, 4))


def write_run(folder: Path, slam: Slam, frames: list[SlamFrame], extra: dict[str, Any]) -> dict[str, Any]:
    """Write all files but the video; returns the content of ``summary.json``."""
    trajectory = trajectory_of(slam, frames)
    points = slam.map.positions[slam.map.good]
    save_trajectory(folder / "trajectory.txt", trajectory)
    save_ply(folder / "map.ply", points)
    save_map(folder / "map.h5", slam.map, slam.camera)
    _write_colmap(folder / "colmap", slam)
    _write_csv(folder / "frames.csv", slam, frames)
    plots = folder / "plots"
    plots.mkdir(exist_ok=True)
    unit = "m" if slam.map.is_metric else "map unit"
    _plot_trajectory(plots / "trajectory.png", trajectory, points, unit)
    _plot_frames(plots / "frames.png", frames)
    summary = summarise(slam, frames) | extra
    (folder / "summary.json").write_text(json.dumps(summary, indent=2, default=str) + "\n")
    return summary


def summarise(slam: Slam, frames: list[SlamFrame]) -> dict[str, Any]:
    """Counts, errors and times. ``start_frame`` is None where no map was begun."""
    found = [frame for frame in frames if slam.is_placed(frame)]
    after = [frame for frame in frames if found and frame.index >= found[0].index]
    times = np.array([frame.total_ms for frame in after] or [0.0])
    waits = np.array([frame.waited_ms for frame in after] or [0.0])
    stages = {s: float(np.median([f.timings_ms[s] for f in after] or [0.0])) for s in STAGES}
    errors = [frame.pose.rms_px for frame in found if frame.pose is not None]
    lost = [frame for frame in after if frame.status == "lost"]
    flags = [f"{len(lost)} frames after the start were lost: frames.csv says why"] if lost else []
    if slam.n_restarts:
        flags.append(f"{slam.n_restarts} young maps were lost for too long and given up, with their poses")
    factor = suspected_focal_factor(slam.map, slam.camera.intrinsics)
    if factor is not None:
        flags.append(
            f"a focal length {factor:.2f} times that of the camera file would explain the map clearly "
            "better: check the calibration"
        )
    if not found:
        flags.append(f"no map was begun: {frames[-1].reason}")
    return {
        "n_frames": len(frames),
        "start_frame": found[0].index if found else None,
        "n_after_start": len(after),
        "n_tracked": len(found),
        "status": dict(Counter(frame.status for frame in frames)),
        "n_restarts": slam.n_restarts,
        "map_frozen": slam.is_frozen,
        "frozen_by_itself_at": slam.frozen_at,
        "n_loops_closed": slam.n_loops,
        "n_keyframes": len(slam.map.kept_keyframes),
        "n_map_points": len(slam.map.good),
        "suspected_focal_factor": factor,
        "median_rms_px": float(np.median(errors)) if errors else None,
        "median_ms": float(np.median(times)),
        "p95_ms": float(np.percentile(times, 95)),
        "stage_median_ms": stages,
        "longest_wait_for_mapper_ms": float(np.max(waits)),
        "p99_wait_for_mapper_ms": float(np.percentile(waits, 99)),
        "scale": "metres" if slam.map.is_metric else "the median depth of the map's first view is 1",
        "settings": asdict(slam.options),
        "flags": flags,
    }


def _write_colmap(folder: Path, slam: Slam) -> None:
    """The map's points and keyframes as a COLMAP model."""
    good = slam.map.state == GOOD
    rows = np.cumsum(good) - 1
    images = []
    for keyframe in (slam.map.keyframes[k] for k in slam.map.kept_keyframes):
        seen = keyframe.seen[good[keyframe.point_ids]]
        name = f"{keyframe.index:06d}.png"
        images.append(ColmapImage(name, keyframe.camera_from_world, rows[seen.ids], seen.pixels))
    write_colmap_model(folder, slam.camera, images, slam.map.positions[good])


def _write_csv(path: Path, slam: Slam, frames: list[SlamFrame]) -> None:
    header = ["frame", "timestamp_s", "status", "reason", *"xyz", "qx", "qy", "qz", "qw"]
    header += ["position_std", "rotation_std_deg", "rms_px", "n_points", "n_candidates", "n_disagreeing"]
    header += ["is_keyframe", *(f"{stage}_ms" for stage in STAGES), "total_ms"]
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        for frame in frames:
            row: list[Any] = [frame.index, f"{frame.timestamp:.6f}", frame.status, frame.reason]
            row += _pose_columns(slam, frame) if slam.is_placed(frame) else [""] * 10
            row += [frame.n_points, frame.n_candidates, frame.n_disagreeing]
            row += [int(frame.is_keyframe), *(f"{frame.timings_ms[s]:.3f}" for s in STAGES)]
            writer.writerow([*row, f"{frame.total_ms:.3f}"])


def _pose_columns(slam: Slam, frame: SlamFrame) -> list[str]:
    camera_from_world = slam.camera_from_world(frame)
    assert camera_from_world is not None
    assert frame.pose is not None
    pose, variances = inverse(camera_from_world), np.diag(frame.pose.covariance)
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
    deviations = [np.sqrt(variances[3:].sum()), np.degrees(np.sqrt(variances[:3].sum()))]
    return [
        *(f"{value:.6f}" for value in (*pose[:3, 3], *quaternion)),
        *(f"{value:.3g}" for value in deviations),
        f"{frame.pose.rms_px:.4f}",
    ]


def _plot_trajectory(path: Path, trajectory: Trajectory, points: Array, unit: str) -> None:
    """The path and the map from above and from the side, as the first view stands."""
    figure = Figure(figsize=(10.0, 4.6), layout="constrained")
    if len(points):
        # A few distant points would shrink everything else.
        low, high = np.percentile(points, [2, 98], axis=0)
        points = points[((points >= low) & (points <= high)).all(axis=1)]
    for axes, vertical, name in zip(figure.subplots(1, 2), (2, 1), ("from above", "from the front"), strict=True):
        axes.plot(points[:, 0], points[:, vertical], ".", color=POINT_COLOUR, markersize=2, label="map points")
        path_points = trajectory.positions
        axes.plot(path_points[:, 0], path_points[:, vertical], color=PATH_COLOUR, linewidth=1.4, label="camera")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel(f"x [{unit}]")
        axes.set_ylabel(f"{'xyz'[vertical]} [{unit}]")
        axes.set_title(name, fontsize=10)
        if vertical == 1:
            axes.invert_yaxis()
    figure.axes[0].legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=DPI)


def _plot_frames(path: Path, frames: list[SlamFrame]) -> None:
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
    text, corner = f"{frame.index}  {frame.status}  {frame.reason}", (round(8 * size), round(18 * size))
    for thickness, grey in ((3, 0), (1, 255)):
        width = round(thickness * size)
        cv2.putText(drawn, text, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.45 * size, (grey, grey, grey), width, cv2.LINE_AA)
    return drawn
