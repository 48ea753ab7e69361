"""Runs compared with measured or simulated truth."""
