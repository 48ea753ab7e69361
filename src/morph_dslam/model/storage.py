"""The `.morph` file: HDF5, versioned, without pickles, and checked in full when loaded (docs/model-file.md).

It begins with a checksum (`io.checksum`). Then every array is checked by itself (`field_storage`) and against the
others, so that a file of a faulty writer is refused as well.
"""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from urllib.parse import unquote

import h5py
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import ModelFileError, check_kind
from morph_dslam.io.checksum import begins_with, check_checksum, is_other_hdf5, written_with_checksum
from morph_dslam.io.file_kinds import MESHES, file_kind
from morph_dslam.io.hdf5_writing import member_name
from morph_dslam.model.field_storage import names, read_array, read_field, read_group, read_text, write_field
from morph_dslam.model.parameters import Parameter
from morph_dslam.model.reduced_model import REACTION, ReducedModel
from morph_dslam.model.separated import SeparatedField
from morph_dslam.model.unknown_loads import ROOT, SecondOrder, UnknownLoads
from morph_dslam.units import FACTORS

#: Ranges of functions may differ from the parameters' by this share of the range: rounding.
_ROUNDING = 1e-9


def check_model(model: ReducedModel) -> None:
    """Raise ValueError, which says what does not fit, if a part of the model contradicts another."""
    check_parameters(model.parameters)
    n_nodes = len(model.nodes)
    if model.nodes.shape != (n_nodes, 3) or n_nodes == 0 or not np.isfinite(model.nodes).all():
        raise ValueError("its nodes are not finite points")
    _check_indices("triangles", model.triangles, 3, n_nodes)
    for name, connectivity in model.cells.items():
        matched = re.fullmatch(r"[a-z]+(\d+)", name)
        if matched is None:
            raise ValueError(f"'{name}' is not a type of cell")
        _check_indices(f"{name} cells", connectivity, int(matched[1]), n_nodes)
    for name, nodes in model.supports.items():
        _check_indices(f"nodes of the support '{name}'", nodes[:, None], 1, n_nodes)
    for name, field in model.fields.items():
        n_points = 1 if name.startswith(REACTION) else n_nodes
        n_components = {"stress": (3, 6), "strain": (6,)}.get(name.split("_")[0], (3,))
        _check_field(name, field, n_points, n_components, model)
    if model.unknown_loads is not None:
        _check_loads(model.unknown_loads, model)


def check_parameters(parameters: tuple[Parameter, ...]) -> None:
    """Raise ValueError where names are not distinct, units not known or a default not in its range."""
    names = [p.name for p in parameters]
    if "" in names or len(set(names)) != len(names):
        raise ValueError(f"its parameters' names are missing or not distinct: {names}")
    for p in parameters:
        if p.unit not in FACTORS.get(p.quantity, {}):
            raise ValueError(f"parameter '{p.name}' is a {p.quantity} in '{p.unit}'")
        bounds = (p.lower, p.default, p.upper)
        if not (np.isfinite(bounds).all() and p.lower < p.upper and p.lower <= p.default <= p.upper):
            raise ValueError(f"parameter '{p.name}' has the lower end, default and upper end {bounds}")


def _check_indices(name: str, connectivity: NDArray[np.integer], size: int, n_nodes: int) -> None:
    if connectivity.ndim != 2 or connectivity.shape[1] != size:
        raise ValueError(f"its {name} do not have {size} nodes each")
    if connectivity.min(initial=0) < 0 or connectivity.max(initial=0) >= n_nodes:
        raise ValueError(f"its {name} name nodes that do not exist")


def _check_field(
    name: str, field: SeparatedField, n_points: int, n_components: tuple[int, ...], model: ReducedModel
) -> None:
    functions, shape = field.functions, field.modes.shape
    if len(shape) != 3 or shape[1] != n_points or shape[2] not in n_components:
        raise ValueError(f"field '{name}' has modes of shape {shape} on {n_points} points")
    if (functions.n_functions, functions.dimension) != (shape[0], len(model.parameters)):
        raise ValueError(
            f"field '{name}' has {functions.n_functions} functions of {functions.dimension} parameters, "
            f"but {shape[0]} modes and {len(model.parameters)} parameters"
        )
    lower, upper = functions.bounds
    slack = _ROUNDING * (model.upper - model.lower)
    if (lower > model.lower + slack).any() or (upper < model.upper - slack).any():
        raise ValueError(f"the functions of field '{name}' do not cover the ranges of the parameters")
    if not np.isfinite(field.modes).all():
        raise ValueError(f"field '{name}' holds values that are not finite")


FORMAT = "morph-dslam reduced model"
VERSION = 3


def save_model(path: str | Path, model: ReducedModel) -> None:
    """Write a model file; the file appears under its name only when it is complete.

    Parameters
    ----------
    path : of the file.
    model : to be written.

    Raises
    ------
    ArgumentError
        If the arguments are not a path and a model, in this order.
    ValueError
        If the parts of the model do not fit together: such a file could not be read again.
    """
    check_kind(path, (str, PathLike), "the first argument of save_model", "the path, and the model as the second")
    check_kind(model, ReducedModel, "the second argument of save_model", "the model, and its path as the first")
    check_model(model)
    path = Path(path)
    with written_with_checksum(path, FORMAT) as file:
        file.attrs["format"] = FORMAT
        file.attrs["version"] = VERSION
        file.attrs["name"] = model.name
        file.attrs["parameters"] = json.dumps([asdict(parameter) for parameter in model.parameters])
        file.attrs["certificate"] = json.dumps(model.certificate)
        file.attrs["provenance"] = json.dumps(model.provenance)
        file.create_dataset("nodes", data=model.nodes)
        file.create_dataset("triangles", data=model.triangles.astype(np.int32))
        for cell_type, connectivity in model.cells.items():
            file.create_dataset(f"cells/{cell_type}", data=connectivity.astype(np.int32))
        for name, nodes in model.supports.items():
            file.create_dataset(f"supports/{member_name(name)}", data=nodes.astype(np.int32))
        if model.unknown_loads is not None:
            _write_loads(file.create_group("unknown_loads"), model.unknown_loads)
        for name, field in model.fields.items():
            write_field(file.create_group(f"fields/{member_name(name)}"), field)


def _write_loads(group: h5py.Group, loads: UnknownLoads) -> None:
    group.attrs["surface"], group.attrs["direction"] = loads.surface, "inward" if loads.inward else "any"
    group.create_dataset("nodes", data=loads.nodes.astype(np.int32))
    group.create_dataset("tractions", data=loads.tractions)
    group.create_dataset("resultants", data=loads.resultants)
    for name, field in loads.responses.items():
        write_field(group.create_group(f"responses/{member_name(name)}"), field)
    if loads.second_order is not None:
        group.create_dataset("second_order/soft", data=loads.second_order.soft)
        write_field(group.create_group("second_order/displacement"), loads.second_order.displacement)


def _read_loads(file: h5py.File, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> UnknownLoads | None:
    if "unknown_loads" not in file:
        return None
    group = read_group(file, "unknown_loads")
    responses = read_group(group, "responses")
    return UnknownLoads(
        read_text(group, "surface"),
        read_text(group, "direction") == "inward",
        read_array(group, "nodes", 1, np.int64),
        read_array(group, "tractions", 3),
        read_array(group, "resultants", 2),
        {unquote(name): read_field(read_group(responses, name), lower, upper) for name in names(responses)},
        _read_second_order(group, lower, upper) if "second_order" in group else None,
    )


def _read_second_order(group: h5py.Group, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> SecondOrder:
    second = read_group(group, "second_order")
    return SecondOrder(read_array(second, "soft", 2), read_field(read_group(second, "displacement"), lower, upper))


def _check_loads(loads: UnknownLoads, model: ReducedModel) -> None:
    """Raise ValueError where responses do not belong to the tractions, or to the model's fields."""
    m, n_nodes = loads.count, len(model.nodes)
    _check_indices("nodes with unknown loads", loads.nodes[:, None], 1, n_nodes)
    if loads.tractions.shape != (len(loads.nodes), 3, m) or m == 0:
        raise ValueError(f"{len(loads.nodes)} nodes have unknown tractions of shape {loads.tractions.shape}")
    if loads.resultants.shape != (m, 6):
        raise ValueError(f"{m} unknown loads have resultants of shape {loads.resultants.shape}")
    if missing := sorted({*model.fields, ROOT} - loads.responses.keys()):
        raise ValueError(f"it does not say what unknown loads do to '{missing[0]}'")
    for name, field in loads.responses.items():
        n_points = 1 if name == ROOT or name.startswith(REACTION) else n_nodes
        known = model.fields.get(name)
        each = m * (m + 1) // 2 if name == ROOT else m * (3 if known is None else known.modes.shape[2])
        _check_field(f"{name} of unknown loads", field, n_points, (each,), model)
    second = loads.second_order
    if second is not None:
        if second.soft.shape[1] != m or not np.isfinite(second.soft).all():
            raise ValueError(f"{m} unknown loads have soft combinations of shape {second.soft.shape}")
        _check_field("second order of unknown loads", second.displacement, n_nodes, (3 * second.n_pairs,), model)


def _read_parameters(file: h5py.File) -> tuple[Parameter, ...]:
    parameters = tuple(Parameter(**entry) for entry in json.loads(read_text(file, "parameters")))
    for p in parameters:
        texts, numbers = (p.name, p.quantity, p.unit, p.description), (p.lower, p.upper, p.default)
        if not all(isinstance(t, str) for t in texts) or not all(isinstance(n, int | float) for n in numbers):
            raise ValueError("a parameter's names are not texts or its ends not numbers")
    check_parameters(parameters)
    return parameters


def _with_prefix(fields: dict[str, SeparatedField], prefix: str) -> dict[str, SeparatedField]:
    """Take the fields whose names begin with ``prefix`` out of ``fields``, under the rest of their names."""
    found = [name for name in fields if name.startswith(prefix)]
    return {name.removeprefix(prefix): fields.pop(name) for name in found}


def _read_indices(file: h5py.File, group: str, n_dimensions: int) -> dict[str, NDArray[np.int64]]:
    """The arrays of node indices in a group, by name; none where the group is missing."""
    if group not in file:
        return {}
    found = read_group(file, group)
    return {unquote(name): read_array(found, name, n_dimensions, np.int64) for name in names(found)}


def _read_model(file: h5py.File) -> ReducedModel:
    parameters = _read_parameters(file)
    lower = np.array([p.lower for p in parameters], dtype=np.float64)
    upper = np.array([p.upper for p in parameters], dtype=np.float64)
    group = read_group(file, "fields")
    fields = {unquote(name): read_field(read_group(group, name), lower, upper) for name in names(group)}
    model = ReducedModel(
        name=read_text(file, "name"),
        nodes=read_array(file, "nodes", 2),
        triangles=read_array(file, "triangles", 2, np.int64),
        parameters=parameters,
        displacement=fields.pop("displacement"),
        stresses=_with_prefix(fields, "stress_"),
        cells=_read_indices(file, "cells", 2),
        supports=_read_indices(file, "supports", 1),
        strain=fields.pop("strain", None),
        reactions=_with_prefix(fields, REACTION),
        unknown_loads=_read_loads(file, lower, upper),
        certificate=json.loads(read_text(file, "certificate")),
        provenance=json.loads(read_text(file, "provenance")),
    )
    if fields:
        raise ValueError(f"its fields {', '.join(sorted(fields))} are not known")
    check_model(model)
    return model


def _check_kind(path: Path) -> None:
    """Raise ModelFileError if a file is no model but what one is made from, or a file of another program."""
    if is_other_hdf5(path):
        raise ModelFileError(f"{path} is an HDF5 file but not a morph-dslam model")
    if begins_with(path, FORMAT):
        return
    if path.suffix.lower() == ".toml":
        raise ModelFileError(
            f"{path} is a study, not a model: build it first with `morph build {path} -o {path.stem}.morph`, and give "
            f"{path.stem}.morph"
        )
    if file_kind(path) in MESHES:
        raise ModelFileError(
            f"{path} is a mesh, not a model: name it in the [mesh] of a study and build that with `morph build`, or a "
            "rigid object's surface with `morph build --rigid`"
        )


def _open_and_read(path: Path) -> ReducedModel:
    _check_kind(path)
    check_checksum(path, FORMAT)
    with h5py.File(path, "r") as file:
        if file.attrs.get("format") != FORMAT:
            raise ModelFileError(f"{path} is an HDF5 file but not a morph-dslam model")
        version = int(file.attrs["version"])  # type: ignore[arg-type]
        if version != VERSION:
            advice = "update morph-dslam" if version > VERSION else "build it again with `morph build`"
            raise ModelFileError(
                f"{path} has model file version {version}, this release reads version {VERSION}: {advice}"
            )
        return _read_model(file)


def load_model(path: str | Path) -> ReducedModel:
    """Read and check a model file.

    Parameters
    ----------
    path : of the file.

    Raises
    ------
    ArgumentError
        If it is no path.
    ModelFileError
        If the file is missing, cut short, damaged, not a model, or of another version.
    """
    check_kind(path, (str, PathLike), "the model file", "its path")
    path = Path(path)
    if not path.is_file():
        raise ModelFileError(f"there is no model file {path}; `morph build study.toml -o {path.name}` makes one")
    try:
        return _open_and_read(path)
    except ModelFileError:
        raise
    except Exception as error:
        # h5py raises half a dozen types on files of faulty writers, RuntimeError and KeyError among them.
        raise ModelFileError(
            f"{path} is damaged or cut short ({error}): build it again with `morph build`, or copy it again"
        ) from error
