"""Shells against closed forms and published tables."""

import meshio
import numpy as np
import pytest
import scipy.optimize

from morph_dslam.errors import SolverError
from morph_dslam.mechanics.solvers.buckling import buckling_modes
from morph_dslam.mechanics.solvers.newton import sensitivities
from morph_dslam.meshing.surface_generators import plate
from tests.support.shells import (
    CANTILEVER,
    CANTILEVER_STUDY,
    HEMISPHERE,
    HEMISPHERE_STUDY,
    SLIT_PLATE,
    SLIT_PLATE_STUDY,
    shell_study,
    solved_shell,
)


@pytest.mark.slow
@pytest.mark.parametrize("cells", ["quad4", "tri3", "quad9", "tri6"])
def test_cantilever_under_end_shear(cells):
    shell = solved_shell(CANTILEVER_STUDY.format(n=10, cells=cells))
    for part in (0.5, 1.0):
        shell = shell.at(part)
        along, _, up = 100.0 * shell.displacement("x_max")
        np.testing.assert_allclose([-along, up], CANTILEVER[part], rtol=3e-3)


def test_hemisphere_with_a_hole():
    shell = solved_shell(HEMISPHERE_STUDY.format(n=6, cells="quad9")).at(1.0)
    outwards, inwards = 1e3 * shell.displacement("outwards")[0], -1e3 * shell.displacement("inwards")[1]
    np.testing.assert_allclose([outwards, inwards], HEMISPHERE[1.0], rtol=2e-2)


@pytest.mark.slow
@pytest.mark.parametrize("cells", ["quad9", "tri6"])
def test_slit_annular_plate(cells):
    shell = solved_shell(SLIT_PLATE_STUDY.format(across=4, around=32, cells=cells)).at(1.0)
    end = shell.problem.mesh.set_nodes("end")
    radius = np.linalg.norm(shell.problem.mesh.nodes[end], axis=1)
    up = 1e3 * shell.field("displacement")[end[[np.argmin(radius), np.argmax(radius)]], 2]
    np.testing.assert_allclose(up, SLIT_PLATE[1.0], rtol=1e-2)


@pytest.mark.parametrize(("cells", "tolerance"), [("tri3", 1e-8), ("quad4", 3e-2)])
def test_uniform_tension_of_distorted_cells(cells, tolerance, tmp_path):
    """S11 = Young's modulus times E11 and E22 = -nu E11, in the Green-Lagrange strain of a stretch of 10 %."""
    mesh = plate((0.03, 0.02), (3, 2), cells)
    inside = np.all((mesh.nodes[:, :2] > 1e-9) & (mesh.nodes[:, :2] < [0.03 - 1e-9, 0.02 - 1e-9]), axis=1)
    mesh.nodes[inside, :2] += np.random.default_rng(0).uniform(-1e-3, 1e-3, (inside.sum(), 2))
    (block,) = mesh.blocks
    name = {"tri3": "triangle", "quad4": "quad"}[cells]
    meshio.Mesh(mesh.nodes, [(name, block.connectivity)]).write(tmp_path / "plate.vtu")
    shell = solved_shell(f"""
        mesh = {{ file = "{tmp_path}/plate.vtu", unit = "m" }}
        shell = {{ thickness = "1 mm" }}
        material = {{ young = "5 MPa", poisson = 0.3 }}
        supports = [
            {{ kind = "displacement", on = "left", x = "0 mm", z = "0 mm" }},
            {{ kind = "displacement", on = "right", x = "3 mm", z = "0 mm" }},
            {{ kind = "displacement", on = "below", y = "0 mm", z = "0 mm" }},
        ]
        [sets]
        left.box = [["0 mm", "0 mm", "0 mm"], ["0 mm", "20 mm", "0 mm"]]
        right.box = [["30 mm", "0 mm", "0 mm"], ["30 mm", "20 mm", "0 mm"]]
        below.box = [["0 mm", "0 mm", "0 mm"], ["30 mm", "0 mm", "0 mm"]]
        above.box = [["0 mm", "20 mm", "0 mm"], ["30 mm", "20 mm", "0 mm"]]
    """)
    strain = 0.1 + 0.5 * 0.1**2
    for face in ("stress_top", "stress_bottom"):
        expected = np.tile([5e6 * strain, 0, 0], (mesh.n_nodes, 1))
        np.testing.assert_allclose(shell.field(face), expected, atol=tolerance * 5e6 * strain)
    across = np.sqrt(1.0 - 2.0 * 0.3 * strain) - 1.0
    np.testing.assert_allclose(shell.displacement("above")[1], 0.02 * across, rtol=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize("cells", ["quad9", "tri3"])
def test_a_strip_bent_to_a_circle(cells):
    """One end is turned by 90 degrees along the circle: moment and stress of pure bending."""
    length, width, thickness, young = 0.1, 0.02, 5e-3, 2e9
    shell = solved_shell(f"""
        mesh = {{ generator = "plate", size = ["100 mm", "20 mm"], divisions = [8, 1], cells = "{cells}" }}
        shell = {{ thickness = "5 mm" }}
        material = {{ young = "2 GPa", poisson = 0.0 }}
        [[supports]]
        kind = "clamped"
        on = "x_min"
        [[supports]]
        kind = "rotation"
        on = "x_max"
        axis = [0, 1, 0]
        angle = "turn"
        translation = ["along", "0 mm", "up"]
        [parameters]
        turn.range = ["0 deg", "90 deg"]
        along.range = ["-100 mm", "0 mm"]
        up.range = ["-100 mm", "0 mm"]
    """)
    for angle in np.radians(np.linspace(18.0, 90.0, 5)):
        radius = length / angle
        shell = shell.at(angle, radius * np.sin(angle) - length, -radius * (1.0 - np.cos(angle)))
    end = shell.problem.mesh.nodes[shell.problem.mesh.set_nodes("x_max")].mean(axis=0) + shell.displacement("x_max")
    _, moment = shell.problem.reactions(shell.state.dofs, shell.state.mu, "x_max", end)
    bending = young * width * thickness**3 / 12.0 * angle / length
    np.testing.assert_allclose(moment, [0.0, bending, 0.0], atol=1.2e-2 * bending)
    top = shell.field("stress_top")[:, 0]
    # Bent downwards: the face towards z is stretched.
    np.testing.assert_allclose(top, young * thickness / 2.0 * angle / length, rtol=2.5e-2)
    np.testing.assert_allclose(shell.field("stress_bottom")[:, 0], -top, rtol=3e-2)


def test_off_axis_tension_of_an_orthotropic_sheet():
    """1/E = c^4/E1 + (1/G - 2 nu/E1) c^2 s^2 + s^4/E2 at an angle to the fibres (Jones, equation 2.97)."""
    shell = solved_shell("""
        mesh = { generator = "plate", size = ["60 mm", "20 mm"], divisions = [3, 2] }
        shell = { thickness = "0.2 mm" }
        sets = { pin = { nearest = ["0 mm", "0 mm", "0 mm"] }, slide = { nearest = ["0 mm", "20 mm", "0 mm"] } }
        supports = [
            { kind = "displacement", on = "x_min", x = "0 mm", z = "0 mm" }, { kind = "fixed", on = "pin" },
            { kind = "displacement", on = "x_max", z = "0 mm" },
        ]
        loads = [{ kind = "edge", on = "x_max", force = ["1 N/m", "0 N/m", "0 N/m"] }]
        [material]
        young_fibre = "4 GPa"
        young_cross = "1 GPa"
        poisson = 0.25
        shear = "0.5 GPa"
        fibre_angle = "90 deg"
    """)
    stress = 1.0 / 0.2e-3
    np.testing.assert_allclose(shell.displacement("x_max")[0], 0.06 * stress / 1e9, rtol=1e-4)
    np.testing.assert_allclose(shell.field("stress_top"), np.tile([0.0, stress, 0.0], (35, 1)), atol=1e-3 * stress)


def test_shear_coupling_at_an_angle_to_the_fibres():
    angle, moduli = np.radians(30.0), (4e9, 1e9, 0.25, 0.5e9)
    shell = solved_shell("""
        mesh = { generator = "plate", size = ["60 mm", "20 mm"], divisions = [3, 2], cells = "tri6" }
        shell = { thickness = "0.2 mm" }
        sets = { pin = { nearest = ["0 mm", "0 mm", "0 mm"] }, roll = { nearest = ["60 mm", "0 mm", "0 mm"] } }
        supports = [
            { kind = "displacement", on = "y_min", z = "0 mm" }, { kind = "displacement", on = "y_max", z = "0 mm" },
            { kind = "fixed", on = "pin" }, { kind = "displacement", on = "roll", y = "0 mm" },
        ]
        loads = [
            { kind = "edge", on = "x_max", force = ["1 N/m", "0 N/m", "0 N/m"] },
            { kind = "edge", on = "x_min", force = ["-1 N/m", "0 N/m", "0 N/m"] },
        ]
        [material]
        young_fibre = "4 GPa"
        young_cross = "1 GPa"
        poisson = 0.25
        shear = "0.5 GPa"
        fibre_angle = "30 deg"
    """)
    fibre, cross, poisson, shear = moduli
    c, s = np.cos(angle), np.sin(angle)
    stress = 1.0 / 0.2e-3
    stretch = stress * (c**4 / fibre + (1 / shear - 2 * poisson / fibre) * c**2 * s**2 + s**4 / cross)
    along, over = 2 * (1 + poisson) / fibre - 1 / shear, 2 / cross + 2 * poisson / fibre - 1 / shear
    distortion = stress * (along * s * c**3 - over * s**3 * c)
    corner = shell.problem.mesh.node_sets["roll"]
    assert shell.field("displacement")[corner[0], 0] == pytest.approx(0.06 * stretch, rel=1e-3)
    top = np.argmin(np.linalg.norm(shell.problem.mesh.nodes - [0.0, 0.02, 0.0], axis=1))
    assert shell.field("displacement")[top, 0] == pytest.approx(0.02 * distortion, rel=1e-3)
    expected = stress * np.array([c * c, s * s, -c * s])
    np.testing.assert_allclose(shell.field("stress_bottom"), np.tile(expected, (35, 1)), atol=1e-3 * stress)


@pytest.mark.parametrize(("cells", "tolerance"), [("quad9", 1e-2), ("tri6", 1e-2)])
def test_a_cylinder_under_pressure(cells, tolerance):
    """Hoop stress p R / t, and a radius that grows by p R^2 / (E t)."""
    shell = solved_shell(f"""
        shell = {{ thickness = "0.5 mm" }}
        material = {{ young = "2 GPa", poisson = 0.3, fibre = [0, 0, 1] }}
        supports = [
            {{ kind = "symmetry", on = "start", axis = "y" }}, {{ kind = "symmetry", on = "end", axis = "x" }},
            {{ kind = "symmetry", on = "bottom", axis = "z" }},
        ]
        loads = [{{ kind = "pressure", pressure = "-1 kPa" }}]
        [mesh]
        generator = "cylinder"
        radius = "50 mm"
        length = "40 mm"
        divisions = [2, 8]
        angles = ["0 deg", "90 deg"]
        cells = "{cells}"
    """)
    hoop = 1e3 * 0.05 / 0.5e-3
    mean = (shell.field("stress_top") + shell.field("stress_bottom")) / 2.0
    np.testing.assert_allclose(mean[:, 1], hoop, rtol=tolerance)
    np.testing.assert_allclose(mean[:, 0], 0.0, atol=tolerance * hoop)
    assert shell.displacement("start")[0] == pytest.approx(0.05 * hoop / 2e9, rel=tolerance)


EVERYTHING = """
shell = { thickness = "2 mm + 0.5 mm * a" }
supports = [
    { kind = "clamped", on = "start" },
    { kind = "rotation", on = "end", axis = [1, 2, 0], angle = "20 deg * a", translation = ["0 mm", "1 mm", "0 mm"] },
    { kind = "foundation", stiffness = "1e3 N/m3 * a" },
]
parameters = { a = { range = [0.0, 1.0], default = 0.5 } }

[mesh]
generator = "cylinder"
radius = "50 mm"
length = "40 mm"
divisions = [2, 4]
angles = ["0 deg", "120 deg"]
cells = "tri6"

[material]
young_fibre = "30 MPa + 5 MPa * a"
young_cross = "10 MPa"
poisson = "0.3 + 0.05 * a"
shear = "5 MPa"
density = "900 kg/m3"
fibre = [0, 1, 1]
fibre_angle = "40 deg * a"

[[loads]]
kind = "gravity"

[[loads]]
kind = "pressure"
pressure = "150 Pa + 50 Pa * a"

[[loads]]
kind = "edge"
on = "top"
force = ["0 N/m", "0.1 N/m", "0.5 N/m * a"]

[[loads]]
kind = "point"
on = "top"
force = ["0 N", "10 mN * a", "0 N"]

[[loads]]
kind = "moving_patch"
force = ["10 mN", "0 N", "0 N"]
centre = ["45 mm", "0 mm", "20 mm * a"]
width = "15 mm"
"""


@pytest.fixture(scope="module")
def loaded():
    return solved_shell(EVERYTHING)


def test_the_tangent_is_the_derivative_of_the_residual(loaded):
    problem, x, mu = loaded.problem, loaded.state.dofs, loaded.state.mu
    direction = np.random.default_rng(0).standard_normal(problem.n_dofs) * 1e-2
    product, step = problem.linearise(x, mu).apply(direction), 1e-6
    forward, backward = (problem.residual(x + sign * step * direction, mu) for sign in (1.0, -1.0))
    difference = (forward - backward) / (2.0 * step)
    np.testing.assert_allclose(product, difference, atol=2e-6 * np.abs(difference).max())


def test_derivatives_by_a_parameter(loaded):
    problem, state, step = loaded.problem, loaded.state, 1e-4
    slopes = problem.sample_slopes(state.dofs, state.mu, sensitivities(problem, state))
    ahead, behind = loaded.at(0.5 + step), loaded.at(0.5 - step)
    for name, slope in slopes.items():
        difference = (ahead.field(name) - behind.field(name)) / (2.0 * step)
        np.testing.assert_allclose(slope[0], difference, atol=2e-4 * np.abs(difference).max())


def test_the_support_listed_first_holds_an_edge():
    """A clamp of the same edges, listed after a plane of symmetry, changes nothing."""
    plane = '{ kind = "symmetry", on = "x_min", axis = "x" }, { kind = "fixed", on = "x_min" }'
    text = """
        mesh = { generator = "plate", size = ["40 mm", "20 mm"], divisions = [2, 1] }
        shell = { thickness = "1 mm" }
        material = { young = "1 GPa", poisson = 0.3 }
        supports = [%s]
        loads = [{ kind = "pressure", pressure = "1 kPa" }]
    """
    alone, both = (solved_shell(text % s) for s in (plane, plane + ', { kind = "clamped", on = "x_min" }'))
    np.testing.assert_allclose(both.field("displacement"), alone.field("displacement"), atol=1e-12)


#: A plate that is clamped at one end, of so many cells along it, without its loads.
PULLED_AT_A_CORNER = """
    mesh = {{ generator = "plate", size = ["100 mm", "20 mm"], divisions = [{}, 2] }}
    shell = {{ thickness = "0.5 mm" }}
    material = {{ young = "1 GPa", poisson = 0.3 }}
    sets = {{ tip = {{ nearest = ["100 mm", "20 mm", "0 mm"] }} }}
    supports = [{{ kind = "clamped", on = "x_min" }}]
"""


def test_reactions_balance_the_loads():
    """Force and moment of a clamped edge, against those of a point load at its deformed place."""
    shell = solved_shell(
        PULLED_AT_A_CORNER.format(4) + 'loads = [{ kind = "point", on = "tip", force = ["0 N", "10 mN", "30 mN"] }]'
    )
    load, place = np.array([0.0, 0.01, 0.03]), np.array([0.1, 0.02, 0.0]) + shell.displacement("tip")
    force, moment = shell.problem.reactions(shell.state.dofs, shell.state.mu, "x_min", np.zeros(3))
    np.testing.assert_allclose(force, -load, atol=1e-9)
    np.testing.assert_allclose(moment, -np.cross(place, load), atol=1e-7)


def test_derivatives_of_reactions_balance_those_of_the_loads():
    """Of a clamped edge, against a point load that grows at its deformed place: d(x cross f) = dx cross f + x cross df.

    The load is a parameter once, and once comes beside the study's.
    """
    shell = solved_shell(
        PULLED_AT_A_CORNER.format(3)
        + """
        loads = [{ kind = "point", on = "tip", force = ["0 N", "10 mN * a", "30 mN * a"] }]
        parameters = { a = { range = [0.0, 1.0], default = 1.0 } }
    """
    )
    problem, dofs, mu = shell.problem, shell.state.dofs, shell.state.mu
    load, place = np.array([0.0, 0.01, 0.03]), np.array([0.1, 0.02, 0.0]) + shell.displacement("tip")
    tangent, applied = problem.linearise(dofs, mu), problem.residual_slopes(dofs, mu)
    changes = sensitivities(problem, shell.state, tangent)
    moved = problem.nodal_displacement(changes[0])[problem.mesh.set_nodes("tip")[0]]
    given = changes, tangent.apply(changes) + applied, "x_min", np.zeros(3)
    expected = -load, -np.cross(moved, load) - np.cross(place, load)
    for found in (problem.reaction_slopes(dofs, mu, *given), problem.response_reactions(dofs, mu, *given)):
        for slope, balance in zip(found, expected, strict=True):
            np.testing.assert_allclose(slope[0], balance, atol=1e-4 * np.linalg.norm(balance))


@pytest.mark.slow
def test_a_cloth_hung_by_two_corners():
    """It swings down from level to rest: its weight is on the corners, and its middle hangs below them."""
    study = shell_study("""
        mesh = { generator = "plate", size = ["0.55 m", "0.55 m"], divisions = [4, 4] }
        shell = { thickness = "0.5 mm" }
        material = { young = "1 MPa", poisson = 0.3, density = "400 kg/m3" }
        loads = [{ kind = "gravity", acceleration = ["0 m/s2", "0 m/s2", "-9.81 m/s2"] }]
        supports = [{ kind = "fixed", on = "left" }, { kind = "fixed", on = "right" }]
        [sets]
        left.nearest = ["0 m", "0.55 m", "0 m"]
        right.nearest = ["0.55 m", "0.55 m", "0 m"]
    """)
    sweep = study.sweep_problem()
    snapshot = sweep.take_snapshot(sweep.first_state())
    weight = 400.0 * 0.5e-3 * 0.55**2 * 9.81
    for corner in ("left", "right"):
        assert snapshot.outputs[f"force_{corner}"][2] == pytest.approx(weight / 2.0, rel=1e-6)
    assert snapshot.outputs["negative_pivots"] == 0
    place = study.model_mesh().nodes + snapshot.fields["displacement"]
    lowest = place[np.argmin(place[:, 2])]
    assert lowest[2] < -0.5
    # Its middle hangs straight below the line between the corners.
    assert np.average(place, axis=0, weights=study.model_mesh().weights)[1] == pytest.approx(0.55, abs=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("width", "divisions", "young", "gap"), [(20, [20, 2], 2, 25), (100, [14, 3], 10, 4)])
def test_a_cloth_whose_ends_have_come_together_by_default_hangs_as_a_catenary(width, divisions, young, gap):
    """Motion and weight together lead the flat shape nowhere, or to a plate compressed in its plane, which is unstable.

    The narrow one is turned inside out at its edge. Sag and pull are those of a rope (Bernoulli).
    """
    study = shell_study(f"""
        mesh = {{ generator = "plate", size = ["200 mm", "{width} mm"], divisions = {divisions} }}
        shell = {{ thickness = "0.3 mm" }}
        material = {{ young = "{young} MPa", poisson = 0.0, density = "1 g/cm3" }}
        loads = [{{ kind = "gravity" }}]
        parameters = {{ gap = {{ range = ["{gap} mm", "60 mm"] }} }}
        [[supports]]
        kind = "fixed"
        on = "x_min"
        [[supports]]
        kind = "displacement"
        on = "x_max"
        x = "-1 * gap"
        y = "0 mm"
        z = "0 mm"
    """)
    sweep = study.sweep_problem()
    snapshot = sweep.take_snapshot(sweep.first_state())
    length, span = 0.2, 0.2 - 1e-3 * gap
    a = scipy.optimize.brentq(lambda a: 2.0 * a * np.sinh(span / 2.0 / a) - length, 0.01, 5.0)
    weight = 1000.0 * 9.80665 * 0.3e-3 * 1e-3 * width
    assert snapshot.outputs["negative_pivots"] == 0
    # Its own bending, and stretching by its weight, are left out by the rope.
    assert -snapshot.fields["displacement"][:, 2].min() == pytest.approx(a * (np.cosh(span / 2.0 / a) - 1.0), rel=0.01)
    np.testing.assert_allclose(
        snapshot.outputs["force_x_max"], [weight * a, 0.0, weight * length / 2.0], rtol=0.02, atol=1e-9
    )


@pytest.mark.slow
def test_a_cloth_by_two_corners_that_have_come_together_by_default_is_refused_with_what_builds():
    """Its defaults are to be those of corners at rest, from where it is found."""
    text = """
        mesh = { generator = "plate", size = ["150 mm", "150 mm"], divisions = [1, 1] }
        shell = { thickness = "2 mm" }
        material = { young = "1 MPa", poisson = 0.3, density = "1100 kg/m3" }
        loads = [{ kind = "gravity", acceleration = ["0 m/s2", "0 m/s2", "-9.81 m/s2"] }]
        parameters = { close = { range = ["0 mm", "25 mm"], default = "DEFAULT mm" } }
        supports = [
            { kind = "fixed", on = "left" },
            { kind = "displacement", on = "right", x = "-1 * close", y = "0 mm", z = "0 mm" },
        ]
        [sets]
        left.nearest = ["0 mm", "150 mm", "0 mm"]
        right.nearest = ["150 mm", "150 mm", "0 mm"]
    """
    with pytest.raises(SolverError, match=r"Supports have moved at the defaults already: .* at which they are at rest"):
        shell_study(text.replace("DEFAULT", "10")).sweep_problem().first_state()
    sweep = shell_study(text.replace("DEFAULT", "0")).sweep_problem()
    weight = 1100.0 * 2e-3 * 0.15**2 * 9.81
    snapshot = sweep.take_snapshot(sweep.first_state())
    assert snapshot.outputs["force_left"][2] == pytest.approx(weight / 2.0, rel=1e-6)


@pytest.mark.slow
def test_the_euler_load_of_a_clamped_strip():
    """4 pi^2 E I / L^2, reached by moving one clamped end towards the other by the strain that it means."""
    length, thickness = 0.3, 2e-3
    shell = solved_shell("""
        mesh = { generator = "plate", size = ["300 mm", "20 mm"], divisions = [8, 1] }
        shell = { thickness = "2 mm" }
        material = { young = "5 GPa", poisson = 0.0 }
        parameters = { push = { range = ["0 mm", "1 mm"] } }
        [[supports]]
        kind = "clamped"
        on = "x_min"
        [[supports]]
        kind = "rotation"
        on = "x_max"
        axis = [0, 1, 0]
        angle = "0 deg"
        translation = ["-1 * push", "0 mm", "0 mm"]
    """)
    (mode,) = buckling_modes(shell.problem, shell.state, parameter=0, step=1e-6)
    strain = 4.0 * np.pi**2 * thickness**2 / 12.0 / length**2
    assert mode.change == pytest.approx(strain * length, rel=5e-3)
    shape = shell.problem.nodal_displacement(mode.shape)
    along = shell.problem.mesh.nodes[:, 0]
    np.testing.assert_allclose(
        shape[:, 2], shape[:, 2].max() * (1.0 - np.cos(2 * np.pi * along / length)) / 2.0, atol=2e-3
    )
