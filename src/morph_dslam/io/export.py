"""`morph export`: states of a model as a series for ParaView (VTU or XDMF) or as a glTF animation.

States are parameter values along a path or on a grid. Users give values in each parameter's own unit (that of
`morph info`); arrays here are SI, (s, d) for s states of d parameters.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args
from xml.etree import ElementTree

import h5py
import meshio
import numpy as np
from meshio.xdmf import TimeSeriesWriter
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from morph_dslam.errors import ExportError, StudyError
from morph_dslam.io.gltf import GENERATOR, Colours, write_glb
from morph_dslam.io.text import name_and_unit, read_csv
from morph_dslam.model import Parameter, ReducedModel, load_model
from morph_dslam.model.reduced_model import von_mises
from morph_dslam.model.shown_field import shown_field
from morph_dslam.units import FACTORS, read_quantity, to_si

Array = NDArray[np.float64]
FileFormat = Literal["xdmf", "vtu", "gltf"]
#: States that one export may have: beyond, a grid was meant to be coarser.
MOST_STATES = 10_000
#: States of a tour from the default to one end of a range; twice as many cross it.
_QUARTER = 6


def _index(model: ReducedModel, name: str) -> int:
    names = [p.name for p in model.parameters]
    if name not in names:
        raise ExportError(f"the model has no parameter '{name}'; it has {', '.join(names) or 'none'}")
    return names.index(name)


def _in_range(parameter: Parameter, si: float, where: str) -> float:
    """A value in SI, checked to lie in the parameter's range."""
    if not parameter.in_range(si):
        shown = f"{parameter.display(si):g} is outside the range of {parameter.name}"
        raise ExportError(f"{where}: {shown}, {parameter.range_text}")
    return min(max(si, parameter.lower), parameter.upper)


def fixed_values(model: ReducedModel, settings: Sequence[str]) -> Array:
    """The parameters (d,) with some of them set by texts "name=value"; the others keep their defaults."""
    mu, given = model.default, dict[str, str]()
    for text in settings:
        name, equals, value = text.partition("=")
        if not equals:
            raise ExportError(f"--at {text} is not a parameter and its value{_example(model, '{0}={1}')}")
        k = _index(model, name)
        if name in given:
            raise ExportError(f"--at {given[name]} and --at {text} both set '{name}': give one of them")
        given[name] = text
        mu[k] = _number(model.parameters[k], value, f"--at {text}")
    return mu


def grid(model: ReducedModel, ranges: Sequence[str], base: Array) -> Array:
    """All combinations (s, d) of ranges "name=from:to:count", the last one varying fastest.

    Parameters
    ----------
    base : (d,) values of the parameters without a range, SI.
    """
    axes: dict[int, Array] = {}
    for text in ranges:
        name, _, limits = text.partition("=")
        parts = limits.split(":")
        if len(parts) != 3 or not name or not parts[2].isdecimal() or int(parts[2]) < 1:
            raise ExportError(f"--vary {text} is not a parameter and its values{_example(model, '{0}={1}:{2}:21')}")
        k, n = _index(model, name), int(parts[2])
        if k in axes:
            raise ExportError(f"--vary {text}: parameter '{name}' has a range already")
        low, high = (_number(model.parameters[k], end, f"--vary {text}") for end in parts[:2])
        if n > MOST_STATES:
            raise ExportError(f"--vary {text} asks for {n} states, and {MOST_STATES} is the most")
        axes[k] = np.linspace(low, high, n)
    count = math.prod(len(axis) for axis in axes.values())
    if count > MOST_STATES:
        raise ExportError(f"these ranges make {count} states, and {MOST_STATES} is the most; ask for fewer")
    states = np.tile(base, (count, 1))
    for k, values in zip(axes, np.meshgrid(*axes.values(), indexing="ij"), strict=True):
        states[:, k] = values.ravel()
    return states


def tour(model: ReducedModel, base: Array) -> Array:
    """Each parameter in turn from ``base`` (d,) to the top of its range, to the bottom, and back (s, d)."""
    states = [base]
    for k, parameter in enumerate(model.parameters):
        stops = [(base[k], parameter.upper), (parameter.upper, parameter.lower), (parameter.lower, base[k])]
        for (start, end), count in zip(stops, (_QUARTER, 2 * _QUARTER, _QUARTER), strict=True):
            leg = np.tile(base, (count, 1))
            leg[:, k] = np.linspace(start, end, count + 1)[1:]
            states.extend(leg)
    return np.array(states)


def read_path(model: ReducedModel, path: Path, base: Array) -> Array:
    """The states (s, d) in the rows of a CSV table.

    A column is headed "name [unit]", as in the table of an export, or "name_unit", as in the ``frames.csv``
    of a run; the unit is any of the parameter's quantity. Other columns are passed over, and so are rows without
    values: frames that were not tracked. Parameters without a column keep their value in ``base``.

    Raises
    ------
    ExportError
        If the table cannot be read, a parameter's column has no unit, another quantity's, or a twin, no column is a
        parameter's, or a value is no number in the range.
    """
    if not model.parameters:
        raise ExportError(f"'{model.name}' has no parameters, and so one state only: leave --path out")
    (_, header), *rows = read_csv(path, "path", ExportError) or [(1, [])]
    found = {k: _column_of(p, header, path) for k, p in enumerate(model.parameters)}
    columns = {k: column for k, column in found.items() if column is not None}
    if not columns:
        wanted = ", ".join(f"'{p.name} [{p.unit}]'" for p in model.parameters)
        raise ExportError(f"{path} has no column of a parameter; name the columns {wanted}")
    states = []
    for line, row in rows:
        texts = {k: row[column] if column < len(row) else "" for k, (column, _) in columns.items()}
        if not all(texts.values()):
            continue
        mu = base.copy()
        for k, text in texts.items():
            mu[k] = _number(model.parameters[k], text, f"{path}, line {line}", columns[k][1])
        states.append(mu)
    if not 0 < len(states) <= MOST_STATES:
        raise ExportError(f"{path} holds {len(states)} states, and 1 to {MOST_STATES} can be exported")
    return np.array(states)


def _column_of(parameter: Parameter, header: Sequence[str], path: Path) -> tuple[int, str] | None:
    """The column that holds a parameter, and its unit; None if there is none.

    A title in the parameter's own unit goes before "name" alone and "name_unit" in another one: a parameter may be
    called as one of the columns of ``frames.csv`` ("time" as ``time_ms``).
    """
    units, all_units = FACTORS[parameter.quantity], {unit for known in FACTORS.values() for unit in known}
    found, wrong = dict[int, str](), []
    for column, title in enumerate(header):
        name, unit = name_and_unit(title)
        if name == parameter.name and unit in units:
            found[column] = unit
        elif title == parameter.name or (name == parameter.name and (title.endswith("]") or unit in all_units)):
            wrong.append(title)
    if parameter.unit in found.values():
        found = {k: unit for k, unit in found.items() if unit == parameter.unit or header[k].endswith("]")}
        wrong = [title for title in wrong if title.endswith("]")]
    if wrong:
        raise ExportError(
            f"{path}: the column '{wrong[0]}' has no unit of '{parameter.name}': name it "
            f"'{parameter.name} [{parameter.unit}]', or with another unit of {parameter.quantity} ({', '.join(units)})"
        )
    if len(found) > 1:
        titles = " and ".join(f"'{header[column]}'" for column in found)
        raise ExportError(f"{path}: the columns {titles} both hold '{parameter.name}': leave one of them in")
    return next(iter(found.items()), None)


def _number(parameter: Parameter, text: str, where: str, unit: str = "") -> float:
    """A value in the parameter's unit or ``unit``, or with another unit behind it, as SI."""
    unit = unit or parameter.unit
    try:
        value = to_si(float(text), unit, parameter.quantity)
    except ValueError:
        try:
            value = read_quantity(text, parameter.quantity)
        except StudyError as error:
            raise ExportError(
                f"{where}: '{text}' is not a value of {parameter.name}: write a number in {unit}, or with "
                f"another unit: {error}"
            ) from None
    return _in_range(parameter, value, where)


def _example(model: ReducedModel, form: str) -> str:
    """The end of a message: how to write it for a parameter that the model has, from its name and its range's ends."""
    if not model.parameters:
        return f": '{model.name}' has no parameters"
    p = model.parameters[0]
    return ", such as " + form.format(p.name, *(f"{p.display(end):.4g}" for end in (p.lower, p.upper)))


def states_of_array(model: ReducedModel, choice: ArrayLike) -> Array:
    """Parameters (s, d) or (d,), SI, as states; ExportError where they are none of the model's."""
    d = len(model.parameters)
    try:
        states = np.atleast_2d(np.array(choice, dtype=np.float64))
    except (TypeError, ValueError):
        raise ExportError("states are a StateChoice, or an array of parameters (s, d)") from None
    if states.ndim != 2 or states.shape[1] != d or not 0 < len(states) <= MOST_STATES:
        names = ", ".join(p.name for p in model.parameters) or "none"
        raise ExportError(
            f"an array of states has a row for each, 1 to {MOST_STATES}, and a column for each of the parameters "
            f"({names}), not the shape {states.shape}"
        )
    for number, row in enumerate(states):
        states[number] = [_in_range(p, x, f"state {number}") for p, x in zip(model.parameters, row, strict=True)]
    return states


def write_table(path: Path, model: ReducedModel, states: Array, places: Sequence[dict[str, str | int]]) -> None:
    """The parameters of each state (s, d, SI) as CSV, after the columns that say where it is.

    The layout is that of tables of external solutions, so that a study can be made from an export.
    """
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*places[0], *(f"{p.name} [{p.unit}]" for p in model.parameters)])
        for place, mu in zip(places, states, strict=True):
            values = [f"{p.display(x):.9g}" for p, x in zip(model.parameters, mu, strict=True)]
            writer.writerow([*place.values(), *values])


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
#: By what series and animations of exports are known.
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


def _remove_export(folder: Path, stem: str) -> None:
    """Remove what an export of this name has written, in any format: it would pass for states of the next.

    Files that others have written under these names are left alone.
    """
    series, collection, animation = (folder / f"{stem}.{ending}" for ending in ("xdmf", "pvd", "glb"))
    written = [
        folder / name for name in re.findall(rf'file="({re.escape(stem)}_\d{{4,}}\.vtu)"', _beginning(collection))
    ]
    found = [*written, collection] if written else []
    head = _beginning(series, _HEAD)
    if _XDMF_SERIES in head and f">{stem}.h5:/" in head:
        found += [series, series.with_suffix(".h5")]
    if _GLB_GENERATOR in _beginning(animation, _HEAD):
        found.append(animation)
    for path in found:
        path.unlink(missing_ok=True)


def _beginning(path: Path, length: int = -1) -> str:
    """The first characters of a file, or all; nothing if there is no such file."""
    if not path.is_file():
        return ""
    with path.open(errors="replace") as file:
        return file.read(length)


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


@dataclass(frozen=True)
class StateChoice:
    """Which states of a model to export, in the parameters' units.

    Attributes
    ----------
    vary : texts "name=from:to:count"; several make a grid.
    path : CSV table with a state in each row, instead.
    at : texts "name=value" for parameters that are not varied.
    """

    vary: Sequence[str] = ()
    path: str | Path | None = None
    at: Sequence[str] = ()

    def states(self, model: ReducedModel) -> NDArray[np.float64]:
        """The states (s, d), SI; with neither ranges nor a path, a tour of all parameters."""
        twice = {text.partition("=")[0] for text in self.vary} & {text.partition("=")[0] for text in self.at}
        if twice:
            raise ExportError(f"'{min(twice)}' is both varied and fixed: leave out its --vary or its --at")
        if self.path is not None and self.vary:
            raise ExportError("--path and --vary both choose the states: give one of them")
        base = fixed_values(model, self.at)
        if self.path is not None:
            return read_path(model, Path(self.path), base)
        return grid(model, self.vary, base) if self.vary else tour(model, base)


def export(
    model: str | Path | ReducedModel,
    folder: str | Path,
    file_format: FileFormat = "xdmf",
    choice: StateChoice | ArrayLike = StateChoice(),
    show: Colours | None = None,
) -> Path:
    """Write a model's states for ParaView or as an animation; returns the file to open.

    Files are called as the model's file, or as the model itself if it is given as a `ReducedModel`.

    Parameters
    ----------
    model : a model or its file.
    folder : to write into; made if missing. An export of the same name that is there is replaced, in whatever format.
    file_format : "xdmf" or "vtu" for ParaView, "gltf" for 3-D viewers.
    choice : of the states, by default each parameter in turn; or their parameters (s, d), SI.
    show : what colours a glTF file: "stress" (von Mises), "strain" (equivalent), "displacement", or "none"; by default
        the stress of a model that has it, else the displacement.

    Raises
    ------
    ModelFileError
        If the model cannot be read.
    ParameterError
        If the model does not hold what is to be shown.
    ExportError
        If there is no such format, the states are not in the model's box, or the folder cannot be written.
    """
    if file_format not in get_args(FileFormat):
        raise ExportError(f"'{file_format}' is no format of an export; these are {', '.join(get_args(FileFormat))}")
    if show is not None and file_format != "gltf":
        raise ExportError("show (--show) chooses the colours of a glTF file; XDMF and VTU files hold all fields")
    if isinstance(model, ReducedModel):
        loaded, stem = model, _file_name(model.name)
    else:
        loaded, stem = load_model(model), Path(model).stem
    states = choice.states(loaded) if isinstance(choice, StateChoice) else states_of_array(loaded, choice)
    if show != "none":
        shown_field(loaded, show)  # before a folder is made
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _remove_export(folder, stem)
        if file_format == "gltf":
            target = folder / f"{stem}.glb"
            write_glb(target, loaded, states, show)
            write_table(folder / "states.csv", loaded, states, [{"frame": i} for i in range(len(states))])
            return target
        write = write_xdmf_series if file_format == "xdmf" else write_vtu_series
        return write(folder, stem, loaded, states)
    except OSError as error:
        raise ExportError(f"cannot write to {folder}: {error.strerror or error}") from error


def _file_name(name: str) -> str:
    """A model's name as that of a file."""
    return re.sub(r"[^\w.+-]+", "_", name).strip("._") or "model"
