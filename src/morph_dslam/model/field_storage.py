"""Arrays and texts of an HDF5 file, checked before they are believed: kind, shape, size, finite values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.basis_functions import Basis
from morph_dslam.model.functions import Functions, ParameterFunctions
from morph_dslam.model.separated import CompactModes, ComponentModes, GridModes, SeparatedField
from morph_dslam.model.tensor_functions import (
    CPFunctions,
    ProductFunctions,
    StackedFunctions,
    TensorTrainFunctions,
    TuckerFunctions,
)


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


# Separated fields in the groups of a model file: modes as they are or compact, functions in any format.
# The layout is documented in docs/model-file.md. Modes are in single precision, whose rounding is far below
# any model's error; the numbers that make the functions are few and stay in double precision.


Array = NDArray[np.float64]

#: Products of more parts than this are not met; a file that announces them is not believed.
_MOST_PARTS = 64


def write_field(group: h5py.Group, field: SeparatedField) -> None:
    """Write a field into an empty group."""
    compact = field.compact
    if isinstance(compact, ComponentModes):
        group.attrs["modes"] = "by_component"
        group.attrs["n_components"] = compact.n_components
        _write_single(group, "modes", compact.values)
        group.create_dataset("components", data=compact.components.astype(np.uint8))
    elif isinstance(compact, GridModes):
        group.attrs["modes"] = "grid"
        for k, axis in enumerate(compact.axes):
            _write_single(group, f"axis_{k + 1}", axis)
        _write_single(group, "components", compact.components)
    else:
        group.attrs["modes"] = "full"
        _write_single(group, "modes", field.modes)
    _write_functions(group.create_group("functions"), field.functions)


def _write_single(group: h5py.Group, name: str, values: Array) -> None:
    with np.errstate(over="ignore"):
        single = values.astype(np.float32)
    if not np.isfinite(single).all():
        raise ValueError(f"{group.name}/{name} has values that are not finite in single precision")
    group.create_dataset(name, data=single)


def _write_arrays(group: h5py.Group, stem: str, arrays: Sequence[Array]) -> None:
    for k, array in enumerate(arrays):
        group.create_dataset(f"{stem}_{k + 1}", data=array)


def _write_bases(group: h5py.Group, bases: tuple[Basis, ...]) -> None:
    for k, basis in enumerate(bases):
        made = group.create_group(f"basis_{k + 1}")
        made.attrs["kind"] = basis.kind
        made.attrs["lower"], made.attrs["upper"] = basis.lower, basis.upper
        made.attrs["size"], made.attrs["degree"] = basis.size, basis.degree
        made.create_dataset("knots", data=basis.knots)


def _write_functions(group: h5py.Group, functions: Functions) -> None:
    if isinstance(functions, ParameterFunctions):
        group.attrs["format"] = "polynomial"
        degrees = functions.multi_indices
        group.create_dataset("multi_indices", data=degrees.astype(np.min_scalar_type(int(degrees.max()))))
        group.create_dataset("coefficients", data=functions.coefficients)
    elif isinstance(functions, CPFunctions):
        group.attrs["format"] = "cp"
        _write_bases(group, functions.bases)
        _write_arrays(group, "factor", functions.factors)
        if not functions.is_unmixed:
            group.create_dataset("mixing", data=functions.mixing)
    elif isinstance(functions, TuckerFunctions):
        group.attrs["format"] = "tucker"
        _write_bases(group, functions.bases)
        _write_arrays(group, "factor", functions.factors)
        group.create_dataset("core", data=functions.core)
    elif isinstance(functions, TensorTrainFunctions):
        group.attrs["format"] = "tensor_train"
        _write_bases(group, functions.bases)
        _write_arrays(group, "core", functions.cores)
    elif isinstance(functions, StackedFunctions):
        group.attrs["format"] = "stacked"
        for k, part in enumerate(functions.parts):
            _write_functions(group.create_group(f"part_{k + 1}"), part)
        if functions.mixing is not None:
            group.create_dataset("mixing", data=functions.mixing)
    elif isinstance(functions, ProductFunctions):
        group.attrs["format"] = "product"
        group.attrs["n_first"] = functions.first.dimension
        _write_functions(group.create_group("part_1"), functions.first)
        _write_functions(group.create_group("part_2"), functions.second)
        if functions.mixing is not None:
            group.create_dataset("mixing", data=functions.mixing)
    else:
        raise TypeError(f"there is no place in the model file for {type(functions).__name__}")


def read_field(group: h5py.Group, lower: Array, upper: Array) -> SeparatedField:
    """Read a field over the box [lower, upper] (d,).

    Raises
    ------
    ValueError
        If anything in the group is missing, misshapen or not finite, or does not fit the rest.
    """
    functions = read_functions(read_group(group, "functions"), lower, upper)
    form = read_text(group, "modes")
    compact: CompactModes
    if form == "full":
        return SeparatedField(read_array(group, "modes", 3), functions)
    if form == "by_component":
        components = read_array(group, "components", 1, np.int64)
        count = int(read_number(group, "n_components"))
        compact = ComponentModes(read_array(group, "modes", 2), components, count)
    elif form == "grid":
        axes = [read_array(group, f"axis_{k}", 2) for k in _numbers(group, "axis")]
        compact = GridModes(tuple(axes), read_array(group, "components", 2))
    else:
        raise ValueError(f"modes are kept in the unknown form '{form}'")
    return SeparatedField.from_compact(compact, functions)


def _numbers(group: h5py.Group, stem: str) -> range:
    """1, 2 ... n for the n members of the group that are called ``stem``_1, ``stem``_2 and so on."""
    count = sum(name.startswith(f"{stem}_") for name in names(group))
    if not 1 <= count <= _MOST_PARTS:
        raise ValueError(f"{group.name} holds {count} of '{stem}_1', '{stem}_2' and so on")
    return range(1, count + 1)


def _read_basis(group: h5py.Group) -> Basis:
    return Basis(
        kind=read_text(group, "kind"),
        lower=read_number(group, "lower"),
        upper=read_number(group, "upper"),
        size=int(read_number(group, "size")),
        degree=int(read_number(group, "degree")),
        knots=read_array(group, "knots", 1),
    )


def read_functions(group: h5py.Group, lower: Array, upper: Array) -> Functions:
    """The functions of a field; see `read_field`."""
    form, d = read_text(group, "format"), len(lower)
    if form == "polynomial":
        degrees = read_array(group, "multi_indices", 2, np.int64)
        return ParameterFunctions(lower, upper, degrees, read_array(group, "coefficients", 2))
    if form == "stacked":
        parts = [read_functions(read_group(group, f"part_{k}"), lower, upper) for k in _numbers(group, "part")]
        return StackedFunctions(tuple(parts), read_array(group, "mixing", 2) if "mixing" in group else None)
    if form == "product":
        split = int(read_number(group, "n_first"))
        if not 1 <= split < d:
            raise ValueError(f"products of functions of {split} parameters in a model of {d}")
        first = read_functions(read_group(group, "part_1"), lower[:split], upper[:split])
        second = read_functions(read_group(group, "part_2"), lower[split:], upper[split:])
        return ProductFunctions(first, second, read_array(group, "mixing", 2) if "mixing" in group else None)
    if form not in ("cp", "tucker", "tensor_train"):
        raise ValueError(f"functions are kept in the unknown format '{form}'")
    bases = tuple(_read_basis(read_group(group, f"basis_{k + 1}")) for k in range(d))
    if form == "tensor_train":
        return TensorTrainFunctions(bases, tuple(read_array(group, f"core_{k + 1}", 3) for k in range(d)))
    factors = tuple(read_array(group, f"factor_{k + 1}", 2) for k in range(d))
    if form == "cp":
        unmixed = np.eye(factors[0].shape[1])
        return CPFunctions(bases, factors, read_array(group, "mixing", 2) if "mixing" in group else unmixed)
    return TuckerFunctions(bases, factors, read_array(group, "core", d + 1))
