"""The [materials.NAME] sections of a solid's study: a law, its constants with units, and where it is.

A constant is a number with its unit or a linear expression of parameters; ratios are plain numbers. The keys
are those of the law's class (`morph_dslam.mechanics.materials`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import ConfigDict, ValidationInfo, model_validator

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.materials.base import Material
from morph_dslam.mechanics.materials.library import constant_quantities, material_from_table
from morph_dslam.studies.sections import Section, SetName
from morph_dslam.studies.solid_sections import Reader

_SERIES = {"relative_moduli": "ratio", "bulk_moduli": "ratio", "times": "time"}


class MaterialSection(Section):
    """A material.

    ``law`` names its energy, "neo_hookean" say; ``on`` is the cell set made of it ("all" if absent). The
    other keys are the law's constants, ``density``, and directions such as ``fibre``. A direction is three
    numbers, or ``{ angle = "30 deg", from = [1, 0, 0], towards = [0, 1, 0] }``; its angle may be a parameter.
    ``prony`` makes the law viscoelastic: ``{ relative_moduli = [0.6], times = ["2 s"] }``. ``function`` is
    that of a user's own law, "file.py:name", the file being relative to the study.
    """

    model_config = ConfigDict(extra="allow", frozen=True)
    law: str
    on: SetName = "all"

    @model_validator(mode="before")
    @classmethod
    def _resolve(cls, content: Any, info: ValidationInfo) -> Any:
        if isinstance(content, dict) and isinstance(content.get("function"), str):
            folder = Path((info.context or {}).get("folder", "."))
            return content | {"function": str(folder / content["function"])}
        return content

    @property
    def constants(self) -> dict[str, Any]:
        """Everything but the law and the place, as written."""
        return dict(self.model_extra or {})

    @property
    def file(self) -> Path | None:
        """The file of a user's own law; None for others."""
        function = self.constants.get("function")
        return Path(function.rpartition(":")[0]) if isinstance(function, str) else None

    @property
    def source(self) -> str:
        """Text of the file of a user's own law; empty for others."""
        path = self.file
        return path.read_text(encoding="utf-8") if path is not None and path.is_file() else ""

    def make(self, read: Reader) -> Material:
        """The material, its constants read as numbers or expressions."""
        quantities: dict[str, str] = {**constant_quantities(self.law), **_SERIES}
        table = {name: _read(name, value, read, quantities) for name, value in self.constants.items()}
        return material_from_table({"law": self.law, **table})


def _read(name: str, value: Any, read: Reader, quantities: dict[str, str]) -> Any:
    """A constant, a list of them, or a table of named ones; a direction's numbers are left as they are."""
    if name == "function" or (name not in quantities and isinstance(value, list)):
        return value
    if isinstance(value, dict):
        if "angle" in value:
            return value | {"angle": read(value["angle"], "angle")}
        return {key: _read(key, entry, read, quantities) for key, entry in value.items()}
    try:
        if isinstance(value, (list, tuple)):
            return tuple(read(entry, quantities.get(name)) for entry in value)
        return read(value, quantities.get(name))
    except StudyError as error:
        raise StudyError(f"{name}: {error}") from error
