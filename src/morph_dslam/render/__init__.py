"""Rasteriser, overlays and simulated recordings."""
