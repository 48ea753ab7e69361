"""The certificate: what a reduced model gets wrong on solutions that it has not seen."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel
from morph_dslam.offline.snapshots import FACES, Snapshot

Array = NDArray[np.float64]


def confidence_statement(count: int) -> str:
    """What the largest of ``count`` random held-out errors says: P(next error exceeds it) < 1 - coverage."""
    coverage = 0.05 ** (1.0 / count)
    return (
        f"with 95 % confidence at least {100.0 * coverage:.1f} % of the parameter box "
        f"errs no more than the largest of these {count}"
    )


def certify(model: ReducedModel, held_out: list[Snapshot]) -> dict[str, Any]:
    """Errors of displacement, sensitivities and stress over held-out solves, in plain JSON types.

    Displacement errors are distances in mm over all nodes; the relative figure is the mean distance over the
    largest displacement. Sensitivity errors are relative L2 norms over all held-out solves, by parameter.
    Stress errors are relative L2 norms by face.
    """
    names = [parameter.name for parameter in model.parameters]
    distances, largest = [], 0.0
    slope_missed, slope_norm = np.zeros(len(names)), np.zeros(len(names))
    stress = {face: [0.0, 0.0] for face in FACES}
    for snapshot in held_out:
        value, slopes = model.displacement.value_and_sensitivities(snapshot.coordinates)
        distances.append(np.linalg.norm(value - snapshot.displacement, axis=1))
        largest = max(largest, float(np.linalg.norm(snapshot.displacement, axis=1).max()))
        slope_missed += np.sum((slopes - snapshot.displacement_sensitivity) ** 2, axis=(1, 2))
        slope_norm += np.sum(snapshot.displacement_sensitivity**2, axis=(1, 2))
        for face in FACES:
            difference = model.stresses[face].value(snapshot.coordinates) - snapshot.stress[face]
            stress[face][0] += float(np.sum(difference**2))
            stress[face][1] += float(np.sum(snapshot.stress[face] ** 2))
    per_sample = np.array([distance.mean() for distance in distances])
    return {
        "displacement": {
            "mean_mm": 1e3 * float(per_sample.mean()),
            "max_mm": 1e3 * float(np.max(distances)),
            "worst_sample_mean_mm": 1e3 * float(per_sample.max()),
            "largest_displacement_mm": 1e3 * largest,
            "mean_relative_to_largest": float(per_sample.mean()) / largest,
            "n_held_out": len(held_out),
            "confidence": confidence_statement(len(held_out)),
        },
        "sensitivity": dict(zip(names, np.sqrt(slope_missed / slope_norm).tolist(), strict=True)),
        **{f"stress_{face}": float(np.sqrt(stress[face][0] / stress[face][1])) for face in FACES},
    }


def compression_percent(model: ReducedModel, n_snapshots: int) -> float:
    """The paper's compression factor: 1 - (memory of the separated field) / (memory of the snapshots)."""
    field = model.displacement
    functions = field.functions
    kept = field.modes.size + functions.coefficients.size + functions.multi_indices.size / 4.0
    original = n_snapshots * field.modes.shape[1] * field.modes.shape[2]
    return 100.0 * (1.0 - kept / original)
