"""What a model's certificate says of the errors of its displacement, stress and forces.

A displacement may be reduced well where stress and forces are not: in thin shells a small error of the shape strains
the middle surface, which is stiff.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from morph_dslam.model.reduced_model import FORCE, MOMENT, REACTION, ReducedModel

#: Displacements, stress and forces that the reduction, or the mesh, misses by more than this part are not to be relied
#: on. Of the mesh stress is left out: it is singular at edges of supports, in good models too.
MOST = 0.1
#: The certificate's entries, within that of the discretisation, of why it has no error, and whether it can have one.
NOT_ESTIMATED, ESTIMABLE = "not_estimated", "estimable"


def stated_stresses(model: ReducedModel) -> list[dict[str, Any]]:
    """What the certificate has of the von Mises stress at each place; empty where it has nothing."""
    return [model.certificate.get(f"stress_{place}", {}).get("von_mises", {}) for place in model.stresses]


def doubtful_errors(model: ReducedModel) -> dict[str, float]:
    """Errors of the reduction above `MOST`, relative, by what they are of: "von Mises stress", "forces".

    Of several faces or supports it is the largest, as a part of the largest value of all of them: what is missed of a
    support that hardly holds anything matters to nobody. Moments count by the force that has them on the body's size.
    """
    stated = model.certificate
    stresses = {"von Mises stress": [(entry, "largest_MPa", 1.0) for entry in stated_stresses(model)]}
    return _above_most(_moved(stated) | stresses | _forces(model, stated))


def doubtful_mesh_errors(model: ReducedModel) -> dict[str, float]:
    """Errors by the mesh above `MOST`, as `doubtful_errors` has those of the reduction, but for stress."""
    stated = model.certificate.get("discretisation", {}).get("errors", {})
    return _above_most(_moved(stated) | _forces(model, stated))


#: Certificate entries; with each the key of its largest value and the factor to one unit.
_Entries = list[tuple[dict[str, Any], str, float]]


def _moved(stated: dict[str, Any]) -> dict[str, _Entries]:
    return {"displacements": [(stated.get("displacement", {}), "largest_mm", 1.0)]}


def _forces(model: ReducedModel, stated: dict[str, Any]) -> dict[str, _Entries]:
    size = float(np.linalg.norm(np.ptp(model.nodes, axis=0)))
    reactions = {name: stated.get(REACTION + name, {}) for name in model.reactions}
    forces = [(entry, "largest_N", 1.0) for name, entry in reactions.items() if name.startswith(FORCE)]
    moments = [(entry, "largest_Nmm", 1e-3 / size) for name, entry in reactions.items() if name.startswith(MOMENT)]
    return {"forces": [*forces, *moments]}


def _above_most(kinds: dict[str, _Entries]) -> dict[str, float]:
    errors = {kind: _largest(entries) for kind, entries in kinds.items()}
    return {kind: error for kind, error in errors.items() if error > MOST}


def _largest(entries: _Entries) -> float:
    """The largest error, as a part of the largest value of all."""
    found = [(entry.get("relative_l2"), factor * entry.get(key, 0.0)) for entry, key, factor in entries]
    known = [(error, value) for error, value in found if error is not None]
    largest = max((value for _, value in known), default=0.0)
    return max((error * value / largest for error, value in known), default=0.0) if largest else 0.0


def errors_in_words(errors: dict[str, float]) -> str:
    """Relative errors as "34 % of von Mises stress and 390 % of forces"."""
    return " and ".join(f"{100.0 * error:.0f} % of {kind}" for kind, error in errors.items())


def unknown_mesh_error(model: ReducedModel) -> str | None:
    """Why the error of a model's mesh was not estimated though it can be; None if it was, or nobody could.

    Solutions of another program, sheets in grips and elements of the highest order have no finer ones to compare with.
    """
    stated = model.certificate.get("discretisation", {})
    return stated.get(NOT_ESTIMATED) if model.study_parameters and stated.get(ESTIMABLE, False) else None


def reduction_force_error(model: ReducedModel, support: str) -> float | None:
    """Relative error of the force on a support by the reduction alone; None if none is stated."""
    return model.certificate.get(f"{REACTION}{FORCE}{support}", {}).get("relative_l2")


def force_error(model: ReducedModel, support: str) -> tuple[float, bool] | None:
    """Relative error of the force on a support, and whether the discretisation's is in it; None if none is stated."""
    name = f"{REACTION}{FORCE}{support}"
    reduction = reduction_force_error(model, support)
    if reduction is None:
        return None
    discretisation = model.certificate.get("discretisation", {}).get("errors", {}).get(name, {}).get("relative_l2")
    return reduction + (discretisation or 0.0), discretisation is not None


def largest_force_error(model: ReducedModel, support: str) -> float:
    """Error of the force on a support where that is largest, newtons; 0 if none is stated."""
    stated = force_error(model, support)
    largest = model.certificate.get(f"{REACTION}{FORCE}{support}", {}).get("largest_N")
    return stated[0] * largest if stated is not None and largest is not None else 0.0


def uncounted(model: ReducedModel) -> list[str]:
    """What of a model no deviation of a shape or a force contains: it may be wrong and leave the images alike."""
    return ["law", "supports"] + ([] if model.n_loads else ["loads"])
