"""Whether stress and strain of another program are those of its displacement, in the order and the measure wanted.

Strains follow from displacement and cells. Cauchy stress of an isotropic solid has the principal axes of its
stretches, so that it commutes with F F^T; that of others need not, and is refused only where the same numbers commute
in another order or measure. (Forces of equilibrium at inner nodes tell less: stress averaged at nodes leaves a fifth of
them unbalanced, stress of a wrong order a quarter.)
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.model.cell_types import cell_type
from morph_dslam.studies.problem import ModelMesh

Array = NDArray[np.float64]
#: Where xx, xy, xz, yx, ..., zz stand among xx, yy, zz, yz, xz, xy.
_FULL = [0, 5, 4, 5, 1, 3, 4, 3, 2]
#: Where yz, xz and xy may stand among the shears; the first is the order wanted.
_ORDERS = tuple(permutations(range(3)))
_SHEARS = ("yz", "xz", "xy")
#: Which of these stands first, second and third in VTK's order.
_VTK = (2, 0, 1)
#: Another reading is what was meant if it leaves this part of what the reading as it is leaves.
BETTER = 0.4
#: Shears that are off by this share, and stresses that commute so badly, are looked at.
SHEAR_OFF, APART = 0.3, 0.03
#: Stress read in another way was meant only if it commutes so well: that of strong fibres commutes badly in all.
TOGETHER = 0.15
#: So many times too large or more are strains of another unit; coarse elements of mixed form differ by one at most.
STRAIN_OFF = 5.0
#: Shears that are a smaller share of the strain say nothing of their order.
LEAST_SHEAR = 0.05
#: Strains below this are rounding.
UNSTRAINED = 1e-6
#: Where cells are read on the way from their centres to their nodes.
INSIDE = 0.95
_TINY = np.finfo(float).tiny


def check_strain(mesh: ModelMesh, displacements: Sequence[Array], strains: Sequence[Array], where: str) -> None:
    """Compare strains with those of the displacement, at the nodes.

    Parameters
    ----------
    mesh : of a solid.
    displacements : (n, 3) of some states, m.
    strains : (n, 6) of the same states, components as in `Snapshot`.
    where : file and name of the strain, for messages.

    Raises
    ------
    StudyError
        If they clearly disagree, with the order or the factor of the shears if that is why.
    """
    given = np.concatenate(strains)
    stretch = _deformation_gradients(mesh, displacements)
    full = (np.swapaxes(stretch, -1, -2) @ stretch - np.eye(3)) / 2.0
    true = full[..., [0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]]
    if np.abs(true).max() < UNSTRAINED:
        return

    def off(values: Array, wanted: Array) -> float:
        return min(float(np.linalg.norm(values - each) / max(np.linalg.norm(each), _TINY)) for each in wanted)

    shears, true_shears = given[:, 3:], true[..., 3:]
    if np.linalg.norm(true_shears[0]) > LEAST_SHEAR * np.linalg.norm(true[0]):
        tried = {
            (order, factor): off(factor * shears[:, order], true_shears) for order in _ORDERS for factor in (1.0, 0.5)
        }
        as_it_is, (order, factor) = tried[_ORDERS[0], 1.0], min(tried, key=lambda reading: tried[reading])
        if as_it_is > SHEAR_OFF and tried[order, factor] < BETTER * as_it_is:
            raise StudyError(f"{where} does not fit the displacement, {_order_advice(order, factor)}")
    if (missed := off(given, true)) > STRAIN_OFF:
        raise StudyError(
            f"{where} is {missed:.2g} times off the strain of the displacement: check whether it is in percent, and "
            "whether points and displacements are both in external.length_unit"
        )


def check_stress(mesh: ModelMesh, displacements: Sequence[Array], stresses: Sequence[Array], where: str) -> None:
    """Compare principal axes of stress with those of the displacement's stretches, at the nodes.

    Parameters
    ----------
    mesh : of a solid.
    displacements : (n, 3) of some states, m.
    stresses : (n, 6) of the same states, components as in `Snapshot`.
    where : file and name of the stress, for messages.

    Raises
    ------
    StudyError
        If the axes agree clearly better where the stress is read in another order, or as the second
        Piola-Kirchhoff stress.
    """
    given = np.concatenate(stresses)
    stretch = _deformation_gradients(mesh, displacements)
    turned = np.swapaxes(stretch, -1, -2)
    left = stretch @ turned
    if np.abs(left - np.eye(3)).max() < UNSTRAINED:
        return

    def full(order: tuple[int, ...]) -> Array:
        return np.hstack([given[:, :3], given[:, 3:][:, order]])[:, _FULL].reshape(-1, 3, 3)

    def apart(stress: Array) -> float:
        return min(_commutator(*pair) for pair in zip(np.broadcast_to(stress, left.shape), left, strict=True))

    tried = {order: apart(full(order)) for order in _ORDERS}
    as_it_is, order = tried[_ORDERS[0]], min(tried, key=lambda reading: tried[reading])
    if as_it_is <= APART:
        return
    least = min(BETTER * as_it_is, TOGETHER)
    if tried[order] < least:
        raise StudyError(f"{where} does not fit the displacement of an isotropic solid, {_order_advice(order)}")
    if apart(stretch @ full(_ORDERS[0]) @ turned) < least:
        raise StudyError(
            f"{where} does not fit the displacement as Cauchy stress, but as the second Piola-Kirchhoff stress S: "
            "write the Cauchy stress F S F^T / det F"
        )


def _order_advice(order: tuple[int, ...], factor: float = 1.0) -> str:
    """How shears must be read and written."""
    in_file = ", ".join(_SHEARS[order.index(slot)] for slot in _VTK)
    readings = [f"with shears in the order {in_file}"] if order != _ORDERS[0] else []
    readings += ["with engineering shears halved"] if factor != 1.0 else []
    return f"but {' and '.join(readings)} it does: write tensor components xx, yy, zz, xy, yz, xz"


def _deformation_gradients(mesh: ModelMesh, displacements: Sequence[Array]) -> Array:
    """F (2, s n, 3, 3) at the n nodes of s states: averaged over cells, of their values there, and of their means.

    Cells are read a little inside of their nodes, where none of those of crack tips is singular.
    """
    states = np.stack(displacements)
    sums, counts = np.zeros((2, *states.shape, 3)), np.zeros(len(mesh.nodes))
    for name, cells in mesh.cells.items():
        points = cell_type(name).nodes
        gradients = cell_type(name).shape_gradients(INSIDE * points + (1.0 - INSIDE) * points.mean(axis=0))
        jacobians = np.einsum("mka,pkb->mpab", mesh.nodes[cells], gradients)
        to_physical = np.einsum("pkb,mpbc->mpkc", gradients, np.linalg.inv(jacobians))
        np.add.at(counts, cells, 1.0)
        for state, total, means in zip(states, *sums, strict=True):
            values = np.eye(3) + np.einsum("mka,mpkc->mpac", state[cells], to_physical)
            np.add.at(total, cells, values)
            np.add.at(means, cells, values.mean(axis=1, keepdims=True))
    return np.reshape(sums / counts[:, None, None], (2, -1, 3, 3))


def _commutator(stress: Array, stretch: Array) -> float:
    """Norm of A B - B A over those of the deviators of A and B (n, 3, 3)."""
    a, b = (each - np.trace(each, axis1=1, axis2=2)[:, None, None] * np.eye(3) / 3.0 for each in (stress, stretch))
    sizes = np.linalg.norm(a, axis=(1, 2)) * np.linalg.norm(b, axis=(1, 2))
    return float(np.linalg.norm(a @ b - b @ a) / max(np.linalg.norm(sizes), _TINY))
