"""Materials from a study file's section, by the law that it names.

    {"law": "neo_hookean", "young": 3.0e6, "poisson": 0.45, "density": 1080.0,
     "prony": {"relative_moduli": [0.6], "times": [2.0]}}

Values are SI numbers, or symbols of the study's parameters. The keys are the attributes of the law's class. A direction
is three numbers, or an angle that a parameter may turn: {"angle": ..., "from": [1, 0, 0], "towards": [0, 1, 0]}.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from functools import cache
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

from morph_dslam.errors import StudyError
from morph_dslam.mechanics import materials
from morph_dslam.mechanics.materials.anisotropic import Directed, turned_direction
from morph_dslam.mechanics.materials.base import Material, registered_laws
from morph_dslam.mechanics.materials.user import UserMaterial, load_function
from morph_dslam.mechanics.materials.viscoelastic import Prony


@cache
def _import_all() -> None:
    """Import every module beside this one, so that a new law is one new file."""
    for module in iter_modules(materials.__path__):
        import_module(f"{materials.__name__}.{module.name}")


def laws() -> dict[str, type[Material]]:
    """Every law by its name in a study file."""
    _import_all()
    return registered_laws()


def law_named(name: Any) -> type[Material]:
    """The law of this name in a study file; StudyError listing the known ones if there is none."""
    known = laws()
    if name not in known:
        raise StudyError(f"'{name}' is not a known material law; known are {', '.join(known)}")
    return known[name]


def constant_quantities(law: str) -> dict[str, str]:
    """What each constant of a law measures: "stress", "ratio" or "density", as in `units.FACTORS`.

    Directions and the series are left out; so are a user's own constants, which may be anything.
    """
    kind = law_named(law)
    skipped = {"prony", "function", "values", *getattr(kind, "directions", ())}
    names = [field.name for field in fields(kind) if field.name not in skipped]
    return dict.fromkeys(names, "stress") | {"density": "density"} | kind.quantities


def material_from_table(table: Mapping[str, Any], folder: Path = Path()) -> Material:
    """The material that a study's section describes.

    Raises StudyError for an unknown law or key, a missing constant, or a value of the wrong kind; `Material.check`
    finds constants that are unstable.

    Parameters
    ----------
    table : law and constants, see above.
    folder : where a user's "file.py:name" is sought.
    """
    table = dict(table)
    if "law" not in table:
        raise StudyError(f"the material names no law; set law to one of {', '.join(laws())}")
    law = law_named(table.pop("law"))
    if law is UserMaterial:
        return _user_material(table, folder)
    known = {field.name: field for field in fields(law)}
    unknown = [key for key in table if key not in known]
    if unknown:
        raise StudyError(f"{law.law} has no constant '{unknown[0]}'; it has {', '.join(known)}")
    missing = [name for name, f in known.items() if f.default is MISSING and name not in table]
    if missing:
        raise StudyError(f"{law.law} lacks its constant '{missing[0]}'")
    return law(**{key: _value(law, key, value, str(known[key].type)) for key, value in table.items()})


def _value(law: type[Material], key: str, value: Any, annotation: str) -> Any:
    if key == "prony":
        return _prony(value)
    if issubclass(law, Directed) and key in law.directions:
        return _direction(value)
    if annotation.startswith("tuple"):
        return _sequence(value, key)
    return _number(law, key, value)


def _number(law: type[Material], key: str, value: Any) -> Any:
    if isinstance(value, (str, list, tuple, dict, bool)):
        given = list(value) if isinstance(value, tuple) else value
        raise StudyError(f"{law.law}: {key} = {given} is not a number")
    return value


def _direction(value: Any) -> Any:
    if isinstance(value, str):
        raise StudyError(f"the direction {value} must be three numbers, or given by its angle")
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
    own = {key: _number(UserMaterial, key, table.pop(key)) for key in ("density", "bulk") if key in table}
    if "prony" in table:
        own["prony"] = _prony(table.pop("prony"))
    return UserMaterial(function=function, values=table, **own)
