"""A law that the user writes as one Python function."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import field
from pathlib import Path
from typing import Any

import ngsolve as ngs
import numpy as np

from morph_dslam.errors import MorphError, StudyError
from morph_dslam.mechanics.materials.base import Constant, evaluate, register_law
from morph_dslam.mechanics.materials.isotropic import Rubber


@register_law("user_material")
class UserMaterial(Rubber):
    """A law that the user writes as one Python function.

    Energy  W = function(F, **constants) + kappa/2 (J - 1)^2

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
