"""Where tracking starts."""
