"""The silicone bar's example on a bar made here, whose outline and depths are drawn in a known state."""

import importlib
import sys

import cv2
import numpy as np
import pytest

from morph_dslam import MorphError
from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, rotation_exp
from morph_dslam.meshing.generators import block
from morph_dslam.model import Parameter, ReducedModel, SeparatedField
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.render.rasteriser import rasterise
from tests.support.real_data import ROOT

NAMES = ("recording", "silhouette", "silicone", "pictures", "fitting")
CLAMPED_FROM = 0.07
CAMERA = Camera(640, 480, 700.0, 700.0, 319.5, 239.5)
#: The bar hangs in front of the camera, seen a little from the side: y up, as the recordings have it.
POSE = RigidTransform(
    rotation_exp(np.array([0.0, 0.35, 0.0])) @ np.diag([1.0, -1.0, -1.0]), np.array([0.0, -0.02, 0.45])
)
SOFTNESS = 1.3


@pytest.fixture
def example(monkeypatch):
    """The example's modules by name."""
    monkeypatch.syspath_prepend(str(ROOT / "examples" / "diffcal_silicone"))
    for name in NAMES:
        monkeypatch.delitem(sys.modules, name, raising=False)
    return {name: importlib.import_module(name) for name in NAMES}


def bar_model() -> ReducedModel:
    """A bar along x whose free part sinks with the square of the way from its clamp, and with softness."""
    mesh = block((0.2, 0.03, 0.03), (40, 4, 4), "hex8")
    nodes = mesh.nodes - [0.1, 0.015, 0.015]
    free = np.maximum(CLAMPED_FROM - nodes[:, 0], 0.0)
    modes = np.zeros((1, len(nodes), 3))
    modes[0, :, 1] = -1.5 * free**2
    low, high = 0.3, 2.5
    middle, half = (low + high) / 2.0, (high - low) / 2.0
    functions = ParameterFunctions(
        np.array([low]), np.array([high]), np.array([[0], [1]]), np.array([[middle], [half]])
    )
    return ReducedModel(
        "bar",
        nodes,
        mesh.surface_triangles(),
        (Parameter("softness", "ratio", "1", low, high, 1.0, ""),),
        SeparatedField(modes, functions),
        cells={"hex8": mesh.blocks[0].connectivity},
    )


def drawn(model):
    """What the camera sees of the bar: brightness, noisy (h, w), and depth, NaN where there is none."""
    nodes = POSE.apply(model.positions(np.array([SOFTNESS])))
    buffers = rasterise(CAMERA.project(nodes), nodes[:, 2], model.triangles, CAMERA.height, CAMERA.width)
    random = np.random.default_rng(2)
    level = cv2.GaussianBlur(100.0 * buffers.covered.astype(np.float32), (0, 0), 1.0)
    level += random.normal(0.0, 2.0, level.shape).astype(np.float32)
    depth = np.where(buffers.covered, buffers.depth, np.nan)
    return level, (depth + random.normal(0.0, 5e-4, depth.shape)).astype(np.float32)


def test_outline_of_a_disc_is_its_circle(example):
    rows, columns = np.mgrid[:120, :160]
    distance = np.hypot(columns - 80.3, rows - 60.7)
    level = np.clip(40.5 - distance, 0.0, 1.0).astype(np.float32)
    outline = example["silhouette"].outline_of(level, np.array([[80.0, 60.0], [75.0, 55.0]]))
    radii = np.hypot(outline[:, 0] - 80.3, outline[:, 1] - 60.7)
    assert radii.mean() == pytest.approx(40.0, abs=0.1)
    assert radii.std() < 0.25
    with pytest.raises(MorphError, match="does not stand out"):
        example["silhouette"].outline_of(level, np.array([[5.0, 5.0]]))


def test_softness_and_pose_of_a_drawn_bar_are_found(example):
    model = bar_model()
    level, depth = drawn(model)
    truth = POSE.apply(model.positions(np.array([SOFTNESS])))
    inside = CAMERA.project(truth[np.abs(model.nodes[:, 0]) < 0.05])
    outline = example["silhouette"].outline_of(level, inside)
    # What is known of the pose beforehand is off by as much as a marker's.
    off = RigidTransform(rotation_exp(np.radians([0.8, -0.9, 0.7])), np.zeros(3))
    known = RigidTransform(off.rotation @ POSE.rotation, POSE.translation + np.array([0.003, -0.002, 0.005]))
    image = np.zeros((480, 640, 3), dtype=np.uint8)
    away = {}
    for seen in (depth, None):
        picture = example["pictures"].Picture("drawn", image, CAMERA, known, 6e-3, outline, seen)
        found = example["fitting"].fit(model, picture)
        assert found.outline_rms < 0.5
        assert found.interval[0] < 50.1e3 / SOFTNESS < found.interval[1]
        assert found.shear == pytest.approx(50.1e3 / SOFTNESS, rel=0.05)
        nodes = found.state.camera_from_object.apply(model.positions(found.state.parameters))
        away[seen is None] = np.linalg.norm(nodes - truth, axis=1).mean()
    assert away[False] < 1e-3  # with depths the place along the sight lines is known too
    assert away[True] < 6e-3


def test_neighbouring_errors_are_counted_as_often_as_they_repeat(example):
    """Of an autoregressive sequence with correlation r, (1 + r) / (1 - r) neighbours have one error."""
    random = np.random.default_rng(0)
    errors = random.normal(size=20_000)
    assert example["fitting"].points_alike(errors) == pytest.approx(1.0, abs=0.1)
    for k in range(1, len(errors)):
        errors[k] += 0.8 * errors[k - 1]
    assert example["fitting"].points_alike(errors) == pytest.approx(9.0, rel=0.25)
