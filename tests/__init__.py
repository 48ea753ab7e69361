"""Tests. Each process of a run computes in one thread: two workers would take the cores from each other."""

import os

for _name in ("NGS_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
