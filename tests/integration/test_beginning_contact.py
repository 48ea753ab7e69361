"""A cantilever whose tip meets a stop: past it another load fits nearly as well at first, in another pose."""

import numpy as np

from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.reduction.grid_functions import functions_on_grid, interpolation_nodes, values_on_grid
from morph_dslam.reduction.task import parameter_bases
from morph_dslam.registration.registration import Registration
from morph_dslam.tracking.estimator import State
from morph_dslam.tracking.tracker import Tracker
from tests.support.bent_sheet import sheet_mesh
from tests.support.rendered_sequence import CAMERA, UPRIGHT, SheetFilm

#: How far the tip goes, metres, under the load at which it touches: 10 N of at most 45.
GAP, TOUCHING = 0.05, 10.0
LOAD = Parameter("load", "force", "N", 0.0, 45.0, 0.0, "even load along the beam")
POSE = RigidTransform(rotation_exp(np.array([0.2, -0.3, 0.0])) @ UPRIGHT, np.array([0.0, 0.0, 0.7]))


def propped_cantilever():
    """Euler and Bernoulli: s^2 (6 - 4 s + s^2) q L^4 / 24 E I, with the tip propped half of s^2 (1 - s) (3 - 2 s)."""
    nodes, triangles = sheet_mesh(43, 31)
    s = (nodes[:, 0] - nodes[:, 0].min()) / np.ptp(nodes[:, 0])
    free = -GAP * s**2 * (6.0 - 4.0 * s + s**2) / 3.0
    propped = -GAP * s**2 * (1.0 - s) * (3.0 - 2.0 * s) / 6.0
    zero = np.zeros(len(nodes))
    bases = parameter_bases("cubic_spline", (LOAD,), [46])

    def loads(mu):
        return np.array([min(mu[0], TOUCHING), max(mu[0] - TOUCHING, 0.0)]) / TOUCHING

    values = values_on_grid(loads, tuple(interpolation_nodes(basis) for basis in bases))
    functions = functions_on_grid(values, bases, "cp", 1e-9)
    modes = np.stack([np.column_stack([zero, part, zero]) for part in (free, propped)])
    return ReducedModel("propped cantilever", nodes, triangles, (LOAD,), SeparatedField(modes, functions))


def test_a_load_that_goes_on_rising_past_a_contact_is_followed():
    """The wrong load leaves 0.07 px at first, where the right one leaves 0.02."""
    model, rest = propped_cantilever(), State(np.zeros(1), POSE)
    for seed in range(2):
        film = SheetFilm(model, seed=seed)
        tracker = Tracker(model, CAMERA, Registration(model, rest), reference=film.frame(rest))
        for load in np.linspace(2.0, 44.0, 22):
            found = tracker.track(film.frame(State(np.array([load]), POSE))).estimate
            assert abs(found.state.parameters[0] - load) < 0.5
