"""`morph export`: choose the states, write them in one format."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import ExportError
from morph_dslam.export.gltf import write_glb
from morph_dslam.export.paraview import write_vtu_series, write_xdmf_series
from morph_dslam.export.states import fixed_values, grid, read_path, tour, write_table
from morph_dslam.model import ReducedModel, load_model

FORMATS = ("xdmf", "vtu", "gltf")


@dataclass(frozen=True)
class StateChoice:
    """What the command line says about the states, in the parameters' units.

    Attributes
    ----------
    vary : texts "name=from:to:count"; several make a grid.
    path : CSV table with a state in each row, instead.
    at : texts "name=value" for parameters that are not varied.
    """

    vary: Sequence[str] = ()
    path: Path | None = None
    at: Sequence[str] = ()

    def states(self, model: ReducedModel) -> NDArray[np.float64]:
        """The states (s, d), SI; with neither ranges nor a path, a tour of all parameters.

        Raises
        ------
        ExportError
            If the choices contradict each other, or do not fit the model.
        """
        twice = {text.partition("=")[0] for text in self.vary} & {text.partition("=")[0] for text in self.at}
        if twice:
            raise ExportError(f"'{min(twice)}' is both varied and fixed: leave out its --vary or its --at")
        if self.path is not None and self.vary:
            raise ExportError("--path and --vary both choose the states: give one of them")
        base = fixed_values(model, self.at)
        if self.path is not None:
            return read_path(model, self.path, base)
        return grid(model, self.vary, base) if self.vary else tour(model, base)


def export(model_path: Path, folder: Path, file_format: str, choice: StateChoice) -> Path:
    """Write a model's states into ``folder``; returns the file to open.

    Parameters
    ----------
    file_format : one of `FORMATS`.

    Raises
    ------
    ModelFileError
        If the model cannot be read.
    ExportError
        If the states are not in the model's box, or the folder cannot be written.
    """
    model = load_model(model_path)
    states = choice.states(model)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if file_format == "gltf":
            target = folder / f"{model_path.stem}.glb"
            write_glb(target, model, states)
            write_table(folder / "states.csv", model, states, [{"frame": i} for i in range(len(states))])
            return target
        write = write_xdmf_series if file_format == "xdmf" else write_vtu_series
        return write(folder, model_path.stem, model, states)
    except OSError as error:
        raise ExportError(f"cannot write to {folder}: {error.strerror or error}") from error
