"""Solution of discretised equilibrium: linear solver, Newton, load stepping, arc length, buckling."""
