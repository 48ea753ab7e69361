"""Settings of camera tracking and mapping, with the values that the tests and the benchmark run with."""

from __future__ import annotations

from dataclasses import dataclass, field

from morph_dslam.tracking.patches import FlowOptions


@dataclass(frozen=True)
class SlamOptions:
    """Settings; pixels are those of the undistorted image.

    Attributes
    ----------
    flow : Lucas-Kanade. patch_half : half width of patches that must agree; least_correlation : how well.
    inlier_px : points that miss by more do not belong to the rigid scene.
    least_inliers : a pose from fewer points counts as lost.
    start_corners : corners followed from the first view; least_start_points : the fewest a map begins with.
    start_parallax_deg : median angle between the first two views' rays.
    start_rms_px, start_share : error, and share of the points that must fit, in three views.
    start_clearness : how much larger a rejected hypothesis' squared error must be than the accepted one's.
    most_disparity_px : of stereo pairs; nearer points have no depth from one frame.
    least_disparity_px : from this disparity on the depth of a point in one frame makes it a map point; in
        depth images the baseline counts as 8 cm.
    map_corners : points and candidates that a keyframe is filled up to.
    corner_distance_px : new corners keep this far from followed points.
    triangulation_deg : angle between rays from which a candidate becomes a map point.
    keyframe_share : a keyframe is due when fewer than this share of the last one's points are left.
    keyframe_motion_px : or when points have moved this far since it (median).
    keyframe_baseline : or when the camera has moved this part of the median depth.
    quiet_px : where keyframes can wait, they wait for frames in which the image moves less than this: fast
        motion blurs, and most cameras read their rows one after the other, which bends what they see.
    urgent_share : they cannot wait when fewer than this share of the last one's points are left.
    least_frames_between : keyframes are at least this many frames apart.
    window, fixed_window : keyframes that local bundle adjustment moves, and those that hold it.
    search_points, search_keyframes : lost points looked for in a frame, from at most so many keyframes.
    enough_points : in a frozen map lost points are looked for while fewer than this are followed.
    search_radius_px : how far from its predicted pixel a lost point may be found.
    deforming_share, deforming_frames : the scene is taken to deform when more than this share of its points
        disagree with the rigid scene in so many frames on end.
    restart_after : frames after which a young map that stays lost is given up.
    """

    flow: FlowOptions = field(default_factory=FlowOptions)
    patch_half: int = 6
    least_correlation: float = 0.6
    inlier_px: float = 4.0
    least_inliers: int = 20
    start_corners: int = 500
    least_start_points: int = 80
    start_parallax_deg: float = 1.2
    start_rms_px: float = 1.0
    start_share: float = 0.9
    start_clearness: float = 1.5
    most_disparity_px: int = 128
    least_disparity_px: float = 10.0
    map_corners: int = 450
    corner_distance_px: int = 9
    triangulation_deg: float = 1.2
    keyframe_share: float = 0.75
    keyframe_motion_px: float = 30.0
    keyframe_baseline: float = 0.06
    quiet_px: float = 5.0
    urgent_share: float = 0.6
    least_frames_between: int = 3
    window: int = 8
    fixed_window: int = 6
    search_points: int = 80
    search_keyframes: int = 3
    enough_points: int = 340
    search_radius_px: float = 5.0
    deforming_share: float = 0.12
    deforming_frames: int = 5
    restart_after: int = 90
