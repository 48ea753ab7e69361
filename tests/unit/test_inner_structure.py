"""Inner structures: carried by a displacement that is known in closed form, kept in files, and drawn."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from morph_dslam.cli.app import main
from morph_dslam.errors import ModelFileError, StudyError
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.model import ReducedModel, SeparatedField, save_model
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.model.inner_structure import load_inner_structure, save_inner_structure
from morph_dslam.render.overlay import draw_inner_surface, draw_overlay
from morph_dslam.studies.inner_structures import place_inner_structure
from morph_dslam.tracking.estimator import Estimate, State, moved
from morph_dslam.tracking.run_folder import centre_and_std
from morph_dslam.tracking.run_options import TrackOptions
from morph_dslam.tracking.setup import load_objects
from tests.support.bent_sheet import bent_sheet_model
from tests.support.rendered_sequence import CAMERA
from tests.support.small_models import block_model

#: Four points inside of the block of 100 mm.
NODES = np.array([[0.02, 0.03, 0.04], [0.06, 0.03, 0.04], [0.03, 0.07, 0.05], [0.04, 0.05, 0.08]])
TRIANGLES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
GRADIENTS = np.random.default_rng(4).normal(size=(3, 3, 3))
MU = np.array([0.4, 0.3, 1.1])


def affine_block() -> ReducedModel:
    """A block whose displacement is u = sum_k mu_k G_k X."""
    block = block_model("polynomial")
    lower, upper = block.lower, block.upper
    powers = np.vstack([np.zeros(3, dtype=np.int64), np.eye(3, dtype=np.int64)])
    coefficients = np.vstack([(lower + upper) / 2.0, np.diag((upper - lower) / 2.0)])
    functions = ParameterFunctions(lower, upper, powers, coefficients)
    modes = np.einsum("kxy,ny->knx", GRADIENTS, block.nodes)
    return replace(block, displacement=SeparatedField(modes, functions), reactions={})


def placed():
    return place_inner_structure(affine_block(), "tumour", NODES, TRIANGLES)


def test_nodes_follow_the_displacement_of_the_points_where_they_lie():
    carried = placed().carried_by(affine_block())
    expected = NODES + np.einsum("k,kxy,ny->nx", MU, GRADIENTS, NODES)
    np.testing.assert_allclose(carried.nodes(MU), expected, atol=1e-12)
    centre, sensitivities = carried.centre_and_sensitivities(MU)
    np.testing.assert_allclose(centre, expected.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(sensitivities, GRADIENTS @ NODES.mean(axis=0), atol=1e-12)


def test_files_keep_everything(tmp_path):
    structure = placed()
    save_inner_structure(tmp_path / "tumour.h5", structure)
    found = load_inner_structure(tmp_path / "tumour.h5")
    assert found.name == "tumour"
    for ours, theirs in ((found, structure), (found.points, structure.points)):
        for name in vars(theirs):
            if isinstance(vars(theirs)[name], np.ndarray):
                np.testing.assert_array_equal(vars(ours)[name], vars(theirs)[name])


def test_models_of_another_mesh_are_refused():
    other = affine_block()
    with pytest.raises(ModelFileError, match="'tumour' was not made for the mesh of the model 'block'"):
        placed().carried_by(replace(other, nodes=1.01 * other.nodes))
    sheet = bent_sheet_model(3, 3)
    with pytest.raises(ModelFileError, match="was not made for the mesh"):
        placed().carried_by(sheet)


def test_points_outside_and_sheets_are_refused():
    with pytest.raises(
        StudyError, match=r"'rib' does not fit into 'block': 1 of 4 points lie outside .* reaches from \(0.0, "
    ):
        place_inner_structure(affine_block(), "rib", NODES + np.array([0.0, 0.0, 0.03]), TRIANGLES)
    with pytest.raises(StudyError, match="the model of a surface: it has no inside for 'rib'"):
        place_inner_structure(bent_sheet_model(3, 3), "rib", NODES, TRIANGLES)


@pytest.mark.parametrize("damage", ["text", "other", "index", "missing"])
def test_damaged_files_are_refused(tmp_path, damage):
    path = tmp_path / "tumour.h5"
    if damage == "text":
        path.write_text("tumour")
    elif damage != "missing":
        save_inner_structure(path, placed())
        with h5py.File(path, "a") as file:
            if damage == "other":
                file.attrs["format"] = "something else"
            else:
                del file["triangles"]
                file["triangles"] = np.where(TRIANGLES == 3, 4, TRIANGLES)
    with pytest.raises(ModelFileError, match="morph inner"):
        load_inner_structure(path)


def test_the_centres_deviation_is_that_of_samples_of_the_estimate():
    """Standard deviations of 40 000 normally distributed states, moved one by one."""
    carried = placed().carried_by(affine_block())
    pose = RigidTransform(rotation_exp(np.array([0.3, -0.5, 0.2])), np.array([0.02, -0.01, 0.4]))
    rng = np.random.default_rng(3)
    root = rng.normal(size=(9, 9)) * np.array([2e-3] * 3 + [1e-3] * 3 + [1e-4] * 3)[:, None]
    estimate = Estimate(
        state=State(MU, pose), cost=0.0, residuals=np.zeros((0, 2)), sigma_px=1.0,
        covariance=root @ root.T, at_bound=np.zeros(3, dtype=bool), iterations=1, converged=True,
    )  # fmt: skip
    centre, deviation = centre_and_std(carried, estimate)
    np.testing.assert_allclose(centre, pose.apply(carried.nodes(MU)).mean(axis=0), atol=1e-12)
    rest = NODES.mean(axis=0)
    samples = []
    for step in rng.normal(size=(40000, 9)) @ root.T:
        state = moved(estimate.state, step)
        point = rest + np.einsum("k,kxy,y->x", state.parameters, GRADIENTS, rest)
        samples.append(state.camera_from_object.apply(point[None])[0])
    np.testing.assert_allclose(deviation, np.std(samples, axis=0), rtol=0.02)
    blind = replace(estimate, covariance=np.full((9, 9), np.inf))
    assert np.isinf(centre_and_std(carried, blind)[1]).all()


def test_what_lies_behind_the_surface_is_drawn_through_it():
    grey = np.full((120, 160, 3), 90, dtype=np.uint8)
    square = np.array([[20.0, 20.0], [119.0, 20.0], [119.0, 99.0], [20.0, 99.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    surface = draw_overlay(grey, square, np.ones(4), faces, np.ones(4), (0.0, 1.0), label="stress [MPa]", alpha=0.4)
    before = surface.copy()
    inner = 0.25 * (square - 60.0) + 60.0
    drawn = draw_inner_surface(surface, inner, np.full(4, 2.0), faces, (200, 40, 220), alpha=0.6)
    np.testing.assert_array_equal(surface, before)
    np.testing.assert_allclose(drawn[60, 60], 0.4 * before[60, 60] + 0.6 * np.array([200, 40, 220]), atol=1)
    changed = np.argwhere((drawn != before).any(axis=2))
    assert (changed.min(axis=0) >= [49, 49]).all()
    assert (changed.max(axis=0) <= [71, 76]).all()
    labelled = draw_inner_surface(surface, inner, np.full(4, 2.0), faces, (200, 40, 220), label="tumour")
    assert (labelled[30:49, 78:100] != before[30:49, 78:100]).any()


def write_surface(path, nodes):
    """An .obj file of the four points, as numbers without a unit."""
    lines = ["v {:.6f} {:.6f} {:.6f}".format(*node) for node in nodes]
    lines += ["f {} {} {}".format(*triangle) for triangle in TRIANGLES + 1]
    path.write_text("\n".join(lines) + "\n")


def test_the_command_places_a_surface_file(tmp_path, capsys):
    save_model(tmp_path / "block.morph", affine_block())
    write_surface(tmp_path / "tumour.obj", 1e3 * NODES)
    command = ["inner", str(tmp_path / "tumour.obj"), "--model", str(tmp_path / "block.morph")]
    assert main([*command, "--unit", "mm", "-o", str(tmp_path / "tumour.h5")]) == 0
    out = capsys.readouterr().out
    assert "'tumour', 4 nodes inside of 'block', 40 x 40 x 40 mm around (37.5, 45, 52.5) mm" in out
    assert "note:" not in out
    found = load_inner_structure(tmp_path / "tumour.h5")
    np.testing.assert_allclose(np.sort(found.rest, axis=0), np.sort(NODES, axis=0), atol=1e-9)
    assert main([*command, "--unit", "cm", "-o", str(tmp_path / "wrong.h5")]) == 2
    assert "does not fit into 'block'" in capsys.readouterr().err


def test_a_structure_that_is_hardly_as_small_is_named_with_the_unit_that_fits(tmp_path, capsys):
    """Drawn in metres and read in millimetres; a bead of 0.5 mm may be one."""
    save_model(tmp_path / "block.morph", affine_block())
    command = ["inner", str(tmp_path / "tumour.obj"), "--model", str(tmp_path / "block.morph"), "--unit", "mm"]
    write_surface(tmp_path / "tumour.obj", NODES)
    assert main([*command, "-o", str(tmp_path / "tumour.h5")]) == 0
    out = capsys.readouterr().out
    assert "measures 0.04 x 0.04 x 0.04 mm in a solid of 100 x 100 x 100 mm" in out
    assert "drawn in m, it would measure 40 x 40 x 40 mm and lie inside too: if so, make it again with --unit m" in out
    for size, is_named in ((0.5, False), (0.05, True)):
        write_surface(tmp_path / "tumour.obj", [60, 70, 80] + size * (NODES - NODES[0]) / 0.04)
        assert main([*command, "-o", str(tmp_path / "tumour.h5")]) == 0
        assert ("is --unit mm right?" in capsys.readouterr().out) == is_named


def test_names_are_of_letters_digits_and_spaces(tmp_path, capsys):
    save_model(tmp_path / "block.morph", affine_block())
    write_surface(tmp_path / "tumour.obj", 1e3 * NODES)
    command = ["inner", str(tmp_path / "tumour.obj"), "--model", str(tmp_path / "block.morph"), "--unit", "mm"]
    assert main([*command, "--name", "left/lobe", "-o", str(tmp_path / "tumour.h5")]) == 2
    assert "'left/lobe' is no name of an inner structure: give one of letters" in capsys.readouterr().err
    assert not (tmp_path / "tumour.h5").exists()


def test_two_structures_of_one_name_are_refused_before_the_tracking(tmp_path):
    save_model(tmp_path / "block.morph", affine_block())
    for name in ("a.h5", "b.h5"):
        save_inner_structure(tmp_path / name, placed())
    run = TrackOptions(
        frames="frames",
        model=tmp_path / "block.morph",
        camera=tmp_path / "camera.yaml",
        output=tmp_path / "run",
        landmarks=tmp_path / "landmarks.csv",
        inner=(tmp_path / "a.h5", tmp_path / "b.h5"),
    )
    with pytest.raises(ModelFileError, match=r"two inner structures are called 'tumour', the second one is .*b\.h5"):
        load_objects(run, CAMERA)


def test_a_file_of_another_kind_is_named_with_those_that_are_read(tmp_path, capsys):
    save_model(tmp_path / "block.morph", affine_block())
    (tmp_path / "tumour.step").write_text("ISO-10303-21;")
    command = ["inner", str(tmp_path / "tumour.step"), "--model", str(tmp_path / "block.morph")]
    assert main([*command, "--unit", "mm", "-o", str(tmp_path / "tumour.h5")]) == 2
    assert "is no surface file that is read; use .stl, .obj, .ply" in capsys.readouterr().err
