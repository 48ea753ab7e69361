"""Camera localisation in, and mapping of, the rigid scene around the object."""
