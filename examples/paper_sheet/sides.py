"""The positions of the paper's sheet on either side of its plane, as models to film and to track.

A flat sheet may buckle to either side, and nothing but the images tells which. So the path of these models
has a sign: what was solved above the plane, seen in a mirror that lies in it, is what happens below. Along
the path the height is odd and the approach of the ends even, both smooth through the flat sheet; there the
parameter is inside its range, and its sensitivity is not zero.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from reduction import NODES, OPTIONS, Grid

import morph_dslam as md
from morph_dslam.extend.reduction import ReductionTask, certify, reduction_method
from morph_dslam.extend.studies import Snapshot

PATH = md.Parameter("path", "ratio", "1", -1.0, 1.0, 0.0, "part of the path to full height; negative below the plane")
#: The model that is filmed is made of every position, to this tolerance.
FILMED = OPTIONS.model_copy(update={"tolerance": 1e-6})


def below(snapshot: Snapshot) -> Snapshot:
    """A position seen in a mirror in the plane of the flat sheet: its upper face is then the lower one."""
    fields = snapshot.fields
    mirrored = {
        "displacement": fields["displacement"] * np.array([1.0, 1.0, -1.0]),
        "stress_top": fields["stress_bottom"],
        "stress_bottom": fields["stress_top"],
    }
    return Snapshot(-snapshot.coordinates, mirrored)


def both_sides(snapshots: Sequence[Snapshot]) -> list[Snapshot]:
    """The positions below the plane, then those given, the flat sheet once."""
    return [*(below(snapshot) for snapshot in snapshots[:0:-1]), *snapshots]


def tracked_model(snapshots: Sequence[Snapshot], grid: Grid) -> md.ReducedModel:
    """The model that the tracker has: of few positions, certified on all others."""
    every = max(1, round((len(snapshots) - 1) / (NODES - 1)))
    training, held_out = snapshots[::every], [s for i, s in enumerate(snapshots) if i % every]
    task = ReductionTask(grid.mesh(), (PATH,), [[s] for s in both_sides(training)], OPTIONS, "paper sheet, either side")
    model = reduction_method("pod").reduce(task)
    model.certificate.update(certify(model, [*held_out, *map(below, held_out)]))
    return model


def filmed_model(snapshots: Sequence[Snapshot], grid: Grid) -> md.ReducedModel:
    """The model that is filmed: through all positions."""
    task = ReductionTask(
        grid.mesh(), (PATH,), [[s] for s in both_sides(snapshots)], FILMED, "paper sheet, every position"
    )
    return reduction_method("pod").reduce(task)
