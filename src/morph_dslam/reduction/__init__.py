"""Model reduction: from snapshots, or the equations, to separated fields, and their certificate."""
