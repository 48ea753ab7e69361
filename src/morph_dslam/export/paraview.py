"""Series of VTU or XDMF files for ParaView, through meshio.

Points are the undeformed nodes; "Warp By Vector" with ``displacement`` draws the deformed shape. All values
are SI: metres and pascals. Tensors are written with nine components row by row, because VTK and XDMF order
six of them differently.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import h5py
import meshio
import numpy as np
from meshio.xdmf import TimeSeriesWriter
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from morph_dslam.export.states import write_table
from morph_dslam.model import ReducedModel
from morph_dslam.model.reduced_model import von_mises

Array = NDArray[np.float64]

#: meshio's name and number of nodes of each cell type; meshio has no prisms of 15 nodes: their corners stand.
_MESHIO_CELLS = {
    "hex8": ("hexahedron", 8), "hex20": ("hexahedron20", 20), "hex27": ("hexahedron27", 27),
    "tet4": ("tetra", 4), "tet10": ("tetra10", 10),
    "prism6": ("wedge", 6), "prism15": ("wedge", 6), "prism18": ("wedge18", 18),
}  # fmt: skip
#: Where the nine components of a symmetric tensor stand among xx, yy, zz, yz, xz, xy.
_FULL_TENSOR = [0, 5, 4, 5, 1, 3, 4, 3, 2]


def point_fields(model: ReducedModel, mu: Array) -> dict[str, ArrayLike]:
    """Every field of the model at the nodes for the parameters ``mu`` (d,), under its name in the files.

    Solids: ``stress`` (Cauchy), ``von_mises``, ``strain`` (Green-Lagrange). Sheets, for each face:
    ``stress_top_11``, ``_22``, ``_12`` (second Piola-Kirchhoff, material axes) and ``von_mises_top``.
    """
    fields = {"displacement": model.displacement.value(mu)}
    for place, field in model.stresses.items():
        stress = field.value(mu)
        suffix = "" if place == "solid" else f"_{place}"
        if stress.shape[1] == 6:
            fields[f"stress{suffix}"] = stress[:, _FULL_TENSOR]
        else:
            parts = zip(("11", "22", "12"), stress.T, strict=True)
            fields |= {f"stress{suffix}_{name}": part for name, part in parts}
        fields[f"von_mises{suffix}"] = von_mises(stress)
    if model.strain is not None:
        fields["strain"] = model.strain.value(mu)[:, _FULL_TENSOR]
    return {name: values.astype(np.float32) for name, values in fields.items()}


def _cells(model: ReducedModel) -> list[tuple[str, ArrayLike] | meshio.CellBlock]:
    if not model.cells:
        return [("triangle", model.triangles.astype(np.int32))]
    result: list[tuple[str, ArrayLike] | meshio.CellBlock] = []
    for cell_type, cells in model.cells.items():
        name, size = _MESHIO_CELLS[cell_type]
        result.append((name, cells[:, :size].astype(np.int32)))
    return result


def write_vtu_series(folder: Path, stem: str, model: ReducedModel, states: Array) -> Path:
    """One ``stem_0000.vtu`` a state (s, d), ``stem.pvd`` to open all, ``states.csv``; returns the .pvd."""
    root = ElementTree.Element("VTKFile", type="Collection", version="0.1")
    collection = ElementTree.SubElement(root, "Collection")
    cells, places = _cells(model), []
    for i, mu in enumerate(tqdm(states, desc="states", unit="file")):
        name = f"{stem}_{i:04d}.vtu"
        meshio.Mesh(model.nodes, cells, point_data=point_fields(model, mu)).write(folder / name)
        ElementTree.SubElement(collection, "DataSet", timestep=str(i), file=name)
        places.append({"file": name})
    write_table(folder / "states.csv", model, states, places)
    series = folder / f"{stem}.pvd"
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(series, xml_declaration=True, encoding="utf-8")
    return series


class _SeriesWriter(TimeSeriesWriter):
    """meshio's writer with the HDF5 file beside the XDMF file, where meshio takes the working folder."""

    def __enter__(self) -> _SeriesWriter:
        self.h5_filename = str(self.filename.with_suffix(".h5"))
        self.h5_file = h5py.File(self.h5_filename, "w")
        return self


def write_xdmf_series(folder: Path, stem: str, model: ReducedModel, states: Array) -> Path:
    """``stem.xdmf``, its data of states (s, d) in ``stem.h5``, and ``states.csv``; returns the .xdmf."""
    series = folder / f"{stem}.xdmf"
    with _SeriesWriter(series) as writer:
        writer.write_points_cells(model.nodes, _cells(model))
        for i, mu in enumerate(tqdm(states, desc="states", unit="state")):
            writer.write_data(i, point_data=point_fields(model, mu))
    places = [{"file": series.name, "step": i} for i in range(len(states))]
    write_table(folder / "states.csv", model, states, places)
    return series
