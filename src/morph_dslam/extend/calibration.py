"""Calibration of several cameras that are fixed to each other."""

from morph_dslam.calibration.rig import RigCalibration as RigCalibration, calibrate_rig as calibrate_rig
