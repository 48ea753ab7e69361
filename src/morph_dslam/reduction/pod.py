"""Which modes of a field a model keeps: the leading ones in the study's inner product, by component if asked.

Fields are given as coefficients of modes that are more than enough. In an inner product with Gram matrix
G = R'R of these modes, the singular value decomposition of R times the coefficients gives the best modes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import scipy.linalg
import scipy.sparse
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.errors import StudyError
from morph_dslam.mechanics.solid import SolidProblem
from morph_dslam.model import ReducedModel, SeparatedField
from morph_dslam.model.basis_functions import chebyshev_basis
from morph_dslam.model.functions import Functions, ParameterFunctions
from morph_dslam.model.separated import ComponentModes
from morph_dslam.reduction.grid_functions import EvenGrid, functions_on_grid
from morph_dslam.reduction.regression import fit_functions
from morph_dslam.reduction.separation import expansion_train
from morph_dslam.reduction.task import FieldRows, ReductionTask, field_names, model_of, parameter_bases
from morph_dslam.studies.problem import Snapshot

Array = NDArray[np.float64]

#: Directions of so little of the largest norm are rounding.
RANK = 1e-13


@dataclass(frozen=True)
class KeptModes:
    """Modes of a field, most important first.

    Attributes
    ----------
    modes : (m, n_points, n_components). components : (m,) the one that each moves; None if all.
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


def keep_modes(task: ReductionTask, name: str, modes: Array, coefficients: Array) -> KeptModes:
    """The modes of a field that the study's tolerance asks for, and at most ``max_modes``.

    Parameters
    ----------
    modes : (k, n_points, n_components). coefficients : (k, n) of the fields.

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
    return KeptModes(
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
    n_points = modes.shape[1]
    weights = task.mesh.weights if n_points == len(task.mesh.weights) else np.ones(n_points)
    flat = (modes * np.sqrt(weights)[:, None]).reshape(len(modes), -1)
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


# Proper orthogonal decomposition of snapshots, in any inner product and for more data than memory holds.


#: Weights (n,) of the unknowns (a lumped mass matrix), or a sparse symmetric positive definite matrix (n, n).
InnerProduct = Array | scipy.sparse.sparray | scipy.sparse.spmatrix

#: Bytes that a decomposition may take before it is done in blocks.
DEFAULT_MEMORY = 4e9

#: Arrays of the snapshots' size, in double precision, that a decomposition at once needs.
COPIES = 3

#: Part of the tolerance that truncation before the last decomposition may use.
BLOCK_SHARE = 0.1


@dataclass(frozen=True)
class Pod:
    """A basis of snapshots, orthonormal in an inner product.

    Attributes
    ----------
    modes : (n_modes, n). singular_values : decreasing; all that are known.
    weights : the inner product.
    error_bound : of the root of the relative energy left out by truncation in blocks, beside that of the
        singular values left out; 0 for a decomposition at once.
    """

    modes: Array
    singular_values: Array
    weights: InnerProduct
    error_bound: float = 0.0

    def project(self, fields: Array) -> Array:
        """Coefficients (..., n_modes) of fields (..., n)."""
        return weighted(fields, self.weights) @ self.modes.T


def weighted(fields: Array, inner_product: InnerProduct) -> Array:
    """Fields (..., n) times the weights or the matrix of an inner product."""
    if isinstance(inner_product, np.ndarray):
        return fields * inner_product
    matrix: Any = inner_product
    return np.asarray(fields @ matrix)


class Rows(Protocol):
    """Snapshots (n_snapshots, n) that are gathered when sliced: an array, or one that is on disk."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    def __getitem__(self, rows: slice, /) -> NDArray[Any]: ...


def compute_pod(
    snapshots: Rows, weights: InnerProduct, tolerance: float, max_modes: int, memory: float = DEFAULT_MEMORY
) -> Pod:
    """Leading modes of ``snapshots`` (n_snapshots, n).

    Parameters
    ----------
    weights : (n,) quadrature weights (the mass matrix, lumped), or a sparse symmetric positive definite
        matrix (n, n), a stiffness at rest for instance, in whose norm errors then count.
    tolerance : modes are kept until the root of the relative energy left out is below it.
    max_modes : at most this many.
    memory : bytes; if more were needed, blocks of snapshots are decomposed one after the other
        (`hierarchical_pod`). Snapshots may then be of single precision, or on disk (`numpy.memmap`).

    Raises
    ------
    ValueError
        If the matrix is not positive definite.
    """
    count, n = snapshots.shape
    if COPIES * 8 * count * n <= memory:
        found = _decompose(np.asarray(snapshots[:], dtype=np.float64), weights)
        kept = min(_rank(found.values, tolerance**2 * float(np.sum(found.values**2))), max_modes)
        return Pod(found.modes(kept), found.values, weights)
    # Two blocks and what is kept of others must fit.
    size = max(1, int(memory / (4 * COPIES * 8 * n)))
    blocks = (snapshots[start : start + size] for start in range(0, count, size))
    return hierarchical_pod(blocks, -(-count // size), weights, tolerance, max_modes)


def hierarchical_pod(
    blocks: Iterable[Array], n_blocks: int, weights: InnerProduct, tolerance: float, max_modes: int
) -> Pod:
    """Leading modes of snapshots that come in blocks (n_i, n), of which few are in memory at a time.

    Each block is replaced by its modes times their singular values, and pairs of equally many blocks are
    merged and truncated again. The squares of what all truncations leave out add up to a bound of the error
    (Himpel, Leibner, Rave, "Hierarchical approximate proper orthogonal decomposition", SIAM J. Sci. Comput.
    40, 2018, theorem 3.3); the last decomposition keeps so many modes that the sum stays below the tolerance.

    Parameters
    ----------
    n_blocks : how many come, from which follows what each truncation may leave out.
    weights, tolerance, max_modes : as of `compute_pod`.
    """
    levels = int(np.ceil(np.log2(max(n_blocks, 2)))) + 1
    share = (BLOCK_SHARE * tolerance) ** 2 / levels
    merged = _Merged(weights, share)
    for block in blocks:
        merged.add(np.asarray(block, dtype=np.float64))
    rows, energy, lost = merged.rest()
    found = _decompose(rows, weights)
    kept = min(_rank(found.values, tolerance**2 * energy - lost), max_modes)
    bound = float(np.sqrt(lost / energy)) if energy else 0.0
    return Pod(found.modes(kept), found.values, weights, bound)


class _Merged:
    """Blocks merged in pairs of one size, as in a binary counter, so that few are held at a time."""

    def __init__(self, weights: InnerProduct, share: float) -> None:
        self._weights, self._share = weights, share
        # Level, modes times singular values, energy of the snapshots that they stand for.
        self._held: list[tuple[int, Array, float]] = []
        self._lost = 0.0

    def add(self, block: Array) -> None:
        energy = float(np.sum(block * weighted(block, self._weights)))
        self._held.append((0, self._truncated(block, energy), energy))
        while len(self._held) > 1 and self._held[-1][0] == self._held[-2][0]:
            (level, second, more), (_, first, energy) = self._held.pop(), self._held.pop()
            both = np.vstack([first, second])
            del first, second
            self._held.append((level + 1, self._truncated(both, energy + more), energy + more))

    def _truncated(self, rows: Array, energy: float) -> Array:
        found = _decompose(rows, self._weights)
        kept = _rank(found.values, self._share * energy)
        self._lost += float(np.sum(found.values[kept:] ** 2))
        return found.values[:kept, None] * found.modes(kept)

    def rest(self) -> tuple[Array, float, float]:
        """Rows left, energy of all snapshots, and the part of it that truncation has left out."""
        return (np.vstack([rows for _, rows, _ in self._held]), sum(energy for *_, energy in self._held), self._lost)


def _rank(values: Array, allowed: float) -> int:
    """How many singular values to keep for the squares of the others to add up to at most ``allowed``."""
    left_out = np.append(np.cumsum(values[::-1] ** 2)[::-1][1:], 0.0)
    return int(np.argmax(left_out <= max(allowed, 0.0))) + 1


@dataclass(frozen=True)
class _Decomposition:
    """Singular values (k,) of snapshots, and modes as ``combinations`` (k, k) of ``basis`` (k, n)."""

    values: Array
    combinations: Array
    basis: Array

    def modes(self, count: int) -> Array:
        """The first modes (count, n), orthonormal in the inner product."""
        return self.combinations[:count] @ self.basis


def _decompose(snapshots: Array, weights: InnerProduct) -> _Decomposition:
    """The singular value decomposition of snapshots (s, n) in an inner product.

    A QR factorisation in place comes first, so that little more memory is needed than the snapshots take. In
    the inner product of a matrix K, snapshots are R'Q' with Q'Q = 1, and with Q'KQ = CC' the modes follow
    from the singular value decomposition of R'C: nothing is squared but the condition of K.
    """
    lumped = isinstance(weights, np.ndarray)
    root = np.sqrt(weights) if lumped else np.ones(1)
    factors: Any = scipy.linalg.qr((snapshots * root).T, mode="economic", overwrite_a=True)
    basis, triangle = factors[0].T, factors[1].T
    if lumped:
        _, values, right = np.linalg.svd(triangle, full_matrices=False)
        basis /= root
        return _Decomposition(values, right, basis)
    try:
        factor = np.linalg.cholesky(weighted(basis, weights) @ basis.T)
    except np.linalg.LinAlgError as error:
        raise ValueError("the matrix of the inner product is not positive definite") from error
    _, values, right = np.linalg.svd(triangle @ factor, full_matrices=False)
    return _Decomposition(values, scipy.linalg.solve_triangular(factor, right.T, lower=True, trans=1).T, basis)


# The method "pod": modes of the snapshots, functions of the parameters through their coefficients.
# Snapshots on a full, evenly spaced grid (of one parameter, a line) are interpolated by splines, so that all
# that is left of the error is what the modes leave out. Scattered ones are fitted by polynomials of the total
# degree that predicts left-out samples best, with sensitivities where they are known.


#: Bases that interpolate on a grid, and error of a separated form there as a part of the tolerance.
GRID_BASES, SHARE = ("cubic_spline", "hat"), 0.2

#: Modes that those kept are chosen from: to this part of the tolerance, and so many times ``max_modes``.
FINER, MORE_MODES = 0.1, 3


def reduce_by_pod(task: ReductionTask) -> ReducedModel:
    """A reduced model of every field that the snapshots hold.

    Snapshots of one group (mirror images) are left out together in cross-validation.

    Raises
    ------
    StudyError
        If the basis or the format that the study asks for does not suit its samples.
    """
    snapshots = [snapshot for group in task.groups for snapshot in group]
    samples = np.array([snapshot.coordinates for snapshot in snapshots])
    grid = EvenGrid.of(samples, task.box)
    _check_choices(task, grid)
    use_grid = grid is not None and task.options.basis in (None, *GRID_BASES) and task.options.format != "polynomial"
    fields, summaries = {}, {}
    for name in tqdm(field_names(snapshots), desc="modes and functions", unit="field"):
        rows = FieldRows(snapshots, name)
        pod = _field_pod(task, rows)
        # One snapshot at a time: all of them together may not fit in memory.
        coefficients = np.array([pod.project(rows[i : i + 1])[0] for i in range(len(snapshots))])
        kept = keep_modes(task, name, pod.modes.reshape(-1, *rows.field_shape), coefficients.T)
        coefficients = coefficients @ kept.rotation.T
        if use_grid:
            assert grid is not None
            functions, summary = _interpolated(task, grid, coefficients)
        else:
            functions, summary = _fitted(task, samples, coefficients, _slopes(snapshots, name, pod, kept))
        fields[name] = kept.field(functions)
        summaries[name] = summary | {"modes": len(kept.modes), "singular_values": kept.singular_values[:60].tolist()}
    return model_of(task, fields, {"method": "pod", **summaries["displacement"]})


def _check_choices(task: ReductionTask, grid: EvenGrid | None) -> None:
    options = task.options
    if options.basis not in (None, "chebyshev", *GRID_BASES):
        raise StudyError(
            f'reduction.method = "pod" has no functions "{options.basis}": use "chebyshev", on even samples '
            'and grids "cubic_spline" or "hat", or method = "sparse_pgd", which has all of them'
        )
    if options.basis in GRID_BASES and grid is None:
        raise StudyError(
            f'reduction.basis = "{options.basis}" interpolates on even samples, at least 4 along each '
            'parameter and all of them solved: use sampling.scheme = "even" (one parameter) or "grid", '
            'or basis = "chebyshev"'
        )
    if (grid is None or options.basis == "chebyshev") and options.format in ("tucker", "cp"):
        raise StudyError(
            f'reduction.format = "{options.format}" of method "pod" needs samples on a grid and splines: '
            'use "polynomial" or "tensor_train", or sampling.scheme = "grid"'
        )


def _field_pod(task: ReductionTask, rows: FieldRows) -> Pod:
    """More modes of a field in all snapshots than are kept; points count by the nodes' weights."""
    n_points, n_components = rows.field_shape
    at_nodes = n_points == len(task.mesh.weights)
    weights = np.repeat(task.mesh.weights if at_nodes else np.ones(n_points), n_components)
    options = task.options
    most = MORE_MODES * options.max_modes
    return compute_pod(rows, weights, FINER * options.tolerance, most, 1e9 * options.memory_gb)


def _slopes(snapshots: list[Snapshot], name: str, pod: Pod, kept: KeptModes) -> Array | None:
    """Derivatives (n_snapshots, d, n_modes) of a field's coefficients; None where they are unknown."""
    if name not in snapshots[0].sensitivities:
        return None
    # One snapshot at a time: the slopes of all of them together would be the largest array of a build.
    slopes = [
        pod.project(values.reshape(len(values), -1).astype(np.float64)) @ kept.rotation.T
        for values in (snapshot.sensitivities[name] for snapshot in snapshots)
    ]
    return np.array(slopes)


def _interpolated(task: ReductionTask, grid: EvenGrid, coefficients: Array) -> tuple[Functions, dict[str, Any]]:
    """Splines through coefficients (n_snapshots, n_modes) on a grid."""
    options = task.options
    basis = options.basis or "cubic_spline"
    form = options.format or ("tucker" if len(task.parameters) > 1 else "tensor_train")
    bases = parameter_bases(basis, task.parameters, grid.counts)
    functions = functions_on_grid(grid.tensor(coefficients), bases, form, SHARE * options.tolerance)
    return functions, {"format": form, "basis": basis, "grid": list(grid.counts)}


def _fitted(
    task: ReductionTask, samples: Array, coefficients: Array, slopes: Array | None
) -> tuple[Functions, dict[str, Any]]:
    """Polynomials fitted to the coefficients (n_snapshots, n_modes) of a field at scattered samples."""
    options, box = task.options, task.box
    folds = np.concatenate([np.full(len(group), index) for index, group in enumerate(task.groups)])
    functions, errors = fit_functions(
        samples, coefficients, slopes, box[:, 0], box[:, 1], options.max_degree, folds, raise_single=True
    )
    summary = {
        "format": options.format or "polynomial",
        "basis": "chebyshev",
        "degree": int(functions.multi_indices.sum(axis=1).max()),
        "degrees": functions.multi_indices.max(axis=0).tolist(),
        "terms": len(functions.multi_indices),
        "cross_validation": {str(degree): error for degree, error in errors.items()},
    }
    if options.format == "tensor_train":
        return _train(functions, SHARE * options.tolerance), summary
    return functions, summary


def _train(functions: ParameterFunctions, tolerance: float) -> Functions:
    """The same polynomials as a tensor train."""
    degrees = functions.multi_indices.max(axis=0)
    bases = tuple(
        chebyshev_basis(lower, upper, int(degree))
        for lower, upper, degree in zip(functions.lower, functions.upper, degrees, strict=True)
    )
    return expansion_train(functions.multi_indices, functions.coefficients, bases, tolerance)
