"""Separated fields in the groups of a model file (docs/model-file.md), and arrays checked before they are believed.

Modes are kept in single precision, whose rounding is far below any model's error; the numbers that make the
functions are few and stay in double precision.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.basis_functions import Basis
from morph_dslam.model.functions import Functions, ParameterFunctions
from morph_dslam.model.separated import SeparatedField
from morph_dslam.model.tensor_functions import CPFunctions, ProductFunctions, TensorTrainFunctions, TuckerFunctions

Array = NDArray[np.float64]


class _Format(NamedTuple):
    """How functions with a basis for each parameter are kept: an array for each parameter, and one of all.

    Attributes
    ----------
    kind : class of the functions.
    parts : its attribute that has an array for each parameter.
    stem : name of these in the file, before "_1", "_2" and so on.
    n_dimensions : of these arrays.
    whole : attribute, and name in the file, of the array of all parameters.
    """

    kind: type
    parts: str
    stem: str
    n_dimensions: int
    whole: str | None


_FORMATS = {
    "cp": _Format(CPFunctions, "factors", "factor", 2, "mixing"),
    "tucker": _Format(TuckerFunctions, "factors", "factor", 2, "core"),
    "tensor_train": _Format(TensorTrainFunctions, "cores", "core", 3, None),
}


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


def write_field(group: h5py.Group, field: SeparatedField) -> None:
    """Write a field into an empty group."""
    group.attrs["modes"] = "full"
    _write_single(group, "modes", field.modes)
    _write_functions(group.create_group("functions"), field.functions)


def _write_single(group: h5py.Group, name: str, values: NDArray[np.floating]) -> None:
    with np.errstate(over="ignore"):
        single = values.astype(np.float32)
    if not np.isfinite(single).all():
        raise ValueError(f"{group.name}/{name} has values that are not finite in single precision")
    group.create_dataset(name, data=single)


def _write_basis(group: h5py.Group, basis: Basis) -> None:
    group.attrs["kind"] = basis.kind
    group.attrs["lower"], group.attrs["upper"] = basis.lower, basis.upper
    group.attrs["size"], group.attrs["degree"] = basis.size, basis.degree
    group.create_dataset("knots", data=basis.knots)


def _write_functions(group: h5py.Group, functions: Functions) -> None:
    if isinstance(functions, ParameterFunctions):
        group.attrs["format"] = "polynomial"
        degrees = functions.multi_indices
        group.create_dataset("multi_indices", data=degrees.astype(np.min_scalar_type(int(degrees.max(initial=0)))))
        group.create_dataset("coefficients", data=functions.coefficients)
        return
    if isinstance(functions, ProductFunctions):
        group.attrs["format"] = "product"
        group.attrs["n_first"] = functions.first.dimension
        _write_functions(group.create_group("part_1"), functions.first)
        _write_functions(group.create_group("part_2"), functions.second)
        if functions.mixing is not None:
            group.create_dataset("mixing", data=functions.mixing)
        return
    name, form = next(item for item in _FORMATS.items() if isinstance(functions, item[1].kind))
    found: Any = functions
    group.attrs["format"] = name
    for k, (basis, part) in enumerate(zip(found.bases, getattr(found, form.parts), strict=True), start=1):
        _write_basis(group.create_group(f"basis_{k}"), basis)
        group.create_dataset(f"{form.stem}_{k}", data=part)
    if form.whole is not None and not (name == "cp" and found.is_unmixed):
        group.create_dataset(form.whole, data=getattr(found, form.whole))


def read_field(group: h5py.Group, lower: Array, upper: Array) -> SeparatedField:
    """Read a field over the box [lower, upper] (d,)."""
    functions = read_functions(read_group(group, "functions"), lower, upper)
    form = read_text(group, "modes")
    if form == "full":
        return SeparatedField(read_array(group, "modes", 3), functions)
    if form != "by_component":
        raise ValueError(f"modes are kept in the unknown form '{form}'")
    return SeparatedField(_read_by_component(group), functions)


def _read_by_component(group: h5py.Group) -> Array:
    """Modes (k, n, c) that move one component each, as releases before 0.2.0 could write them."""
    values, components = read_array(group, "modes", 2), read_array(group, "components", 1, np.int64)
    count = int(read_number(group, "n_components"))
    if count not in (3, 6) or len(components) != len(values):
        raise ValueError(f"{len(components)} components, each one of {count}, do not fit modes {values.shape}")
    if components.min(initial=0) < 0 or components.max(initial=0) >= count:
        raise ValueError(f"a mode's component is not one of {count}")
    modes = np.zeros((*values.shape, count))
    modes[np.arange(len(modes)), :, components] = values
    return modes


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
    name, d = read_text(group, "format"), len(lower)
    if name == "polynomial":
        degrees = read_array(group, "multi_indices", 2, np.int64)
        return ParameterFunctions(lower, upper, degrees, read_array(group, "coefficients", 2))
    if name == "product":
        split = int(read_number(group, "n_first"))
        if not 1 <= split < d:
            raise ValueError(f"products of functions of {split} parameters in a model of {d}")
        first = read_functions(read_group(group, "part_1"), lower[:split], upper[:split])
        second = read_functions(read_group(group, "part_2"), lower[split:], upper[split:])
        return ProductFunctions(first, second, read_array(group, "mixing", 2) if "mixing" in group else None)
    if name not in _FORMATS:
        raise ValueError(f"functions are kept in the unknown format '{name}'")
    form = _FORMATS[name]
    bases = tuple(_read_basis(read_group(group, f"basis_{k + 1}")) for k in range(d))
    parts = tuple(read_array(group, f"{form.stem}_{k + 1}", form.n_dimensions) for k in range(d))
    if form.whole is None:
        return form.kind(bases, parts)
    if name == "cp" and form.whole not in group:
        return CPFunctions(bases, parts, np.eye(parts[0].shape[1]))
    return form.kind(bases, parts, read_array(group, form.whole, d + 1 if name == "tucker" else 2))
