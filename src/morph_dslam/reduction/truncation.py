"""Which modes of a field a model keeps: the leading ones in the study's inner product, by component if asked.

Fields are given as coefficients of modes that are more than enough. In an inner product with Gram matrix
G = R'R of these modes, the singular value decomposition of R times the coefficients gives the best modes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.model import SeparatedField
from morph_dslam.model.functions import Functions
from morph_dslam.model.separated import ComponentModes
from morph_dslam.reduction.task import ReductionTask

Array = NDArray[np.float64]
#: Directions of so little of the largest norm are rounding.
RANK = 1e-13


@dataclass(frozen=True)
class Truncation:
    """Modes of a field, most important first.

    Attributes
    ----------
    modes : (m, n_points, n_components).
    components : (m,) the one that each moves; None if all.
    rotation : (m, k) from coefficients of the modes given to coefficients of these.
    singular_values : of the fields, decreasing, beyond those kept too.
    """

    modes: Array
    components: NDArray[np.int64] | None
    rotation: Array
    singular_values: Array

    def field(self, functions: Functions) -> SeparatedField:
        """The separated field with these modes."""
        if self.components is None:
            return SeparatedField(self.modes, functions)
        values = self.modes[np.arange(len(self.modes)), :, self.components]
        return SeparatedField.from_compact(ComponentModes(values, self.components, self.modes.shape[2]), functions)


def truncate(task: ReductionTask, name: str, modes: Array, coefficients: Array) -> Truncation:
    """The modes of a field that the study's tolerance asks for, and at most ``max_modes``.

    Parameters
    ----------
    modes : (k, n_points, n_components).
    coefficients : (k, n) of the fields.

    Raises
    ------
    StudyError
        If the energy is asked for and there are no equations of a solid.
    """
    options = task.options
    alone: list[int | None] = [None]
    if options.components == "separate":
        alone = list(range(modes.shape[2]))
    found, values, owners, rotations = [], [], [], []
    for component in alone:
        part = modes if component is None else _one_component(modes, component)
        lengths, vectors = np.linalg.eigh(_gram(task, name, part))
        kept = lengths > RANK * max(lengths.max(), np.finfo(float).tiny)
        root, vectors = np.sqrt(lengths[kept]), vectors[:, kept]
        left, singular, _ = np.linalg.svd((root[:, None] * vectors.T) @ coefficients, full_matrices=False)
        found.append(np.tensordot((left / root[:, None]).T @ vectors.T, part, axes=1))
        rotations.append(left.T @ (root[:, None] * vectors.T))
        values.append(singular)
        owners.append(np.full(len(singular), -1 if component is None else component))
    singular = np.concatenate(values)
    order = np.argsort(-singular, kind="stable")
    left_out = np.sqrt(np.cumsum(singular[order][::-1] ** 2))[::-1]
    count = max(1, int(np.sum(left_out > options.tolerance * left_out[0])))
    order_kept = order[: min(count, options.max_modes)]
    return Truncation(
        np.concatenate(found)[order_kept],
        None if options.components == "together" else np.concatenate(owners)[order_kept],
        np.concatenate(rotations)[order_kept],
        singular[order],
    )


def _one_component(modes: Array, component: int) -> Array:
    part = np.zeros_like(modes)
    part[..., component] = modes[..., component]
    return part


def _gram(task: ReductionTask, name: str, modes: Array) -> Array:
    """Inner products (k, k) of modes (k, n_points, n_components)."""
    if task.options.inner_product == "energy" and name == "displacement":
        return _energy_gram(task, modes)
    flat = (modes * np.sqrt(task.weights(modes.shape[1]))[:, None]).reshape(len(modes), -1)
    return flat @ flat.T


def _energy_gram(task: ReductionTask, modes: Array) -> Array:
    """Inner products by the stiffness of the undeformed body at the parameters' defaults, J."""
    problem = getattr(task.problem(), "problem", None) if task.problem else None
    if not isinstance(problem, SolidProblem):
        raise StudyError(
            'reduction.inner_product = "energy" needs the stiffness of a solid, which this study has not: use "mass"'
        )
    rest = problem.initial_state()
    space = problem.displacements
    dofs = np.zeros((len(modes), problem.n_dofs))
    nodal = np.moveaxis(modes, 2, 1).reshape(-1, modes.shape[1])
    dofs[:, : 3 * space.n_scalar] = (space.coefficients @ nodal.T).T.reshape(len(modes), -1)
    gram = problem.linearise(rest.dofs, rest.mu).apply(dofs) @ dofs.T
    return (gram + gram.T) / 2.0
