"""Solid and shell mechanics: kinematics, supports, loads, and the solvers."""
