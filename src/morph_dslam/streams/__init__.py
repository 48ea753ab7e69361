"""Results of a session for other programs, frame by frame: what is sent, and the ways to send it."""
