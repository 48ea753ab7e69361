"""Arrays and texts of an HDF5 file, checked before they are believed: kind, shape, size, finite values."""

from __future__ import annotations

from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray


def read_array(group: h5py.Group, name: str, n_dimensions: int, kind: type = np.float64) -> NDArray[Any]:
    """A dataset as an array of ``kind``, float64 or int64.

    Raises
    ------
    ValueError
        If there is no such dataset, or it holds other things or another number of dimensions, or values
        that are not finite, or announces more data than the file has.
    """
    dataset = group.get(name)
    if not isinstance(dataset, h5py.Dataset):
        raise ValueError(f"'{name}' is not a dataset")
    if dataset.dtype.kind not in ("f" if kind is np.float64 else "iu") or dataset.ndim != n_dimensions:
        raise ValueError(f"'{name}' holds {dataset.dtype} of shape {dataset.shape}")
    if dataset.nbytes > dataset.file.id.get_filesize():  # before memory is asked for
        raise ValueError(f"'{name}' announces {dataset.nbytes} bytes, more than the file has")
    values = np.ascontiguousarray(dataset[()], dtype=kind)
    if not np.isfinite(values).all():
        raise ValueError(f"'{name}' holds values that are not finite")
    return values


def names(group: h5py.Group) -> list[str]:
    """Names of a group's members, in alphabetical order."""
    return sorted(str(name) for name in group)


def read_group(group: h5py.Group, name: str) -> h5py.Group:
    """A group of the file; ValueError if it is not there."""
    found = group.get(name)
    if not isinstance(found, h5py.Group):
        raise ValueError(f"'{name}' is not a group")
    return found


def read_text(group: h5py.Group, name: str) -> str:
    """A text attribute; ValueError if it is not there."""
    text = group.attrs.get(name)
    if not isinstance(text, str):
        raise ValueError(f"'{name}' is not a text")
    return text


def read_number(group: h5py.Group, name: str) -> float:
    """A finite number among the attributes; ValueError if it is not there."""
    number = group.attrs.get(name)
    if not isinstance(number, (np.integer, np.floating)) or not np.isfinite(number):
        raise ValueError(f"'{name}' is not a finite number")
    return float(number)
