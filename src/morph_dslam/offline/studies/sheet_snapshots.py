"""Snapshots of the gripped sheet: fields on the output grid, and their mirror images.

A sheet does not know its two sides apart, so the mirror image of a solution is a solution; if its grips are
at the same height, it does not know left from right either, and if that is half its width, nor top from
bottom.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.offline.mechanics.gripped_sheet import EquilibriumState, GrippedSheet
from morph_dslam.offline.problem import Snapshot

Array = NDArray[np.float64]

FACES = ("top", "bottom")
#: Signs that the coordinates take when the sheet is mirrored in its own plane, in x = 0 and in y = 0.
MIRROR_Z = np.array([-1.0, 1.0, -1.0, 1.0])
MIRROR_X = np.array([1.0, 1.0, -1.0, -1.0])
MIRROR_Y = np.array([1.0, 1.0, 1.0, -1.0])


def output_points(length: float, width: float, grid: tuple[int, int]) -> Array:
    """Points (n, 2) of a grid of cells over the sheet, x fastest, metres."""
    nx, ny = grid
    x = np.linspace(-length / 2.0, length / 2.0, nx + 1)
    y = np.linspace(-width / 2.0, width / 2.0, ny + 1)
    return np.column_stack([np.tile(x, ny + 1), np.repeat(y, nx + 1)])


def take_snapshot(
    problem: GrippedSheet, state: EquilibriumState, points: Array, thickness_ratio: float
) -> Snapshot:
    """Displacement, stress and their derivatives at a solved state.

    Parameters
    ----------
    points : (n, 2) material points. thickness_ratio : the sheet's thickness over that of ``problem``.
    """
    dof_slopes, _ = problem.sensitivities(state)
    fields = _fields(problem, state.dofs, points, thickness_ratio)
    slopes = [_fields(problem, slope, points, thickness_ratio) for slope in dof_slopes]
    return Snapshot(
        state.coordinates,
        fields,
        {name: np.array([slope[name] for slope in slopes]) for name in fields},
        {"motion": state.motion},
    )


def _fields(problem: GrippedSheet, dofs: Array, points: Array, ratio: float) -> dict[str, Array]:
    displacement, stress = problem.shell.sample(dofs, points)
    # The membrane part of the stress goes with thickness squared, the bending part with thickness.
    membrane = ratio**2 * (stress["top"] + stress["bottom"]) / 2.0
    bending = ratio * (stress["bottom"] - stress["top"]) / 2.0
    return {
        "displacement": displacement,
        "stress_top": membrane - bending,
        "stress_bottom": membrane + bending,
    }


def mirrored(snapshot: Snapshot) -> Snapshot:
    """The mirror image z -> -z: another state of the same sheet, with its faces swapped."""
    flip, z = MIRROR_Z[:, None, None], np.array([1.0, 1.0, -1.0])

    def image(fields: dict[str, Array], sign: Array | float) -> dict[str, Array]:
        return {
            "displacement": fields["displacement"] * z * sign,
            "stress_top": fields["stress_bottom"] * sign,
            "stress_bottom": fields["stress_top"] * sign,
        }

    return Snapshot(
        snapshot.coordinates * MIRROR_Z,
        image(snapshot.fields, 1.0),
        image(snapshot.sensitivities, flip),
        {"motion": snapshot.outputs["motion"] * np.array([-1.0, -1.0, -1.0, 1.0, 1.0])},
    )


def reversed_ends(snapshot: Snapshot, columns: int) -> Snapshot:
    """The mirror image x -> -x: another state of the same sheet if its grips are at the same height.

    Parameters
    ----------
    columns : points along x of the output grid.
    """
    flip, x, shear = MIRROR_X[:, None, None], np.array([-1.0, 1.0, 1.0]), np.array([1.0, 1.0, -1.0])

    def turned(field: Array) -> Array:
        grid = field.reshape(*field.shape[:-2], -1, columns, 3)
        return grid[..., ::-1, :].reshape(field.shape)

    def image(fields: dict[str, Array], sign: Array | float) -> dict[str, Array]:
        return {
            name: turned(field) * (x if name == "displacement" else shear) * sign
            for name, field in fields.items()
        }

    left, right, twist, approach, turn = snapshot.outputs["motion"]
    return Snapshot(
        snapshot.coordinates * MIRROR_X,
        image(snapshot.fields, 1.0),
        image(snapshot.sensitivities, flip),
        {"motion": np.array([right, left, -twist, approach, -turn])},
    )


def upside_down(snapshot: Snapshot, columns: int) -> Snapshot:
    """The mirror image y -> -y: another state of the same sheet if its grips are at the middle of its edges.

    Parameters
    ----------
    columns : points along x of the output grid.
    """
    flip, y, shear = MIRROR_Y[:, None, None], np.array([1.0, -1.0, 1.0]), np.array([1.0, 1.0, -1.0])

    def turned(field: Array) -> Array:
        grid = field.reshape(*field.shape[:-2], -1, columns, 3)
        return grid[..., ::-1, :, :].reshape(field.shape)

    def image(fields: dict[str, Array], sign: Array | float) -> dict[str, Array]:
        return {
            name: turned(field) * (y if name == "displacement" else shear) * sign
            for name, field in fields.items()
        }

    return Snapshot(
        snapshot.coordinates * MIRROR_Y,
        image(snapshot.fields, 1.0),
        image(snapshot.sensitivities, flip),
        {"motion": snapshot.outputs["motion"] * np.array([1.0, 1.0, -1.0, 1.0, -1.0])},
    )
