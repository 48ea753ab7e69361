"""A map from frames whose poses are known, by whatever program: only its points have to be found."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import MapError
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.online.measuring.flow import FlowOptions
from morph_dslam.online.slam.frame_images import FrameImages
from morph_dslam.online.slam.mapping import Mapper
from morph_dslam.online.slam.mapping_work import do_all
from morph_dslam.online.slam.options import SlamOptions
from morph_dslam.online.slam.pose import PoseEstimate, reprojection_errors
from morph_dslam.online.slam.projection import inverse
from morph_dslam.online.slam.rigid_map import GOOD, NOWHERE, RigidMap
from morph_dslam.online.slam.tracking import Tracked, Tracker
from morph_dslam.sources import FrameSource

Array = NDArray[np.float64]

#: Frames and poses belong together if they are at most this far apart in time, seconds.
MOST_TIME_DIFFERENCE = 0.01
#: Depth of points of which nothing is known, in lengths of the path: images then move by rotation alone.
FAR = 100.0
#: Points are found again where the poses have them in at least this share of frames: 0.9 with exact
#: poses, 0.15 with poses that are a tenth of a second late.
LEAST_FOUND = 0.4


def map_from_trajectory(
    trajectory: Trajectory, source: FrameSource, images: FrameImages, options: SlamOptions
) -> RigidMap:
    """Points triangulated from the frames of a recording that have a pose, with these poses.

    Lengths are the trajectory's.

    Raises
    ------
    MapError
        If fewer than three frames have a pose, or too few points obey the poses.
    """
    rigid_map, intrinsics = RigidMap(), np.asarray(images.camera.intrinsics)
    mapper = Mapper(rigid_map, intrinsics, options, hold_poses=True, unknown_depth=FAR * trajectory.length)
    tracker = _PosedTracker(rigid_map, intrinsics, options)
    times, n_posed = [], 0
    for frame in source:
        times.append(frame.timestamp)
        nearest = int(np.abs(trajectory.timestamps - frame.timestamp).argmin())
        if abs(trajectory.timestamps[nearest] - frame.timestamp) > MOST_TIME_DIFFERENCE:
            continue
        n_posed += 1
        pose = inverse(trajectory.world_from_camera[nearest])
        view = images.prepare(frame.image, frame.index, frame.timestamp)
        if not rigid_map.keyframes:
            mapper.begin_at(view, pose)
            tracker.place(pose, rigid_map.keyframes[-1].seen)
            continue
        tracked = tracker.track_at(view.flat, pose)
        if mapper.wants_keyframe(tracked, view.index):
            do_all(mapper.insert(tracked, view))
            tracker.points = rigid_map.keyframes[-1].seen
    _check(trajectory, source, options, n_posed, times, rigid_map)
    mapper.adjust_all()
    return rigid_map


def _check(
    trajectory: Trajectory,
    source: FrameSource,
    options: SlamOptions,
    n_posed: int,
    times: list[float],
    rigid_map: RigidMap,
) -> None:
    """Refuse what gives no map."""
    if n_posed < 3:
        raise MapError(
            f"only {n_posed} of {len(times)} frames of {source.name} have a pose: they are from "
            f"{times[0]:.3f} to {times[-1]:.3f} s, the trajectory's from {trajectory.timestamps[0]:.3f} to "
            f"{trajectory.timestamps[-1]:.3f} s, and may differ by {1e3 * MOST_TIME_DIFFERENCE:.0f} ms"
        )
    share = float(rigid_map.n_found.sum() / max(rigid_map.n_expected.sum(), 1))
    if share < LEAST_FOUND or len(rigid_map.good) < options.least_start_points:
        raise MapError(
            f"the poses of the trajectory do not fit the images of {source.name}: "
            f"{len(rigid_map.good)} points were made, found again in {share:.0%} of the frames. Check that "
            "poses are world from camera (x right, y down, z forward) at the frames' timestamps, that most "
            "frames have one, and the camera file"
        )


class _PosedTracker(Tracker):
    """Follows points through frames of known pose."""

    def track_at(self, flat: NDArray[np.uint8], camera_from_world: Array) -> Tracked:
        """The points of the next frame, at its pose (4, 4)."""
        options = self._options
        flow = FlowOptions(options.flow.window, options.flow.levels + 1)
        found = self._follow(flat, camera_from_world, flow)
        found = found.joined(self._search(flat, camera_from_world, found.ids))
        known = self._map.state[found.ids] == GOOD
        positions, pixels = self._map.positions[found.ids[known]], found.pixels[known]
        errors = reprojection_errors(camera_from_world, positions, pixels, self._intrinsics)
        rms = float(np.sqrt(np.mean(errors**2))) if len(errors) else 0.0
        pose = PoseEstimate(camera_from_world, np.zeros((6, 6)), errors < options.inlier_px, rms)
        result = self._tracked(flat, pose, found, NOWHERE)
        self.camera_from_world, self.points = camera_from_world, result.points
        return result
