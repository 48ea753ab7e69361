"""The certificate: what a reduced model gets wrong on solutions that it has not seen."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel, SeparatedField
from morph_dslam.offline.problem import Snapshot

Array = NDArray[np.float64]


def confidence_statement(count: int) -> str:
    """What the largest of ``count`` random held-out errors says: P(next error exceeds it) < 1 - coverage."""
    coverage = 0.05 ** (1.0 / count)
    return (
        f"with 95 % confidence at least {100.0 * coverage:.1f} % of the parameter box "
        f"errs no more than the largest of these {count}"
    )


def certify(model: ReducedModel, held_out: list[Snapshot]) -> dict[str, Any]:
    """Errors of displacement, sensitivities, stress and strain over held-out solves, in plain JSON types.

    Displacement errors are distances in mm over all nodes; the relative figure is the mean distance over the
    largest displacement. Sensitivity errors are relative L2 norms over all held-out solves, by parameter;
    they are absent where the solver gave no sensitivities. Stress and strain errors are relative L2 norms.
    """
    certificate: dict[str, Any] = {"displacement": _displacement_errors(model, held_out)}
    if all("displacement" in snapshot.sensitivities for snapshot in held_out):
        names = [parameter.name for parameter in model.parameters]
        errors = _sensitivity_errors(model, held_out)
        certificate["sensitivity"] = dict(zip(names, errors.tolist(), strict=True))
    others = {f"stress_{place}": field for place, field in model.stresses.items()}
    if model.strain is not None:
        others["strain"] = model.strain
    return certificate | {name: _relative_error(field, name, held_out) for name, field in others.items()}


def _displacement_errors(model: ReducedModel, held_out: list[Snapshot]) -> dict[str, Any]:
    distances, largest = [], 0.0
    for snapshot in held_out:
        displacement = snapshot.fields["displacement"]
        missed = model.displacement.value(snapshot.coordinates) - displacement
        distances.append(np.linalg.norm(missed, axis=1))
        largest = max(largest, float(np.linalg.norm(displacement, axis=1).max()))
    per_sample = np.array([distance.mean() for distance in distances])
    return {
        "mean_mm": 1e3 * float(per_sample.mean()),
        "max_mm": 1e3 * float(np.max(distances)),
        "worst_sample_mean_mm": 1e3 * float(per_sample.max()),
        "largest_displacement_mm": 1e3 * largest,
        "mean_relative_to_largest": float(per_sample.mean()) / largest,
        "n_held_out": len(held_out),
        "confidence": confidence_statement(len(held_out)),
    }


def _sensitivity_errors(model: ReducedModel, held_out: list[Snapshot]) -> Array:
    """Relative L2 errors (d,) of the displacement's derivatives."""
    missed, norm = 0.0, 0.0
    for snapshot in held_out:
        truth = snapshot.sensitivities["displacement"].astype(np.float64)
        _, slopes = model.displacement.value_and_sensitivities(snapshot.coordinates)
        missed += np.sum((slopes - truth) ** 2, axis=(1, 2))
        norm += np.sum(truth**2, axis=(1, 2))
    return np.sqrt(missed / norm)


def _relative_error(field: SeparatedField, name: str, held_out: list[Snapshot]) -> float:
    missed, norm = 0.0, 0.0
    for snapshot in held_out:
        truth = snapshot.fields[name].astype(np.float64)
        missed += float(np.sum((field.value(snapshot.coordinates) - truth) ** 2))
        norm += float(np.sum(truth**2))
    return float(np.sqrt(missed / norm))


def compression_percent(model: ReducedModel, n_snapshots: int) -> float:
    """The paper's compression factor: 1 - (memory of the separated field) / (memory of the snapshots)."""
    field = model.displacement
    functions = field.functions
    kept = field.modes.size + functions.coefficients.size + functions.multi_indices.size / 4.0
    original = n_snapshots * field.modes.shape[1] * field.modes.shape[2]
    return 100.0 * (1.0 - kept / original)
