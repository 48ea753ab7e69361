"""Exports of runs: shapes with unknown loads and a discrepancy, in closed form, and where the camera saw them."""

import csv
from dataclasses import replace

import meshio
import numpy as np
import pygltflib
import pytest
from scipy.spatial.transform import Rotation

from morph_dslam import StateChoice, export, load_run
from morph_dslam.camera import Camera
from morph_dslam.cli import app as cli
from morph_dslam.errors import ExportError
from morph_dslam.geometry import RigidTransform
from morph_dslam.io.camera_files import save_camera
from morph_dslam.model import SeparatedField, save_model
from morph_dslam.model.discrepancy import Discrepancy, DiscrepancyBasis
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.model.unknown_loads import SecondOrder, UnknownLoads, with_unknown_loads
from morph_dslam.tracking.estimator import Estimate, State
from morph_dslam.tracking.known_values import KnownValues
from morph_dslam.tracking.outcomes import FoundBy, Rejection, RejectionReason, Status
from morph_dslam.tracking.result import FrameResult
from morph_dslam.tracking.run_folder import write_csv, write_hdf5
from morph_dslam.tracking.run_results import RunResults
from tests.support.bent_sheet import bent_sheet_model
from tests.support.documents import samples
from tests.support.streamed import stress_at
from tests.support.stretched_block import SHEAR_MODULUS, SIZE, YOUNG_MODULUS, stretched_block_model

#: Stretch, slide (m), and the coefficients of two loads in the frames that were tracked.
STATES = {3: (0.1, 0.001, 0.5, -0.2), 5: (0.05, -0.002, -0.3, 0.4), 6: (-0.1, 0.004, 0.2, 0.1)}
#: Stress yz, Pa, of a unit of the first load at z = 1 m.
LOADED = 2e6
POSE = RigidTransform(Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix(), np.array([0.02, -0.01, 0.5]))


def loaded_block():
    """The block with two loads q, p: u_y = q z², u_z = p x, to second order u_x = q² z; stress yz = LOADED q z."""
    block = stretched_block_model()
    constant = ParameterFunctions(block.lower, block.upper, np.zeros((1, 2), dtype=np.int64), np.ones((1, 1)))
    (x, _, z), n = block.nodes.T, len(block.nodes)
    moved, second, stress = np.zeros((1, n, 6)), np.zeros((1, n, 3)), np.zeros((1, n, 12))
    moved[0, :, 1], moved[0, :, 5], second[0, :, 0], stress[0, :, 3] = z**2, x, z, LOADED * z
    responses = {
        "displacement": SeparatedField(moved, constant),
        "stress_solid": SeparatedField(stress, constant),
        "strain": SeparatedField(stress / (2.0 * SHEAR_MODULUS), constant),
        "compliance_root": SeparatedField(np.array([[[1.0], [0.0], [1.0]]]).reshape(1, 1, 3), constant),
    }
    of_second = SecondOrder(np.array([[1.0, 0.0]]), SeparatedField(second, constant))
    loads = UnknownLoads("", False, np.arange(n), np.ones((n, 3, 2)), np.ones((2, 6)), responses, of_second)
    return replace(block, unknown_loads=loads)


def displaced(nodes, stretch, slide, q=0.0, p=0.0):
    x, _, z = nodes.T
    return np.column_stack([stretch * x + slide * z / SIZE[2] + q**2 * z, q * z**2, p * x])


def shifted(nodes, scale):
    """A discrepancy that is given at the nodes themselves, and so is its values there: shifts along y."""
    values = np.zeros_like(nodes)
    values[:, 1] = scale * (1.0 + nodes[:, 0])
    return Discrepancy(DiscrepancyBasis(nodes, 0.02), values)


def write_run(folder, model, of_study, discrepancies=False):
    """Files of a run with `STATES`, and a frame 4 that was lost; ``model`` has loads where the run has them."""
    folder.mkdir(exist_ok=True)
    run, d = RunResults(model, 3), len(model.parameters)
    for frame, state in STATES.items():
        if frame == 5:
            reason = Rejection(RejectionReason.FEW_POINTS, 4, 300, 30)
            run.add(4, 0.4, FrameResult(model, Status.LOST, rejection=reason))
        estimate = Estimate(
            State(np.array(state[:d]), POSE), 1.0, np.zeros((9, 2)), 0.3, np.eye(d + 6), np.zeros(d, bool), 4, True
        )
        beyond = shifted(model.nodes, 1e-3 * frame) if discrepancies else None
        run.add(frame, 0.1 * frame, FrameResult(model, Status.TRACKED, estimate, FoundBy.FLOW, discrepancy=beyond))
    write_hdf5(folder / "result.h5", run)
    write_csv(folder / "frames.csv", run)
    save_model(folder / "model.morph", of_study)
    save_camera(folder / "camera.yaml", Camera(640, 480, 500.0, 500.0, 320.0, 240.0))
    return folder


@pytest.fixture
def with_loads(tmp_path):
    return write_run(tmp_path / "run", with_unknown_loads(loaded_block()), loaded_block())


def test_the_documented_table_along_a_line(tmp_path, monkeypatch):
    """Of a block that is stretched and sheared evenly."""
    write_run(tmp_path / "run", stretched_block_model(), stretched_block_model())
    monkeypatch.chdir(tmp_path)
    exec(compile(samples("export", "python")[1], "export", "exec"), {})
    table = np.genfromtxt("line.csv", delimiter=",", names=True)
    assert len(table) == 24 * len(STATES)
    for frame, (stretch, slide, *_) in STATES.items():
        rows = table[table["frame"] == frame]
        np.testing.assert_allclose(rows["x_mm"], np.linspace(1.0, 47.0, 24))
        moved = stretch * rows["x_mm"] + 1e3 * slide * 2.5e-3 / SIZE[2]
        np.testing.assert_allclose(rows["displacement_x_mm"], moved, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(rows["von_mises_Pa"], stress_at(stretch, slide), rtol=1e-6)


@pytest.fixture
def with_discrepancy(tmp_path):
    return write_run(tmp_path / "run", stretched_block_model(), stretched_block_model(), discrepancies=True)


def read(folder, name="model"):
    """Rows of states.csv, and the mesh of each."""
    with (folder / "states.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return rows, [meshio.read(folder / f"{name}_{i:04d}.vtu") for i in range(len(rows))]


def close(found, wanted, **tolerance):
    np.testing.assert_allclose(found, wanted, **tolerance or {"atol": 1e-8})


@pytest.mark.parametrize("path", ["", "result.h5", "frames.csv"])
def test_a_run_with_unknown_loads_is_exported_whole(path, with_loads, tmp_path, capsys):
    options = ["--format", "vtu", "--path", str(with_loads / path), "-o", str(tmp_path / "out")]
    assert cli.main(["export", str(with_loads / "model.morph"), *options]) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]
    assert len(said) == (path == "frames.csv")
    assert all("unknown loads of the table's frames" in line and str(with_loads / "result.h5") in line for line in said)
    rows, meshes = read(tmp_path / "out")
    assert [row["from_frame"] for row in rows] == ["3", "5", "6"]
    for row, mesh, state in zip(rows, meshes, STATES.values(), strict=True):
        stretch, slide, q, _ = state
        close(mesh.point_data["displacement"], displaced(mesh.points, *state))
        stress = mesh.point_data["stress"].reshape(-1, 3, 3)
        close(stress[:, 1, 2], LOADED * q * mesh.points[:, 2], rtol=1e-5, atol=1e-3)
        close(stress[:, 0, 0], YOUNG_MODULUS * stretch, rtol=1e-5)
        close([float(row["load 1 [1]"]), float(row["slide [mm]"])], [q, 1e3 * slide])


def test_a_table_of_exported_states_keeps_their_loads(with_loads, tmp_path):
    model = loaded_block()
    for path, out in ((with_loads, "once"), (tmp_path / "once" / "states.csv", "twice")):
        export(model, tmp_path / out, "vtu", StateChoice(path=path))
    _, meshes = read(tmp_path / "twice", "stretched_block")
    for mesh, state in zip(meshes, STATES.values(), strict=True):
        close(mesh.point_data["displacement"], displaced(mesh.points, *state))


def test_rows_of_a_runs_table_are_found_in_its_result(with_loads, tmp_path):
    header, *rows = (with_loads / "frames.csv").read_text().splitlines()
    (with_loads / "chosen.csv").write_text("\n".join([header, rows[3], rows[0]]))
    export(loaded_block(), tmp_path / "out", "vtu", StateChoice(path=with_loads / "chosen.csv"))
    _, meshes = read(tmp_path / "out", "stretched_block")
    for mesh, frame in zip(meshes, (6, 3), strict=True):
        close(mesh.point_data["displacement"], displaced(mesh.points, *STATES[frame]))


@pytest.mark.parametrize("path", ["", "frames.csv"])
def test_displacements_have_the_discrepancy_of_their_frame(path, with_discrepancy, tmp_path):
    notices = []
    choice = StateChoice(path=with_discrepancy / path)
    export(with_discrepancy / "model.morph", tmp_path / "out", "vtu", choice, tell=notices.append)
    kinds = ["taken_from_result"] * (path == "frames.csv") + ["stress_without_discrepancy"]
    assert [notice.kind for notice in notices] == kinds
    _, meshes = read(tmp_path / "out")
    for mesh, (frame, state) in zip(meshes, STATES.items(), strict=True):
        moved = displaced(mesh.points, *state[:2])
        moved[:, 1] += 1e-3 * frame * (1.0 + mesh.points[:, 0])
        close(mesh.point_data["displacement"], moved, atol=2e-8)


def test_an_animation_has_loads_and_discrepancy(tmp_path):
    model = loaded_block()
    run = write_run(tmp_path / "run", with_unknown_loads(model), model, discrepancies=True)
    target = export(model, tmp_path / "out", "gltf", StateChoice(path=run))
    file = pygltflib.GLTF2().load(target)
    surface = np.unique(model.triangles)
    for mesh, node, (frame, state) in zip(file.meshes, file.nodes[1:], STATES.items(), strict=True):
        accessor = file.accessors[mesh.primitives[0].attributes.POSITION]
        start = file.bufferViews[accessor.bufferView].byteOffset
        points = np.frombuffer(file.binary_blob(), "<f4", 3 * accessor.count, start).reshape(-1, 3)
        moved = displaced(model.nodes, *state)
        moved[:, 1] += 1e-3 * frame * (1.0 + model.nodes[:, 0])
        close(points + node.translation, (model.nodes + moved)[surface], atol=1e-7)


@pytest.mark.parametrize("path", ["", "frames.csv"])
def test_coordinates_of_the_camera(path, tmp_path):
    """Nodes that are warped by their displacement are where the run, as it is evaluated, has them."""
    model = loaded_block()
    folder = write_run(tmp_path / "run", with_unknown_loads(model), model, discrepancies=True)
    export(model, tmp_path / "out", "vtu", StateChoice(path=folder / path, coordinates="camera"))
    run, (_, meshes) = load_run(folder), read(tmp_path / "out", "stretched_block")
    for mesh, (frame, (stretch, slide, q, _)) in zip(meshes, STATES.items(), strict=True):
        row = run.row(frame)
        close(mesh.points, POSE.apply(model.nodes), atol=1e-12)
        close(mesh.points + mesh.point_data["displacement"], run.camera_points(row), atol=2e-8)
        corner = int(np.argmax(model.nodes.sum(axis=1)))
        z, shear = model.nodes[corner, 2], SHEAR_MODULUS * slide / SIZE[2]
        stress = np.array([[YOUNG_MODULUS * stretch, 0, shear], [0, 0, LOADED * q * z], [shear, LOADED * q * z, 0]])
        turned = POSE.rotation @ stress @ POSE.rotation.T
        close(mesh.point_data["stress"][corner].reshape(3, 3), turned, rtol=1e-5, atol=0.1)
        # Invariants of a stress do not turn with it.
        equivalent = np.sqrt(1.5) * np.linalg.norm(stress - np.trace(stress) / 3.0 * np.eye(3))
        close(float(mesh.point_data["von_mises"].ravel()[corner]), equivalent, rtol=1e-5)


def test_a_run_without_either_is_exported_as_before(tmp_path):
    block = stretched_block_model()
    folder = write_run(tmp_path / "run", block, block)
    for path in ("", "result.h5", "frames.csv"):
        np.testing.assert_allclose(
            StateChoice(path=folder / path).states(block), [state[:2] for state in STATES.values()], rtol=1e-5
        )


@pytest.mark.parametrize("name", ["x", "rotation", "largest_displacement"])
def test_a_parameter_called_as_a_column_of_the_pose(name, tmp_path):
    """`x_mm` was there twice: of two columns of one name a reader gets the last."""
    block = stretched_block_model()
    stretch, slide = block.parameters
    block = replace(block, parameters=(stretch, replace(slide, name=name)))
    folder = write_run(tmp_path / "run", block, block)
    with (folder / "frames.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    assert len(set(header)) == len(header)
    tracked = [dict(zip(header, row, strict=True)) for row in rows if row[2] == "tracked"]
    title = f"{name}_mm" if name == "rotation" else f"{name} [mm]"
    close([float(row[title]) for row in tracked], [1e3 * state[1] for state in STATES.values()])
    close([float(row["x_mm"]) for row in tracked], 1e3 * POSE.translation[0])
    states = StateChoice(path=folder / "frames.csv").states(block)
    np.testing.assert_allclose(states, [state[:2] for state in STATES.values()], rtol=1e-5)


def test_a_parameter_called_as_the_deviation_of_another(tmp_path):
    """x_std_mm is the one, and beside a pose's x_mm "x_std [mm]" the deviation of x; so it is where it is known."""
    block = stretched_block_model()
    stretch, slide = block.parameters
    length = replace(stretch, name="x_std", quantity="length", unit="mm")
    block = replace(block, parameters=(length, replace(slide, name="x")))
    folder = write_run(tmp_path / "run", block, block)
    states = [state[:2] for state in STATES.values()]
    found = StateChoice(path=folder / "frames.csv").states(block)
    np.testing.assert_allclose(found, states, rtol=1e-5)
    known = KnownValues.read(folder / "frames.csv", block)
    names = [block.parameters[k].name for k in known.indices]
    rows = [dict(zip(names, known.by_frame[frame][:, 0].tolist(), strict=True)) for frame in STATES]
    np.testing.assert_allclose([[row["x_std"], row["x"]] for row in rows], states, rtol=1e-5)


def refused_for(model, match, **choice):
    with pytest.raises(ExportError, match=match):
        StateChoice(**choice).states(model)


def test_what_cannot_be_exported_says_why(with_loads, tmp_path, refused):
    model, other = loaded_block(), replace(loaded_block(), nodes=1.1 * loaded_block().nodes)
    options = ("-o", tmp_path / "out", "--path", with_loads)
    save_model(tmp_path / "other.morph", other)
    for path in (with_loads, with_loads / "frames.csv"):
        refused_for(other, "is of another model than", path=path)
    refused_for(bent_sheet_model(3, 3), "is of another model than", path=with_loads)
    refused_for(stretched_block_model(), r"another model .*export .*model\.morph", path=with_loads)
    refused_for(model, "--at slide=1 changes nothing", path=with_loads, at=["slide=1"])
    refused_for(model, "needs the poses of a run", coordinates="camera")
    refused_for(model, "not 'world'", coordinates="world")
    refused_for(model, "there is no .*result.h5", path=tmp_path)
    assert "needs --format vtu" in refused("export", with_loads / "model.morph", *options, "--coordinates", "camera")
    (with_loads / "chosen.csv").write_text("frame,slide_mm\n3,1\n9,1\n")
    refused_for(model, "has no state of frame 9", path=with_loads / "chosen.csv")
    (with_loads / "chosen.csv").write_text("frame,slide_mm\nlast,1\n")
    refused_for(model, "the frame 'last' is no number", path=with_loads / "chosen.csv")
    (with_loads / "result.h5").write_bytes(b"broken")
    refused_for(model, "or damaged", path=with_loads)


def test_shapes_with_a_discrepancy_show_no_stress(with_discrepancy, tmp_path, refused):
    options = ("-o", tmp_path / "out", "--path", with_discrepancy, "--format", "gltf", "--show")
    for show in ("stress", "none"):
        assert f"--show {show} cannot show its shapes" in refused(
            "export", with_discrepancy / "model.morph", *options, show
        )
