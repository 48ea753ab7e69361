"""Objects that stay in their place in the map of the scene."""
