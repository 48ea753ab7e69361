"""Registration from files to files, landmarks, and other ways to find an object in a frame."""

from morph_dslam.io.landmarks import Landmarks, load_landmarks
from morph_dslam.registration.board import FiducialBoard, load_board, print_board
from morph_dslam.registration.initialization import InitializerFiles, register_by_initializer
from morph_dslam.registration.register import draw_registration, registration_line, run_registration

__all__ = [
    "FiducialBoard",
    "InitializerFiles",
    "Landmarks",
    "draw_registration",
    "load_board",
    "load_landmarks",
    "print_board",
    "register_by_initializer",
    "registration_line",
    "run_registration",
]
