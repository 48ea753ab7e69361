"""Hyperelastic and viscoelastic material laws."""
