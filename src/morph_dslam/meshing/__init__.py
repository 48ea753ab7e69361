"""Meshes: files, generators, checks."""
