"""`morph slam`: track the camera through a recording, map the scene, write the run folder."""

from __future__ import annotations

import sys
from collections.abc import Sized
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from morph_dslam.camera import Camera, StereoCamera
from morph_dslam.errors import MapError
from morph_dslam.io.camera_files import load_camera_or_pair
from morph_dslam.io.colmap import read_colmap_model
from morph_dslam.io.trajectory import load_trajectory
from morph_dslam.io.video import VideoWriter
from morph_dslam.slam.bundle_adjustment import Observations, adjust
from morph_dslam.slam.frame_images import SlamFrame, least_distances, orientations
from morph_dslam.slam.map_files import load_map, map_from_colmap, map_from_trajectory
from morph_dslam.slam.options import SlamOptions
from morph_dslam.slam.output import draw_frame, write_run
from morph_dslam.slam.pose import refine_pose
from morph_dslam.slam.relocalization import bit_counts
from morph_dslam.slam.rigid_map import RigidMap
from morph_dslam.slam.slam import Slam
from morph_dslam.sources import FrameStream, open_source, open_stream
from morph_dslam.sources.frames import has_registered_depth
from morph_dslam.sources.live import LiveCamera
from morph_dslam.threads import threads_side_by_side
from morph_dslam.tracking.patches import patch_correlation
from morph_dslam.tracking.run_folder import check_run_folder


@dataclass(frozen=True)
class SlamRunOptions:
    """What to track and where the results go.

    Attributes
    ----------
    source : recording, or `webcam:0`. camera : camera file, or that of a stereo pair. output : run folder.
    use_depth : use the depth images of a recording that has them for its colour pixels.
    first, last : frame numbers, both included; all by default.
    map_path : a map of an earlier run with the same camera, or the folder of a COLMAP model; a new map by
        default. trajectory : file of poses to make the map with instead. images : recording that belongs to
        the model or the trajectory; the source by default. extend : let the map grow, instead of keeping it
        as it is.
    freeze_at : frame number from which the map is kept as it is; never by default. freeze_when_deforming :
        keep it from when something in the scene begins to move or to deform.
    video : draw the video with the points followed. overwrite : replace a run that is there already.
    """

    source: Path
    camera: Path
    output: Path
    first: int | None = None
    last: int | None = None
    map_path: Path | None = None
    trajectory: Path | None = None
    images: Path | None = None
    extend: bool = False
    freeze_at: int | None = None
    freeze_when_deforming: bool = False
    use_depth: bool = True
    video: bool = True
    overwrite: bool = False
    slam: SlamOptions = field(default_factory=SlamOptions)


def run_slam(options: SlamRunOptions) -> dict[str, Any]:
    """Track the camera through a recording, or a live camera's, and write the run folder.

    The map is made in step with a recording's frames, and beside those of a live camera. An interrupt, or a
    source that ends early, keeps what was done: the run folder is completed with the frames so far and the
    exception goes on.

    Returns
    -------
    The content of ``summary.json``.

    Raises
    ------
    MorphError
        If an input cannot be used (CameraError, SourceError, MapError) or the run folder holds a run
        (TrackingError).
    """
    if options.extend and options.map_path is None and options.trajectory is None:
        raise MapError("--extend needs the map that is to grow: --map run/map.h5")
    if options.map_path is not None and options.trajectory is not None:
        raise MapError("a map comes either from --map or from --trajectory, not from both")
    needs_images = options.trajectory is not None or (options.map_path is not None and options.map_path.is_dir())
    if options.images is not None and not needs_images:
        raise MapError("--images says what a COLMAP model (--map MODEL) or poses (--trajectory) are of")
    camera = load_camera_or_pair(options.camera)
    source = open_stream(options.source, options.first, options.last)
    with source if isinstance(source, LiveCamera) else nullcontext():
        check_run_folder(options.output, options.overwrite, "trajectory.txt")
        warm_up()
        return _run(options, camera, source)


def _run(options: SlamRunOptions, camera: Camera | StereoCamera, source: FrameStream) -> dict[str, Any]:
    with_depth = options.use_depth and isinstance(camera, Camera) and has_registered_depth(source)
    is_live = isinstance(source, LiveCamera)
    slam, frames = Slam(camera, options.slam, with_depth, options.freeze_when_deforming, is_live), []
    known = _known_map(options, slam)
    if known is not None:
        slam.use_map(known, options.extend)
    n_before = source.dropped if isinstance(source, LiveCamera) else 0
    try:
        with threads_side_by_side() if is_live else nullcontext():
            _process(slam, source, options, frames)
    finally:
        dropped = {"n_dropped": source.dropped - n_before} if isinstance(source, LiveCamera) else {}
        summary = _finish(slam, frames, options, dropped) if frames else {}
    return summary


def _known_map(options: SlamRunOptions, slam: Slam) -> RigidMap | None:
    """The map to find the camera in; None where a new one is to be made."""
    path = options.map_path
    if options.trajectory is None and (path is None or not path.is_dir()):
        return None if path is None else load_map(path, slam.camera)
    source, images = open_source(options.images or options.source), slam.frame_images
    if options.trajectory is not None:
        return map_from_trajectory(load_trajectory(options.trajectory), source, images, options.slam)
    assert path is not None
    return map_from_colmap(read_colmap_model(path), source, images, options.slam)


def _process(slam: Slam, source: FrameStream, options: SlamRunOptions, frames: list[SlamFrame]) -> None:
    """Process all frames into ``frames``."""
    size = (slam.camera.width, slam.camera.height)
    video = VideoWriter(options.output / "tracked.mp4", source.fps, size) if options.video else nullcontext()
    with video as writer:
        total = len(source) if isinstance(source, Sized) else None
        for frame in tqdm(source, total=total, desc="tracking", unit="frame"):
            if options.freeze_at is not None and frame.index >= options.freeze_at and not slam.is_frozen:
                slam.freeze()
            result = slam.process_frame(frame.image, frame.index, frame.timestamp, frame.depth, frame.right)
            frames.append(result.record(is_final=slam.is_frozen))
            if writer is not None:
                writer.write(draw_frame(slam.undistort(frame.image), result))


def _finish(slam: Slam, frames: list[SlamFrame], options: SlamRunOptions, extra: dict[str, Any]) -> dict[str, Any]:
    slam.refine_map()
    inputs = {"source": str(options.source), "camera": str(options.camera)}
    return write_run(options.output, slam, frames, {"inputs": inputs} | extra)


def warm_up() -> None:
    """Compile the inner loops, so that no frame has to wait for it."""
    print("preparing: compiling the inner loops (half a minute the first time) ...", file=sys.stderr)
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
