"""Landmarks, and registration of a model in a map with its run folder."""

from morph_dslam.io.landmarks import Landmarks, load_landmarks
from morph_dslam.registration.run import registration_line, run_registration
from morph_dslam.registration.start import InitializerFiles

__all__ = ["InitializerFiles", "Landmarks", "load_landmarks", "registration_line", "run_registration"]
