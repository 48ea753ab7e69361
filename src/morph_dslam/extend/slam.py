"""Tracking and mapping of a rigid scene, frame by frame, beside `morph_dslam.map_scene`."""

from morph_dslam.io.camera_files import load_camera_or_pair
from morph_dslam.io.trajectory import Trajectory, load_trajectory
from morph_dslam.slam.result import NoPose, SlamFrame, SlamReason, SlamStatus
from morph_dslam.slam.run import run_slam
from morph_dslam.slam.scene import trajectory_of, warm_up
from morph_dslam.slam.slam import Slam

__all__ = [
    "NoPose",
    "Slam",
    "SlamFrame",
    "SlamReason",
    "SlamStatus",
    "Trajectory",
    "load_camera_or_pair",
    "load_trajectory",
    "run_slam",
    "trajectory_of",
    "warm_up",
]
