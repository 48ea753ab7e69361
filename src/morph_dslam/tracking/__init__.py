"""Tracking: pose and parameters of a deformable object in every frame."""
