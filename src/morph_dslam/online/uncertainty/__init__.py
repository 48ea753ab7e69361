"""How sure an estimate is, and what the images cannot tell."""
