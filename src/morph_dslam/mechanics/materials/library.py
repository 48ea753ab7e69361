"""A user's own strain-energy density."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any

import ngsolve as ngs
import numpy as np

from morph_dslam.errors import MorphError, StudyError
from morph_dslam.mechanics.materials.anisotropic import (
    Directed,
    HolzapfelGasserOgden,
    Orthotropic,
    TransverselyIsotropic,
)
from morph_dslam.mechanics.materials.base import Constant, Material, evaluate, law_name, turned_direction
from morph_dslam.mechanics.materials.isotropic import (
    Gent,
    LinearElastic,
    MooneyRivlin,
    NeoHookean,
    Ogden,
    Rubber,
    StVenantKirchhoff,
    Yeoh,
)
from morph_dslam.mechanics.materials.viscoelastic import Prony


@dataclass(frozen=True, kw_only=True, eq=False)
class UserMaterial(Rubber):
    """A law that the user writes as one Python function.

    Energy  W = function(F, **constants) + kappa/2 (J - 1)^2
    Stress  by differentiation, as of every law

    The function receives F as a 3x3 NGSolve coefficient function and returns the energy, Pa, written with
    NGSolve's functions (`ngs.Det`, `ngs.Trace`, `ngs.log`, ...). It should depend on F'F alone, so that a
    rigid rotation stores no energy.

    Attributes
    ----------
    function : function(F, **constants) -> energy density, Pa.
    values : the function's own constants by name; they may be parameters.
    bulk : kappa, Pa, if the function leaves the volumetric part out; with it the law serves mixed elements.
    """

    function: Callable[..., Any]
    values: dict[str, Constant] = field(default_factory=dict)
    bulk: Constant | None = None

    def distortional(self, F: Any, J: Any) -> Any:
        return self.function(F, **self.values)

    def constants(self) -> dict[str, Constant]:
        return super().constants() | self.values

    def check_constants(self) -> None:
        if self.bulk is not None:
            super().check_constants()
        try:
            slope = evaluate(self.first_piola_kirchhoff(ngs.Id(3)))
        except MorphError:
            raise
        except Exception as error:  # whatever the user's function may raise
            raise StudyError(f"the energy function of the user's material failed: {error}") from error
        size = np.abs(self.small_strain_stiffness()).max()
        if not np.abs(slope).max() <= 1e-8 * size:
            raise StudyError(
                "the energy function of the user's material has a stress in the undeformed state "
                f"({np.abs(slope).max():g} Pa); its derivative must vanish at F = 1"
            )


def load_function(reference: str, folder: Path) -> Callable[..., Any]:
    """The function that "file.py:name" means, the file being sought in ``folder``.

    Raises
    ------
    StudyError : the text has another form, there is no such file or function, or the file fails.
    """
    path_text, _, name = reference.rpartition(":")
    path = folder / path_text
    if not path_text or not path.is_file():
        raise StudyError(f'the material\'s function "{reference}" must be "file.py:name"; no file {path}')
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever the user's file may raise
        raise StudyError(f"{path} cannot be run: {error}") from error
    if not callable(getattr(module, name, None)):
        raise StudyError(f"{path} has no function {name}")
    return getattr(module, name)


# Materials from a study file's section.
# {"law": "neo_hookean", "young": 3.0e6, "poisson": 0.45, "density": 1080.0, "prony": {"relative_moduli":
# [0.6], "times": [2.0]}}
# Values are SI numbers already, or symbols of the study's parameters. The keys are the attributes of the
# law's class. A direction is three numbers, the name of a field of the mesh, or an angle that a parameter may
# turn: {"angle": ..., "from": [1, 0, 0], "towards": [0, 1, 0]}.


#: Every law by its name in a study file.
LAWS: dict[str, type[Material]] = {
    law_name(law): law
    for law in (
        NeoHookean, StVenantKirchhoff, LinearElastic, MooneyRivlin, Yeoh, Gent, Ogden,
        Orthotropic, TransverselyIsotropic, HolzapfelGasserOgden, UserMaterial,
    )
}  # fmt: skip

_RATIOS = ("limit", "k2", "dispersion", "exponents")


def law_named(name: Any) -> type[Material]:
    """The law of this name in a study file; StudyError listing the known ones if there is none."""
    if name not in LAWS:
        raise StudyError(f"'{name}' is not a known material law; known are {', '.join(LAWS)}")
    return LAWS[name]


def constant_quantities(law: str) -> dict[str, str]:
    """What each constant of a law measures: "stress", "ratio" or "density", as in `units.FACTORS`.

    Directions and the series are left out; so are a user's own constants, which may be anything.
    """
    kind = law_named(law)
    skipped = {"prony", "function", "values", *getattr(kind, "directions", ())}
    names = [field.name for field in fields(kind) if field.name not in skipped]
    return {name: _quantity(name) for name in names}


def _quantity(constant: str) -> str:
    if constant == "density":
        return "density"
    return "ratio" if constant in _RATIOS or constant.startswith("poisson") else "stress"


def material_from_table(table: Mapping[str, Any], folder: Path = Path()) -> Material:
    """The material that a study's section describes.

    Parameters
    ----------
    table : law and constants, see above.
    folder : where a user's "file.py:name" is sought.

    Raises
    ------
    StudyError
        For an unknown law or key, a missing constant, or a value of the wrong kind. Whether the constants are
        stable is told by `Material.check`.
    """
    table = dict(table)
    if "law" not in table:
        raise StudyError(f"the material names no law; set law to one of {', '.join(LAWS)}")
    law = law_named(table.pop("law"))
    if law is UserMaterial:
        return _user_material(table, folder)
    known = {field.name: field for field in fields(law)}
    unknown = [key for key in table if key not in known]
    if unknown:
        raise StudyError(f"{law_name(law)} has no constant '{unknown[0]}'; it has {', '.join(known)}")
    missing = [name for name, f in known.items() if f.default is MISSING and name not in table]
    if missing:
        raise StudyError(f"{law_name(law)} lacks its constant '{missing[0]}'")
    return law(**_values(law, table))


def _values(law: type[Material], table: Mapping[str, Any]) -> dict[str, Any]:
    directions = law.directions if issubclass(law, Directed) else {}
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key == "prony":
            value = _prony(value)
        elif key in directions:
            value = _direction(value)
        elif key in ("moduli", "exponents"):
            value = _sequence(value, key)
        elif isinstance(value, (str, list, dict, bool)):
            raise StudyError(f"{law_name(law)}: {key} = {value} is not a number")
        values[key] = value
    return values


def _direction(value: Any) -> Any:
    if not isinstance(value, Mapping):
        return tuple(value) if isinstance(value, list) else value
    if set(value) != {"angle", "from", "towards"}:
        raise StudyError(
            "a direction by its angle needs angle, from and towards, as in "
            "{ angle = ..., from = [1, 0, 0], towards = [0, 1, 0] }"
        )
    return turned_direction(value["angle"], value["from"], value["towards"])


def _prony(value: Any) -> Prony | None:
    if value is None or isinstance(value, Prony):
        return value
    keys = ("relative_moduli", "times", "bulk_moduli")
    if not isinstance(value, Mapping) or not set(keys[:2]) <= set(value) <= set(keys):
        raise StudyError("a Prony series needs relative_moduli and times, and may have bulk_moduli; no other")
    return Prony(**{key: _sequence(values, key) for key, values in value.items()})


def _sequence(value: Any, key: str) -> tuple[Any, ...]:
    if not isinstance(value, (list, tuple)):
        raise StudyError(f"{key} = {value} must be a list, one entry for each term")
    return tuple(value)


def _user_material(table: dict[str, Any], folder: Path) -> UserMaterial:
    """Keys that are not the base's own are constants of the user's function."""
    function = table.pop("function", None)
    if isinstance(function, str):
        function = load_function(function, folder)
    if not callable(function):
        raise StudyError('user_material lacks its function, given as "file.py:name"')
    own = {key: table.pop(key) for key in ("density", "bulk", "prony") if key in table}
    if "prony" in own:
        own["prony"] = _prony(own["prony"])
    return UserMaterial(function=function, values=table, **own)
