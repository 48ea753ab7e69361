"""`morph studio`: the way from a mesh and a video to stress, by clicks in a browser on this computer."""
