"""The methods of reduction by their names in study files.

A method is a function from a `ReductionTask` to a `ReducedModel` with all fields that the snapshots hold.
What it says of itself goes under "reduction" into the model's certificate; the build adds held-out errors.
Methods "galerkin" and "reduced_basis" differ in how the build samples for them (`adaptive_sampling`).
"""

from __future__ import annotations

from collections.abc import Callable

from morph_dslam.model import ReducedModel
from morph_dslam.reduction.galerkin_method import reduce_by_galerkin
from morph_dslam.reduction.pgd import reduce_by_pgd
from morph_dslam.reduction.pod import reduce_by_pod
from morph_dslam.reduction.sparse_pgd import reduce_by_sparse_pgd
from morph_dslam.reduction.task import ReductionTask

__all__ = ["METHODS", "ReductionTask"]

METHODS: dict[str, Callable[[ReductionTask], ReducedModel]] = {
    "galerkin": reduce_by_galerkin,
    "pod": reduce_by_pod,
    "pgd": reduce_by_pgd,
    "reduced_basis": reduce_by_galerkin,
    "sparse_pgd": reduce_by_sparse_pgd,
}
