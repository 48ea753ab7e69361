"""Reactions of supports: fields of one point in a model, forces with deviations in a frame."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from morph_dslam.geometry import RigidTransform
from morph_dslam.mechanics.loads import reaction_names, with_reactions
from morph_dslam.model import Parameter, ReducedModel, SeparatedField, save_model
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.studies.problem import Snapshot
from morph_dslam.studio.run_files import run_frames
from morph_dslam.tracking.estimator import Estimate, State
from morph_dslam.tracking.outcomes import FoundBy, Status
from morph_dslam.tracking.reactions import Reactions
from morph_dslam.tracking.result import FrameResult
from morph_dslam.tracking.run_folder import write_hdf5
from morph_dslam.tracking.run_results import RunResults


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
    """1e-5 of 50 N at 0.1 m is 5e-5 N m; Newton's method leaves some 1e-6 where Poisson's ratio is 0.4999."""
    moments = {"moment_top": np.array([4e-5, 0.0, 0.0]), "moment_bottom": np.array([6e-5, 0.0, 0.0])}
    others = {"negative_pivots": np.array(0), "force_side": np.array([0.0, 4e-4, 0.0])}
    snapshots = [solve(0.0), solve(50.0, **moments, **others), solve(20.0)]
    snapshots = [Snapshot(s.coordinates, s.fields, {}, snapshots[1].outputs | s.outputs) for s in snapshots]
    assert reaction_names(snapshots, 0.1) == ["force_bottom", "force_top", "moment_bottom"]


def test_reactions_of_balanced_loads_are_rounding_and_small_ones_are_not():
    """A finger of 60 mm under 20 kPa whose support feels 1e-12 N; a strip 200 mm long and 0.1 mm thick that is bent.

    At 1 MPa the strip, 100 mm wide, carries sigma w t^2 / (6 l) = 0.8 mN at its end, and a moment of 0.17 N mm.
    """

    def solution(stress, force, moment):
        fields = {"displacement": np.zeros((2, 3)), "stress_top": np.array([[stress, 0.0, 0.0], [0.0, 0.0, 0.0]])}
        return Snapshot(
            np.zeros(1), fields, {}, {"force_root": np.array([force, 0, 0]), "moment_root": moment * np.eye(3)[1]}
        )

    assert reaction_names([solution(2e4, 2e-12, 4e-13), solution(0.0, 0.0, 0.0)], 0.06) == []
    bent = solution(1e6, 8.3e-4, 1.7e-4)
    assert reaction_names([bent], 0.22) == ["force_root", "moment_root"]
    assert reaction_names([solution(1e6, 1e-13, 1.7e-4)], 0.22) == ["moment_root"]


def test_a_study_without_supports_has_no_reactions():
    bare = Snapshot(np.zeros(1), {"displacement": np.zeros((2, 3))}, {}, {"motion": np.ones(6)})
    assert reaction_names([bare], 1.0) == []
    assert with_reactions(bare, []).fields.keys() == {"displacement"}


def test_nothing_is_reduced_where_no_force_ever_acts():
    assert reaction_names([solve(0.0)], 0.1) == []
    with pytest.raises(KeyError):
        with_reactions(solve(0.0), ["force_side"])


def linear(*columns):
    """A field of constant, first and second parameter over [-1, 1]^2, each times an array (n, c)."""
    indices = np.array([[0, 0], [1, 0], [0, 1]])
    functions = ParameterFunctions(-np.ones(2), np.ones(2), indices, np.eye(3))
    return SeparatedField(np.array(columns, dtype=float), functions)


def held_bar(supports):
    """A bar of 2 m along z: its top moves by (a, 0, b) m, pulled with 100 a N along x and 300 b N along z."""
    none, x, z = np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 3))
    x[1, 0] = z[1, 2] = 1.0
    parameters = tuple(Parameter(name, "length", "m", -1.0, 1.0, 0.0) for name in "ab")
    nodes, triangles = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]]), np.empty((0, 3), dtype=np.int64)
    reactions = {
        "force_top": linear([[0, 0, 0]], [[100, 0, 0]], [[0, 0, 300]]),
        "moment_top": linear([[0, 0, 0]], [[0, 250, 0]], [[0, 0, 0]]),
    }
    displacement = linear(none, x, z)
    return ReducedModel("bar", nodes, triangles, parameters, displacement, supports=supports, reactions=reactions)


def estimate_at(a, b, covariance):
    state = State(np.array([a, b]), RigidTransform(np.eye(3), np.array([0.0, 0.0, 5.0])))
    whole = np.zeros((8, 8))
    whole[:2, :2] = covariance
    return Estimate(state, 0.0, np.empty((0, 2)), 0.1, whole, np.zeros(2, dtype=bool), 5, True)


def test_forces_have_the_deviations_of_the_parameters():
    """The force is (20, 0, 90) N; a and b are known to 0.01 and 0.02 m with a correlation of 0.5."""
    covariance = np.array([[1e-4, 1e-4], [1e-4, 4e-4]])
    top = Reactions(held_bar({"top": np.array([1])}))(estimate_at(0.2, 0.3, covariance))["top"]
    assert top.point == pytest.approx([0.2, 0.0, 2.3])
    assert top.force.value == pytest.approx([20.0, 0.0, 90.0])
    assert top.force.std == pytest.approx([1.0, 0.0, 6.0])
    along = np.array([20.0, 90.0]) / np.hypot(20.0, 90.0)
    expected = along @ np.array([[1.0, 3.0], [3.0, 36.0]]) @ along
    assert top.force.size_std == pytest.approx(np.sqrt(expected))


def test_moments_are_about_the_middle_of_the_support():
    """About the origin 250 a; of it (2 + b) 100 a - a 300 b are the force's, so that a (50 + 200 b) is left."""
    covariance = np.diag([1e-4, 4e-4])
    top = Reactions(held_bar({"top": np.array([1])}))(estimate_at(0.2, 0.3, covariance))["top"]
    assert top.moment.value == pytest.approx([0.0, 0.2 * (50.0 + 200.0 * 0.3), 0.0])
    assert top.moment.std[1] == pytest.approx(np.hypot(0.01 * (50.0 + 200.0 * 0.3), 0.02 * 0.2 * 200.0))
    about_origin = Reactions(held_bar({}))(estimate_at(0.2, 0.3, covariance))["top"]
    assert about_origin.moment.value == pytest.approx([0.0, 50.0, 0.0])


def test_moduli_count_by_one_common_factor():
    model = held_bar({"top": np.array([1])})
    top = Reactions(model)(estimate_at(0.2, 0.3, np.diag([1e-4, 4e-4])), modulus_std=0.1)["top"]
    assert top.force.std == pytest.approx([np.hypot(1.0, 2.0), 0.0, np.hypot(6.0, 9.0)])
    exact = Reactions(model)(estimate_at(0.2, 0.3, np.zeros((2, 2))), modulus_std=0.1)["top"]
    assert exact.force.size_std == pytest.approx(0.1 * np.hypot(20.0, 90.0))


def test_forces_of_undetermined_parameters_are_undetermined():
    top = Reactions(held_bar({}))(estimate_at(0.2, 0.3, np.full((2, 2), np.inf)))["top"]
    assert np.isposinf([*top.force.std, top.force.size_std, *top.moment.std]).all()
    assert top.force.value == pytest.approx([20.0, 0.0, 90.0])


def test_forces_of_an_unobservable_parameter_spread_by_their_curvature():
    """The force is 100 a^2 N along x and 300 b N along z, the moment about the support 50 a^2 N m: (T0 + T2) / 2."""
    indices = np.array([[0, 0], [2, 0], [0, 1]])
    functions = ParameterFunctions(-np.ones(2), np.ones(2), indices, np.eye(3))
    force = np.array([[[50.0, 0, 0]], [[50.0, 0, 0]], [[0, 0, 300.0]]])
    moment = np.array([[[0, 25.0, 0]], [[0, 25.0, 0]], [[0, 0, 0]]])
    fields = {"force_top": SeparatedField(force, functions), "moment_top": SeparatedField(moment, functions)}
    model = replace(held_bar({}), reactions=fields)
    a, sigma = 0.1, 0.6
    top = Reactions(model)(estimate_at(a, 0.2, np.diag([sigma**2, 4e-4])))["top"]
    draws = (a + sigma * np.array([-1.0, 1.0])) ** 2 - a**2
    spread = np.sqrt(np.mean(draws**2))
    assert top.force.value == pytest.approx([1.0, 0.0, 60.0])
    assert top.force.std == pytest.approx([100.0 * spread, 0.0, 6.0])
    assert top.moment.std == pytest.approx([0.0, 50.0 * spread, 0.0])


def test_supports_whose_names_have_a_slash_are_found_again_in_a_run(tmp_path):
    """Both would be one group of the file, "end", with another in it."""
    held = held_bar({})
    names = ("end", "end/left", "100 %", "Träger")
    reactions = {f"force_{name}": held.reactions["force_top"] for name in names}
    model = replace(held, reactions=reactions, triangles=np.array([[0, 1, 0]]))
    run = RunResults(model, reference_frame=0)
    found = FrameResult(
        model, Status.TRACKED, estimate_at(0.2, 0.3, np.zeros((2, 2))), FoundBy.FLOW, n_points=2, n_inliers=2
    )
    run.add(0, 0.0, found)
    write_hdf5(tmp_path / "result.h5", run)
    save_model(tmp_path / "model.morph", model)
    with h5py.File(tmp_path / "result.h5") as file:
        assert set(file["reactions"]) == {"end", "end%2Fleft", "100 %25", "Tr%C3%A4ger"}
    (frame,) = run_frames(tmp_path)
    assert set(frame["forces"]) == set(names)
    for force in frame["forces"].values():
        assert force == pytest.approx([20.0, 0.0, 90.0], rel=1e-6)
