"""Meshes of cells with named sets: their types, generators, files and checks."""
