"""Obstacles that would pass through a wall or begin inside of it, against places known from the shapes."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

import morph_dslam as md
from morph_dslam.errors import StudyError
from morph_dslam.mechanics.contact import RigidCylinder, RigidObstacle, RigidPlane, RigidSphere
from morph_dslam.mechanics.contact_passage import core_inside
from morph_dslam.mechanics.parameters import ParameterSymbols
from morph_dslam.mechanics.rigid_mesh import RigidMesh
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.mechanics.solvers.continuation import PassageError, PathError, advance, refuse_passage
from morph_dslam.mechanics.solvers.newton import State
from morph_dslam.mechanics.supports import fixed
from morph_dslam.meshing.generators import block, tube
from morph_dslam.studies.solid_study import SolidStudy
from morph_dslam.studies.solid_sweep import SolidSweep
from tests.support.small_systems import SmallSystem
from tests.support.solids import RUBBER, load_parameter

#: A wall 4 mm thick, from x = 0 to 4 mm, 40 mm high.
WALL = block((0.004, 0.010, 0.040), (1, 2, 10), "hex8")
MM = 1e-3


def ball(symbols: ParameterSymbols, radius: float) -> RigidMesh:
    """A ball of triangles whose middle moves along x from -2 mm on, at half the wall's width and 34 mm high."""
    shape = trimesh.creation.icosphere(2, radius=radius)
    place = (MM * symbols["push"] - 2 * MM, 5 * MM, 34 * MM)
    return RigidMesh("x_min", np.array(shape.vertices), np.array(shape.faces), place, spacing=radius / 8)


def obstacle(kind: str, symbols: ParameterSymbols, radius: float = 1.5 * MM) -> RigidObstacle:
    if kind == "mesh":
        return ball(symbols, radius)
    middle = (MM * symbols["push"] - 2 * MM, 5 * MM, 34 * MM)
    if kind == "sphere":
        return RigidSphere("x_min", middle, radius)
    return RigidCylinder("x_min", middle, (0.0, 1.0, 0.0), radius)


def wall(kind: str, push: float = 0.0, radius: float = 1.5 * MM) -> SolidProblem:
    symbols = load_parameter(push=push)
    contacts = [obstacle(kind, symbols, radius)]
    return SolidProblem(WALL, {"all": RUBBER}, [fixed("z_min")], [], symbols, contacts=contacts)


def moved(problem: SolidProblem, push: float, by: float = 0.0) -> State:
    """The wall pushed along x by ``by`` as a whole, m, with the obstacle at ``push`` mm."""
    dofs = np.zeros(problem.n_dofs)
    dofs[: problem.displacements.n_scalar] = by
    return State(np.array([push]), dofs)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["cylinder", "sphere", "mesh"])
def test_an_obstacle_behind_the_wall_has_gone_through_it(kind: str) -> None:
    """Its middle comes from 2 mm before the wall's face to 6 mm behind it; the wall stays, or gives way by as much."""
    problem = wall(kind)
    with pytest.raises(PassageError, match=rf"the {kind} passes through the surface 'x_min' on the way from push = 0"):
        refuse_passage(problem, moved(problem, 0.0), moved(problem, 8.0))
    refuse_passage(problem, moved(problem, 0.0), moved(problem, 8.0, by=8 * MM))
    # The wall may as well be what has moved; and both may go on together.
    with pytest.raises(PassageError):
        refuse_passage(problem, moved(problem, 0.0), moved(problem, 0.0, by=-8 * MM))
    refuse_passage(problem, moved(problem, -3.0), moved(problem, 0.4))


def test_what_passes_beside_the_wall_has_not_gone_through_it() -> None:
    """A rod of 1.5 mm radius, 2 mm above the wall; one that moves along itself; a plane, which has no other side."""
    symbols = load_parameter(push=0.0)
    ahead = MM * symbols["push"] - 2 * MM
    above = RigidCylinder("x_min", (ahead, 5 * MM, 42 * MM), (0.0, 1.0, 0.0), 1.5 * MM)
    along = RigidCylinder("x_min", (-2 * MM, MM * symbols["push"], 34 * MM), (0.0, 1.0, 0.0), 1.5 * MM)
    plane = RigidPlane("x_min", (ahead, 0.0, 0.0), (1.0, 0.0, 0.0))
    problem = SolidProblem(WALL, {"all": RUBBER}, [fixed("z_min")], [], symbols, contacts=[above, along, plane])
    refuse_passage(problem, moved(problem, 0.0), moved(problem, 9.0))


def finger(push: str) -> SolidStudy:
    """A finger of 2 x 6 x 40 mm that a rod of 3 mm radius, 30 mm above its root, bends by up to ``push``."""
    study = md.make_study(
        {
            "name": "finger",
            "mesh": {"generator": "block", "size": ["2 mm", "6 mm", "40 mm"], "divisions": [1, 2, 20], "cells": "hex8"},
            "materials": {"m": {"law": "neo_hookean", "young": "1 MPa", "poisson": 0.4}},
            "supports": [{"kind": "fixed", "on": "z_min"}],
            "contacts": [
                {
                    "kind": "cylinder", "on": "x_min", "point": ["push - 3.5 mm", "3 mm", "30 mm"], "axis": [0, 1, 0],
                    "radius": "3 mm",
                }
            ],
            "parameters": {"push": {"range": ["0 mm", push]}},
            "solver": {"threads": 1},
        }
    )  # fmt: skip
    assert isinstance(study, SolidStudy)
    return study


@pytest.mark.slow
def test_a_large_step_of_a_rod_bends_a_finger_as_small_ones_do() -> None:
    """At 8 mm the rod has come 7.5 mm past the finger's face; a single increment would leave the finger at rest.

    A cantilever that is bent by d at 3/4 of its length moves by 1.5 d at its end, in linear theory.
    """
    sweep = finger("8 mm").sweep_problem()
    assert isinstance(sweep, SolidSweep)
    solved = sweep.take_snapshot(sweep.advance(sweep.first_state(), np.array([8 * MM])))
    nodes = sweep.problem.mesh.nodes
    face = sweep.problem.mesh.set_nodes("x_min")
    places = (nodes + solved.fields["displacement"])[face]
    gaps = np.hypot(places[:, 0] - 4.5 * MM, places[:, 2] - 30 * MM) - 3 * MM
    assert gaps.min() > -0.02 * MM
    end = solved.fields["displacement"][nodes[:, 2] > 39.9 * MM, 0]
    assert end.mean() == pytest.approx(1.5 * 7.5 * MM, rel=0.1)


class Dragged(SmallSystem):
    """A ball that follows the parameter, x = mu, with a wall that it cannot get past."""

    def __init__(self, wall: float, parts: int = 1) -> None:
        one = np.ones((1, 1))
        super().__init__(1, lambda x, mu: x - mu, lambda x, mu: one, lambda x, mu: -one)
        self.wall, self.parts = wall, parts

    def strides(self, begin: np.ndarray, end: np.ndarray) -> int:
        return self.parts

    def passage(self, before: State, after: State) -> str | None:
        return "the ball passes through the wall" if before.dofs[0] < self.wall < after.dofs[0] else None


def test_a_path_that_ends_where_an_obstacle_would_pass_says_so() -> None:
    """Increments of a path to 4 shrink to a 64th of it, and with 8 strides to a 64th of a stride."""
    start, goal = State(np.zeros(1), np.zeros(1)), np.array([4.0])
    for parts in (1, 8):
        with pytest.raises(PathError, match="the ball passes through the wall on the way from") as failed:
            advance(Dragged(1.1, parts), start, goal)
        assert failed.value.passage is not None
        assert "limit point" not in str(failed.value)
        assert 1.1 - 4.0 / 64.0 / parts <= failed.value.states[-1].mu[0] < 1.1
    assert [state.mu[0] for state in advance(Dragged(9.0), start, goal)] == [0.0, 4.0]
    assert [state.mu[0] for state in advance(Dragged(9.0, 8), start, goal)] == [0.0, 0.5, 1.5, 3.5, 4.0]


@pytest.mark.parametrize("kind", ["cylinder", "sphere", "mesh"])
def test_an_obstacle_that_begins_in_the_solid_is_refused(kind: str) -> None:
    """At push = 4 mm its middle is half way through the wall; 1.5 mm earlier it only overlaps, and may be pushed in."""
    with pytest.raises(StudyError, match=rf"the {kind} of the contact on 'x_min' lies inside the undeformed solid"):
        wall(kind, push=4.0)
    with pytest.raises(StudyError, match="where push = 4: have it outside there"):
        wall(kind, push=4.0, radius=0.8 * MM)
    wall(kind, push=1.5)


def test_a_study_with_an_obstacle_inside_is_refused_at_once(tmp_path, refused) -> None:
    """A ball of 5 mm radius whose middle is 5 mm under the face of a cube: no point of the face is in it."""
    (tmp_path / "study.toml").write_text(
        """
name = "cube"
mesh = { generator = "block", size = ["20 mm", "20 mm", "20 mm"], divisions = [2, 2, 2], cells = "hex8" }
materials = { m = { law = "neo_hookean", young = "1 MPa", poisson = 0.3 } }
supports = [{ kind = "fixed", on = "z_min" }]
contacts = [{ kind = "sphere", on = "z_max", centre = ["10 mm", "10 mm", "15 mm - p"], radius = "5 mm" }]
parameters = { p = { range = ["0 mm", "4 mm"] } }
sampling = { training = 8, held_out = 4, refined = 0 }
"""
    )
    message = refused("build", tmp_path / "study.toml", "-o", tmp_path / "x.morph")
    assert "the sphere of the contact on 'z_max' lies inside the undeformed solid" in message
    assert "at (10, 10, 15) mm where p = 0 mm" in message


def test_a_mandrel_in_a_bore_is_not_in_the_solid() -> None:
    """The bore of the tube has a radius of 5 mm, its wall ends at 8 mm; a housing around the tube has no core."""
    mesh = tube(5 * MM, 8 * MM, 20 * MM, (4, 1, 16), "hex8")
    triangles, none = mesh.surface_triangles(), ParameterSymbols()

    def inside(body: RigidObstacle) -> int:
        return len(core_inside(body, none, mesh.nodes, triangles))

    along = (0.0, 0.0, 1.0)
    assert inside(RigidCylinder("inner", (0.0, 0.0, 0.0), along, 4 * MM)) == 0
    assert inside(RigidCylinder("inner", (6.5 * MM, 0.0, 0.0), along, 1 * MM)) > 10
    assert inside(RigidCylinder("inner", (9 * MM, 0.0, 0.0), along, 1 * MM)) == 0
    assert inside(RigidCylinder("outer", (6.5 * MM, 0.0, 0.0), along, 30 * MM, inside=True)) == 0
    assert inside(RigidSphere("outer", (0.0, 6.5 * MM, 10 * MM), 2 * MM)) == 1
    assert inside(RigidSphere("outer", (0.0, 6.5 * MM, 10 * MM), 30 * MM, inside=True)) == 0
    assert inside(RigidSphere("inner", (0.0, 0.0, 10 * MM), 2 * MM)) == 0
