"""The method "sparse_pgd": a sum of products for every field, fitted to the training solutions."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel, SeparatedField
from morph_dslam.model.basis_functions import Basis
from morph_dslam.model.tensor_functions import CPFunctions
from morph_dslam.offline.reduction.bases import parameter_bases
from morph_dslam.offline.reduction.fields import field_names, field_values, model_of
from morph_dslam.offline.reduction.sparse_pgd import SamplingWarning, SparsePgdOptions, fit_sparse_pgd
from morph_dslam.offline.reduction.task import ReductionTask

Array = NDArray[np.float64]


def reduce_by_sparse_pgd(task: ReductionTask) -> ReducedModel:
    """A reduced model of every field that the snapshots hold, each in CP form with one term a mode.

    ``options.basis`` names the functions of the parameters (Chebyshev polynomials if absent), of which there
    are ``max_degree + 1``, and ``options.max_modes`` bounds the products of a field; how many there are,
    samples kept aside decide. Mirror images of one solution are kept aside together. Too few samples are said
    under "warnings" of the certificate's "reduction".

    Raises
    ------
    StudyError
        If Fourier functions are asked for and no parameter is a full turn.
    """
    options, dimension = task.options, len(task.parameters)
    basis = options.basis or "chebyshev"
    bases = parameter_bases(basis, task.parameters, (options.max_degree + 1,) * dimension)
    snapshots = [snapshot for group in task.groups for snapshot in group]
    samples = np.array([snapshot.coordinates for snapshot in snapshots])
    labels = np.concatenate([np.full(len(group), index) for index, group in enumerate(task.groups)])
    fields: dict[str, SeparatedField] = {}
    summaries: dict[str, dict[str, Any]] = {}
    notes: list[str] = []
    for name in field_names(snapshots):
        values = field_values(snapshots, name)
        weights = task.mesh.weights if values.shape[1] == len(task.mesh.weights) else np.ones(values.shape[1])
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", SamplingWarning)
            fields[name], summaries[name] = _fit_field(
                samples, values, weights, bases, SparsePgdOptions(max_modes=options.max_modes), labels
            )
        notes += [f"{name}: {w.message}" for w in caught if issubclass(w.category, SamplingWarning)]
    summary: dict[str, Any] = {"method": "sparse_pgd", "basis": basis, **summaries["displacement"]}
    return model_of(task, fields, summary | ({"warnings": notes} if notes else {}))


def _fit_field(
    samples: Array,
    values: Array,
    weights: Array,
    bases: tuple[Basis, ...],
    options: SparsePgdOptions,
    labels: NDArray[np.int64],
) -> tuple[SeparatedField, dict[str, Any]]:
    """One field of values (n_samples, n_points, n_components), points by ``weights``, and its summary."""
    shape = values.shape[1:]
    root = np.sqrt(np.repeat(weights, shape[1]))
    fit = fit_sparse_pgd(samples, values.reshape(len(values), -1) * root, bases, options, labels)
    modes = (fit.functions.mixing @ fit.pod.modes / root).reshape(-1, *shape)
    functions = CPFunctions(bases, fit.functions.factors, np.eye(len(modes)))
    summary = {
        "modes": len(modes),
        "functions_of_a_parameter": max(basis.size for basis in bases),
        "singular_values": fit.pod.singular_values[:60].tolist(),
        "validation_errors": {str(count): error for count, error in fit.validation_errors.items()},
    }
    return SeparatedField(modes, functions), summary
