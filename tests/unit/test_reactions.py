"""Reactions of supports become fields of one point; those that are rounding do not."""

import numpy as np
import pytest

from morph_dslam.mechanics.loads import reaction_names, with_reactions
from morph_dslam.studies.problem import Snapshot


def solve(pull, **outputs):
    """A bar of 100 mm pulled by ``pull`` N along z, held at its bottom."""
    fields = {"displacement": np.zeros((2, 3))}
    forces = {"force_bottom": np.array([0.0, 0.0, -pull]), "force_top": np.array([0.0, 0.0, pull])}
    return Snapshot(np.array([pull]), fields, {}, forces | outputs)


def test_forces_become_fields_of_one_point():
    snapshot = with_reactions(solve(3.0), ["force_bottom"])
    assert set(snapshot.fields) == {"displacement", "reaction_force_bottom"}
    assert snapshot.fields["reaction_force_bottom"].tolist() == [[0.0, 0.0, -3.0]]
    assert snapshot.outputs["force_top"].tolist() == [0.0, 0.0, 3.0], "outputs stay"


def test_what_is_rounding_is_left_out():
    """1e-6 of 50 N at 0.1 m is 5e-6 N m."""
    moments = {"moment_top": np.array([4e-6, 0.0, 0.0]), "moment_bottom": np.array([6e-6, 0.0, 0.0])}
    others = {"negative_pivots": np.array(0), "force_side": np.array([0.0, 4e-5, 0.0])}
    snapshots = [solve(0.0), solve(50.0, **moments, **others), solve(20.0)]
    snapshots = [Snapshot(s.coordinates, s.fields, {}, snapshots[1].outputs | s.outputs) for s in snapshots]
    assert reaction_names(snapshots, 0.1) == ["force_bottom", "force_top", "moment_bottom"]


def test_a_study_without_supports_has_no_reactions():
    bare = Snapshot(np.zeros(1), {"displacement": np.zeros((2, 3))}, {}, {"motion": np.ones(6)})
    assert reaction_names([bare], 1.0) == []
    assert with_reactions(bare, []).fields.keys() == {"displacement"}


def test_nothing_is_reduced_where_no_force_ever_acts():
    assert reaction_names([solve(0.0)], 0.1) == []
    with pytest.raises(KeyError):
        with_reactions(solve(0.0), ["force_side"])
