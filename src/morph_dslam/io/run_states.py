"""The states that a run found, as its ``result.h5`` has them (docs/run-folder.md)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import ExportError, MorphError
from morph_dslam.model import ReducedModel, load_model
from morph_dslam.model.reduced_model import SAME_PLACE
from morph_dslam.model.unknown_loads import with_unknown_loads

if TYPE_CHECKING:
    from morph_dslam.model.discrepancy import Discrepancy

Array = NDArray[np.float64]
FORMAT, VERSION = "morph-dslam run", 1
#: Name of the file in a run folder.
RESULT = "result.h5"


@dataclass(frozen=True)
class RunStates:
    """The states of the frames that were tracked.

    Attributes
    ----------
    path : of the file.
    frames : (s,) numbers.
    times : (s,) seconds.
    parameters : (s, d), SI; the coefficients of unknown loads, if any, are the last ones.
    poses : camera_from_object (s, 4, 4).
    discrepancies : of each frame, None where there is none.
    """

    path: Path
    frames: NDArray[np.int64]
    times: Array
    parameters: Array
    poses: Array
    discrepancies: Sequence[Discrepancy | None]

    @property
    def has_discrepancy(self) -> bool:
        return any(one is not None for one in self.discrepancies)

    def has_loads(self, model: ReducedModel) -> bool:
        """Whether there are more parameters than the study of ``model`` names."""
        return self.parameters.shape[1] > len(model.parameters)

    def model_with_loads(self, model: ReducedModel) -> ReducedModel:
        """``model`` with the parameters of these states.

        Raises
        ------
        ExportError
            If the run is of a model with other parameters or another mesh.
        ModelFileError
            If the copy of the model in the run folder cannot be read.
        """
        copied = self.path.with_name("model.morph")
        is_same = not copied.is_file() or _are_alike(model, load_model(copied))
        if is_same and self.has_loads(model) and model.unknown_loads is not None:
            model = with_unknown_loads(model)
        if not is_same or self.has_loads(model) or self.parameters.shape[1] < len(model.parameters):
            raise ExportError(f"the run {self.path.parent} is of another model than '{model.name}': export {copied}")
        return model

    def take(self, frames: Sequence[int]) -> RunStates:
        """The states of some frames, by their numbers; ExportError if one was not tracked."""
        rows = {int(frame): row for row, frame in enumerate(self.frames)}
        if unknown := [frame for frame in frames if frame not in rows]:
            raise ExportError(f"{self.path} has no state of frame {unknown[0]}, which was not tracked: leave it out")
        chosen = np.array([rows[frame] for frame in frames], dtype=np.int64)
        return RunStates(
            self.path,
            self.frames[chosen],
            self.times[chosen],
            self.parameters[chosen],
            self.poses[chosen],
            [self.discrepancies[row] for row in chosen],
        )


def _are_alike(model: ReducedModel, other: ReducedModel) -> bool:
    """Whether parameters and meshes are the same, so that states of one are states of the other."""
    same = [p.name for p in model.parameters] == [p.name for p in other.parameters]
    same = same and model.nodes.shape == other.nodes.shape
    return same and np.abs(model.nodes - other.nodes).max() <= SAME_PLACE * np.abs(model.nodes).max()


@contextmanager
def opened_result(path: Path, error_class: type[MorphError]) -> Iterator[h5py.File]:
    """A run's ``result.h5``, to be read in the block.

    Parameters
    ----------
    path : of the file.
    error_class : what is raised if it is of another version, or damaged, which may show anywhere in the block.
    """
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT or int(file.attrs["version"]) != VERSION:  # type: ignore[arg-type]
                raise error_class(f"{path} is not a run of version {VERSION}: track again with this release")
            yield file
    except error_class:
        raise
    except Exception as error:
        # h5py raises half a dozen types on damaged files, RuntimeError and KeyError among them.
        raise error_class(
            f"{path} is no result of a run, or damaged or cut short: track again, or copy it again"
        ) from error


def load_run_states(path: Path) -> RunStates:
    """Read the states from a run's ``result.h5``.

    Raises
    ------
    ExportError
        If it is none, is damaged, or no frame was tracked.
    """
    if not path.is_file():
        raise ExportError(f"there is no {path}: give a run folder of `morph track -o`, or a table of states")
    states = _read(path)
    if not len(states.frames):
        raise ExportError(f"{path} has no state: the object was tracked in none of the frames")
    return states


def _read(path: Path) -> RunStates:
    from morph_dslam.model.discrepancy import load_discrepancies  # SciPy takes long to load

    with opened_result(path, ExportError) as file:
        status, parameters = np.asarray(file["status"]), np.asarray(file["parameters"]).astype(float)
        rows = np.flatnonzero((status == b"tracked") & np.isfinite(parameters).all(axis=1))
        found = load_discrepancies(file)
        return RunStates(
            path,
            np.asarray(file["frame"]).astype(np.int64)[rows],
            np.asarray(file["timestamp"]).astype(float)[rows],
            parameters[rows],
            np.asarray(file["camera_from_object"]).astype(float).reshape(-1, 4, 4)[rows],
            [found.get(int(row)) for row in rows],
        )
