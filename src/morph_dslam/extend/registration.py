"""Registration from files to files, landmarks, and other ways to find an object in a frame."""

from morph_dslam.io.camera_files import load_rig as load_rig
from morph_dslam.io.landmarks import (
    Landmarks as Landmarks,
    load_landmarks as load_landmarks,
    save_landmarks as save_landmarks,
)
from morph_dslam.registration.board import (
    FiducialBoard as FiducialBoard,
    load_board as load_board,
    print_board as print_board,
)
from morph_dslam.registration.initialization import (
    InitializerFiles as InitializerFiles,
    register_by_initializer as register_by_initializer,
)
from morph_dslam.registration.landmark_binding import bind_landmarks as bind_landmarks
from morph_dslam.registration.register import (
    draw_registration as draw_registration,
    registration_line as registration_line,
    run_registration as run_registration,
)
from morph_dslam.tracking.rig import RigCamera as RigCamera
