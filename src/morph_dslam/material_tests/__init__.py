"""Laws fitted to material tests: stress against stretch, measured on specimens of simple shape."""
