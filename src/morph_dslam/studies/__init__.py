"""Studies: a problem over a box of parameters, its samples, solved and kept."""
