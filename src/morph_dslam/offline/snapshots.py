"""Snapshots on disk: one file for each solved sample, named by what it depends on.

The name is a hash of the mechanical problem and the coordinates, so a build that was stopped goes on where
it was, and a changed study solves again only what the change touches.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.offline.gripped_sheet import EquilibriumState, GrippedSheet
from morph_dslam.offline.study import Study

Array = NDArray[np.float64]

FACES = ("top", "bottom")
#: Signs that the coordinates take when the sheet is mirrored in its own plane, and in the plane x = 0.
MIRROR_Z = np.array([-1.0, 1.0, -1.0, -1.0])
MIRROR_X = np.array([1.0, 1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Snapshot:
    """A solved sample on the output grid.

    Attributes
    ----------
    coordinates : (4,). motion : (6,) of the grips.
    displacement : (n, 3), m. stress : face -> (n, 3), Pa.
    displacement_sensitivity : (4, n, 3). stress_sensitivity : face -> (4, n, 3).
    """

    coordinates: Array
    motion: Array
    displacement: Array
    displacement_sensitivity: Array
    stress: dict[str, Array]
    stress_sensitivity: dict[str, Array]

    def mirrored(self) -> Snapshot:
        """The mirror image z -> -z: another state of the same sheet, with its faces swapped."""
        flip = MIRROR_Z
        z = np.array([1.0, 1.0, -1.0])
        swap = {"top": "bottom", "bottom": "top"}
        return Snapshot(
            self.coordinates * flip,
            self.motion * np.array([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0]),
            self.displacement * z,
            self.displacement_sensitivity * z * flip[:, None, None],
            {face: self.stress[swap[face]] for face in FACES},
            {face: self.stress_sensitivity[swap[face]] * flip[:, None, None] for face in FACES},
        )

    def reversed(self, columns: int) -> Snapshot:
        """The mirror image x -> -x: another state of the same sheet if its grips are at the same height.

        Parameters
        ----------
        columns : points along x of the output grid.
        """
        flip, x = MIRROR_X, np.array([-1.0, 1.0, 1.0])
        shear = np.array([1.0, 1.0, -1.0])

        def turned(fields: Array) -> Array:
            grid = fields.reshape(*fields.shape[:-2], -1, columns, 3)
            return grid[..., ::-1, :].reshape(fields.shape)

        left, right, twist, approach, turn_left, turn_right = self.motion
        return Snapshot(
            self.coordinates * flip,
            np.array([right, left, -twist, approach, -turn_right, -turn_left]),
            turned(self.displacement) * x,
            turned(self.displacement_sensitivity) * x * flip[:, None, None],
            {face: turned(self.stress[face]) * shear for face in FACES},
            {face: turned(self.stress_sensitivity[face]) * shear * flip[:, None, None] for face in FACES},
        )

    def images(self, study: Study) -> list[Snapshot]:
        """This state and its mirror images that are states of the same sheet."""
        result = [self, self.mirrored()]
        if study.grips.symmetric:
            columns = study.reduction.grid[0] + 1
            result += [snapshot.reversed(columns) for snapshot in result]
        return result


def output_points(study: Study) -> Array:
    """Grid points (n, 2) of the model's mesh, x fastest, metres."""
    nx, ny = study.reduction.grid
    x = np.linspace(-study.sheet.length / 2.0, study.sheet.length / 2.0, nx + 1)
    y = np.linspace(-study.sheet.width / 2.0, study.sheet.width / 2.0, ny + 1)
    return np.column_stack([np.tile(x, ny + 1), np.repeat(y, nx + 1)])


@cache
def _solver_fingerprint() -> str:
    """Hash of the code that solves, so that snapshots of another release are never mixed in."""
    modules = ("shell", "grips", "gripped_sheet", "snapshots")
    texts = [Path(__file__).with_name(f"{module}.py").read_bytes() for module in modules]
    return hashlib.sha256(b"".join(texts)).hexdigest()


def snapshot_key(study: Study, coordinates: Array) -> str:
    """Name of a sample: hash of the mechanical problem, the solver, the output grid and the coordinates."""
    problem = study.model_dump(include={"sheet", "material", "grips", "solver"})
    problem |= {"grid": study.reduction.grid, "code": _solver_fingerprint()}
    text = json.dumps(problem, sort_keys=True) + np.round(coordinates, 12).tobytes().hex()
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def take_snapshot(problem: GrippedSheet, study: Study, state: EquilibriumState) -> Snapshot:
    """Displacement, stress and their derivatives at a solved state, on the output grid."""
    points = output_points(study)
    dof_slopes, _ = problem.sensitivities(state)
    displacement, stress = problem.shell.sample(state.dofs, points)
    slopes = [problem.shell.sample(slope, points) for slope in dof_slopes]
    # The membrane part of the stress goes with thickness squared, the bending part with thickness.
    ratio = study.sheet.thickness / study.solve_thickness

    def scaled(faces: dict[str, Array]) -> dict[str, Array]:
        membrane, bending = (faces["top"] + faces["bottom"]) / 2.0, (faces["bottom"] - faces["top"]) / 2.0
        membrane, bending = membrane * ratio**2, bending * ratio
        return {"top": membrane - bending, "bottom": membrane + bending}

    stress_slopes = [scaled(slope[1]) for slope in slopes]
    return Snapshot(
        state.coordinates,
        state.motion,
        displacement,
        np.array([slope[0] for slope in slopes]),
        scaled(stress),
        {face: np.array([slope[face] for slope in stress_slopes]) for face in FACES},
    )


def save_snapshot(path: Path, state: EquilibriumState, snapshot: Snapshot) -> None:
    """Write a snapshot and the solver's state; the file appears only when it is complete."""
    partial = path.with_suffix(f".{os.getpid()}.partial")
    fields = {
        "displacement": snapshot.displacement,
        "displacement_sensitivity": snapshot.displacement_sensitivity,
        **{f"stress_{face}": snapshot.stress[face] for face in FACES},
        **{f"stress_sensitivity_{face}": snapshot.stress_sensitivity[face] for face in FACES},
    }
    arrays: dict[str, Any] = {name: values.astype(np.float32) for name, values in fields.items()}
    arrays |= {"coordinates": state.coordinates, "motion": state.motion, "dofs": state.dofs}
    with partial.open("wb") as file:
        np.savez(file, **arrays)
    os.replace(partial, path)


def load_snapshot(path: Path) -> Snapshot:
    """Read what `save_snapshot` wrote."""
    with np.load(path) as file:
        return Snapshot(
            file["coordinates"],
            file["motion"],
            file["displacement"].astype(float),
            file["displacement_sensitivity"].astype(float),
            {face: file[f"stress_{face}"].astype(float) for face in FACES},
            {face: file[f"stress_sensitivity_{face}"].astype(float) for face in FACES},
        )


def load_state(path: Path) -> EquilibriumState:
    """The solver's state of a snapshot, to start a neighbour from."""
    with np.load(path) as file:
        return EquilibriumState(file["coordinates"], file["motion"], file["dofs"])
