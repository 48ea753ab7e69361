"""Solutions of another program that are wrong in themselves: each is refused, or named in a warning, by what it is."""

from __future__ import annotations

import re

import meshio
import numpy as np
import pytest

from morph_dslam import load_study
from morph_dslam.meshing.generators import block
from morph_dslam.model import load_model
from morph_dslam.studies.build import build
from morph_dslam.studies.external_doubts import doubts

MESH = block((0.06, 0.03, 0.02), (3, 2, 2), "hex8")
POINTS, CELLS = 1e3 * MESH.nodes, MESH.blocks[0].connectivity
STUDY = """
name = "block"
[external]
table = "table.csv"
length_unit = "mm"
displacement = "U"
{}
[reduction]
max_degree = 3
"""
TENSORS = 'stress = "S"\nstress_unit = "MPa"\nstrain = "E"'
#: Components of a tensor in VTK's order and in Abaqus's.
VTK, ABAQUS = ([0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]), ([0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2])


def gradient(pull, shear):
    """F of a homogeneous deformation that stretches, shears in two planes and turns."""
    stretch = np.array([[1.0 + pull, 0.6 * shear, shear], [0.0, 1.0 - 0.3 * pull, 0.0], [0.0, 0.0, 1.0 - 0.2 * pull]])
    cos, sin = np.cos(2.0 * shear), np.sin(2.0 * shear)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ stretch


def neo_hookean(f):
    """Cauchy stress, MPa, of shear modulus 1 MPa and bulk modulus 5 MPa."""
    volume, left = np.linalg.det(f), f @ f.T
    return (left - np.eye(3)) / volume + 5.0 * (volume - 1.0) * np.eye(3)


def homogeneous(pull, shear, order=VTK, engineering=1.0, second=False):
    """Point data of one state of the block."""
    f = gradient(pull, shear)
    strain, stress = (f.T @ f - np.eye(3)) / 2.0, neo_hookean(f)
    if second:
        inverse = np.linalg.inv(f)
        stress = np.linalg.det(f) * inverse @ stress @ inverse.T
    components = strain[order] * np.array([1.0] * 3 + [engineering] * 3)
    count = len(POINTS)
    return {
        "U": POINTS @ (f - np.eye(3)).T,
        "S": np.tile(stress[order], (count, 1)),
        "E": np.tile(components, (count, 1)),
    }


def scattered(count=30):
    return np.random.default_rng(0).uniform([0.05, -0.1], [0.4, 0.3], (count, 2))


def write(folder, states, fields, keys="", header="file, pull [1], shear [1]", points=POINTS, cells=CELLS):
    """A study of the solutions ``fields(number, *state)``; `keys` are more of its section [external]."""
    folder.mkdir(exist_ok=True)
    rows = [header]
    for number, state in enumerate(states):
        data = fields(number, *state)
        meshio.Mesh(points, [("hexahedron", cells)], point_data=data).write(folder / f"s{number}.vtu")
        rows.append(", ".join([f"s{number}.vtu", *(repr(float(value)) for value in state)]))
    (folder / "table.csv").write_text("\n".join(rows) + "\n")
    (folder / "study.toml").write_text(STUDY.format(keys))
    return folder


def made(folder):
    """The model of a study's folder, and its warnings."""
    model = build(folder, folder / "x.morph")
    return load_model(folder / "x.morph"), model.certificate.get("warnings", [])


def doubted_rows(folder):
    """The warnings that name a row of the table; that such models miss much of what they are made of is another one."""
    return [warning for warning in made(folder)[1] if warning.startswith("table.csv")]


def moved(number, *state):
    """A cubic displacement only."""
    pull, shear = state[:2]
    return {"U": (pull + pull**2 * shear) * POINTS + shear**3 * POINTS[:, [1, 2, 0]]}


def test_right_tensors_are_accepted_without_a_word(tmp_path, capsys):
    folder = write(tmp_path, scattered(), lambda _, *state: homogeneous(*state), TENSORS)
    model, warnings = made(folder)
    assert warnings == []
    assert "mesh: 60 x 30 x 20 mm, 12 hex8, 36 nodes" in capsys.readouterr().err
    state = np.array([0.2, 0.15])
    stress = neo_hookean(gradient(*state))
    ours = stress[[0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]]
    assert model.stresses["solid"].value(state)[7] == pytest.approx(1e6 * ours, abs=1e4)
    assert "confidence" not in model.certificate["displacement"], "nobody knows that the states are scattered"


@pytest.mark.parametrize(
    ("wrong", "keys", "message"),
    [
        ({"order": ABAQUS}, TENSORS, "'E' does not fit the displacement, but with shears in the order xy, xz, yz it"),
        ({"engineering": 2.0}, TENSORS, "'E' does not fit the displacement, but with engineering shears halved it"),
        (
            {"order": ABAQUS, "engineering": 2.0},
            TENSORS,
            "in the order xy, xz, yz and with engineering shears halved it does",
        ),
        ({"order": ABAQUS}, 'stress = "S"\nstress_unit = "MPa"', "'S' does not fit .* shears in the order xy, xz, yz"),
        ({"second": True}, TENSORS, "'S' does not fit the displacement as Cauchy stress, but as the second Piola-"),
    ],
)
def test_a_wrong_order_or_measure_is_named(tmp_path, refused, wrong, keys, message):
    folder = write(tmp_path, scattered(), lambda _, *state: homogeneous(*state, **wrong), keys)
    assert re.search(message, refused("build", folder, "-o", tmp_path / "x.morph"))


def test_strain_in_percent_is_refused(tmp_path, refused):
    def percent(_, *state):
        data = homogeneous(*state)
        return data | {"E": 100.0 * data["E"]}

    folder = write(tmp_path, scattered(), percent, TENSORS)
    assert "'E' is 99 times off the strain of the displacement" in refused("build", folder, "-o", tmp_path / "x.morph")


def test_stress_of_strong_fibres_is_accepted(tmp_path):
    """Its axes are not those of the stretches, in whatever order."""
    fibre = np.outer([0.6, 0.0, 0.8], [0.6, 0.0, 0.8])

    def fibrous(_, *state):
        f = gradient(*state)
        second = 20.0 * np.sum(fibre * (f.T @ f - np.eye(3))) * fibre
        stress = neo_hookean(f) + f @ second @ f.T / np.linalg.det(f)
        return homogeneous(*state) | {"S": np.tile(stress[VTK], (len(POINTS), 1))}

    assert made(write(tmp_path, scattered(), fibrous, TENSORS))[1] == []


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        (CELLS[:, [4, 5, 6, 7, 0, 1, 2, 3]], "every hex8 cell is inverted: their nodes are listed in mirrored order"),
        (
            CELLS[:, [0, 1, 3, 2, 4, 5, 7, 6]],
            "all 12 hex8 cells are inverted or folded: .* in another order than VTK's",
        ),
        (CELLS[[*range(12), 0]], "1 hex8 cells are there more than once"),
    ],
)
def test_a_wrong_mesh_is_refused(tmp_path, refused, cells, message):
    folder = write(tmp_path, scattered(), moved, cells=cells)
    assert re.search(rf"s0\.vtu: {message}", refused("build", folder, "-o", tmp_path / "x.morph"))


@pytest.mark.parametrize("first", [True, False])
def test_points_without_cells_are_left_out_with_their_data(tmp_path, first):
    def with_reference(number, *state):
        rows = np.full((1, 3), np.nan), moved(number, *state)["U"]
        return {"U": np.vstack(rows if first else rows[::-1])}

    far = [[500.0, 0.0, 0.0]]
    points = np.vstack([far, POINTS] if first else [POINTS, far])
    model, warnings = made(write(tmp_path, scattered(), with_reference, points=points, cells=CELLS + first))
    assert warnings == []
    assert model.nodes == pytest.approx(MESH.nodes)
    assert model.displacement.value(np.array([0.2, 0.1])) == pytest.approx(
        1e-3 * moved(0, 0.2, 0.1)["U"], abs=1e-6 * np.ptp(MESH.nodes)
    )


def test_parts_that_share_no_node_are_accepted(tmp_path):
    """Other programs tie them, or let them touch."""
    away = POINTS + np.array([0.0, 0.0, 20.0])
    points, cells = np.vstack([POINTS, away]), np.vstack([CELLS, CELLS + len(POINTS)])

    def both(number, *state):
        return {"U": np.vstack([moved(number, *state)["U"]] * 2)}

    model, warnings = made(write(tmp_path, scattered(), both, points=points, cells=cells))
    assert (len(model.nodes), warnings) == (2 * len(POINTS), [])


def with_one(change, at=9):
    """Right displacements but for the solution of number ``at``."""

    def fields(number, *state):
        data = moved(number, *state)["U"]
        return {"U": change(data) if number == at else data}

    return fields


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda u: 1e-3 * u, "the displacement is off by"),
        (lambda u: 1e3 * u, "the displacement is off by"),
        (lambda u: u[::-1].copy(), "the displacement is off by"),
        (lambda u: 0.0 * u, "the displacement is zero everywhere, where"),
    ],
)
def test_one_wrong_solution_is_named_and_no_other(tmp_path, change, message):
    states = np.vstack([scattered(), [[0.05, -0.1], [0.05, 0.3], [0.4, -0.1], [0.4, 0.3]]])
    states[9] = [0.3, 0.2]  # between the others, and moved far
    (warning,) = doubted_rows(write(tmp_path, states, with_one(change)))
    assert warning.startswith(f"table.csv, line 11, 's9.vtu': {message}")


def test_two_rows_with_the_parameters_of_each_other_are_named(tmp_path):
    states = scattered(40)
    states[4], states[5] = [0.12, 0.0], [0.35, 0.2]
    swapped = states.copy()
    swapped[[4, 5]] = states[[5, 4]]
    folder = write(tmp_path, swapped, lambda number, *_: moved(number, *states[number]))
    warnings = doubted_rows(folder)
    assert [warning.split(":")[0] for warning in warnings] == [
        "table.csv, line 6, 's4.vtu'",
        "table.csv, line 7, 's5.vtu'",
    ]


@pytest.mark.parametrize(
    "size",
    [
        lambda t: 1.0 / (1.05 - t),
        lambda t: np.maximum(0.0, t - 0.8),
        lambda t: np.sqrt(t),
        lambda t: np.tanh(30.0 * (t - 0.5)),
    ],
    ids=["pole", "gap", "root", "snap"],
)
def test_steep_right_solutions_are_not_named(tmp_path, size):
    corners = [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]]
    states = np.vstack([np.random.default_rng(3).random((36, 2)), corners])
    folder = write(tmp_path, states, lambda _, a, b: {"U": (0.02 * a + 0.1 * size((2 * a + b) / 3)) * POINTS})
    assert doubted_rows(folder) == []


def test_states_along_one_history_leave_the_box_empty(tmp_path):
    time = np.linspace(0.0, 1.0, 40)
    states = np.column_stack([0.2 * np.sin(0.9 * np.pi * time) ** 2, 0.1 * np.sin(2.0 * np.pi * time)])
    (warning,) = made(write(tmp_path, states, moved))[1]
    assert re.match(r"the solutions leave \d+ % of the parameter box empty", warning)


def test_a_parameter_without_an_effect_is_named(tmp_path):
    """The last of three columns is random; of the others the block's sides know only one each."""
    states = np.column_stack([scattered(), np.random.default_rng(1).uniform(-20.0, 60.0, 30)])

    def without_heat(_, pull, shear, heat):
        size = np.array([np.sin(6.0 * pull), np.exp(-4.0 * shear), 0.3 * pull * shear])  # no polynomials
        return {"U": 0.1 * POINTS * size}

    header = "file, pull [1], shear [1], heat [1]"
    (warning,) = made(write(tmp_path / "a", states, without_heat, header=header))[1]
    assert warning.startswith("parameter 'heat' has no effect that the solutions show")

    def with_heat(number, *state):
        return {"U": without_heat(number, *state)["U"] + 3e-4 * state[2] * POINTS[:, ::-1]}

    assert made(write(tmp_path / "b", states, with_heat, header=header))[1] == []
    # Few states show no more than a plane; others' curvature must not count against a parameter.
    few = np.column_stack([np.tile([-1.0, -0.4, 0.1, 0.6, 1.0], 4), np.repeat([-1.0, -0.2, 0.4, 1.0], 5)])
    curved = write(tmp_path / "c", few, lambda _, a, b: {"U": (0.1 * np.sin(3.0 * a) + 0.005 * b) * POINTS})
    assert not [text for text in made(curved)[1] if "no effect" in text]


def test_neither_of_two_proportional_columns_is_without_an_effect():
    """Either column alone gives the displacement exactly; without both of them nothing would."""
    pull = np.linspace(-1.0, 1.0, 20)
    moved_by = (1.0 + pull)[:, None] * np.random.default_rng(1).normal(size=30)
    states = np.column_stack([pull, 2.0 * pull])
    found = doubts(states, ["pull", "shear"], {"displacement": moved_by @ moved_by.T}, [""] * len(pull))
    assert not [text for text in found if "no effect" in text]


def test_defaults_are_those_of_the_study(tmp_path):
    folder = write(tmp_path, scattered(), moved, '[external.defaults]\npull = "0.31"')
    assert [parameter.default for parameter in made(folder)[0].parameters] == pytest.approx([0.31, 0.0])


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ('stress = "U"', r"external: stress_unit is missing: .* stress_unit = \"MPa\""),
        (
            '[external.defaults]\npull = "0.9"',
            r"external\.defaults\.pull: 0\.9 is outside of the table's range, 0\.0\d+ to",
        ),
        ('[external.defaults]\npull = "3 mm"', r"external\.defaults\.pull: 'mm' is not a unit of ratio"),
        ('[external.defaults]\npush = "1"', r"external\.defaults: 'push' is no parameter of .*; it has: pull, shear"),
        ('[external.reactions]\nbase = "RF"', r"external: force_unit is missing"),
        ('[external.reactions]\nbase = ["pull", "shear"]', r"external\.reactions\.base names 2 columns: name three"),
        (
            '[external.reactions]\nbase = ["pull", "pull", "shear"]',
            r"external\.reactions\.base: column 'pull \[1\]' of .*table\.csv: '1' is not a unit of force",
        ),
        (
            '[external.reactions]\nbase = ["x", "y", "z"]',
            r"external\.reactions\.base: .* has no column 'x'; it has: file",
        ),
    ],
)
def test_a_wrong_key_is_one_message(tmp_path, refused, keys, message):
    folder = write(tmp_path, scattered(12), moved, keys)
    assert re.search(message, refused("build", folder, "-o", tmp_path / "x.morph"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: [*rows, f"s0.vtu, {rows[1].split(', ', 1)[1]}"], r"line 14: 's0\.vtu' is in line 2 already"),
        (
            lambda rows: [*rows, f"./s0.vtu, {rows[1].split(', ', 1)[1]}"],
            r"line 14: the parameters are those of line 2",
        ),
        (
            lambda rows: [*rows[:4], "s3.vtu, 0,1, 0,2", *rows[5:]],
            r"line 5: 5 cells under 3 headers; write decimals with",
        ),
        (lambda rows: [*rows[:4], "s3.vtu, 0.1", *rows[5:]], r"line 5: 2 cells under 3 headers"),
        (lambda rows: [*rows[:4], "s3.vtu, nan, 0.2", *rows[5:]], r"line 5: 'nan' is no number for pull \[1\]"),
        (lambda rows: [*rows[:4], "s3.vtu, inf, 0.2", *rows[5:]], r"line 5: 'inf' is no number for pull \[1\]"),
        (lambda rows: ["file, pull [1], pull [1]", *rows[1:]], r"has two columns 'pull \[1\]': leave one out"),
        (lambda rows: ["file, pull [1], pull [mm]", *rows[1:]], r"has two columns of the parameter 'pull'"),
        (lambda rows: ["file, pull_N, shear", *rows[1:]], r"'pull_N' has no unit in brackets: write 'pull \[N\]', or"),
    ],
)
def test_a_wrong_table_is_one_message(tmp_path, refused, change, message):
    folder = write(tmp_path, scattered(12), moved)
    table = folder / "table.csv"
    table.write_text("\n".join(change(table.read_text().splitlines())) + "\n")
    assert re.search(message, refused("build", folder, "-o", tmp_path / "x.morph"))


def test_cells_left_empty_behind_the_last_column_are_nothing(tmp_path):
    folder = write(tmp_path, scattered(), moved, header="file, pull_1, shear")
    table = folder / "table.csv"
    header, *rows = table.read_text().splitlines()
    table.write_text("\n".join([header, *(f"{row},," for row in rows)]) + "\n")
    assert [(parameter.name, parameter.unit) for parameter in made(folder)[0].parameters] == [
        ("pull_1", "1"),
        ("shear", "1"),
    ]


def test_stress_in_cells_is_told_from_none(tmp_path, refused):
    folder = write(tmp_path, scattered(12), moved, 'stress = "S"\nstress_unit = "MPa"')
    content = meshio.read(folder / "s0.vtu")
    content.cell_data = {"S": [np.zeros((len(CELLS), 6))]}
    content.write(folder / "s0.vtu")
    assert "s0.vtu has 'S' as cell data" in refused("build", folder, "-o", tmp_path / "x.morph")


def test_a_folder_is_a_study(tmp_path):
    assert load_study(write(tmp_path, scattered(12), moved)).name == "block"


BASE, TIP = POINTS[:, 0] == 0.0, POINTS[:, 0] == POINTS[:, 0].max()


def with_forces(number, *state):
    """Forces in N along x and z, the same at each of the nodes of the base; their opposites hold the tip."""
    pull, shear = state[:2]
    base = np.where(BASE[:, None], [-2.0 * pull, 0.0, shear], 0.0)
    return moved(number, *state) | {"RF": base, "all": base - base[::-1]}


def test_forces_at_points_are_the_reaction_of_a_support(tmp_path):
    keys = 'force_unit = "N"\n[external.reactions]\nbase = "RF"'
    model = made(write(tmp_path, scattered(), with_forces, keys))[0]
    pull, shear = state = np.array([0.2, 0.1])
    count, force = BASE.sum(), np.array([-2.0 * pull, 0.0, shear])
    middle = (MESH.nodes + 1e-3 * moved(0, *state)["U"])[BASE].mean(axis=0)
    assert model.reactions["force_base"].value(state) == pytest.approx(count * force[None], abs=1e-5)
    assert model.reactions["moment_base"].value(state)[0] == pytest.approx(count * np.cross(middle, force), abs=1e-4)
    assert model.supports["base"].tolist() == np.flatnonzero(BASE).tolist()


def test_columns_of_the_table_are_the_reaction_of_a_support(tmp_path):
    states = scattered()
    rows = np.column_stack([states, 3.0 * states[:, 0], 0.0 * states[:, 0], states[:, 1] ** 2])
    keys = '[external.reactions]\nbase = ["fx", "fy", "fz"]'
    header = "file, pull [1], shear [1], fx [kN], fy [kN], fz [kN]"
    model = made(write(tmp_path, rows, moved, keys, header))[0]
    assert [parameter.name for parameter in model.parameters] == ["pull", "shear"]
    assert model.reactions["force_base"].value([0.2, 0.1])[0] == pytest.approx([600.0, 0.0, 10.0], abs=1e-2)


@pytest.mark.parametrize(
    ("data", "message"),
    [("all", "the forces 'all' balance, so they are those of several supports"), ("none", "are zero in all")],
)
def test_forces_that_are_those_of_no_support_are_refused(tmp_path, refused, data, message):
    def fields(number, *state):
        return with_forces(number, *state) | {"none": np.zeros((len(POINTS), 3))}

    folder = write(tmp_path, scattered(12), fields, f'force_unit = "N"\n[external.reactions]\nbase = "{data}"')
    assert message in refused("build", folder, "-o", tmp_path / "x.morph")
