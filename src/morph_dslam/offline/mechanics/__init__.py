"""Solids and shells on NGSolve: spaces, energies, supports, loads, and recovery of fields."""
