"""`morph export`: states of a model as a series for ParaView (VTU or XDMF) or as a glTF animation."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Literal, get_args
from xml.etree import ElementTree
from xml.sax.saxutils import escape, unescape

import h5py
import meshio
import numpy as np
from meshio.xdmf import TimeSeriesWriter
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from morph_dslam.errors import ExportError
from morph_dslam.geometry import RigidTransform
from morph_dslam.interrupts import WaitingInterrupts
from morph_dslam.io.gltf import GENERATOR, Colours, write_glb
from morph_dslam.io.hdf5_writing import written_hdf5
from morph_dslam.io.state_choice import EACH_IN_TURN, StateChoice, States, states_of_array
from morph_dslam.io.writing import check_no_input, removed_on_failure
from morph_dslam.model import ReducedModel, load_model
from morph_dslam.model.inner_structure import CarriedStructure, load_inner_structures
from morph_dslam.model.reduced_model import von_mises
from morph_dslam.model.shown_field import shown_field
from morph_dslam.notices import Notice

Array = NDArray[np.float64]
FileFormat = Literal["xdmf", "vtu", "gltf"]


def write_table(path: Path, states: States, places: Sequence[dict[str, str | int]]) -> None:
    """The parameters of states as CSV, after the columns that say where each is and where it comes from.

    States that have no place, the last ones, were not written. The layout is that of tables of external solutions,
    so that a study can be made from an export.
    """
    parameters = states.model.parameters
    with removed_on_failure(path), path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*places[0], *states.origins[0], *(f"{p.name} [{p.unit}]" for p in parameters)])
        for place, origin, mu in zip(places, states.origins, states.parameters, strict=False):
            values = [f"{p.display(x):.9g}" for p, x in zip(parameters, mu, strict=True)]
            writer.writerow([*place.values(), *origin.values(), *values])


# ParaView: points are the undeformed nodes, values are SI, and tensors have nine components row by row, because VTK and
# XDMF order six of them differently.


#: meshio's name and number of nodes of each cell type; meshio has no prisms of 15 nodes: their corners stand.
_MESHIO_CELLS = {
    "hex8": ("hexahedron", 8), "hex20": ("hexahedron20", 20), "hex27": ("hexahedron27", 27),
    "tet4": ("tetra", 4), "tet10": ("tetra10", 10),
    "prism6": ("wedge", 6), "prism15": ("wedge", 6), "prism18": ("wedge18", 18),
}  # fmt: skip
#: Where the nine components of a symmetric tensor stand among xx, yy, zz, yz, xz, xy.
_FULL_TENSOR = [0, 5, 4, 5, 1, 3, 4, 3, 2]
#: How files of structures inside are called behind the model's name, and by what other exports are known.
_INNER = "inner_"
_XDMF_SERIES, _GLB_GENERATOR = 'Name="TimeSeries_meshio"', f'"generator":"{GENERATOR} '


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


def fields_of_state(states: States, state: int) -> tuple[Array, dict[str, ArrayLike]]:
    """The undeformed nodes (n, 3) of a state, and its `point_fields` with what the shape has beyond the model's.

    In the camera frame both are turned with the object, the nodes moved as well; stresses of sheets are those in the
    axes of the material.
    """
    model = states.model
    fields = point_fields(model, states.parameters[state])
    moved = np.asarray(fields["displacement"]) + states.beyond_model(state, model.nodes)
    if states.poses is None:
        return model.nodes, fields | {"displacement": moved.astype(np.float32)}
    pose = RigidTransform.from_matrix(states.poses[state])
    fields["displacement"] = (moved @ pose.rotation.T).astype(np.float32)
    for name in ("stress", "strain"):
        if name in fields:
            tensors = np.asarray(fields[name]).reshape(-1, 3, 3)
            fields[name] = (pose.rotation @ tensors @ pose.rotation.T).reshape(-1, 9).astype(np.float32)
    return pose.apply(model.nodes), fields


def _inner_mesh(states: States, structure: CarriedStructure, state: int) -> meshio.Mesh:
    """The surface of a structure inside at rest with its displacement; in the camera frame both are turned."""
    rest, moved = structure.rest, states.inner_displacement(structure, state)
    if states.poses is not None:
        pose = RigidTransform.from_matrix(states.poses[state])
        rest, moved = pose.apply(rest), moved @ pose.rotation.T
    cells: dict[str, ArrayLike] = {"triangle": structure.triangles.astype(np.int32)}
    return meshio.Mesh(rest, cells, point_data={"displacement": moved.astype(np.float32)})


def _cells(model: ReducedModel) -> list[tuple[str, ArrayLike] | meshio.CellBlock]:
    if not model.cells:
        return [("triangle", model.triangles.astype(np.int32))]
    result: list[tuple[str, ArrayLike] | meshio.CellBlock] = []
    for cell_type, cells in model.cells.items():
        name, size = _MESHIO_CELLS[cell_type]
        result.append((name, cells[:, :size].astype(np.int32)))
    return result


#: How much of the beginning of a file tells whether an export has written it, characters.
_HEAD = 4096


def _earlier_export(folder: Path, stem: str) -> list[Path]:
    """What an export of this name has written, in any format, and others have not."""
    series, collection, animation = (folder / f"{stem}.{ending}" for ending in ("xdmf", "pvd", "glb"))
    own = re.compile(rf"{re.escape(stem)}_(?:{_INNER}[\w.+-]+_)?\d{{4,}}\.vtu")
    named = [unescape(name, {"&quot;": '"'}) for name in re.findall('file="([^"]*)"', _beginning(collection))]
    written = [folder / name for name in named if own.fullmatch(name)]
    found = [*written, collection] if written else []
    head = _beginning(series, _HEAD)
    data = series.with_suffix(".h5")
    if _XDMF_SERIES in head and f">{escape(stem)}.h5:/" in head:
        found += [series, data]
    elif _is_own_data(data):  # of a series that was not written to its end
        found.append(data)
    if _GLB_GENERATOR in _beginning(animation, _HEAD):
        found.append(animation)
    return [*found, folder / "states.csv"] if found else []


def _is_own_data(path: Path) -> bool:
    """Whether the data of an XDMF series are there, and an export has written them."""
    if not path.is_file():
        return False
    try:
        with h5py.File(path) as file:
            return file.attrs.get("generator") == GENERATOR
    except OSError:  # it is no HDF5 file
        return False


def _names_of_export(stem: str, file_format: FileFormat, states: States) -> list[str]:
    """Names of all files that an export writes."""
    if file_format == "gltf":
        return ["states.csv", f"{stem}.glb"]
    if file_format == "xdmf":
        return ["states.csv", f"{stem}.xdmf", f"{stem}.h5"]
    of_states = [name for state in range(len(states)) for name in _vtu_names(stem, states, state)]
    return ["states.csv", f"{stem}.pvd", *of_states]


def _vtu_names(stem: str, states: States, state: int) -> list[str]:
    """Names of the files of a state: the object's, and those of the structures inside."""
    inner = (f"{stem}_{_INNER}{_file_name(structure.name)}_{state:04d}.vtu" for structure in states.inner)
    return [f"{stem}_{state:04d}.vtu", *inner]


def _make_way(folder: Path, stem: str, names: Sequence[str], inputs: Sequence[str | Path | None]) -> None:
    """Remove the export of this name that is there, which would pass for states of the next.

    Parameters
    ----------
    folder, stem : of the next.
    names : of the files that it writes.
    inputs : files that it reads; None for what is not given.

    Raises
    ------
    ExportError
        If what is to be written would take the place of a file that no export has written, or of an input.
    """
    targets = [folder / name for name in names]
    stems = {stem, *(path.stem for ending in ("xdmf", "pvd", "glb") for path in folder.glob(f"*.{ending}"))}
    of_exports = {name: _earlier_export(folder, name) for name in stems}
    earlier = of_exports[stem]
    check_no_input([*targets, *earlier], inputs, ExportError)
    own = {path for files in of_exports.values() for path in files}
    for path in targets:
        if path.exists() and path not in own:
            raise ExportError(f"{path} is there, and no earlier export has written it: name another folder")
    for path in earlier:
        path.unlink(missing_ok=True)


def _beginning(path: Path, length: int = -1) -> str:
    """The first characters of a file, or all; nothing if there is no such file."""
    if not path.is_file():
        return ""
    with path.open(encoding="utf-8", errors="replace") as file:
        return file.read(length)


def write_vtu_series(folder: Path, stem: str, states: States) -> Path:
    """One ``stem_0000.vtu`` a state, ``stem.pvd`` to open all, ``states.csv``; returns the .pvd.

    Structures inside have files of their own, ``stem_inner_NAME_0000.vtu``, and are further parts of the collection.

    An interrupt ends the series behind the state that is being written.
    """
    cells, places, series = _cells(states.model), [], folder / f"{stem}.pvd"
    with WaitingInterrupts() as interrupts:
        # By it the next export knows the files of one that was not written to its end.
        _write_collection(series, stem, states, len(states))
        for i in tqdm(range(len(states)), desc="states", unit="file"):
            names = _vtu_names(stem, states, i)
            nodes, fields = fields_of_state(states, i)
            meshes = [meshio.Mesh(nodes, cells, point_data=fields)]
            meshes += [_inner_mesh(states, structure, i) for structure in states.inner]
            for name, mesh in zip(names, meshes, strict=True):
                mesh.write(folder / name)
            places.append({"file": names[0]})
            if interrupts.is_waiting:
                break
        write_table(folder / "states.csv", states, places)
        _write_collection(series, stem, states, len(places))
    return series


def _write_collection(path: Path, stem: str, states: States, n_states: int) -> None:
    """Write the .pvd that names the files of the first states."""
    root = ElementTree.Element("VTKFile", type="Collection", version="0.1")
    collection = ElementTree.SubElement(root, "Collection")
    for i in range(n_states):
        for part, name in enumerate(_vtu_names(stem, states, i)):
            of_part = {"timestep": f"{states.times[i]:.15g}", "part": str(part), "file": name}
            ElementTree.SubElement(collection, "DataSet", of_part)
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, xml_declaration=True, encoding="utf-8")


class _SeriesWriter(TimeSeriesWriter):
    """meshio's writer with the HDF5 file beside the XDMF file, where meshio takes the working folder.

    What fails leaves neither of them.
    """

    def __enter__(self) -> _SeriesWriter:
        data = self.filename.with_suffix(".h5")
        self._written = written_hdf5(data)
        self.h5_filename, self.h5_file = str(data), self._written.__enter__()
        self.h5_file.attrs["generator"] = GENERATOR
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._written.__exit__(kind, error, trace)
        if kind is None:
            super().__exit__()


def write_xdmf_series(folder: Path, stem: str, states: States) -> Path:
    """``stem.xdmf``, its data in ``stem.h5``, and ``states.csv``; returns the .xdmf.

    An interrupt ends the series behind the state that is being written.
    """
    series, places = folder / f"{stem}.xdmf", []
    with WaitingInterrupts() as interrupts:
        with _SeriesWriter(series) as writer:
            writer.write_points_cells(states.model.nodes, _cells(states.model))
            for i in tqdm(range(len(states)), desc="states", unit="state"):
                writer.write_data(f"{states.times[i]:.15g}", point_data=fields_of_state(states, i)[1])
                places.append({"file": series.name, "step": i})
                if interrupts.is_waiting:
                    break
        write_table(folder / "states.csv", states, places)
    return series


def _write_animation(folder: Path, stem: str, states: States, show: Colours | None) -> Path:
    """``stem.glb`` and ``states.csv``; returns the .glb. An interrupt leaves none of them, or both."""
    target = folder / f"{stem}.glb"
    with removed_on_failure(target):
        write_glb(target, states, show)
        with WaitingInterrupts():
            write_table(folder / "states.csv", states, [{"frame": i} for i in range(len(states))])
    return target


def export(
    model: str | Path | ReducedModel,
    folder: str | Path,
    file_format: FileFormat = "xdmf",
    choice: StateChoice | ArrayLike = EACH_IN_TURN,
    show: Colours | None = None,
    tell: Callable[[Notice], object] = lambda notice: None,
    inner: Sequence[str | Path] = (),
) -> Path:
    """Write a model's states for ParaView or as an animation; returns the file to open.

    Files are called as the model's file, or as the model itself if it is given as a `ReducedModel`.

    Parameters
    ----------
    model : a model or its file.
    folder : to write into; made if missing. An export of the same name that is there is replaced, in whatever format;
        other files are not.
    file_format : "xdmf" or "vtu" for ParaView, "gltf" for 3-D viewers.
    choice : of the states, by default each parameter in turn; or their parameters (s, d), SI.
    show : what colours a glTF file: "stress" (von Mises), "strain" (equivalent), "displacement", or "none"; by default
        the stress of a model that has it, else the displacement; of a run with a discrepancy this alone.
    tell : called with each notice of what a reader of the states must know.
    inner : files of structures inside (`morph inner`), whose surfaces are written too; not with "xdmf".

    Raises
    ------
    ModelFileError
        If the model cannot be read.
    ParameterError
        If the model does not hold what is to be shown.
    ExportError
        If there is no such format, the states are not in the model's box, or the folder cannot be written, or holds
        files of such names that no export has written.
    """
    if file_format not in get_args(FileFormat):
        raise ExportError(f"'{file_format}' is no format of an export; these are {', '.join(get_args(FileFormat))}")
    if show is not None and file_format != "gltf":
        raise ExportError("show (--show) chooses the colours of a glTF file; XDMF and VTU files hold all fields")
    if isinstance(model, ReducedModel):
        loaded, stem = model, _file_name(model.name)
    else:
        loaded, stem = load_model(model), Path(model).stem
    if isinstance(choice, StateChoice):
        states = choice.chosen(loaded)
    else:
        states = States.of(loaded, states_of_array(loaded, choice))
    if states.poses is not None and file_format != "vtu":
        raise ExportError("--coordinates camera needs --format vtu: other files hold the undeformed mesh once")
    if inner and file_format == "xdmf":
        raise ExportError("structures inside (--inner) need --format vtu or gltf: an XDMF file holds one mesh")
    structures = load_inner_structures([Path(path) for path in inner], states.model)
    states = replace(states, inner=tuple(one.carried_by(states.model) for one in structures))
    show = _shown(states, show) if file_format == "gltf" else None
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        read = [choice.path if isinstance(choice, StateChoice) else None, *inner]
        _make_way(folder, stem, _names_of_export(stem, file_format, states), read)
        if file_format == "gltf":
            target = _write_animation(folder, stem, states, show)
        else:
            target = (write_xdmf_series if file_format == "xdmf" else write_vtu_series)(folder, stem, states)
    except OSError as error:
        raise ExportError(f"cannot write to {folder}: {error.strerror or error}") from error
    for notice in states.notices:
        tell(notice)
    return target


def _shown(states: States, show: Colours | None) -> Colours | None:
    """What colours a glTF file; raises if the model does not hold it, or the shapes do not go with it."""
    if not states.discrepancies:
        if show != "none":
            shown_field(states.model, show)
        return show
    if show not in (None, "displacement"):
        raise ExportError(
            f"the run has a discrepancy, which neither modes nor stresses have: --show {show} cannot show its shapes; "
            "leave it out, for colours by the displacement"
        )
    return "displacement"


def _file_name(name: str) -> str:
    """A model's name as that of a file."""
    return re.sub(r"[^\w.+-]+", "_", name).strip("._") or "model"
