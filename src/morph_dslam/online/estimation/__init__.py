"""The state of a frame from its measurements."""
