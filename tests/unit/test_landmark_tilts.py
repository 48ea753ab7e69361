"""Landmarks on flat objects far away: both tilts are known, and depth decides between them."""

import numpy as np
import pytest

from morph_dslam.extend.studies import build_rigid
from morph_dslam.geometry import RigidTransform, rotation_exp, rotation_log
from morph_dslam.io.landmarks import Landmarks
from morph_dslam.registration.landmarks import register_landmarks
from morph_dslam.registration.messages import Ambiguity, Ambiguous, DepthScaleUnlikely
from morph_dslam.tracking.estimator import State
from tests.support.rendered_sequence import CAMERA, UPRIGHT, sheet_depth

#: Metres. The back is 2 mm behind the front: its corners do not lie in the front's plane.
PLATE, ROD = (0.16, 0.10, 0.002), (0.24, 0.008, 0.008)


def box(folder, sides):
    """A rigid box with its middle at the origin."""
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)]) - 0.5
    quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
    lines = [f"v {x} {y} {z}" for x, y, z in 1e3 * corners * sides]
    lines += ["f " + " ".join(str(corner + 1) for corner in quad) for quad in quads]
    (folder / "box.obj").write_text("\n".join(lines) + "\n")
    return build_rigid(folder / "box.obj", "mm", folder / "box.morph")


@pytest.fixture(scope="module")
def plate(tmp_path_factory):
    return box(tmp_path_factory.mktemp("plate"), PLATE)


@pytest.fixture(scope="module")
def rod(tmp_path_factory):
    return box(tmp_path_factory.mktemp("rod"), ROD)


def placed(distance, turn=(0.3, 0.5, 0.0)):
    return RigidTransform(rotation_exp(np.array(turn)) @ UPRIGHT, np.array([0.02, -0.01, distance]))


def registered(model, pose, seed, click_px=0.4, depth_factor=None, larger=1.0, **known):
    """By the corners of one side, and two of the other one; the object is ``larger`` than its mesh."""
    rng = np.random.default_rng(seed)
    front = model.nodes[np.lexsort((model.nodes[:, 0], -model.nodes[:, 2]))]
    chosen = np.vstack([front[:4], front[-2:]])
    pixels = CAMERA.project(pose.apply(larger * chosen)) + click_px * rng.standard_normal((len(chosen), 2))
    depth = None
    if depth_factor is not None:
        seen = RigidTransform(pose.rotation, pose.translation)
        depth = sheet_depth(model, State(np.zeros(0), seen), rng, background=8.0) * np.float32(depth_factor)
    return register_landmarks(model, CAMERA, Landmarks(chosen, pixels), depth=depth, click_px=click_px, **known)


def turned(found, pose):
    """By what the attitude is off, and how many of its standard deviations that is."""
    off = rotation_log(found.state.camera_from_object.rotation @ pose.rotation.T)
    return np.linalg.norm(off), np.sqrt(off @ np.linalg.solve(found.covariance[:3, :3], off))


def is_ambiguous(found):
    return any(isinstance(warning, Ambiguous) for warning in found.warnings)


@pytest.mark.parametrize("seed", range(6))
def test_landmarks_nearly_in_a_plane_leave_both_tilts(plate, seed):
    """PnP finds one of them alone, right or wrong, where they lie in no plane exactly."""
    pose = placed(2.5)
    found = registered(plate, pose, seed)
    # It is rigid: what is ambiguous is no shape.
    assert Ambiguous(Ambiguity.TILT, 1 + len(found.alternatives)) in found.warnings
    states = [found.state, *found.alternatives]
    least = min(np.linalg.norm(rotation_log(s.camera_from_object.rotation @ pose.rotation.T)) for s in states)
    assert least < np.radians(15.0)


@pytest.mark.parametrize("seed", range(3))
def test_from_near_there_is_one_tilt(plate, seed):
    pose = placed(0.6)
    found = registered(plate, pose, seed)
    assert not is_ambiguous(found)
    assert turned(found, pose)[1] < 4.0


@pytest.mark.parametrize("seed", range(6))
def test_depth_decides_which_tilt_is_right(plate, seed):
    pose = placed(2.5)
    found = registered(plate, pose, seed, depth_factor=1.0)
    assert not is_ambiguous(found)
    assert not found.alternatives
    angle, deviations = turned(found, pose)
    assert angle < np.radians(20.0)
    assert deviations < 4.0


def test_a_slender_object_is_placed_by_depth_too(rod):
    """It is five pixels wide: no depth is farther inside of its rim than two."""
    pose = placed(0.8)
    found = registered(rod, pose, 0, depth_factor=1.0, depth_scale_std=0.0)
    assert found.state.camera_from_object.translation[2] == pytest.approx(0.8, abs=1.5e-3)


@pytest.mark.parametrize(("larger", "named"), [(1.0, False), (1.01, False), (1.05, True)])
def test_sizes_that_no_likely_scale_of_the_depths_explains_are_named(plate, larger, named):
    """The object is larger than its mesh, and seems to be nearer than depth has it."""
    found = registered(plate, placed(0.5), 1, depth_factor=1.0, larger=larger)
    said = [warning for warning in found.warnings if isinstance(warning, DepthScaleUnlikely)]
    assert bool(said) == named
    if said:
        assert said[0].percent == pytest.approx(-100.0 * (1.0 - 1.0 / larger), abs=1.0)
        assert said[0].deviations == pytest.approx(abs(said[0].percent), rel=1e-6)  # of 1 %
