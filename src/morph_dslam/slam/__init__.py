"""Camera tracking and mapping of a rigid scene."""
