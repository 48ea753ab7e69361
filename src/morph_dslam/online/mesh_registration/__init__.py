"""Finding an object's mesh in the map of a scene, without a hand on the mouse."""
