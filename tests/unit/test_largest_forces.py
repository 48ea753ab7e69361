"""Which force of a run is its largest, and which displacement of a point: closed-form lengths and deviations."""

from types import SimpleNamespace

import numpy as np
import pytest

from morph_dslam.tracking import run_folder
from morph_dslam.tracking.reactions import Reaction, VectorEstimate
from morph_dslam.tracking.run_folder import largest_of_points
from tests.support.stretched_block import stretched_block_model

NOTHING = VectorEstimate.of(np.zeros(3), np.zeros((3, 3)))


def run_of(frames, support, forces, mistaken=(), torn=()):
    """A run with these forces on its one support."""
    reactions = {support: [Reaction(np.zeros(3), force, NOTHING) for force in forces]}
    return SimpleNamespace(
        model=stretched_block_model(),
        frames=frames,
        reactions=lambda: reactions,
        mistaken_frames=frozenset(mistaken),
        torn_frames=frozenset(torn),
    )


def largest_forces(run, held=()):
    """Of a run in whose frames ``held`` the first of two parameters is at an end of its range."""
    return run_folder.largest_forces(run, np.array([[frame in held, False] for frame in run.frames]))


def test_the_largest_force_is_that_which_is_largest_for_certain():
    """3 N along z to 0.1 N; 5 N, of which 4 N along y are known to 3 N; and 3.1 N of which nothing is known."""
    forces = [
        VectorEstimate.of(np.array([0.0, 0.0, 3.0]), 0.01 * np.eye(3)),
        VectorEstimate.of(np.array([0.0, 4.0, 3.0]), np.diag([0.01, 9.0, 0.01])),
        VectorEstimate.of(np.array([0.0, 3.1, 0.0]), np.full((3, 3), np.inf)),
    ]
    (largest,) = largest_forces(run_of([4, 5, 6], "tip", forces))
    assert (largest["frame"], largest["force_N"]) == (4, 3.0)
    assert largest_forces(run_of([5, 6], "tip", forces[1:]))[0]["frame"] == 5


def test_no_force_at_all_is_as_uncertain_as_its_least_known_direction():
    """A poke of 56 mN known to 49 mN, and frames in which nothing is found, to 252 mN in one direction."""
    nothing = VectorEstimate.of(np.zeros(3), np.diag([0.01, 0.252, 0.05]) ** 2)
    assert nothing.size_std == pytest.approx(0.252)
    poke = VectorEstimate.of(np.array([0.0, 0.0, -0.056]), np.diag([0.01, 0.01, 0.049]) ** 2)
    (largest,) = largest_forces(run_of([0, 1, 12], "unknown loads", [nothing, nothing, poke]))
    assert (largest["frame"], largest["force_N"]) == (12, pytest.approx(0.056))
    assert largest["standard_deviation_N"] == pytest.approx(0.049)


@pytest.mark.parametrize("certain", [False, True])
def test_where_no_force_is_told_from_zero_the_largest_that_may_have_acted_is_given(certain):
    """0.8 N to 7.6 N, 120 N to 330 N and 200 N of which nothing is known; 10 N to 2 N is certain."""
    known = [(0.8, 7.6), (120.0, 330.0), (200.0, np.inf)] + [(10.0, 2.0)] * certain
    forces = [VectorEstimate.of(np.array([size, 0.0, 0.0]), std**2 * np.ones((3, 3))) for size, std in known]
    (largest,) = largest_forces(run_of([3, 4, 5, 6][: len(known)], "x_min", forces))
    figures = largest["differs_from_zero"], largest["frame"], largest["force_N"], largest["standard_deviation_N"]
    assert figures == (certain, *((6, 10.0, 2.0) if certain else (4, 120.0, pytest.approx(330.0))))


@pytest.mark.parametrize(
    ("mistaken", "torn", "frame"), [((), (), 6), ((6,), (), 5), ((6,), (5, 6), 4), ((4, 5), (6,), 6)]
)
def test_a_frame_that_is_not_to_be_relied_on_has_not_the_largest_force(mistaken, torn, frame):
    """1 N, 2 N and 3 N; if all frames are doubtful, they have to do."""
    forces = [VectorEstimate.of(np.array([size, 0.0, 0.0]), 1e-4 * np.eye(3)) for size in (1.0, 2.0, 3.0)]
    (largest,) = largest_forces(run_of([4, 5, 6], "tip", forces, mistaken, torn))
    assert (largest["frame"], largest["force_N"]) == (frame, frame - 3.0)


def test_a_force_beyond_the_range_of_a_parameter_is_named():
    forces = [VectorEstimate.of(np.array([size, 0.0, 0.0]), 1e-4 * np.eye(3)) for size in (1.0, 2.0, 3.0)]
    run = run_of([4, 5, 6], "tip", forces)
    assert [largest_forces(run, held)[0]["at_bound"] for held in ((), (4, 5), (6,))] == [[], [], ["stretch"]]


@pytest.mark.parametrize(("mistaken", "torn", "frame"), [((), (), 6), ((6,), (5, 6), 5), ((4, 5, 6), (), 6)])
def test_a_frame_that_is_not_to_be_relied_on_has_not_the_largest_displacement_of_a_point(mistaken, torn, frame):
    """4 mm, 5 mm and 6 mm, and as many degrees; behind a crack a point is seen to move as ever."""
    moved, turned = (
        [VectorEstimate.of(np.array([factor * size, 0.0, 0.0]), 1e-12 * np.eye(3)) for size in (4.0, 5.0, 6.0)]
        for factor in (1e-3, np.radians(1.0))
    )
    run = run_of([4, 5, 6], "tip", [], mistaken, torn)
    run.points, run.results = SimpleNamespace(rest=np.zeros((1, 3))), []
    run.point_displacements, run.point_turns = lambda: {"tip": moved}, lambda: {"tip": turned}
    (largest,) = largest_of_points(run)
    assert (largest["frame"], largest["rotation_frame"]) == (frame, frame)
    assert (largest["displacement_mm"], largest["rotation_deg"]) == pytest.approx((frame, frame))
