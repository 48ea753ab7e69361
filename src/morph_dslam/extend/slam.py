"""Tracking and mapping of a rigid scene, frame by frame, beside `morph_dslam.map_scene`."""

from morph_dslam.slam.frame_images import SlamFrame
from morph_dslam.slam.output import trajectory_of
from morph_dslam.slam.run import SlamRunOptions, run_slam, warm_up
from morph_dslam.slam.slam import Slam

__all__ = ["Slam", "SlamFrame", "SlamRunOptions", "run_slam", "trajectory_of", "warm_up"]
