"""A stiffness ratio estimated from a video: a bar of two rubbers, bent at its end, filmed and tracked."""

from pathlib import Path

import numpy as np
import pytest

from morph_dslam import TrackerOptions
from morph_dslam.meshing.generators import block
from morph_dslam.model import load_model
from morph_dslam.studies.build import build
from morph_dslam.studies.study import make_study
from tests.support.scenes import film_and_track, write_texture

SIZE, CELLS = (0.16, 0.05, 0.006), (16, 4, 1)
RATIO = 2.2
STUDY = {
    "name": "bar of two rubbers",
    "mesh": {"file": "bar.inp", "unit": "mm"},
    "materials": {
        "root": {"law": "neo_hookean", "young": "1 MPa", "poisson": 0.45, "on": "root"},
        "tip": {"law": "neo_hookean", "young": "1 MPa * ratio", "poisson": 0.45, "on": "tip"},
    },
    "supports": [{"kind": "fixed", "on": "held"}, {"kind": "displacement", "on": "moved", "z": "lift"}],
    "parameters": {
        "lift": {"range": ["-60 mm", "60 mm"]},
        "ratio": {"range": [0.25, 4.0], "default": 1.0, "description": "stiffness of the tip over the root's"},
    },
    # The film is of this mesh. A finer one would move the ratio by a quarter and more, and stated deviations hold that.
    "sampling": {"scheme": "grid", "points": [7, 6], "held_out": 4, "refined": 0, "seed": 1},
    "reduction": {"method": "pod", "tolerance": 1e-4},
}
SCENE = """
model = "bar.morph"
frames = {frames}
seed = 1
supersampling = 1
image_format = "png"
camera = {{ width = 640, height = 480, fx = 600.0, fy = 600.0, cx = 319.5, cy = 239.5 }}
[surface]
texture = "print.png"
[sensor]
noise = 1.0
[[camera_path]]
frame = 0
position_mm = [40, -190, 110]
target_mm = [80, 25, 10]
[[parameters]]
frame = 0
lift = 0.0
ratio = {ratio}
[[parameters]]
frame = {middle}
lift = {lift}
[[parameters]]
frame = {last}
lift = 0.0
"""


def write_bar(path: Path) -> None:
    """A bar along x as an Abaqus file: its half at the root and its half at the tip are two cell sets."""
    mesh = block(SIZE, CELLS, "hex8")
    cells = mesh.blocks[0].connectivity
    at_tip = mesh.nodes[cells].mean(axis=1)[:, 0] > SIZE[0] / 2.0
    sets = {
        "ELSET, ELSET=root": np.flatnonzero(~at_tip),
        "ELSET, ELSET=tip": np.flatnonzero(at_tip),
        "NSET, NSET=held": np.flatnonzero(mesh.nodes[:, 0] < 1e-9),
        "NSET, NSET=moved": np.flatnonzero(mesh.nodes[:, 0] > SIZE[0] - 1e-9),
    }
    lines = ["*NODE", *(f"{i}, {x}, {y}, {z}" for i, (x, y, z) in enumerate(1e3 * mesh.nodes, 1))]
    lines += ["*ELEMENT, TYPE=C3D8"]
    lines += [f"{i}, " + ", ".join(map(str, cell + 1)) for i, cell in enumerate(cells, 1)]
    for name, members in sets.items():
        lines += [f"*{name}", *(str(member + 1) for member in members)]
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the bar's model and a print."""
    path = tmp_path_factory.mktemp("bar")
    write_bar(path / "bar.inp")
    build(make_study(STUDY, path), path / "bar.morph")
    write_texture(path, (40, 60), (900, 600))
    return path


def tracked(folder: Path, name: str, lift: float, frames: int) -> dict:
    """The summary of a tracked film in which the bar's end is lifted and let down."""
    scene = folder / f"{name}.toml"
    scene.write_text(SCENE.format(frames=frames, middle=frames // 2, last=frames - 1, lift=lift, ratio=RATIO))
    return film_and_track(scene, folder / "bar.morph", tracker=TrackerOptions(per_sequence=("ratio",)))[0]


@pytest.mark.slow
def test_a_stiffness_ratio_is_estimated_over_a_sequence_with_an_interval_that_holds_it(folder):
    summary = tracked(folder, "lifted", lift=55.0, frames=24)
    assert summary["n_tracked"] == 24
    (ratio,) = summary["one_over_the_sequence"]
    low, high = ratio["interval_95"]
    assert ratio["observable"]
    assert low < RATIO < high
    assert high - low < 0.25 * RATIO


@pytest.mark.slow
def test_a_stiffness_ratio_of_a_bar_that_is_not_bent_is_said_not_to_be_told(folder):
    summary = tracked(folder, "straight", lift=0.0, frames=4)
    (ratio,) = summary["one_over_the_sequence"]
    assert not ratio["observable"]
    assert any("'ratio' is unobservable" in flag for flag in summary["flags"])


def test_the_ratio_changes_the_bars_shape(folder):
    """What there is to be seen: with a stiff tip the root bends more, so the middle is higher."""
    model = load_model(folder / "bar.morph")
    middle = np.argmin(np.linalg.norm(model.nodes - [SIZE[0] / 2.0, SIZE[1] / 2.0, 0.0], axis=1))
    heights = [model.positions(np.array([0.055, ratio]))[middle, 2] for ratio in (0.5, 1.0, 2.0, 4.0)]
    assert (np.diff(heights) > 0.3e-3).all()
