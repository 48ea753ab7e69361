"""The liver example's pieces on organs made here, and an inner structure tracked from files to the video."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from morph_dslam.cli.app import main
from morph_dslam.geometry import RigidTransform
from morph_dslam.meshing.generators import block
from morph_dslam.meshing.mesh_files import load_mesh
from morph_dslam.model import Parameter, ReducedModel, SeparatedField, load_model, save_model
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.model.inner_structure import save_inner_structure
from morph_dslam.render.simulation import simulate
from morph_dslam.studies.inner_structures import place_inner_structure

EXAMPLE = Path(__file__).parents[2] / "examples" / "liver"
SIZE = (0.12, 0.08, 0.06)
SCENE = """
model = "organ.morph"
frames = 6
seed = 1
supersampling = 1
camera = { width = 320, height = 240, fx = 300.0, fy = 300.0, cx = 159.5, cy = 119.5 }
[surface]
texture = "print.png"
[sensor]
noise = 1.0
[[camera_path]]
frame = 0
position_mm = [-30, -170, 130]
target_mm = [60, 40, 30]
[[parameters]]
frame = 0
bend = 0.0
[[parameters]]
frame = 5
bend = 9.0
"""


@pytest.fixture
def example(monkeypatch):
    """The example's modules."""
    monkeypatch.syspath_prepend(str(EXAMPLE))
    import comparison
    import organ
    import organ_mesh

    yield {"comparison": comparison, "organ": organ, "organ_mesh": organ_mesh}
    for name in ("comparison", "organ", "organ_mesh"):
        sys.modules.pop(name)


def volume(nodes, triangles):
    """Volume within a closed surface, by the divergence theorem."""
    a, b, c = (nodes[triangles[:, corner]] for corner in range(3))
    return np.einsum("tx,tx->", a, np.cross(b, c)) / 6.0


def test_an_ellipsoid_is_closed_and_has_its_volume(example):
    nodes, triangles = example["organ"].ellipsoid((0.08, 0.06, 0.11), (0.011, 0.009, 0.008), 642)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges) == len(np.unique(edges[:, ::-1], axis=0))
    exact = 4.0 / 3.0 * np.pi * 0.011 * 0.009 * 0.008
    assert volume(nodes, triangles) == pytest.approx(exact, rel=0.015)


def test_an_organ_is_meshed_anew_and_its_patches_are_kept_in_the_file(tmp_path, example):
    """A ball of 50 mm, given as a block of fine tetrahedra mapped onto it."""
    module = example["organ_mesh"]
    cube = block((2.0, 2.0, 2.0), (8, 8, 8), "tet4")
    unit = cube.nodes - 1.0
    length = np.linalg.norm(unit, axis=1, keepdims=True)
    ball = 0.05 * unit * np.abs(unit).max(axis=1, keepdims=True) / np.where(length > 0.0, length, 1.0)
    patches = {"top": module.Patch((0.0, 0.0, 0.05), 0.02)}
    mesh = module.organ_mesh(replace(cube, nodes=ball), 0.016, patches)
    assert mesh.blocks[0].cell_type == "tet10"
    exact = 4.0 / 3.0 * np.pi * 0.05**3
    # Smoothing and flat faces take about 2 mm off the radius at this size of cells.
    assert 0.8 * exact < volume(mesh.nodes, mesh.surface_triangles()) < exact
    radii = np.linalg.norm(mesh.nodes[np.unique(mesh.surface_triangles())], axis=1)
    assert 0.045 < radii.min() < radii.max() < 0.053
    assert np.abs(mesh.nodes.mean(axis=0)).max() < 2e-3
    top = mesh.nodes[mesh.set_nodes("top")]
    assert np.linalg.norm(top - [0.0, 0.0, 0.05], axis=1).max() < 0.032
    module.write_inp(tmp_path / "organ.inp", mesh)
    found = load_mesh(tmp_path / "organ.inp", "mm")
    np.testing.assert_allclose(found.nodes, mesh.nodes, atol=1e-10)
    np.testing.assert_array_equal(found.blocks[0].connectivity, mesh.blocks[0].connectivity)
    np.testing.assert_array_equal(found.surface("top"), mesh.surface("top"))


def bending_block() -> ReducedModel:
    """A block whose end rises with the square of x: u_z = bend (x / L)²."""
    mesh = block(SIZE, (6, 4, 3), "hex8")
    functions = ParameterFunctions(
        np.array([-0.01]), np.array([0.02]), np.array([[0], [1]]), np.array([[0.005], [0.015]])
    )
    modes = np.zeros((1, mesh.n_nodes, 3))
    modes[0, :, 2] = (mesh.nodes[:, 0] / SIZE[0]) ** 2
    return ReducedModel(
        "organ",
        mesh.nodes,
        mesh.surface_triangles(),
        (Parameter("bend", "length", "mm", -0.01, 0.02, 0.0, "way of the end"),),
        SeparatedField(modes, functions),
        cells={"hex8": mesh.blocks[0].connectivity},
    )


def print_texture(path):
    """Noise with details of several sizes."""
    rng = np.random.default_rng(5)
    image = np.zeros((600, 600))
    for cells in (20, 60, 150):
        image += cv2.resize(rng.normal(size=(cells, cells)), (600, 600), interpolation=cv2.INTER_CUBIC)
    cv2.imwrite(str(path), np.clip(128.0 + 45.0 * image, 0, 255).astype(np.uint8))


@pytest.mark.usefixtures("drawn_figures")
def test_a_hidden_structure_is_followed_through_a_rendered_recording(tmp_path, example):
    model = bending_block()
    save_model(tmp_path / "organ.morph", model)
    print_texture(tmp_path / "print.png")
    (tmp_path / "scene.toml").write_text(SCENE)
    sequence, run = tmp_path / "sequence", tmp_path / "run"
    simulate(tmp_path / "scene.toml", sequence, progress=False)
    nodes, triangles = example["organ"].ellipsoid((0.09, 0.04, 0.03), (0.012, 0.01, 0.008), 60)
    tumour = place_inner_structure(model, "tumour", nodes, triangles)
    save_inner_structure(tmp_path / "tumour.h5", tumour)
    command = ["track", sequence / "frames", "--model", tmp_path / "organ.morph"]
    command += ["--camera", sequence / "camera.yaml", "--landmarks", sequence / "landmarks.csv"]
    command += ["--inner", tmp_path / "tumour.h5", "-o", run]
    assert main([str(part) for part in command]) == 0
    truth = np.load(sequence / "truth.npz")
    bend = truth["parameters"][-1, 0]
    assert bend == pytest.approx(0.009)
    # The displacement is interpolated linearly between nodes 20 mm apart, so it is not x² in between.
    expected = nodes.copy()
    expected[:, 2] += bend * np.interp(nodes[:, 0], np.arange(7) * 0.02, (np.arange(7) / 6.0) ** 2)
    pose = RigidTransform.from_matrix(truth["camera_from_object"][-1])
    with h5py.File(run / "result.h5") as file:
        centre = np.asarray(file["inner/tumour/centre"])
        deviation = np.asarray(file["inner/tumour/centre_std"])
    assert centre.shape == deviation.shape == (6, 3)
    assert np.linalg.norm(centre[-1] - pose.apply(expected).mean(axis=0)) < 0.5e-3
    assert 0.0 < deviation[-1].max() < 1e-3
    found = example["comparison"].compare(run, sequence, model, tumour.carried_by(model))
    assert found.frames.tolist() == list(range(6))
    assert found.tumour.max() < 0.5e-3
    moved = bend * np.interp(nodes[:, 0], np.arange(7) * 0.02, (np.arange(7) / 6.0) ** 2).mean()
    assert found.undeformed[-1] == pytest.approx(moved, rel=1e-6)
    example["comparison"].plot(tmp_path / "tumour.png", found, load_model(run / "model.morph").parameters)
    assert cv2.imread(str(tmp_path / "tumour.png")).shape[0] > 300
    # The video shows the tumour's colour, more red and blue than green, around its centre.
    capture = cv2.VideoCapture(str(run / "augmented.mp4"))
    image = capture.read()[1].astype(int)
    capture.release()
    column, row = np.rint(300.0 * centre[0, :2] / centre[0, 2] + [159.5, 119.5]).astype(int)
    blue, green, red = image[row - 2 : row + 3, column - 2 : column + 3].mean(axis=(0, 1))
    assert min(blue, red) - green > 40


@pytest.mark.slow
def test_without_the_mesh_the_example_says_what_is_missing(tmp_path):
    done = subprocess.run(
        [sys.executable, str(EXAMPLE / "run.py"), "--data", str(tmp_path)], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "there is no mesh" in done.stderr
    assert "MORPH_DATA" in done.stderr
    assert "Traceback" not in done.stderr
