"""Loads of given size in the study of a model: those that do not grow with the moduli of the body.

Where supports alone move a body, forces are proportional to a common factor f of all its moduli, and its shape does not
depend on f. Weights, pressures, forces and springs keep their sizes. Where they all are proportional to parameters p,
the state under p of a body whose moduli are f times as large is that of the model at p / f, with f times its forces.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from morph_dslam.errors import StudyError
from morph_dslam.model import Parameter, ReducedModel
from morph_dslam.studies.affine import Affine, Amplitudes, read_affine
from morph_dslam.studies.solid_sections import GravityLoad

#: Keys of loads, couplings and foundations that hold their size.
SIZES = ("traction", "pressure", "force", "moment", "stiffness")
#: Sections whose values may name parameters, with their keys that hold sizes; keys whose texts are other names.
SECTIONS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("mesh", "shell", "contacts", "shape"), ()),
    **dict.fromkeys(("materials", "material"), ("density",)),
    **dict.fromkeys(("supports", "loads", "couplings"), (*SIZES, "acceleration")),
}
NAMES = ("kind", "law", "on", "against", "kept", "file", "unit", "generator", "cells", "held")

#: Kinds whose force goes with the motion of the body: that of springs, and of a pressure on a surface that changes.
MOVING = ("foundation", "pressure")


@dataclass(frozen=True)
class UnscaledLoad:
    """A load that moduli do not scale, and that no choice of parameters scales as they do.

    Attributes
    ----------
    name : for people, "load 1 (gravity)".
    parameters : names of those that change it.
    is_steady : whether its force is the same in all states with the same values of these parameters.
    """

    name: str
    parameters: frozenset[str]
    is_steady: bool


@dataclass(frozen=True)
class GivenLoads:
    """What a model's study says of them.

    Attributes
    ----------
    scaled : names of the parameters p to which loads are proportional, and that change nothing else.
    unscaled : all other loads of given size.
    are_known : whether the model says which there are; solutions of another program do not.
    """

    scaled: frozenset[str] = frozenset()
    unscaled: tuple[UnscaledLoad, ...] = ()
    are_known: bool = True

    @classmethod
    def of(cls, model: ReducedModel) -> GivenLoads:
        """Those of a model."""
        study = _content(model.provenance.get("study"))
        if study is None or "external" in study:
            return cls(are_known=False)
        try:
            return _read(study, model.study_parameters)
        except StudyError:  # of a release that wrote values otherwise
            return cls(are_known=False)


def _content(text: Any) -> dict[str, Any] | None:
    """A study from the text that a model keeps, a study file or JSON; None if it is neither."""
    for read in (tomllib.loads, json.loads):
        try:
            content = read(text) if isinstance(text, str) else None
        except ValueError:
            continue
        return content if isinstance(content, dict) else None
    return None


@dataclass(frozen=True)
class _Size:
    """The size of a load: one of its components, by which parameters it is multiplied.

    Attributes
    ----------
    name : of the load.
    used : names of the parameters that change it.
    by : names of those to which it is proportional; None if it is not.
    is_steady : as that of `UnscaledLoad`.
    """

    name: str
    used: frozenset[str]
    by: frozenset[str] | None
    is_steady: bool


def _read(study: Mapping[str, Any], parameters: Sequence[Parameter]) -> GivenLoads:
    sizes = list(_sizes(study, parameters))
    elsewhere = {word for section, left_out in SECTIONS.items() for word in _words(study.get(section), left_out)}
    clock = (study.get("time") or {}).get("parameter")
    candidates = {name for size in sizes for name in size.by or ()}
    scaled = frozenset(candidates - elsewhere - {clock} - {n for size in sizes if size.by is None for n in size.used})
    # A load is scaled by all of its parameters or by none.
    while wrong := {n for size in sizes if size.by and not size.by <= scaled for n in size.by & scaled}:
        scaled -= wrong
    rest = [size for size in sizes if size.by is None or not size.by <= scaled]
    unscaled = {
        name: UnscaledLoad(
            name,
            frozenset().union(*(size.used for size in rest if size.name == name)),
            all(size.is_steady for size in rest if size.name == name),
        )
        for name in dict.fromkeys(size.name for size in rest)
    }
    return GivenLoads(scaled, tuple(unscaled.values()))


def _sizes(study: Mapping[str, Any], parameters: Sequence[Parameter]) -> Iterator[_Size]:
    """The sizes of all loads that are not zero."""
    time = study.get("time") or {}
    names = [parameter.name for parameter in parameters]
    clock = names.index(time["parameter"]) if time.get("parameter") in names else -1
    amplitudes = Amplitudes(clock, dict.fromkeys(time.get("amplitudes") or {}, None))  # type: ignore[arg-type]

    def read(values: Any) -> list[Affine]:
        each = values if isinstance(values, list) else [values]
        return [read_affine(value, None, parameters, amplitudes) for value in each]

    densities = [density for density in read([*_densities(study)]) if _acts(density)]
    for kind in ("support", "load", "coupling"):
        for number, section in enumerate(study.get(f"{kind}s") or (), start=1):
            what = section.get("kind") or kind
            where = frozenset(names) & set(_words(section, SECTIONS["loads"]))
            load = _Size(f"{kind} {number}" + (f" ({what})" if what != kind else ""), where, None, what not in MOVING)
            if what == "gravity":
                along = section.get("acceleration") or list(GravityLoad.model_fields["acceleration"].default)
                yield from (_weight(load, a, d, names) for a in read(along) for d in densities if _acts(a))
            else:
                sizes = [size for key in SIZES if section.get(key) is not None for size in read(section[key])]
                yield from (_component(load, size, names) for size in sizes if _acts(size))


def _acts(size: Affine) -> bool:
    return bool(size.constant or size.used)


def _component(load: _Size, size: Affine, names: Sequence[str]) -> _Size:
    """One component of a load; a function of time alone is proportional to no parameter.

    Parameters
    ----------
    load : used are the parameters that say where it acts.
    size : of the component.
    names : of all parameters.
    """
    indices = {k for k, slope in enumerate(size.slopes) if slope} | {product.index for product in size.products}
    by = frozenset(names[k] for k in indices if k is not None)
    used = load.used | {names[k] for k in size.used}
    return replace(load, used=used, by=None if size.constant or None in indices else by)


def _weight(load: _Size, acceleration: Affine, density: Affine, names: Sequence[str]) -> _Size:
    """A load by a product, proportional to the parameters of one factor where the other one is fixed."""
    a, d = (_component(load, factor, names) for factor in (acceleration, density))
    by = d.by if acceleration.fixed else a.by if density.fixed else None
    return replace(a, used=a.used | d.used, by=by)


def _densities(content: Any) -> Iterator[Any]:
    """Those of all materials."""
    if isinstance(content, Mapping):
        for key, value in content.items():
            if key == "density" and value is not None:
                yield value
            else:
                yield from _densities(value)


def _words(content: Any, left_out: Sequence[str]) -> Iterator[str]:
    """The words of all values but those of keys that are ``left_out``."""
    if isinstance(content, Mapping):
        for name, value in content.items():
            if name not in (*NAMES, *left_out):
                yield from _words(value, left_out)
    elif isinstance(content, list | tuple):
        for value in content:
            yield from _words(value, left_out)
    elif isinstance(content, str):
        yield from re.findall(r"[A-Za-z_]\w*", content)
