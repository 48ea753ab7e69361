"""From snapshots to a reduced model: POD in space, smooth functions of the parameters, field by field."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel, SeparatedField
from morph_dslam.offline.problem import Snapshot
from morph_dslam.offline.reduction.pod import Pod, compute_pod
from morph_dslam.offline.reduction.regression import fit_functions
from morph_dslam.offline.reduction.task import ReductionTask
from morph_dslam.offline.studies.study_sections import ReductionSection

Array = NDArray[np.float64]

STRESS = "stress_"


def reduce(task: ReductionTask) -> ReducedModel:
    """A reduced model of every field that the snapshots hold.

    Snapshots of one group (mirror images) are left out together in cross-validation.
    """
    mesh, groups = task.mesh, task.groups
    snapshots = [snapshot for group in groups for snapshot in group]
    fold = np.concatenate([np.full(len(group), index) for index, group in enumerate(groups)])
    fields, summaries = {}, {}
    for key in snapshots[0].fields:
        fields[key], summaries[key] = _reduce_field(
            mesh.weights, task.box, snapshots, key, fold, task.options
        )
    return ReducedModel(
        name=task.name,
        nodes=mesh.nodes,
        triangles=mesh.triangles,
        cells=mesh.cells,
        parameters=task.parameters,
        displacement=fields["displacement"],
        stresses={key.removeprefix(STRESS): field for key, field in fields.items() if key.startswith(STRESS)},
        strain=fields.get("strain"),
        certificate={"reduction": summaries["displacement"]},
    )


def _reduce_field(
    node_weights: Array,
    box: Array,
    snapshots: list[Snapshot],
    name: str,
    fold: NDArray[np.int64],
    options: ReductionSection,
) -> tuple[SeparatedField, dict]:
    """One separated field, and how it was chosen."""
    values = np.array([snapshot.fields[name] for snapshot in snapshots], dtype=np.float64)
    n_snapshots, n_points, n_components = values.shape
    weights = np.repeat(node_weights, n_components)
    values = values.reshape(n_snapshots, -1)
    pod = compute_pod(values, weights, options.tolerance, options.max_modes)
    slopes = None
    if name in snapshots[0].sensitivities:
        # One snapshot at a time: the slopes of all of them together would be the largest array of a build.
        slopes = np.array(
            [
                pod.project(snapshot.sensitivities[name].reshape(len(box), -1).astype(np.float64))
                for snapshot in snapshots
            ]
        )
    functions, errors = fit_functions(
        np.array([snapshot.coordinates for snapshot in snapshots]),
        pod.project(values),
        slopes,
        box[:, 0],
        box[:, 1],
        options.max_degree,
        fold,
    )
    modes = pod.modes.reshape(-1, n_points, n_components)
    return SeparatedField(modes, functions), _summarise(pod, functions.multi_indices, errors)


def _summarise(pod: Pod, indices: NDArray[np.int64], errors: dict[int, float]) -> dict:
    return {
        "modes": len(pod.modes),
        "singular_values": pod.singular_values[:60].tolist(),
        "degree": int(indices.sum(axis=1).max()),
        "terms": len(indices),
        "cross_validation": {str(degree): error for degree, error in errors.items()},
    }
