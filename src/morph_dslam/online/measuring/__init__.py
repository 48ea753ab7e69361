"""Where a frame shows the points of the object."""
