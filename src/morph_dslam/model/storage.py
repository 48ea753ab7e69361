"""The `.morph` file: HDF5, versioned, without pickles, and checked in full when loaded.

The layout is documented in docs/model-file.md. A file is sealed by a checksum over all its bytes, which is
compared before HDF5 opens it (`file_seal`); then every array is checked by itself (`array_reading`) and
against the others (`model_checks`), so that a file of a faulty writer is refused as well.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from pathlib import Path
from urllib.parse import quote, unquote

import h5py
import numpy as np

from morph_dslam.errors import ModelFileError
from morph_dslam.model import earlier_versions
from morph_dslam.model.array_reading import names, read_array, read_group, read_text
from morph_dslam.model.field_storage import read_field, write_field
from morph_dslam.model.file_seal import BLOCK, check_seal, is_sealed, seal
from morph_dslam.model.model_checks import check_model, check_parameters
from morph_dslam.model.reduced_model import Parameter, ReducedModel
from morph_dslam.model.separated import SeparatedField

FORMAT = "morph-dslam reduced model"
VERSION = 3
OLDEST_VERSION = 1
#: What stays as it is in the name of a field's group; "/" would start another group.
_PLAIN = " !#$&'()*+,:;=?@[]"


def save_model(path: Path, model: ReducedModel) -> None:
    """Write a model file; the file appears under its name only when it is complete.

    Raises
    ------
    ValueError
        If the parts of the model do not fit together: such a file could not be read again.
    """
    check_model(model)
    partial = path.with_name(path.name + ".partial")
    with h5py.File(partial, "w", userblock_size=BLOCK) as file:
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
            write_field(file.create_group(f"fields/{quote(name, safe=_PLAIN)}"), field)
    seal(partial)
    os.replace(partial, path)


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


def _read_model(file: h5py.File, version: int) -> ReducedModel:
    parameters = _read_parameters(file)
    lower = np.array([p.lower for p in parameters], dtype=np.float64)
    upper = np.array([p.upper for p in parameters], dtype=np.float64)
    read = read_field if version == VERSION else earlier_versions.read_field
    group = read_group(file, "fields")
    fields = {unquote(name): read(read_group(group, name), lower, upper) for name in names(group)}
    cells = read_group(file, "cells") if "cells" in file else None
    model = ReducedModel(
        name=read_text(file, "name"),
        nodes=read_array(file, "nodes", 2),
        triangles=read_array(file, "triangles", 2, np.int64),
        parameters=parameters,
        displacement=fields.pop("displacement"),
        stresses=_with_prefix(fields, "stress_"),
        cells={} if cells is None else {n: read_array(cells, n, 2, np.int64) for n in names(cells)},
        strain=fields.pop("strain", None),
        reactions=_with_prefix(fields, "reaction_"),
        certificate=json.loads(read_text(file, "certificate")),
        provenance=json.loads(read_text(file, "provenance")),
    )
    if fields:
        raise ValueError(f"its fields {', '.join(sorted(fields))} are not known")
    check_model(model)
    return model


def _open_and_read(path: Path) -> ReducedModel:
    sealed = is_sealed(path)
    if sealed:
        check_seal(path)
    with h5py.File(path, "r") as file:
        if file.attrs.get("format") != FORMAT:
            raise ModelFileError(f"{path} is an HDF5 file but not a morph-dslam model")
        version = int(file.attrs["version"])  # type: ignore[arg-type]
        if not OLDEST_VERSION <= version <= VERSION:
            advice = "update morph-dslam" if version > VERSION else "build it again with `morph build`"
            raise ModelFileError(
                f"{path} has model file version {version}, this release reads versions {OLDEST_VERSION} "
                f"to {VERSION}: {advice}"
            )
        if sealed != (version == VERSION):
            raise ValueError(f"version {version} does not begin like that")
        if not sealed:
            earlier_versions.check_content(file)
        return _read_model(file, version)


def load_model(path: Path) -> ReducedModel:
    """Read and check a model file of this or an earlier version.

    Raises
    ------
    ModelFileError
        If the file is missing, cut short, damaged, not a model, or of another version.
    """
    if not path.is_file():
        raise ModelFileError(
            f"there is no model file {path}; `morph build study.toml -o {path.name}` makes one"
        )
    try:
        return _open_and_read(path)
    except ModelFileError:
        raise
    except Exception as error:
        # h5py raises half a dozen types on files of faulty writers, RuntimeError and KeyError among them.
        raise ModelFileError(
            f"{path} is damaged or cut short ({error}): build it again with `morph build`, or copy it again"
        ) from error
