"""A rigid scene that a camera moved through: mapped from its frames, saved, loaded, summed up."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence, Sized
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.camera import Camera, StereoCamera
from morph_dslam.errors import SourceError
from morph_dslam.io.colmap import ColmapModel
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.slam.bundle_adjustment import Observations, adjust
from morph_dslam.slam.frame_images import least_distances, orientations
from morph_dslam.slam.local_map import gather
from morph_dslam.slam.map_files import load_map_and_trajectory, map_from_colmap, map_from_trajectory, save_map
from morph_dslam.slam.options import SlamOptions
from morph_dslam.slam.pose import inverse, refine_pose
from morph_dslam.slam.relocalization import bit_counts
from morph_dslam.slam.result import STAGES, SlamFrame, SlamStatus
from morph_dslam.slam.rigid_map import Keyframe, RigidMap
from morph_dslam.slam.slam import Slam
from morph_dslam.sources import FrameSource, FrameStream, open_stream
from morph_dslam.sources.frames import has_registered_depth
from morph_dslam.sources.live import LiveStream
from morph_dslam.threads import threads_side_by_side
from morph_dslam.tracking.patches import patch_correlation

Array = NDArray[np.float64]
#: Factors of the focal length that are tried; the ends mean that it may lie beyond.
FACTORS = np.exp(np.linspace(np.log(0.7), np.log(1.43), 9))
#: Keyframes that are adjusted, and the fewest that say anything.
MOST_KEYFRAMES, LEAST_KEYFRAMES = 12, 5
#: The cost with the best factor has to be this part of the given one's, and the factor this far from 1.
MOST_COST, LEAST_DEVIATION = 0.7, 0.04
#: What is called with each undistorted image (h, w[, 3]) and what it gave.
Watch = Callable[[NDArray[np.uint8], SlamFrame], None]


@dataclass(frozen=True)
class Scene:
    """A mapped scene.

    Attributes
    ----------
    camera : camera of the undistorted images
    map : points and keyframes
    trajectory : the camera's path, by frame numbers (``indices``) and ``timestamps``
    frames : what each frame gave, without its points; empty where the scene was loaded
    slam : what made the map, and finds the camera in further frames; None where the scene was loaded
    path : of the file that it was loaded from; None where it was just mapped
    """

    camera: Camera
    map: RigidMap
    trajectory: Trajectory
    frames: tuple[SlamFrame, ...] = ()
    slam: Slam | None = None
    path: Path | None = None

    @property
    def points(self) -> Array:
        """Map points (n, 3), metres, or in units of the first view's median depth."""
        return self.map.positions[self.map.good]

    @property
    def keyframes(self) -> list[Keyframe]:
        """The views that the map keeps."""
        return [self.map.keyframes[k] for k in self.map.kept_keyframes]

    @property
    def is_metric(self) -> bool:
        """Whether lengths are metres."""
        return self.map.is_metric

    def save(self, path: str | Path) -> None:
        """Write map and path into one file, which `load_scene` and the commands read."""
        save_map(Path(path), self.map, self.camera, self.trajectory)

    def summary(self) -> dict[str, Any]:
        """Counts, errors and times, as in ``summary.json`` of a run."""
        content: dict[str, Any] = {
            "n_tracked": len(self.trajectory),
            "n_keyframes": len(self.keyframes),
            "n_map_points": len(self.map.good),
            "scale": "metres" if self.is_metric else "the median depth of the map's first view is 1",
        }
        return content | (_summary_of_run(self, self.slam) if self.slam is not None else {})


def load_scene(path: str | Path, camera: Camera) -> Scene:
    """Read a scene that `Scene.save` or `morph slam` wrote (``map.h5``).

    Raises MapError if the file is missing, damaged, empty, of another version, or of a camera with other intrinsics.
    """
    return Scene(camera, *load_map_and_trajectory(Path(path), camera), path=Path(path))


def map_scene(
    source: FrameStream | str | Path,
    camera: Camera | StereoCamera,
    options: SlamOptions | None = None,
    progress: bool = False,
    *,
    known: Scene | Trajectory | ColmapModel | None = None,
    images: FrameSource | None = None,
    watch: Watch | None = None,
) -> Scene:
    """Track a camera through a rigid scene and map the scene.

    A recording's map is made in step with its frames, a live camera's beside them, until an interrupt.

    Parameters
    ----------
    source : frames, or what `open_source` opens
    camera : of the frames; a stereo pair for frames with right images
    options : choices of the run
    progress : whether to show a bar
    known : map to find the camera in, instead of making a new one; or camera poses or a COLMAP model to make it from
    images : recording that poses or model are of; the source by default
    watch : called with each undistorted image and what it gave, with its points

    Raises MorphError if an input cannot be used: SourceError, CameraError, or MapError if map, poses or model do not
    fit.
    """
    opened = open_stream(source) if isinstance(source, str | Path) else source
    is_live = isinstance(opened, LiveStream)
    with opened if isinstance(opened, LiveStream) and opened is not source else nullcontext():
        slam, frames = start_slam(opened, camera, options or SlamOptions(), known, images), []
        try:
            frames.extend(track_frames(slam, opened, progress, watch))
        except KeyboardInterrupt:
            if not is_live:
                raise
    return finish_scene(slam, frames)


def start_slam(
    source: FrameStream,
    camera: Camera | StereoCamera,
    options: SlamOptions,
    known: Scene | Trajectory | ColmapModel | None = None,
    images: FrameSource | None = None,
) -> Slam:
    """What tracks the camera through a source; parameters as of `map_scene`."""
    warm_up()
    with_depth = options.use_depth and isinstance(camera, Camera) and has_registered_depth(source)
    slam = Slam(camera, options, with_depth, threaded=isinstance(source, LiveStream))
    if isinstance(known, Scene):
        slam.use_map(known.map)
    elif known is not None:
        images = images or (source if isinstance(source, FrameSource) else None)
        if images is None:
            raise SourceError(f"{source.name} is live: give the recording that the poses are of")
        make = map_from_trajectory if isinstance(known, Trajectory) else map_from_colmap
        slam.use_map(make(known, images, slam.frame_images))  # type: ignore[arg-type]
    return slam


def track_frames(
    slam: Slam, source: FrameStream, progress: bool = False, watch: Watch | None = None
) -> Iterator[SlamFrame]:
    """Records of all frames, one after the other; parameters as of `map_scene`."""
    total = len(source) if isinstance(source, Sized) else None
    with threads_side_by_side() if slam.threaded else nullcontext():
        for frame in tqdm(source, total=total, desc="tracking", unit="frame", disable=not progress):
            result = slam.process_frame(frame.image, frame.index, frame.timestamp, frame.depth, frame.right)
            if watch is not None:
                watch(slam.undistort(frame.image), result)
            yield result.record(is_final=slam.is_frozen)


def finish_scene(slam: Slam, frames: Sequence[SlamFrame]) -> Scene:
    """Refine the map, once the sequence is over, and the path by it."""
    slam.refine_map()
    return Scene(slam.camera, slam.map, trajectory_of(slam, frames), tuple(frames), slam)


def trajectory_of(slam: Slam, frames: Sequence[SlamFrame]) -> Trajectory:
    """The camera's path through all frames that have a pose, by what the map knows now."""
    posed = [(frame, slam.camera_from_world(frame)) for frame in frames]
    found = [(frame.index, frame.timestamp, inverse(pose)) for frame, pose in posed if pose is not None]
    indices, times, poses = zip(*found, strict=True) if found else ((), (), ())
    return Trajectory(np.array(times), np.array(poses).reshape(-1, 4, 4), np.array(indices, dtype=np.int64))


def _summary_of_run(scene: Scene, slam: Slam) -> dict[str, Any]:
    placed = set(scene.trajectory.indices.tolist())
    found = [frame for frame in scene.frames if frame.index in placed]
    after = [frame for frame in scene.frames if found and frame.index >= found[0].index]
    times = np.array([frame.total_ms for frame in after] or [0.0])
    waits = np.array([frame.waited_ms for frame in after] or [0.0])
    errors = [frame.pose.rms_px for frame in found if frame.pose is not None]
    factor = suspected_focal_factor(slam.map, slam.camera.intrinsics)
    return {
        "n_frames": len(scene.frames),
        "start_frame": found[0].index if found else None,
        "n_after_start": len(after),
        "status": dict(Counter(str(frame.status) for frame in scene.frames)),
        "n_restarts": slam.n_restarts,
        "map_frozen": slam.is_frozen,
        "frozen_by_itself_at": slam.frozen_at,
        "n_loops_closed": slam.n_loops,
        "suspected_focal_factor": factor,
        "median_rms_px": float(np.median(errors)) if errors else None,
        "median_ms": float(np.median(times)),
        "p95_ms": float(np.percentile(times, 95)),
        "stage_median_ms": {s: float(np.median([f.timings_ms[s] for f in after] or [0.0])) for s in STAGES},
        "longest_wait_for_mapper_ms": float(np.max(waits)),
        "p99_wait_for_mapper_ms": float(np.percentile(waits, 99)),
        "settings": asdict(slam.options),
        "flags": list(_flags(scene, slam, after, factor)),
    }


def _flags(scene: Scene, slam: Slam, after: Sequence[SlamFrame], focal_factor: float | None) -> Iterator[str]:
    """What a reader of the summary must know."""
    n_lost = sum(frame.status is SlamStatus.LOST for frame in after)
    if n_lost:
        yield f"{n_lost} frames after the start were lost: frames.csv says why"
    if slam.n_restarts:
        yield f"{slam.n_restarts} young maps were lost for too long and given up, with their poses"
    if focal_factor is not None:
        yield (
            f"a focal length {focal_factor:.2f} times that of the camera file would explain the map clearly "
            "better: check the calibration"
        )
    if not len(scene.trajectory) and scene.frames:
        yield f"no map was begun: {scene.frames[-1].reason}"


def suspected_focal_factor(rigid_map: RigidMap, intrinsics: Array) -> float | None:
    """By what the focal length would have to be multiplied; None where the given one is as good as any.

    Keyframes and points are adjusted once more for each of some focal lengths. A wrong one leaves more error where the
    camera turned and moved; where it hardly turned, any fits about as well.

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
    problem = gather(rigid_map, intrinsics, kept[chosen], kept[:0], iterations=25)
    seen, scaled = problem.observations, intrinsics * [factor, factor, 1.0, 1.0]
    twice = np.bincount(seen.point_idx)[seen.point_idx] >= 2
    observations = Observations(seen.camera_idx[twice], seen.point_idx[twice], seen.pixels[twice])
    return adjust(
        problem.camera_from_world,
        problem.positions,
        observations,
        scaled,
        problem.held,
        huber_px=1.0,
        iterations=problem.iterations,
        tolerance=1e-4,
    ).cost


def warm_up() -> None:
    """Compile the inner loops, so that no frame has to wait for it."""
    rng = np.random.default_rng(0)
    points, intrinsics = rng.uniform([-1, -1, 3], [1, 1, 4], size=(20, 3)), np.array([100.0, 100.0, 0.0, 0.0])
    pixels = points[:, :2] / points[:, 2:] * 100.0
    refine_pose(np.eye(4), points, pixels, intrinsics)
    seen = Observations(np.repeat([0, 1], 20), np.tile(np.arange(20), 2), np.concatenate([pixels, pixels]))
    adjust(np.stack([np.eye(4)] * 2), points, seen, intrinsics, np.array([True, False]), iterations=1)
    image, centre = rng.integers(0, 255, (32, 32)).astype(np.uint8), np.array([[16.0, 16.0]])
    patch_correlation(image, image, centre, centre, 5)
    orientations(image, centre)
    words, rows = rng.integers(0, 255, (4, 32)).astype(np.uint8), np.arange(4)
    least_distances(words, rows, words, rows)
    bit_counts(words, rows, len(words))
