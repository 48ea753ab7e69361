"""Nonlinear and linear solvers."""
