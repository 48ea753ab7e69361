"""Unknown loads: what a soft block does where it is pressed, against statics and finite elements."""

from __future__ import annotations

import re
from dataclasses import replace

import h5py
import numpy as np
import pytest
from scipy.optimize import minimize_scalar, nnls
from scipy.stats import multivariate_normal

from morph_dslam import Camera, build, make_study
from morph_dslam.cli import app as cli
from morph_dslam.errors import ModelFileError, StudyError
from morph_dslam.geometry import RigidTransform
from morph_dslam.mechanics.load_modes import pressing_tractions, softest_tractions
from morph_dslam.mechanics.loads import FollowerPressure
from morph_dslam.mechanics.materials.isotropic import LinearElastic
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.mechanics.solvers.continuation import advance
from morph_dslam.mechanics.supports import PrescribedDisplacement, fixed
from morph_dslam.meshing.generators import block
from morph_dslam.model import Parameter, load_model, save_model
from morph_dslam.model.discrepancy import farthest_points
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.model.reduced_model import REACTION, spread_over
from morph_dslam.model.separated import SeparatedField
from morph_dslam.model.unknown_loads import LOADS, node_areas, supports_beside_loads, with_unknown_loads
from morph_dslam.studies.build import build_warnings
from morph_dslam.tracking.compact_loads import (
    LoadCovariance,
    LoadPrediction,
    SeenLoads,
    log_evidence,
    spot_displacements,
    spot_variances,
)
from morph_dslam.tracking.estimator import BoundPoints, Estimate, Estimator, Prior, State
from morph_dslam.tracking.load_prior import LoadOptions, LoadPrior
from morph_dslam.tracking.outcomes import Rejection, RejectionReason, Status
from morph_dslam.tracking.reactions import Reactions
from morph_dslam.tracking.result import FrameResult
from morph_dslam.tracking.run_notices import RunWarning, notices_of
from morph_dslam.tracking.run_results import RunResults

STUDY = {
    "name": "soft block",
    "mesh": {"generator": "block", "size": ["60 mm", "60 mm", "20 mm"], "divisions": [8, 8, 3], "cells": "hex8"},
    "materials": {"silicone": {"law": "neo_hookean", "young": "50 kPa", "poisson": "0.45"}},
    "supports": [{"kind": "fixed", "on": "z_min"}],
    "loads": [{"kind": "traction", "on": "z_max", "traction": ["shear", "0 Pa", "0 Pa"]}],
    "parameters": {"shear": {"range": ["-1 kPa", "1 kPa"], "default": "0 Pa"}},
    "solver": {"threads": 1},
    "sampling": {"scheme": "even", "training": 9, "held_out": 4, "refined": 0},
    "unknown_loads": {"on": "z_max", "modes": 25},
}
CAMERA = Camera(640, 480, 560.0, 560.0, 320.0, 240.0)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("pressed") / "block.morph"
    build(make_study(STUDY), path)
    return path


@pytest.fixture(scope="module")
def loaded(file):
    return with_unknown_loads(load_model(file), 1e-3)


def test_what_holds_the_block_balances_each_load(loaded):
    """Force and moment about the origin, in any state: the base is all that holds it."""
    for shear in (-800.0, 0.0, 500.0):
        for k in (1, 12, 25):
            mu = np.array([shear, *np.eye(25)[k - 1]])
            unloaded = np.where(np.arange(26) == 0, mu, 0.0)
            change = {name: field.value(mu) - field.value(unloaded) for name, field in loaded.reactions.items()}
            force = change[f"force_{LOADS}"][0]
            assert force[2] < 0.0
            np.testing.assert_allclose(change["force_z_min"][0], -force, atol=2e-3 * np.linalg.norm(force))
            # The shear goes with the surface that a load moves: its own moment changes by less than this.
            size = 0.06 * np.linalg.norm(force)
            np.testing.assert_allclose(change["moment_z_min"][0], -change[f"moment_{LOADS}"][0], atol=0.03 * size)


def test_a_load_has_the_arm_of_the_place_to_which_the_body_has_moved(file):
    """Statics of a body that one parameter shifts by 40, -30 and 20 mm, and makes longer by a fifth along x: about its
    own point a pressure along z keeps its arm along y, and the one along x grows by a fifth, as it does per range."""
    model, change = load_model(file), np.array([0.04, -0.03, 0.02])
    modes = (change + model.nodes * np.array([0.2, 0.0, 0.0]))[None]
    share = ParameterFunctions(model.lower, model.upper, np.array([[0], [1]]), np.array([[0.5], [0.5]]))
    moved = with_unknown_loads(replace(model, displacement=SeparatedField(modes, share)), 1e-3)
    for load in np.random.default_rng(3).random((5, 25)):
        found = []
        for shear in (-1e3, 500.0):  # where nothing and three quarters of it have happened
            state = State(np.array([shear, *(1e-6 * load)]), RigidTransform.identity())
            covariance = np.diag([20.0, *np.zeros(31)]) ** 2
            estimate = Estimate(state, 0.0, np.zeros((0, 2)), 0.3, covariance, np.zeros(26, dtype=bool), 1, True)
            found.append(Reactions(moved)(estimate)[LOADS])
        rest, now = found
        grown = np.array([1.15, 1.0, 1.0])
        np.testing.assert_allclose(now.point, grown * rest.point + 0.75 * change, atol=1e-6)
        size = 0.06 * np.linalg.norm(rest.force.value)
        np.testing.assert_allclose(now.moment.value, rest.moment.value * [1.0, 1.15, 1.0], atol=2e-4 * size)
        np.testing.assert_allclose(now.moment.std, [0.0, 0.002 * abs(rest.moment.value[1]), 0.0], atol=5e-6 * size)


def test_a_load_that_moves_the_body_itself_has_no_arm_by_that(file):
    """Statics of a body that its loads shift by up to 40 mm: about their own point they have the moment as without."""
    model, rng = load_model(file), np.random.default_rng(4)
    loads, shifts = model.unknown_loads, rng.uniform(-2e-2, 2e-2, (25, 3))
    assert loads is not None
    constant = ParameterFunctions(model.lower, model.upper, np.array([[0]]), np.ones((1, 1)))
    for load in rng.random((5, 25)):
        found = []
        for share in (0.0, 1.0):
            modes = np.tile(share * shifts.ravel(), (1, len(model.nodes), 1))
            responses = loads.responses | {"displacement": SeparatedField(modes, constant)}
            own = replace(loads, responses=responses, second_order=None)
            state = State(np.array([500.0, *load]), RigidTransform.identity())
            covariance = np.diag([20.0, *np.full(25, 0.01), *np.zeros(6)]) ** 2
            estimate = Estimate(state, 0.0, np.zeros((0, 2)), 0.3, covariance, np.zeros(26, dtype=bool), 1, True)
            found.append(Reactions(with_unknown_loads(replace(model, unknown_loads=own), 1e-3))(estimate)[LOADS])
        rest, now = found
        size = 0.06 * np.linalg.norm(rest.force.value)
        np.testing.assert_allclose(now.point, rest.point + load @ shifts, atol=1e-9)
        np.testing.assert_allclose(now.moment.value, rest.moment.value, atol=1e-9 * size)
        np.testing.assert_allclose(now.moment.std, rest.moment.std, atol=1e-9 * size)


class _Pressed:
    """The block with a pressure on its whole top, by finite elements with the pressure in them, before a camera."""

    def __init__(self, loaded, pressure):
        symbols = ParameterSymbols([Parameter("pressure", "stress", "Pa", 0.0, 1e3, 0.0)])
        study = make_study(STUDY)
        top = FollowerPressure("z_max", symbols["pressure"])
        silicone = study.problem().regions[0].material
        problem = SolidProblem(study.solid_mesh(), {"all": silicone}, [fixed("z_min")], [top], symbols)
        state = advance(problem, problem.initial_state(), np.array([pressure]))[-1]
        self.moved = problem.nodal_displacement(state.dofs)
        self.upper = (loaded.nodes[loaded.triangles][:, :, 2] > 0.0199).all(axis=1)
        spread = spread_over(loaded.nodes, loaded.triangles[self.upper], 300)
        surface = replace(spread, triangles=np.flatnonzero(self.upper)[spread.triangles])
        self.points = BoundPoints.from_surface(loaded, surface)
        corners = loaded.triangles[surface.triangles]
        places = self.points.rest + np.einsum("pc,pcx->px", surface.weights, self.moved[corners])
        tilt = np.array([[1.0, 0.0, 0.0], [0.0, -0.8, -0.6], [0.0, 0.6, -0.8]])
        self.pose = RigidTransform(tilt, np.array([-0.03, 0.03, 0.25]))
        self.pixels, self.at_rest = (CAMERA.project(self.pose.apply(x)) for x in (places, self.points.rest))
        self.known = Prior(np.zeros(26), np.zeros((26, 26)), self.pose, np.diag([1e6] * 3 + [1e8] * 3))


@pytest.fixture(scope="module")
def pressed(loaded):
    return _Pressed(loaded, 300.0)


def test_a_pressure_on_the_whole_top_is_found_from_pixels(loaded, pressed):
    """Its force is 300 Pa times the area."""
    estimator, reactions = Estimator(loaded, CAMERA), Reactions(loaded)
    estimator.loads.squared_px = 1e-6  # pixels are exact
    start = State(loaded.default, pressed.pose)
    found = estimator.estimate(pressed.points, pressed.pixels, np.ones(300), start, prior=pressed.known)
    result = reactions(found)[LOADS]
    assert result.force.value[2] == pytest.approx(-300.0 * 0.06**2, rel=0.05)
    assert np.abs(result.force.value[:2]).max() < 1e-9
    np.testing.assert_allclose(result.point[:2], [0.03, 0.03], atol=2e-3)
    on_top = np.unique(loaded.triangles[pressed.upper])
    own = loaded.displacement.value(found.state.parameters)[on_top]
    assert np.linalg.norm(own - pressed.moved[on_top]) < 0.05 * np.linalg.norm(pressed.moved[on_top])
    assert (found.state.parameters[1:] >= 0.0).all()


def test_a_load_that_comes_at_once_after_a_long_rest_is_found(loaded, pressed):
    """Nothing acts in ten frames, so loads are known to be small; then the pressure is there from one frame on."""
    estimator, reactions, rng = Estimator(loaded, CAMERA), Reactions(loaded), np.random.default_rng(5)
    state, forces = State(loaded.default, pressed.pose), []
    for exact in [pressed.at_rest] * 10 + [pressed.pixels] * 12:
        pixels = exact + rng.normal(0.0, 0.2, exact.shape)
        found = estimator.estimate(pressed.points, pixels, np.ones(300), state, prior=pressed.known)
        estimator.loads.learn(found.state.parameters, found.covariance, found.sigma_px)
        state = found.state
        forces.append(reactions(found)[LOADS].force.value[2] / (300.0 * 0.06**2))
    assert np.abs(forces[5:10]).max() < 0.05
    # From the third frame on; a frame alone is as exact as its noise of 0.2 px lets it be.
    assert np.mean(forces[12:]) == pytest.approx(-1.0, abs=0.05)
    assert np.std(forces[12:]) < 0.12


def test_the_softest_traction_of_a_guided_block_is_uniform():
    """Without sideways motion and with nu = 0 it gives way by height / Young's modulus for each pascal."""
    mesh = block((0.03, 0.02, 0.04), (3, 2, 4), "hex8")
    guides = [PrescribedDisplacement(side, **{side[0]: 0.0}) for side in ("x_min", "x_max", "y_min", "y_max", "z_min")]
    problem = SolidProblem(mesh, {"all": LinearElastic(young=2e5, poisson=0.0)}, guides)
    tangent = problem.linearise(problem.initial_state().dofs, np.empty(0))
    surface = problem.loaded_surface("z_max", inward=True)
    tractions, softness = softest_tractions(surface, tangent.solve, 3)
    assert softness[0] == pytest.approx(0.04 / 2e5, rel=1e-6)
    assert softness[1] < softness[0]
    np.testing.assert_array_equal(surface.nodes, np.flatnonzero(np.isclose(mesh.nodes[:, 2], 0.04)))
    uniform = 1.0 / np.sqrt(0.03 * 0.02)
    np.testing.assert_allclose(np.abs(surface.nodal(tractions[:1])[0, :, 2]), uniform, rtol=1e-6)


@pytest.mark.parametrize("cells", ["hex8", "hex20", "hex27", "tet10", "prism15"])
def test_pressures_are_bumps_at_the_nodes_of_the_surface(cells):
    """The logarithm of a Gaussian falls with the squared distance, alike for all; nothing acts below the surface."""
    mesh = block((0.03, 0.02, 0.01), (4, 3, 2), cells)
    problem = SolidProblem(mesh, {"all": LinearElastic(young=2e5, poisson=0.3)}, [fixed("z_min")])
    surface = problem.loaded_surface("z_max", inward=True)
    np.testing.assert_array_equal(surface.nodes, np.flatnonzero(np.isclose(mesh.nodes[:, 2], 0.01)))
    pressures = -surface.nodal(pressing_tractions(surface, mesh.nodes, 6))[:, :, 2]
    x, y, _ = 100.0 * mesh.nodes[surface.nodes].T
    falls = []
    for pressure in pressures:
        seen = pressure > 1e-12
        terms = np.column_stack([np.ones(len(x)), x, y, x**2 + y**2])[seen]
        fall, residual, rank, _ = np.linalg.lstsq(terms, np.log(pressure[seen]), rcond=None)
        assert (rank, seen.sum() > 8, float(residual[0]) < 1e-12) == (4, True, True)
        falls.append(fall[3])
    np.testing.assert_allclose(falls, falls[0], rtol=1e-6)
    assert falls[0] < 0.0


@pytest.mark.parametrize("cells", ["hex8", "hex20", "hex27", "tet10"])
def test_the_resultant_of_pressures_is_what_the_support_holds(cells):
    """Statics, by reactions that finite elements add up."""
    mesh = block((0.03, 0.02, 0.01), (3, 2, 1), cells)
    problem = SolidProblem(mesh, {"all": LinearElastic(young=2e5, poisson=0.3)}, [fixed("z_min")])
    state = problem.initial_state()
    surface = problem.loaded_surface("z_max", inward=True)
    tractions = 1e-3 * pressing_tractions(surface, mesh.nodes, 4)
    changes = problem.linearise(state.dofs, state.mu).solve(surface.loads(tractions))
    for change, resultant in zip(changes, surface.resultants(tractions), strict=True):
        force, moment = problem.reactions(state.dofs + change, state.mu, "z_min", about=np.zeros(3))
        np.testing.assert_allclose(force, -resultant[:3], atol=1e-5 * abs(resultant[2]))
        np.testing.assert_allclose(moment, -resultant[3:], atol=1e-5 * 0.03 * abs(resultant[2]))


def test_the_place_of_a_ball_is_read_from_coarse_loads(loaded):
    """Hertz's pressure about random places, by loads that are 12 mm apart; its radius is 12 mm, too."""
    loads, reactions, rng = loaded.energy.loads, Reactions(loaded), np.random.default_rng(0)
    areas, errors = np.sqrt(node_areas(loaded, loads.nodes)), []
    for place in rng.uniform(0.015, 0.045, (40, 2)):
        distance = np.linalg.norm(loaded.nodes[loads.nodes, :2] - place, axis=1)
        pressure = np.sqrt(np.maximum(1.0 - (distance / 0.012) ** 2, 0.0))
        coefficients, _ = nnls(-loads.tractions[:, 2] * areas[:, None], pressure * areas)
        point, force = reactions.forces(np.array([0.0, *(1e-3 * coefficients / coefficients.max())]))[LOADS]
        assert force[2] < 0.0
        errors.append(np.linalg.norm(point[:2] - place))
    assert np.mean(errors) < 2e-3
    assert np.max(errors) < 4e-3


def test_terms_of_the_prior_agree_with_differences(loaded):
    prior, rng = LoadPrior(loaded.energy, LoadOptions()), np.random.default_rng(1)
    at = np.array([300.0, *(0.03 * rng.random(25))])
    prior.learn(at, np.diag([1.0, *np.full(25, 1e-4)]), 0.5)
    here = at + np.array([50.0, *(0.01 * rng.standard_normal(25))])
    _, hessian, gradient = prior.terms(here)
    assert hessian.shape == (25, 25)
    # They do not depend on the other parameters.
    assert prior.terms(here + np.eye(26)[0])[0] == prior.terms(here)[0]
    for k in range(25):
        change = 1e-5 * np.eye(26)[1 + k]
        slope = (prior.terms(here + change)[0] - prior.terms(here - change)[0]) / 2e-5
        assert gradient[k] == pytest.approx(slope, rel=1e-4, abs=1e-6 * np.abs(gradient).max())
    assert np.linalg.eigvalsh(hessian).min() > 0.0


def test_what_is_found_counts_for_the_next_frame_once_scales_are_known(loaded):
    """The same loads in each frame, measured to a thousandth of their usual deviation but for one combination."""
    prior, at = LoadPrior(loaded.energy, LoadOptions()), np.array([300.0, *np.linspace(0.01, 0.03, 25)])
    exact = np.eye(25) - 0.999 * np.full((25, 25), 1.0 / 25.0)
    covariance = np.eye(26)
    covariance[1:, 1:] = np.linalg.inv(1e8 * exact)
    means = []
    for _ in range(8):
        means.append(prior.known.mean / at[1:])
        prior.learn(at, covariance, 0.3)
    np.testing.assert_array_equal(means[:6], 0.0)
    np.testing.assert_allclose(means[6:], 0.8)
    prior.forget()
    np.testing.assert_array_equal(prior.known.mean, 0.0)


def test_a_frame_whose_points_are_too_few_for_a_deviation_teaches_none(loaded):
    """A prior of infinite weight would end the next frame; the deviation of the frame before holds."""
    prior = LoadPrior(loaded.energy, LoadOptions())
    at, few = np.full(26, 0.1), np.full((26, 26), np.inf)
    prior.learn(at, np.eye(26), 0.3)
    before = prior.terms(at)
    prior.learn(at, few, np.inf)
    cost, information, push = prior.terms(at)
    assert cost == pytest.approx(before[0], rel=1e-9)
    assert information == pytest.approx(before[1], rel=1e-9)
    assert push == pytest.approx(before[2], rel=1e-9)


def test_a_stated_work_scale_stays(loaded):
    prior = LoadPrior(loaded.energy, LoadOptions(work=1e-3))
    at = np.array([300.0, *np.full(25, 0.02)])
    prior.learn(at, np.diag([1.0, *np.full(25, 1e-6)]), 0.3)
    energy = loaded.energy.loads.compliance(at[:1])
    np.testing.assert_allclose(prior.known.inverse, energy / 1e-3, rtol=1e-8, atol=1e-6)
    np.testing.assert_array_equal(prior.known.mean, 0.0)


@pytest.fixture(scope="module")
def displacements(loaded):
    return spot_displacements(loaded.energy.model, loaded.energy.loads)


def test_spots_do_the_work_that_loads_do_on_what_they_cause(loaded, displacements):
    """Reciprocity: finite elements solved with the pressure of a spot, whose displacement each load works on."""
    loads, model, problem = loaded.energy.loads, loaded.energy.model, make_study(STUDY).problem()
    assert displacements.shape == (25, 3 * len(loads.nodes))
    surface = problem.loaded_surface("z_max", inward=True)
    tangent = problem.linearise(problem.initial_state().dofs, np.zeros(1))
    positions = model.nodes[loads.nodes]
    places = positions[farthest_points(positions, len(positions))]
    spot = np.linalg.norm(places[:, :2] - 0.03, axis=1).argmin()
    # Of the widest spots, three times as wide as the nodes are apart.
    shape = np.exp(-0.5 * (np.linalg.norm(model.nodes[surface.nodes] - places[spot], axis=1) / 0.0225) ** 2)
    coefficients = (surface.from_nodes @ shape)[None, None]
    force = np.linalg.norm(surface.resultants(coefficients)[0, :3])
    moved = problem.nodal_displacement(tangent.solve(surface.loads(coefficients))[0] / force)[loads.nodes]
    work = np.einsum("n,ncm,nc->m", node_areas(model, loads.nodes), loads.tractions, moved)
    # A spot's force points outwards, along the normal, and so against the pressure.
    found = displacements[:, 2 * len(loads.nodes) + spot]
    np.testing.assert_allclose(found, -work, atol=0.05 * np.abs(work).max())


def _estimated(information, gradient, prior):
    """The information and the loads of a frame that measures these, with this prior times 0.7 beside."""
    known = information + 0.7 * prior.inverse
    return known, np.linalg.solve(known, gradient + 0.7 * prior.inverse @ prior.mean)


def test_what_a_frame_shows_is_separated_from_the_prior(loaded, displacements):
    """Twelve combinations of 25 loads are measured; of the rest the frame shows nothing."""
    rng, compliance = np.random.default_rng(2), loaded.energy.loads.compliance(loaded.default[:1])
    rows = 300.0 * rng.standard_normal((12, 25))
    truth = 0.05 * rng.standard_normal(25)
    covariance = LoadCovariance(compliance, 1e-3, 0.1 * displacements[:, [3, 90]]).value
    prior = LoadPrediction(0.05 * rng.standard_normal(25), covariance)
    known, found = _estimated(rows.T @ rows, rows.T @ (rows @ truth), prior)
    seen = SeenLoads.of(known, found, prior, compliance, displacements)
    forces = np.linalg.solve(compliance, displacements)
    assert len(seen.values) == 12
    scale = np.abs(rows @ forces).max()
    np.testing.assert_allclose(seen.spots.T @ seen.spots, (rows @ forces).T @ (rows @ forces), atol=1e-6 * scale**2)
    np.testing.assert_allclose(seen.spots.T @ seen.values, forces.T @ rows.T @ (rows @ truth), atol=1e-5 * scale**2)
    assert SeenLoads.of(0.7 * prior.inverse, found, prior, compliance, displacements) is None


def test_the_evidence_is_that_of_a_gaussian():
    """Against scipy's density, which knows nothing of spots."""
    rng = np.random.default_rng(3)
    frames = [SeenLoads(10.0 ** rng.uniform(0, 3, 9), rng.standard_normal((9, 20)), rng.normal(0, 4, 9)) for _ in "ab"]
    cases = [(np.zeros(20), 1e-3), (np.where(np.arange(20) % 7 == 1, 2.0, 0.0), 0.02), (np.full(20, 0.3), 0.5)]

    def density(variances, work):
        covariances = [np.diag(1.0 + work * f.information) + (f.spots * variances) @ f.spots.T for f in frames]
        return sum(multivariate_normal(cov=c).logpdf(f.values) for c, f in zip(covariances, frames, strict=True))

    first = cases[0]
    for case in cases[1:]:
        expected = density(*case) - density(*first)
        assert log_evidence(frames, *case) - log_evidence(frames, *first) == pytest.approx(expected, rel=1e-9)


def test_spots_that_a_frame_hardly_distinguishes_share_the_variance_by_their_evidence():
    """Each alone by the maximum of scipy's density, two of them nearly alike."""
    rng, work = np.random.default_rng(5), 0.01
    information, spots = 10.0 ** rng.uniform(0, 3, 9), rng.standard_normal((9, 5))
    spots[:, 3] = spots[:, 1] + 0.1 * rng.standard_normal(9)
    seen = SeenLoads(information, spots, 6.0 * spots[:, 1] + rng.normal(0.0, np.sqrt(1.0 + work * information)))
    values, evidence = [], []
    for spot in spots.T:

        def density(log_variance, spot=spot):
            covariance = np.diag(1.0 + work * information) + np.exp(log_variance) * np.outer(spot, spot)
            return -multivariate_normal(cov=covariance).logpdf(seen.values)

        best = minimize_scalar(density, bounds=(-20.0, 10.0), method="bounded", options={"xatol": 1e-9})
        values.append(np.exp(best.x))
        evidence.append(-best.fun)
    shares = np.exp(np.array(evidence) - max(evidence))
    expected = np.array(values) * shares / shares.sum()
    assert 0.02 < expected[3] / expected[1] < 50.0
    np.testing.assert_allclose(spot_variances([seen], work), expected, rtol=1e-3, atol=1e-3 * expected.max())


def _frames(loaded, displacements, force, rng):
    """Five frames that measure all loads, those of forces (s,) on spots, to a hundredth of their usual size."""
    compliance = loaded.energy.loads.compliance(loaded.default[:1])
    prior = LoadPrediction(np.zeros(25), LoadCovariance(compliance, 1e-3, np.empty((25, 0))).value)
    true = np.linalg.solve(compliance, displacements @ force)
    information, frames = compliance / 1e-7, []
    for _ in range(5):
        noise = np.linalg.solve(np.linalg.cholesky(information).T, rng.standard_normal(25))
        # A combination that is not seen, lest the prior's factor be taken for a measurement.
        blind = information - information[:, :1] @ information[:1] / information[0, 0]
        known, found = _estimated(blind, blind @ (true + noise), prior)
        frames.append(SeenLoads.of(known, found, prior, compliance, displacements))
    return frames


def test_a_spot_that_presses_is_found_and_none_in_noise(loaded, displacements):
    rng, force = np.random.default_rng(4), np.zeros(displacements.shape[1])
    quiet = [spot_variances(_frames(loaded, displacements, force, rng), 1e-9) for _ in range(20)]
    assert sum((variances > 0.0).any() for variances in quiet) <= 2
    places = loaded.nodes[loaded.energy.loads.nodes]
    places = np.tile(places[farthest_points(places, len(places))], (3, 1))
    pressed = np.linalg.norm(places - [0.02, 0.035, 0.02], axis=1).argmin()
    force[pressed] = 0.5
    variances = spot_variances(_frames(loaded, displacements, force, rng), 1e-9)
    centre = variances @ places / variances.sum()
    assert np.linalg.norm(centre - places[pressed]) < 2e-3
    assert variances.sum() == pytest.approx(0.25, rel=0.3)
    assert (variances > 0.0).sum() <= 4


def test_a_model_file_keeps_its_loads_and_is_checked(file, tmp_path):
    model = load_model(file)
    save_model(tmp_path / "again.morph", model)
    again = load_model(tmp_path / "again.morph")
    assert again.unknown_loads.inward
    np.testing.assert_array_equal(again.unknown_loads.tractions, model.unknown_loads.tractions)
    mu = np.array([400.0])
    for name, field in model.unknown_loads.responses.items():
        np.testing.assert_allclose(again.unknown_loads.responses[name].value(mu), field.value(mu), rtol=1e-5, atol=1e-9)
    lacking = {k: v for k, v in model.unknown_loads.responses.items() if k != f"{REACTION}force_z_min"}
    with pytest.raises(ValueError, match="does not say what unknown loads do to 'reaction_force_z_min'"):
        save_model(
            tmp_path / "bad.morph", replace(model, unknown_loads=replace(model.unknown_loads, responses=lacking))
        )
    with h5py.File(file) as content:
        assert content["unknown_loads"].attrs["surface"] == "z_max"


def test_the_certificate_says_how_well_responses_are_known(file):
    certificate = load_model(file).certificate
    assert certificate["unknown_loads"]["loads"] == 25
    assert 0.0 < certificate["unknown_loads"]["response_error"] < 0.05
    assert not [text for text in build_warnings(certificate) if "unknown loads" in text]
    certificate["unknown_loads"]["response_error"] = 0.3
    assert [text for text in build_warnings(certificate) if "off by 30 %" in text]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("section", "count"),
    [
        # Of the 9 nodes of the side 3 are held: 6 can move, each in three directions.
        ({"on": "x_max", "direction": "any", "modes": 300}, 18),
        # Places on the held bottom move nothing.
        ({"on": ["x_max", "z_min"], "direction": "any", "modes": 300}, 18),
        ({"on": "x_max", "modes": 300}, 9),
    ],
)
def test_a_small_surface_has_as_many_loads_as_can_move_it(section, count):
    small = {"generator": "block", "size": ["20 mm"] * 3, "divisions": [2, 2, 2], "cells": "hex8"}
    model = build(make_study(STUDY | {"mesh": small, "unknown_loads": section}))
    assert model.unknown_loads.count == model.certificate["unknown_loads"]["loads"] == count
    assert all(np.isfinite(field.modes).all() for field in model.unknown_loads.responses.values())


def test_mistakes_are_one_message(file, tmp_path, capsys):
    with pytest.raises(StudyError, match=r"no surface 'lid'; it has: .*z_max"):
        build(make_study(STUDY | {"unknown_loads": {"on": "lid"}}), tmp_path / "x.morph")
    with pytest.raises(StudyError, match=r"unknown_loads\.direction"):
        make_study(STUDY | {"unknown_loads": {"on": "z_max", "direction": "outward"}})
    bare = replace(load_model(file), unknown_loads=None)
    with pytest.raises(ModelFileError, match="no unknown loads: build it again with"):
        with_unknown_loads(bare)
    assert cli.main(["info", str(file)]) == 0
    assert re.search(r"unknown loads", capsys.readouterr().out)


def test_supports_that_move_beside_loads_are_named(loaded):
    """The base is far from the loads on top, and stands still; an edge of the top moves with the shear."""
    height = loaded.nodes[:, 2]
    assert supports_beside_loads(loaded) == []
    edge = np.flatnonzero((height == height.max()) & (loaded.nodes[:, 0] == loaded.nodes[:, 0].max()))
    named = replace(loaded, supports=loaded.supports | {"edge": edge})
    assert supports_beside_loads(named) == ["edge"]
    sides = np.flatnonzero((height > height.min()) & (height < height.max()))
    assert supports_beside_loads(replace(loaded, supports={"z_min": loaded.supports["z_min"], LOADS: sides})) == []
    assert supports_beside_loads(loaded.without_loads) == []
    run = RunResults(named, 0)
    run.add(0, 0.0, FrameResult(named, Status.LOST, rejection=Rejection(RejectionReason.FEW_FEATURES)))
    (notice,) = [notice for notice in notices_of(run) if notice.warning is RunWarning.LOADS_BESIDE_SUPPORT]
    assert "up to the edge of 'edge'" in notice.text


@pytest.mark.slow
def test_places_that_are_held_have_no_loads():
    """A pressure there would move nothing: of unit compliance, its force would be beyond all others."""
    skin = {"skin": {"box": [["-1 mm"] * 3, ["61 mm"] * 3]}}
    content = STUDY | {
        "mesh": STUDY["mesh"] | {"divisions": [6, 6, 2]},
        "sets": skin,
        "sampling": {"scheme": "even", "training": 8, "held_out": 4, "refined": 0},
        "unknown_loads": {"on": "skin", "modes": 60},
    }
    model = build(make_study(content))
    loads = model.unknown_loads
    forces = np.linalg.norm(loads.resultants[:, :3], axis=1)
    assert forces.max() < 10.0 * np.median(forces)
    # The base is 36 of 120 square centimetres, and those at its rim reach what moves.
    assert 60 * (1.0 - 36.0 / 120.0) <= loads.count < 60
