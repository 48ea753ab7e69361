"""The object drawn over the video."""
