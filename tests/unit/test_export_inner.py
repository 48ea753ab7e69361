"""Exports of structures inside, read back by other programs' readers, in closed form."""

from xml.etree import ElementTree

import meshio
import numpy as np
import pygltflib
import pytest

from morph_dslam import StateChoice, export
from morph_dslam.extend.models import save_inner_structure
from morph_dslam.model import save_model
from morph_dslam.model.unknown_loads import with_unknown_loads
from tests.support.inner_structures import NODES, TRIANGLES, inner_structure, moved
from tests.support.stretched_block import SIZE, stretched_block_model
from tests.unit.test_export import gltf_array, sizes_at
from tests.unit.test_export_runs import POSE, STATES, loaded_block, write_run

GRID = StateChoice(vary=["stretch=0:0.2:3"], at=["slide=5"])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Model and structures, of which the second one is the first one, moved."""
    folder = tmp_path_factory.mktemp("models")
    model = stretched_block_model()
    save_model(folder / "block.morph", model)
    for name, shift in (("tumour", 0.0), ("blood vessel", 0.005)):
        save_inner_structure(folder / f"{name}.h5", inner_structure(model, name, shift))
    return folder


def inner_files(folder):
    return [folder / "tumour.h5", folder / "blood vessel.h5"]


def test_structures_are_parts_of_a_vtu_collection(folder, tmp_path):
    series = export(folder / "block.morph", tmp_path, "vtu", GRID, inner=inner_files(folder))
    parts = [dict(entry.attrib) for entry in ElementTree.parse(series).getroot()[0]]
    assert [(float(part["timestep"]), part["part"]) for part in parts] == [
        (i, str(k)) for i in range(3) for k in range(3)
    ]
    for i, stretch in enumerate((0.0, 0.1, 0.2)):
        for k, shift in ((1, 0.0), (2, 0.005)):
            mesh = meshio.read(tmp_path / parts[3 * i + k]["file"])
            np.testing.assert_array_equal(mesh.cells_dict["triangle"], TRIANGLES)
            found = mesh.points + mesh.point_data["displacement"]
            np.testing.assert_allclose(found, moved(NODES + shift, stretch, 0.005), atol=1e-8)
    assert (tmp_path / "block_inner_blood_vessel_0002.vtu").is_file()
    # Another export of this name leaves none of them behind.
    export(folder / "block.morph", tmp_path, "vtu", GRID)
    assert not list(tmp_path.glob("*inner*"))


def test_where_the_camera_saw_a_structure(folder, tmp_path):
    """With unknown loads u_y = q z², u_z = p x, to second order u_x = q² z."""
    model = loaded_block()
    save_inner_structure(tmp_path / "tumour.h5", inner_structure(model))
    write_run(tmp_path / "run", with_unknown_loads(model), model)
    choice = StateChoice(path=tmp_path / "run", coordinates="camera")
    export(model, tmp_path / "out", "vtu", choice, inner=[tmp_path / "tumour.h5"])
    # The loads' fields are linear in each of the block's cells: z² is 0 at z = 0 and height² at the top.
    at_nodes = [NODES[:, 2] * SIZE[2], NODES[:, 0], NODES[:, 2]]
    for i, (stretch, slide, q, p) in enumerate(STATES.values()):
        mesh = meshio.read(tmp_path / "out" / f"stretched_block_inner_tumour_{i:04d}.vtu")
        wanted = moved(NODES, stretch, slide) + np.column_stack([q**2 * at_nodes[2], q * at_nodes[0], p * at_nodes[1]])
        np.testing.assert_allclose(mesh.points + mesh.point_data["displacement"], POSE.apply(wanted), atol=1e-7)


def test_a_gltf_shows_structures_through_the_surface(folder, tmp_path):
    """Each state's structures are drawn below its node, with its size; the surface lets them be seen."""
    target = export(folder / "block.morph", tmp_path, "gltf", GRID, inner=inner_files(folder))
    document = pygltflib.GLTF2().load(target)
    names = [material.name for material in document.materials]
    assert names[1:] == ["tumour", "blood vessel"]
    assert document.materials[0].alphaMode == "BLEND"
    opacities = [material.pbrMetallicRoughness.baseColorFactor[3] for material in document.materials]
    assert opacities[0] < 1.0 == opacities[1] == opacities[2]
    for i, stretch in enumerate((0.0, 0.1, 0.2)):
        (shown,) = (n for n, size in sizes_at(document, (i + 0.5) / 12.0).items() if size == (1.0, 1.0, 1.0))
        above = document.nodes[shown]
        for k, shift in ((1, 0.0), (2, 0.005)):
            node = document.nodes[above.children[k - 1]]
            (primitive,) = document.meshes[node.mesh].primitives
            assert (node.name, primitive.material) == (names[k], k)
            corners = gltf_array(document, primitive.attributes.POSITION) + np.array(above.translation)
            np.testing.assert_allclose(corners, moved(NODES + shift, stretch, 0.005), atol=1e-7)
            np.testing.assert_array_equal(gltf_array(document, primitive.indices).reshape(-1, 3), TRIANGLES)


def test_a_gltf_of_modes_moves_structures_with_them(folder, tmp_path):
    document = pygltflib.GLTF2().load(
        export(folder / "block.morph", tmp_path, "gltf", GRID, "none", inner=inner_files(folder)[:1])
    )
    targets = {channel.target.node for channel in document.animations[0].channels}
    node = document.nodes[document.nodes[0].children[0]]
    assert (node.name, targets) == ("tumour", {0, 1})
    (primitive,) = document.meshes[node.mesh].primitives
    rest = gltf_array(document, primitive.attributes.POSITION)
    modes = np.array([gltf_array(document, target["POSITION"]) for target in primitive.targets])
    weights = gltf_array(document, document.animations[0].samplers[0].output).reshape(3, -1)
    for weight, stretch in zip(weights, (0.0, 0.1, 0.2), strict=True):
        found = rest + np.tensordot(weight, modes, axes=1)
        np.testing.assert_allclose(found, moved(NODES, stretch, 0.005), atol=1e-7)


def test_what_cannot_be_written_is_refused(folder, tmp_path, refused):
    words = ("export", folder / "block.morph", "-o", tmp_path / "out", "--inner", folder / "tumour.h5")
    assert "need --format vtu or gltf" in refused(*words)
    twice = refused(*words, "--format", "vtu", "--inner", folder / "tumour.h5")
    assert "two inner structures are called 'tumour'" in twice
    assert "there is no inner structure" in refused(*words, "--format", "gltf", "--inner", tmp_path / "other.h5")
    assert not (tmp_path / "out").exists()
