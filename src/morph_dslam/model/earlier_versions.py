"""Model files of versions 1 and 2: polynomials only, and a checksum over datasets among the attributes.

Version 1 had sheets only: no cells, no strain. In both, a field's arrays lay in its group without a format.
"""

from __future__ import annotations

import hashlib

import h5py
import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.array_reading import read_array
from morph_dslam.model.functions import ParameterFunctions
from morph_dslam.model.separated import SeparatedField

Array = NDArray[np.float64]


def content_hash(file: h5py.File) -> str:
    """SHA-256 over every dataset and JSON text."""
    digest = hashlib.sha256()
    names: list[str] = []
    file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    for name in sorted(names):
        dataset = file[name]
        assert isinstance(dataset, h5py.Dataset)
        if dataset.nbytes > file.id.get_filesize():
            raise ValueError(f"'{name}' announces {dataset.nbytes} bytes, more than the file has")
        digest.update(f"{name}{dataset.shape}{dataset.dtype.str}".encode())
        digest.update(np.ascontiguousarray(dataset[()]).tobytes())
    for name in ("name", "parameters", "certificate", "provenance"):
        digest.update(str(file.attrs[name]).encode())
    return digest.hexdigest()


def check_content(file: h5py.File) -> None:
    """Compare the content with its checksum; ValueError where they differ."""
    if content_hash(file) != file.attrs["content_sha256"]:
        raise ValueError("its content does not match its checksum")


def read_field(group: h5py.Group, lower: Array, upper: Array) -> SeparatedField:
    """A field of version 1 or 2 over the box [lower, upper] (d,)."""
    degrees = read_array(group, "multi_indices", 2, np.int64)
    functions = ParameterFunctions(lower, upper, degrees, read_array(group, "coefficients", 2))
    return SeparatedField(read_array(group, "modes", 3), functions)
