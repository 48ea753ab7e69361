"""Several cameras, and several objects."""
