"""Sets that move as rigid bodies under remote forces and moments, against closed forms and prescribed motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.contact import RigidPlane, RigidSphere
from morph_dslam.mechanics.coupled_solid import CoupledSolid
from morph_dslam.mechanics.couplings import Coupling, Motion, Rotation as CoupledRotation
from morph_dslam.mechanics.kinematics import ShapeField
from morph_dslam.mechanics.loads import DeadTraction, FollowerPressure
from morph_dslam.mechanics.materials.isotropic import NeoHookean, StVenantKirchhoff
from morph_dslam.mechanics.solid import SolidOptions, SolidProblem
from morph_dslam.mechanics.solvers.continuation import loaded_state
from morph_dslam.mechanics.solvers.newton import State, sensitivities, solve
from morph_dslam.mechanics.solvers.stability import unstable_directions
from morph_dslam.mechanics.supports import PrescribedDisplacement, RigidRotation, fixed
from morph_dslam.meshing.generators import block, tube
from tests.support.solids import RUBBER, load_parameter, solved

Array = NDArray[np.float64]
BAR = block((1.0, 0.3, 0.2), (3, 1, 1), "hex8")


def test_an_end_moment_bends_a_beam_into_a_half_circle() -> None:
    """Angle M L / E I, the tip at (L / angle) (sin, 1 - cos): to (height / radius)^2 / 3."""
    young, height, length = 1e7, 0.05, 1.0
    symbols = load_parameter(angle=0.0)
    moment = symbols["angle"] * young * height**4 / 12.0 / length
    beam = CoupledSolid(
        [Coupling("x_max", moment=(0.0, 0.0, moment))],
        block((length, height, height), (12, 1, 1), "hex20"),
        {"all": StVenantKirchhoff(young=young, poisson=0.0)},
        [fixed("x_min")],
        parameters=symbols,
    )
    state = solved(beam, np.pi)
    (translation, rotation) = np.split(beam.motions(state.dofs)[0], 2)
    np.testing.assert_allclose(rotation, [0.0, 0.0, np.pi], atol=0.01 * np.pi)
    np.testing.assert_allclose(translation, [-length, 2.0 * length / np.pi, 0.0], atol=0.01 * length)


def test_an_end_moment_twists_a_tube() -> None:
    """Angle M L / G J of a thin-walled and a thick tube alike, J the polar moment; rounds do not warp."""
    inner, outer, length, shear = 0.010, 0.015, 0.06, 1e6
    polar = np.pi / 2.0 * (outer**4 - inner**4)
    pipe = CoupledSolid(
        [Coupling("top", moment=(0.0, 0.0, 1e-3 * shear * polar / length))],
        tube(inner, outer, length, (2, 1, 24), cell_type="hex20"),
        {"all": StVenantKirchhoff(young=2.6 * shear, poisson=0.3)},
        [fixed("bottom")],
    )
    motion = pipe.motions(solved(pipe).dofs)[0]
    np.testing.assert_allclose(motion[5], 1e-3, rtol=2e-3)
    np.testing.assert_allclose(motion[[0, 1, 3, 4]], 0.0, atol=1e-7)


FORCE, MOMENT, POINT = (40.0, 300.0, -200.0), (20.0, -60.0, 150.0), (1.2, 0.1, -0.3)


def loaded_bar(mixed: bool | None = None, turned: Array | None = None) -> tuple[CoupledSolid, State]:
    """A rubber bar with a remote load far to the side of its end, all of it ``turned`` by a matrix."""
    Q = np.eye(3) if turned is None else turned
    force, moment, point = (tuple((Q @ v).tolist()) for v in (FORCE, MOMENT, POINT))
    mesh = replace(BAR, nodes=BAR.nodes @ Q.T)
    rubber, options = {"all": NeoHookean(young=3e5, poisson=0.45)}, SolidOptions(mixed=mixed)
    problem = CoupledSolid([Coupling("x_max", force, moment, point)], mesh, rubber, [fixed("x_min")], options=options)
    return problem, loaded_state(problem, np.zeros(0))


@pytest.mark.parametrize("mixed", [None, True])
def test_the_set_moves_as_a_support_that_turns_it_so_with_the_remote_load_as_its_reaction(mixed: bool | None) -> None:
    problem, state = loaded_bar(mixed)
    translation, vector = np.split(problem.motions(state.dofs)[0], 2)
    angle = float(np.linalg.norm(vector))
    assert angle > 0.5
    support = RigidRotation("x_max", tuple(vector), angle, POINT, tuple(translation))
    held = SolidProblem(
        BAR, {"all": NeoHookean(young=3e5, poisson=0.45)}, [fixed("x_min"), support], options=problem.options
    )
    other = loaded_state(held, np.zeros(0))
    expected = held.nodal_displacement(other.dofs)
    np.testing.assert_allclose(problem.nodal_displacement(state.dofs), expected, atol=1e-7)
    force, moment = held.reactions(other.dofs, other.mu, "x_max", np.array(POINT) + translation)
    np.testing.assert_allclose(force, FORCE, atol=1e-4 * np.linalg.norm(FORCE))
    np.testing.assert_allclose(moment, MOMENT, atol=1e-4 * np.linalg.norm(MOMENT))
    np.testing.assert_allclose(problem.strain_energy(state.dofs, state.mu), held.strain_energy(other.dofs, other.mu))


def test_support_and_remote_load_balance() -> None:
    problem, state = loaded_bar()
    force, moment = problem.reactions(state.dofs, state.mu, "x_min", np.zeros(3))
    point = np.array(POINT) + problem.motions(state.dofs)[0, :3]
    np.testing.assert_allclose(force, -np.array(FORCE), atol=1e-6 * np.linalg.norm(FORCE))
    np.testing.assert_allclose(moment, -(np.array(MOMENT) + np.cross(point, FORCE)), atol=1e-5)


def test_a_plate_that_is_pushed_against_a_wall_shares_its_force_with_the_solid() -> None:
    push = 3e3
    problem = CoupledSolid(
        [Coupling("x_max", (push, 0.0, 0.0))],
        BAR,
        {"all": NeoHookean(young=3e5, poisson=0.45)},
        [fixed("x_min")],
        contacts=[RigidPlane("x_max", (1.05, 0.0, 0.0), (-1.0, 0.0, 0.0))],
    )
    state = loaded_state(problem, np.zeros(0))
    translation, rotation = np.split(problem.motions(state.dofs)[0], 2)
    np.testing.assert_allclose(translation[0], 0.05, atol=1e-3)
    np.testing.assert_allclose(rotation, 0.0, atol=1e-8)
    wall = problem.contact_forces(state.dofs, state.mu, 0)[0].sum()
    held, _ = problem.reactions(state.dofs, state.mu, "x_min")
    assert wall < -0.5 * push
    np.testing.assert_allclose(wall + held[0], -push, rtol=1e-6)


def pressed_block(held: bool) -> SolidProblem:
    """A block on whose top, a coupled set or a face that a support moves onto it, a ball presses."""
    symbols = load_parameter(down=0.08, side=0.13)
    mesh = block((1.0, 1.0, 1.0), (3, 3, 2), "hex8")
    down, side = symbols["down"], symbols["side"]
    centre = (0.63, 0.5, 1.3) if held else (0.5 + side, 0.5, 1.3 - down)
    moved = [PrescribedDisplacement("z_max", side - 0.13, 0.0, down)] if held else []
    solid = mesh, {"all": NeoHookean(young=1e5, poisson=0.3)}, [fixed("z_min"), *moved], [], symbols
    contacts = [RigidSphere("z_max", centre, 0.3)]
    return (
        SolidProblem(*solid, contacts=contacts)
        if held
        else CoupledSolid([Coupling("z_max")], *solid, contacts=contacts)
    )


def test_derivatives_where_contact_presses_on_a_coupled_set() -> None:
    """Its pressure, above Young's modulus, turns with the ball's normals: all of that counts at equilibrium."""
    problem = pressed_block(held=False)
    state = loaded_state(problem, problem.symbols.default)
    for slope, change in zip(sensitivities(problem, state), 1e-5 * np.eye(2), strict=True):
        ends = [solve(problem, state.mu + sign * change, state).dofs for sign in (1.0, -1.0)]
        expected = (ends[0] - ends[1]) / 2e-5
        np.testing.assert_allclose(slope, expected, atol=1e-5 * np.abs(expected).max())


def test_derivatives_of_reactions_where_contact_presses_on_a_held_face() -> None:
    problem = pressed_block(held=True)
    state = loaded_state(problem, problem.symbols.default)
    tangent, applied = problem.linearise(state.dofs, state.mu), problem.residual_slopes(state.dofs, state.mu)
    slopes = sensitivities(problem, state, tangent)
    given = slopes, tangent.apply(slopes) + applied, "z_max", np.zeros(3)
    found = problem.reaction_slopes(state.dofs, state.mu, *given)
    for index, change in enumerate(1e-5 * np.eye(2)):
        ends = [solve(problem, state.mu + sign * change, state) for sign in (1.0, -1.0)]
        parts = [problem.reactions(end.dofs, end.mu, "z_max", np.zeros(3)) for end in ends]
        for slope, ahead, behind in zip(found, *parts, strict=True):
            expected = (ahead - behind) / 2e-5
            np.testing.assert_allclose(slope[index], expected, atol=1e-5 * np.abs(expected).max())


def test_a_turned_problem_has_the_turned_solution() -> None:
    Q = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
    (problem, state), (_, other) = loaded_bar(), loaded_bar(turned=Q)
    motion, turned = (problem.motions(s.dofs)[0].reshape(2, 3) for s in (state, other))
    np.testing.assert_allclose(turned, motion @ Q.T, atol=1e-8)


def slender_beam(left: Coupling | None, right: Coupling) -> CoupledSolid:
    """A beam along x of length 1 m with E I = 1 N m2, fixed on the left where there is no coupling."""
    width = 0.04
    couplings = [right] if left is None else [left, right]
    return CoupledSolid(
        couplings,
        block((1.0, width, width), (6, 1, 1), "hex20"),
        {"all": StVenantKirchhoff(young=12.0 / width**4, poisson=0.0)},
        [fixed("x_min")] if left is None else [],
    )


def test_a_hinged_beam_turns_and_leans_on_its_hinges() -> None:
    """A moment M at an end of a beam on two hinges turns it by M L / 3 E I, the other end back by half of that."""
    moment = 1e-3
    left = Coupling("x_min", held=("x", "y", "z", "rx", "rz"))
    right = Coupling("x_max", moment=(0.0, moment, 0.0), held=("y", "z", "rx", "rz"))
    beam = slender_beam(left, right)
    state = solved(beam)
    motions = beam.motions(state.dofs)
    np.testing.assert_allclose(motions[:, 4], [-moment / 6.0, moment / 3.0], rtol=0.01)
    np.testing.assert_array_equal(motions[:, [1, 2, 3, 5]], 0.0)
    for name, sign in (("x_min", -1.0), ("x_max", 1.0)):
        force, about_end = beam.reactions(state.dofs, state.mu, name)
        np.testing.assert_allclose(force, [0.0, 0.0, sign * moment], atol=1e-3 * moment)
        np.testing.assert_allclose(about_end, 0.0, atol=1e-6 * moment)
    assert beam.linearise(state.dofs, state.mu).negative_pivots == 0, "a moment about a hinge has an energy"


def test_a_propped_beam_leans_on_its_prop() -> None:
    """Clamped and propped: 3 M / 2 L on the prop, M L / 4 E I at it."""
    moment = 1e-3
    beam = slender_beam(None, Coupling("x_max", moment=(0.0, moment, 0.0), held=("z",)))
    state = solved(beam)
    np.testing.assert_allclose(beam.motions(state.dofs)[0, 4], moment / 4.0, rtol=0.02)
    force, _ = beam.reactions(state.dofs, state.mu, "x_max", np.zeros(3))
    np.testing.assert_allclose(force, [0.0, 0.0, 1.5 * moment], atol=0.01 * moment)


def test_reactions_of_a_hinge_have_derivatives() -> None:
    """By loads, the hinge's place and the shape, at large turns; against differences."""
    problem, mu = parametric("tet10", False, ("y", "z", "rx", "rz")), np.array([0.7, 0.1, 0.2, 1.1])
    state, about = loaded_state(problem, mu), np.array([0.1, -0.2, 0.3])
    tangent = problem.linearise(state.dofs, mu)
    slopes = sensitivities(problem, state, tangent)
    forces = tangent.apply(slopes) + problem.residual_slopes(state.dofs, mu)
    found = problem.reaction_slopes(state.dofs, mu, slopes, forces, "x_max", about)
    assert abs(problem.motions(state.dofs)[0, 4]) > 0.15
    for index in range(len(mu)):
        change = 1e-4 * np.eye(len(mu))[index]
        ends = [solve(problem, mu + sign * change, state) for sign in (1.0, -1.0)]
        reactions = [problem.reactions(end.dofs, end.mu, "x_max", about) for end in ends]
        for part in (0, 1):
            expected = (reactions[0][part] - reactions[1][part]) / 2e-4
            np.testing.assert_allclose(found[part][index], expected, atol=1e-5 * np.abs(found[part]).max())


def parametric(cell_type: str, mixed: bool | None, held: tuple[Motion, ...] = ()) -> CoupledSolid:
    """Two couplings whose loads, places and sets depend on parameters, beside a pressure that follows."""
    symbols = load_parameter(load=0.5, arm=0.2, growth=0.1, stiffness=1.0)
    mesh = block((1.0, 0.5, 0.5), (3, 1, 1), cell_type)
    field = np.column_stack([0.2 * mesh.nodes[:, 1], 0.3 * mesh.nodes[:, 0], 0.1 * mesh.nodes[:, 2]])
    low = mesh.nodes[:, 2] < 1e-9
    inside = (mesh.nodes[:, 0] > 0.2) & (mesh.nodes[:, 0] < 0.9)
    mesh = replace(mesh, node_sets={"pad": np.flatnonzero(low & inside)})
    load, arm = symbols["load"], symbols["arm"]
    couplings = [
        Coupling("x_max", (3e4 * load, 2e4, 1e4 * load), (2e3, -3e3 * load, 1e3), (1.0 + arm, arm * arm, 0.0), held),
        Coupling("pad", (0.0, 0.0, 1e4 * load)),
    ]
    return CoupledSolid(
        couplings,
        mesh,
        {"all": NeoHookean(young=1e6 * symbols["stiffness"], poisson=0.45)},
        [fixed("x_min")],
        [FollowerPressure("z_max", 3e4 * load), DeadTraction("x_max", (0.0, 0.0, 1e4))],
        symbols,
        SolidOptions(mixed=mixed),
        [ShapeField(symbols["growth"], field)],
    )


@pytest.mark.parametrize(("cell_type", "mixed"), [("hex8", None), ("hex20", True), ("tet10", False)])
def test_tangent_and_derivatives_by_parameters(cell_type: str, mixed: bool | None) -> None:
    """Against central differences, at a state out of balance."""
    problem, mu = parametric(cell_type, mixed), np.array([0.7, 0.1, 0.2, 1.1])
    rng = np.random.default_rng(1)
    x = loaded_state(problem, mu).dofs
    assert np.linalg.norm(problem.motions(x)[0, 3:]) > 0.3
    x = x + 1e-3 * problem.free * rng.standard_normal(problem.n_dofs) * (np.abs(x) < 1.0)
    tangent, v = problem.linearise(x, mu), problem.free * rng.standard_normal(problem.n_dofs)
    step = 1e-6
    slope = (problem.residual(x + step * v, mu) - problem.residual(x - step * v, mu)) / (2.0 * step)
    np.testing.assert_allclose(tangent.apply(v), slope, atol=1e-6 * np.abs(slope).max())
    solution = problem.linearise(x, mu).solve(tangent.apply(v))
    np.testing.assert_allclose(solution, v, atol=1e-6 * np.abs(v).max())
    for index, slopes in enumerate(problem.residual_slopes(x, mu)):
        change = 1e-5 * np.eye(len(mu))[index]
        slope = (problem.residual(x, mu + change) - problem.residual(x, mu - change)) / 2e-5
        np.testing.assert_allclose(slopes, slope, atol=1e-6 * np.abs(slope).max())


def test_derivatives_of_a_solution() -> None:
    problem, mu = parametric("tet10", False), np.array([0.7, 0.1, 0.2, 1.1])
    state = loaded_state(problem, mu)
    for index, slope in enumerate(sensitivities(problem, state)):
        change = 1e-4 * np.eye(len(mu))[index]
        ends = [solve(problem, mu + sign * change, state).dofs for sign in (1.0, -1.0)]
        expected = (ends[0] - ends[1]) / 2e-4
        np.testing.assert_allclose(slope, expected, atol=1e-5 * np.abs(expected).max())


def test_a_column_under_a_remote_force_loses_its_stability() -> None:
    """Euler's load of a clamped column with a free end, pi^2 E I / 4 L^2; a small moment has no energy, and no say."""
    young, width, length = 1e7, 0.05, 1.0
    critical = np.pi**2 * young * width**4 / 12.0 / (4.0 * length**2)
    symbols = load_parameter(share=0.0, twist=0.0)
    end = Coupling("x_max", (-critical * symbols["share"], 0.0, 0.0), (symbols["twist"], 0.0, 0.0))
    column = CoupledSolid(
        [end],
        block((length, width, width), (6, 1, 1), "hex20"),
        {"all": StVenantKirchhoff(young=young, poisson=0.0)},
        [fixed("x_min")],
        parameters=symbols,
    )
    states = [solved(column, share, 0.0) for share in (0.98, 1.02)]
    pivots = [column.linearise(state.dofs, state.mu).negative_pivots for state in states]
    assert pivots == [0, 2], "two directions to bend in"
    twisted = [solved(column, share, 0.1) for share in (0.98, 1.02)]
    tangents = [column.linearise(state.dofs, state.mu) for state in twisted]
    assert [tangent.negative_pivots for tangent in tangents] == [None, None]
    assert [unstable_directions(column, tangent) for tangent in tangents] == [0, 2]


@pytest.mark.parametrize(
    ("on", "message"),
    [
        ("lid", r"no node set or surface 'lid'"),
        ("nothing", r"the set 'nothing' of a coupling is empty"),
        ("edge", r"the set 'edge' of a coupling has 2 corners of cells on one line"),
        ("y_max", r"the set 'y_max' of a coupling has nodes that a support holds"),
    ],
)
def test_sets_that_cannot_be_coupled_are_named(on: str, message: str) -> None:
    edge = np.flatnonzero((BAR.nodes[:, 0] > 0.9) & (BAR.nodes[:, 1] < 0.1))
    mesh = replace(BAR, node_sets={"nothing": np.zeros(0, dtype=np.int64), "edge": edge})
    with pytest.raises(StudyError, match=message):
        CoupledSolid([Coupling(on)], mesh, {"all": RUBBER}, [fixed("x_min")])


def test_couplings_share_no_nodes_and_hold_no_body() -> None:
    with pytest.raises(StudyError, match="'x_max', 'x_max' share nodes"):
        CoupledSolid([Coupling("x_max"), Coupling("x_max")], BAR, {"all": RUBBER}, [fixed("x_min")])
    with pytest.raises(StudyError, match="free to move along x, y, z"):
        CoupledSolid([Coupling("x_max")], BAR, {"all": RUBBER})
    with pytest.raises(StudyError, match="free to move along z and to turn about y"):
        CoupledSolid([Coupling("x_max", held=("x", "y", "z", "rx", "rz"))], BAR, {"all": RUBBER})


@pytest.mark.parametrize("turned", [0.3, 0.999, 1.001, 6.0, 22.0, 28.0, 60.0])
def test_a_rotation_and_its_derivatives_at_any_number_of_turns(turned: float) -> None:
    """Against SciPy's matrices, and central differences of these; a spin about the axis is one of the angle."""
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    found, changes = CoupledRotation.of(turned * axis), 1e-4 * np.eye(3)

    def exact(change: Array) -> Array:
        return Rotation.from_rotvec(turned * axis + change).as_matrix()

    np.testing.assert_allclose(found.matrix, exact(np.zeros(3)), atol=1e-13)
    np.testing.assert_allclose(axis @ found.spins, axis, atol=1e-12)
    for slope, curvatures, a in zip(found.slopes, found.curvatures, changes, strict=True):
        np.testing.assert_allclose(slope, (exact(a) - exact(-a)) / 2e-4, atol=1e-8)
        for curvature, b in zip(curvatures, changes, strict=True):
            mixed = exact(a + b) - exact(a - b) - exact(b - a) + exact(-a - b)
            np.testing.assert_allclose(curvature, mixed / 4e-8, atol=1e-6)


def test_an_iteration_that_winds_a_set_up_gets_no_numbers_and_no_warnings():
    for far in (1e3, 1e80, np.inf):
        assert np.isnan(CoupledRotation.of(np.array([0.0, far, 1.0])).matrix).all()
