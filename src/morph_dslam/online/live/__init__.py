"""Live tracking: capture, localisation, tracking and drawing side by side."""
