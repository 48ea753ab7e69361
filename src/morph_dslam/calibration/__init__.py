"""Camera calibration from pictures of a checkerboard."""
