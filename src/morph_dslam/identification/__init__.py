"""Parameters that are one for a whole recording, from measured points and forces."""
