"""Volumes of surfaces with one closed part inside another, against the polyhedra's own volumes."""

import numpy as np
import pytest
import trimesh

from morph_dslam.errors import StudyError
from morph_dslam.meshing.mesh_files import load_mesh
from morph_dslam.meshing.surface_repair import repaired_surface
from tests.support.meshes import cell_volumes

BOX = trimesh.creation.box((40.0, 40.0, 40.0)).subdivide()
BALL = trimesh.creation.icosphere(1, 10.0)
CORE = trimesh.creation.icosphere(1, 4.0)


def written(path, *parts):
    """An STL file of parts, each a body and whether it is turned inside out."""
    meshes = [trimesh.Trimesh(body.vertices, body.faces[:, ::-1] if turned else body.faces) for body, turned in parts]
    trimesh.util.concatenate(meshes).export(path)
    return path


@pytest.mark.parametrize("all_turned", [False, True])
def test_a_cavity_is_left_out_whichever_way_the_whole_surface_is_turned(tmp_path, all_turned):
    path = written(tmp_path / "hollow.stl", (BOX, all_turned), (BALL, not all_turned))
    assert 1e9 * cell_volumes(load_mesh(path, "mm")).sum() == pytest.approx(BOX.volume - BALL.volume, rel=1e-5)


PATCH = trimesh.Trimesh([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]], [[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(("beside", "volume"), [(CORE, CORE.volume), (PATCH, 0.0)], ids=["a body", "an open patch"])
def test_a_hollow_body_inside_out_is_turned_whatever_lies_beside_it(beside, volume):
    beside = beside.copy().apply_translation([30.0, 0.0, 0.0])
    parts = [trimesh.Trimesh(BOX.vertices, BOX.faces[:, ::-1]), BALL, beside]
    whole = trimesh.util.concatenate(parts)
    points, triangles, repairs = repaired_surface(np.asarray(whole.vertices), np.asarray(whole.faces))
    assert repairs["parts turned inside out"] == 2
    found = trimesh.Trimesh(points, triangles, process=False).volume
    assert found == pytest.approx(BOX.volume - BALL.volume + volume, rel=1e-9)


def test_a_body_in_a_cavity_faces_outwards_again(tmp_path):
    path = written(tmp_path / "rattle.stl", (BOX, False), (BALL, True), (CORE, False))
    expected = BOX.volume - BALL.volume + CORE.volume
    assert 1e9 * cell_volumes(load_mesh(path, "mm")).sum() == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("size", [None, 0.01])
def test_a_part_within_another_that_faces_outwards_too_is_refused(tmp_path, size):
    with pytest.raises(StudyError):
        load_mesh(written(tmp_path / "nested.stl", (BOX, False), (BALL, False)), "mm", size)


def test_a_part_beside_another_is_not_within_it_though_its_box_is(tmp_path):
    """A ball in the open side of a U."""
    bars = [trimesh.creation.box(bounds=b) for b in ([[0, 0, 0], [40, 10, 40]], [[0, 30, 0], [40, 40, 40]])]
    back = trimesh.creation.box(bounds=[[0, 10, 0], [10, 30, 40]])
    profile = np.array([[0, 0], [40, 0], [40, 10], [10, 10], [10, 30], [40, 30], [40, 40], [0, 40.0]])
    cap = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 7], [4, 5, 6], [4, 6, 7]])
    vertices = np.vstack([np.column_stack([profile, np.full(8, z)]) for z in (0.0, 40.0)])
    k, after = np.arange(8), (np.arange(8) + 1) % 8
    sides = np.vstack([np.column_stack([k, after, after + 8]), np.column_stack([k, after + 8, k + 8])])
    letter = trimesh.Trimesh(vertices, np.vstack([cap[:, ::-1], cap + 8, sides]), process=False)
    ball = trimesh.creation.icosphere(1, 5.0).apply_translation([25.0, 20.0, 20.0])
    expected = sum(bar.volume for bar in (*bars, back)) + ball.volume
    path = written(tmp_path / "u.stl", (letter, False), (ball, False))
    assert 1e9 * cell_volumes(load_mesh(path, "mm")).sum() == pytest.approx(expected, rel=1e-5)
