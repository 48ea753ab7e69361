"""Plain numpy and scipy versions of compiled functions, to compare with."""
