"""Reactions of the supports as fields of one point, so that they are reduced and certified like any other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from morph_dslam.offline.problem import Snapshot

#: Name of a reaction's field: this and the name of the output, "force_SET" (N) or "moment_SET" (N m).
REACTION, FORCE, MOMENT = "reaction_", "force_", "moment_"
#: A reaction that never exceeds so much of the largest is rounding, and has nothing to be reduced.
NEGLIGIBLE = 1e-6


def reaction_names(snapshots: Sequence[Snapshot], size: float) -> list[str]:
    """Outputs that are forces and moments on supports and do not vanish in all of the snapshots.

    Parameters
    ----------
    size : extent of the body, m; a moment counts against the largest force at that distance.
    """
    names = [name for name in snapshots[0].outputs if name.startswith((FORCE, MOMENT))]
    largest = {name: max(float(np.linalg.norm(s.outputs[name])) for s in snapshots) for name in names}
    force = max((value for name, value in largest.items() if name.startswith(FORCE)), default=0.0)
    limit = {FORCE: NEGLIGIBLE * force, MOMENT: NEGLIGIBLE * force * size}
    return [name for name in names if largest[name] > limit[name[: name.index("_") + 1]]]


def with_reactions(snapshot: Snapshot, names: Sequence[str]) -> Snapshot:
    """The snapshot with these outputs (3,) as fields (1, 3); their derivatives are not known."""
    fields = {REACTION + name: np.reshape(snapshot.outputs[name], (1, 3)) for name in names}
    return replace(snapshot, fields=snapshot.fields | fields)
