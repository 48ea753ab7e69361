"""Camera calibration from pictures of a checkerboard (Zhang 2000)."""
