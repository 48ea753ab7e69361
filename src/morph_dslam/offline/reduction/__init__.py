"""From snapshots or operators to separated representations: POD, regression, Galerkin, PGD."""
