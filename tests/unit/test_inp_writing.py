"""Meshes written as Abaqus input files are read back with the same nodes, cells and sets."""

from dataclasses import replace

import numpy as np
import pytest

from morph_dslam.errors import StudyError
from morph_dslam.extend.mechanics import block, load_mesh, save_mesh, tube


@pytest.mark.parametrize("cells", ["hex8", "hex20", "tet4", "tet10", "prism6", "prism15"])
@pytest.mark.parametrize("unit", ["mm", "m"])
def test_what_is_written_is_read_back(tmp_path, cells, unit):
    mesh = block((0.03, 0.02, 0.05), (2, 1, 3), cells)
    mesh = replace(mesh, cell_sets={"half": np.arange(mesh.n_cells // 2)})
    save_mesh(tmp_path / "block.inp", mesh, unit)
    again = load_mesh(tmp_path / "block.inp", unit)
    np.testing.assert_allclose(again.nodes, mesh.nodes, rtol=0, atol=1e-13)
    assert [part.cell_type for part in again.blocks] == [part.cell_type for part in mesh.blocks]
    np.testing.assert_array_equal(again.blocks[0].connectivity, mesh.blocks[0].connectivity)
    assert set(again.surfaces) == set(mesh.surfaces)
    for name in mesh.surfaces:
        np.testing.assert_array_equal(again.set_nodes(name), mesh.set_nodes(name))
        found, wanted = (set(map(tuple, m.surface(name).tolist())) for m in (again, mesh))
        assert found == wanted
    np.testing.assert_array_equal(again.cells("half"), mesh.cells("half"))


def test_cells_that_abaqus_orders_otherwise_are_refused(tmp_path):
    with pytest.raises(StudyError, match="hex27"):
        save_mesh(tmp_path / "tube.inp", tube(0.01, 0.02, 0.03, (2, 1, 8), "hex27"), "mm")
    assert not (tmp_path / "tube.inp").exists()
