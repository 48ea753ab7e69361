"""Rigid objects: surfaces mended to known volumes and areas, models without parameters."""

import numpy as np
import pytest

from morph_dslam import MorphError, load_model
from morph_dslam.cli import main
from morph_dslam.extend.studies import build_rigid

#: A unit cube, outwards.
CORNERS = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=float)
QUADS = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
CUBE = [t for a, b, c, d in QUADS for t in ([a, b, c], [a, c, d])]


def written_obj(path, points, faces):
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in points]
    lines += ["f " + " ".join(str(i + 1) for i in face) for face in faces]
    path.write_text("\n".join(lines) + "\n")
    return path


def written_stl(path, soup):
    facets = [
        "facet normal 0 0 0\nouter loop\n" + "".join(f"vertex {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in triangle)
        + "endloop\nendfacet" for triangle in soup
    ]  # fmt: skip
    path.write_text("solid part\n" + "\n".join(facets) + "\nendsolid part\n")
    return path


def volume_and_area(model):
    """By the divergence theorem, millimetres."""
    a, b, c = np.moveaxis(1e3 * model.nodes[model.triangles], 1, 0)
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    return np.sum(a * np.cross(b, c)) / 6.0, area


def test_stl_with_a_hole_a_flipped_face_and_doubled_points_is_mended(tmp_path):
    # 40 mm; a triangle missing, one turned, one there twice; corners not quite the same in all their faces.
    faces = [face[::-1] if k == 4 else face for k, face in enumerate(CUBE) if k != 9]
    soup = 40.0 * CORNERS[[*faces, faces[0]]]
    soup += 1e-5 * np.random.default_rng(0).uniform(-1.0, 1.0, soup.shape)
    path = written_stl(tmp_path / "part.stl", soup)
    model = build_rigid(path, "mm", tmp_path / "part.morph")
    repairs = model.provenance["repairs"]
    volume, area = volume_and_area(model)
    assert volume == pytest.approx(40.0**3, rel=1e-5)
    assert area == pytest.approx(6 * 40.0**2, rel=1e-5)
    assert repairs == {"points merged": 28, "double faces removed": 1, "faces turned": 1, "holes closed": 1}


def test_hole_that_is_not_convex_is_closed_in_its_plane(tmp_path):
    # A plate of 6 x 4 cells, 1 high, on whose top side an L of five cells is missing.
    quads = []
    for x, y in np.ndindex(6, 4):
        cell = [(x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1)]
        quads.append([(*corner, 0) for corner in cell[::-1]])
        if (x, y) not in {(1, 1), (2, 1), (3, 1), (3, 2), (1, 2)}:
            quads.append([(*corner, 1) for corner in cell])
    ring = [(x, 0) for x in range(6)] + [(6, y) for y in range(4)]
    ring += [(6 - x, 4 - y) for x, y in ring]
    quads += [[(*a, 0), (*b, 0), (*b, 1), (*a, 1)] for a, b in zip(ring, [*ring[1:], ring[0]], strict=True)]
    path = written_obj(tmp_path / "plate.obj", np.concatenate(quads), np.arange(4 * len(quads)).reshape(-1, 4))
    model = build_rigid(path, "mm")
    assert volume_and_area(model) == pytest.approx((24.0, 2 * 24.0 + 2 * 10.0))
    assert model.provenance["repairs"] == {"holes closed": 1}


def test_surfaces_turned_inside_out_are_turned_and_cavities_are_kept(tmp_path):
    inwards = [face[::-1] for face in CUBE]
    model = build_rigid(written_obj(tmp_path / "inside_out.obj", CORNERS, inwards), "cm")
    assert volume_and_area(model)[0] == pytest.approx(1e3)
    assert model.provenance["repairs"] == {"parts turned inside out": 1}
    points = np.concatenate([CORNERS, 0.25 + 0.5 * CORNERS])
    hollow = written_obj(tmp_path / "hollow.obj", points, [*CUBE, *(np.array(inwards) + 8).tolist()])
    assert volume_and_area(build_rigid(hollow, "cm"))[0] == pytest.approx(1e3 * (1.0 - 0.125))


def test_open_surfaces_stay_open_and_say_so(tmp_path):
    box = build_rigid(written_obj(tmp_path / "box.obj", CORNERS, QUADS[:1] + QUADS[2:]), "mm")
    assert volume_and_area(box)[1] == pytest.approx(5.0)
    assert box.provenance["repairs"] == {"open edges left": 4}


def test_model_without_parameters_is_kept_as_it_is(tmp_path):
    path = tmp_path / "cube.morph"
    model = build_rigid(written_obj(tmp_path / "cube.obj", CORNERS, QUADS), "cm", path)
    loaded = load_model(path)
    assert loaded.parameters == ()
    assert loaded.provenance == model.provenance
    np.testing.assert_array_equal(loaded.positions([]), model.nodes)
    np.testing.assert_array_equal(loaded.at({}).displacement(), np.zeros_like(model.nodes))
    edges = loaded.nodes[loaded.triangles] - loaded.nodes[np.roll(loaded.triangles, 1, axis=1)]
    assert np.linalg.norm(edges, axis=2).max() <= 0.01 * np.sqrt(3.0) / 24.0
    assert volume_and_area(loaded) == pytest.approx((1e3, 6e2))
    with pytest.raises(MorphError, match="no stress"):
        loaded.von_mises([])


def test_command_states_the_repairs_and_info_repeats_them(tmp_path, capsys):
    path = written_obj(tmp_path / "part.obj", CORNERS, CUBE[1:])
    assert main(["build", "--rigid", str(path), "--unit", "mm", "-o", str(tmp_path / "part.morph")]) == 0
    printed = capsys.readouterr().out
    assert " triangles, 1 x 1 x 1 mm" in printed
    assert "repair: 1 hole closed" in printed
    assert main(["info", str(tmp_path / "part.morph")]) == 0
    assert "repairs: holes closed  1" in capsys.readouterr().out


@pytest.mark.parametrize("faces", [[], [[0, 1, 1]], [[0, 8, 1]]], ids=["no face", "a line", "no area"])
def test_unusable_surface_is_refused(tmp_path, capsys, faces):
    path = written_obj(tmp_path / "part.obj", [*CORNERS, [0.5, 0.0, 0.0]], faces)
    assert main(["build", "--rigid", str(path), "--unit", "mm", "-o", str(tmp_path / "part.morph")]) == 2
    assert "part.obj" in capsys.readouterr().err
    assert not (tmp_path / "part.morph").exists()


@pytest.mark.parametrize(
    "arguments",
    [[], ["study.toml", "--rigid", "part.stl"], ["--rigid", "part.stl"], ["study.toml", "--unit", "mm"],
     ["--rigid", "part.stl", "--unit", "mm", "--workers", "2"], ["--rigid", "part.stl", "--unit", "mm"]],
    ids=["nothing", "both", "no unit", "unit of a study", "workers", "no file"],
)  # fmt: skip
def test_commands_that_cannot_be_meant(tmp_path, capsys, arguments):
    assert main(["build", *arguments, "-o", str(tmp_path / "part.morph")]) == 2
    assert capsys.readouterr().err.count("\n") <= 2
