"""The `.morph` file: HDF5, versioned, without pickles, and checked in full when loaded.

Layout (documented in docs/model-file.md): attributes `format`, `version`, `name`, `content_sha256` and the
JSON texts `parameters`, `certificate`, `provenance` on the root; datasets `nodes`, `triangles` and, for
solids, `cells/TYPE`; one group per field under `fields/` with `modes`, `multi_indices`, `coefficients`.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict
from pathlib import Path

import h5py
import numpy as np

from morph_dslam.errors import ModelFileError
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.model.reduced_model import Parameter, ReducedModel
from morph_dslam.model.separated import SeparatedField

FORMAT = "morph-dslam reduced model"
#: Version 1 had sheets only: no cells, no strain. Its files are read as they are.
VERSION = 2
OLDEST_VERSION = 1


def _content_hash(file: h5py.File) -> str:
    """SHA-256 over every dataset and JSON text, so that any damaged byte that matters is noticed."""
    digest = hashlib.sha256()
    names: list[str] = []
    file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    for name in sorted(names):
        dataset = file[name]
        assert isinstance(dataset, h5py.Dataset)
        digest.update(f"{name}{dataset.shape}{dataset.dtype.str}".encode())
        digest.update(np.ascontiguousarray(dataset[()]).tobytes())
    for name in ("name", "parameters", "certificate", "provenance"):
        digest.update(str(file.attrs[name]).encode())
    return digest.hexdigest()


def _write_field(group: h5py.Group, field: SeparatedField) -> None:
    group.create_dataset("modes", data=field.modes.astype(np.float32))
    group.create_dataset("multi_indices", data=field.functions.multi_indices.astype(np.uint8))
    group.create_dataset("coefficients", data=field.functions.coefficients)


def save_model(path: Path, model: ReducedModel) -> None:
    """Write a model file; the file appears under its name only when it is complete."""
    partial = path.with_name(path.name + ".partial")
    with h5py.File(partial, "w") as file:
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
        for name, field in model.fields.items():
            _write_field(file.create_group(f"fields/{name}"), field)
        file.attrs["content_sha256"] = _content_hash(file)
    os.replace(partial, path)


def _read_array(group: h5py.Group, name: str, dtype: type) -> np.ndarray:
    dataset = group[name]
    if not isinstance(dataset, h5py.Dataset):
        raise ValueError(f"'{name}' is not a dataset")
    return np.ascontiguousarray(dataset[()], dtype=dtype)


def _read_field(group: h5py.Group, lower: np.ndarray, upper: np.ndarray) -> SeparatedField:
    functions = ParameterFunctions(
        lower=lower,
        upper=upper,
        multi_indices=_read_array(group, "multi_indices", np.int64),
        coefficients=_read_array(group, "coefficients", np.float64),
    )
    return SeparatedField(_read_array(group, "modes", np.float64), functions)


def _check_field(name: str, field: SeparatedField, n_nodes: int, d: int) -> None:
    functions = field.functions
    consistent = (
        field.modes.ndim == 3
        and field.modes.shape[1] == n_nodes
        and functions.multi_indices.shape == (len(functions.coefficients), d)
        and functions.coefficients.shape[1:] == (field.n_modes,)
    )
    if not consistent:
        raise ValueError(f"the arrays of field '{name}' do not fit together")
    if not (np.isfinite(field.modes).all() and np.isfinite(functions.coefficients).all()):
        raise ValueError(f"field '{name}' holds values that are not finite")


def _read_model(file: h5py.File) -> ReducedModel:
    if _content_hash(file) != file.attrs["content_sha256"]:
        raise ValueError("its content does not match its checksum")
    parameters = tuple(Parameter(**entry) for entry in json.loads(str(file.attrs["parameters"])))
    lower = np.array([p.lower for p in parameters])
    upper = np.array([p.upper for p in parameters])
    nodes = _read_array(file, "nodes", np.float64)
    triangles = _read_array(file, "triangles", np.int64)
    if nodes.ndim != 2 or nodes.shape[1] != 3 or not np.isfinite(nodes).all():
        raise ValueError("its nodes are not finite points")
    if triangles.ndim != 2 or triangles.min() < 0 or triangles.max() >= len(nodes):
        raise ValueError("its triangles name nodes that do not exist")
    cells = {name: _read_array(file["cells"], name, np.int64) for name in file.get("cells", {})}  # type: ignore[arg-type]
    for name, connectivity in cells.items():
        if connectivity.ndim != 2 or connectivity.min() < 0 or connectivity.max() >= len(nodes):
            raise ValueError(f"its {name} cells name nodes that do not exist")
    fields_group = file["fields"]
    assert isinstance(fields_group, h5py.Group)
    fields = {name: _read_field(group, lower, upper) for name, group in fields_group.items()}
    for name, field in fields.items():
        _check_field(name, field, len(nodes), len(parameters))
    return ReducedModel(
        name=str(file.attrs["name"]),
        nodes=nodes,
        triangles=triangles,
        parameters=parameters,
        displacement=fields["displacement"],
        stresses={
            name.removeprefix("stress_"): field
            for name, field in fields.items()
            if name.startswith("stress_")
        },
        cells=cells,
        strain=fields.get("strain"),
        certificate=json.loads(str(file.attrs["certificate"])),
        provenance=json.loads(str(file.attrs["provenance"])),
    )


def load_model(path: Path) -> ReducedModel:
    """Read and check a model file.

    Raises
    ------
    ModelFileError
        If the file is missing, cut short, damaged, not a model, or of another version.
    """
    rebuild = "build it again with `morph build`, or copy it again"
    if not path.is_file():
        raise ModelFileError(
            f"there is no model file {path}; `morph build study.toml -o {path.name}` makes one"
        )
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT:
                raise ModelFileError(f"{path} is an HDF5 file but not a morph-dslam model")
            version = int(file.attrs["version"])  # type: ignore[arg-type]
            if not OLDEST_VERSION <= version <= VERSION:
                raise ModelFileError(
                    f"{path} has model file version {version}, this release reads versions {OLDEST_VERSION} "
                    f"to {VERSION}: "
                    f"{'update morph-dslam' if version > VERSION else rebuild}"
                )
            return _read_model(file)
    except ModelFileError:
        raise
    except Exception as error:
        # h5py raises half a dozen types on damaged files, RuntimeError and KeyError among them.
        raise ModelFileError(f"{path} is damaged or cut short ({error}): {rebuild}") from error
