"""Tracking and mapping of a rigid scene, frame by frame, beside `morph_dslam.map_scene`."""

from morph_dslam.io.camera_files import load_camera_or_pair as load_camera_or_pair, save_camera as save_camera
from morph_dslam.io.trajectory import Trajectory as Trajectory, load_trajectory as load_trajectory
from morph_dslam.slam.camera_terms import CameraEstimate as CameraEstimate, TermEstimate as TermEstimate
from morph_dslam.slam.result import (
    NoPose as NoPose,
    SlamFrame as SlamFrame,
    SlamReason as SlamReason,
    SlamStatus as SlamStatus,
)
from morph_dslam.slam.run import run_slam as run_slam
from morph_dslam.slam.scene import refine_camera as refine_camera, trajectory_of as trajectory_of, warm_up as warm_up
from morph_dslam.slam.slam import Slam as Slam
