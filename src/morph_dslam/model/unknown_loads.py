"""Unknown loads of a model: tractions on a surface that act beside the study's loads, with what they cause.

A load is a combination of m tractions, whose coefficients q are unknown. Displacement, stress, strain and reactions
change linearly with q about the parametric state; how they do is a field of the parameters. The displacement changes to
second order along the few softest combinations: a slender body turns long before it strains, and a turn that is linear
would make it longer. The elastic energy of the loads is q' C(mu) q / 2 with the compliance C, and tells what loads are
likely: exp(-energy / work scale).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np
from numba import njit
from numpy.typing import NDArray

from morph_dslam.errors import ModelFileError
from morph_dslam.model.functions import Functions, ParameterFunctions
from morph_dslam.model.parameters import Parameter
from morph_dslam.model.separated import SeparatedField

if TYPE_CHECKING:
    from morph_dslam.model.reduced_model import ReducedModel

Array = NDArray[np.float64]
#: Name of the field that holds the root of the compliance.
ROOT = "compliance_root"
#: Under this name reactions have what unknown loads amount to.
LOADS = "unknown loads"
#: A load's compliance is at least this share of the mean of all.
LEAST_COMPLIANCE = 1e-9
#: A support whose nodes move by a smaller share of the largest displacement stands still.
STILL = 1e-6
#: The search for coefficients ends at so many standard deviations.
SPAN = 10.0


def packed_root(compliance: Array) -> Array:
    """The symmetric root of a compliance (m, m) as its upper triangle (m (m + 1) / 2,)."""
    values, vectors = np.linalg.eigh(compliance)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return root[np.triu_indices(len(root))]


@dataclass(frozen=True)
class SecondOrder:
    """What the softest combinations of loads do to second order.

    Attributes
    ----------
    soft : (s, m) to their coefficients z from those of all loads.
    displacement : 3 s (s + 1) / 2 components: what z_a z_b adds to the displacement for each pair a <= b, metres, row
        by row, pairs running slowest.
    """

    soft: Array
    displacement: SeparatedField

    @property
    def n_pairs(self) -> int:
        """Number of pairs s (s + 1) / 2."""
        return len(self.soft) * (len(self.soft) + 1) // 2


@dataclass(frozen=True)
class UnknownLoads:
    """The tractions, and what a unit of each does.

    Attributes
    ----------
    surface : name of the surface that they act on; empty for all of a shell.
    inward : whether they are pressures, whose coefficients are not negative.
    nodes : (k,) that have a traction.
    tractions : (k, 3, m), N per undeformed square metre and unit of each coefficient, object frame.
    resultants : (m, 6) force, N, and moment about the origin, N m, of a unit of each, on the undeformed surface.
    responses : by the name of a model's field, c m components: each of the field's c for each load, loads
        running slowest; and the `ROOT` of the compliance, J, as its upper triangle.
    second_order : of the displacement; None where it was not found, as with contact.
    """

    surface: str
    inward: bool
    nodes: NDArray[np.int64]
    tractions: Array
    resultants: Array
    responses: dict[str, SeparatedField]
    second_order: SecondOrder | None = None

    @property
    def count(self) -> int:
        """Number of tractions m."""
        return self.tractions.shape[2]

    def compliance(self, mu: Array) -> Array:
        """The compliance (m, m), J, at parameters (d,): twice the elastic energy of unit loads; positive definite."""
        rows, columns = np.triu_indices(self.count)
        root = np.empty((self.count, self.count))
        root[rows, columns] = root[columns, rows] = self.responses[ROOT].value(mu).ravel()
        whole = root @ root
        # Between the states that it is known in, polynomials may take a load's compliance to zero.
        return whole + LEAST_COMPLIANCE * np.trace(whole) / self.count * np.eye(self.count)


@njit(cache=True, nogil=True)
def _joined_rows(known, of_loads, coefficients):
    """Values and derivatives (1 + d + m, a + m r) of a functions, then of r functions times each coefficient."""
    rows, a = known.shape
    r, m = of_loads.shape[1], len(coefficients)
    result = np.zeros((rows + m, a + m * r))
    for i in range(rows):
        for j in range(a):
            result[i, j] = known[i, j]
        for k in range(m):
            for j in range(r):
                result[i, a + k * r + j] = coefficients[k] * of_loads[i, j]
    for k in range(m):
        for j in range(r):
            result[rows + k, a + k * r + j] = of_loads[0, j]
    return result


@njit(cache=True, nogil=True)
def _pair_rows(of_pairs, soft, coefficients):
    """Values and derivatives (1 + d + m, p r) of r functions times z_a z_b of each pair a <= b, z = soft q."""
    rows, r = of_pairs.shape
    s, m = soft.shape
    z = soft @ coefficients
    result, pair = np.zeros((rows + m, s * (s + 1) // 2 * r)), 0
    for a in range(s):
        for b in range(a, s):
            for j in range(r):
                column = pair * r + j
                for i in range(rows):
                    result[i, column] = z[a] * z[b] * of_pairs[i, j]
                for k in range(m):
                    result[rows + k, column] = (soft[a, k] * z[b] + z[a] * soft[b, k]) * of_pairs[0, j]
            pair += 1
    return result


@dataclass(frozen=True)
class LoadedFunctions(Functions):
    """Functions of the parameters, followed by those of the loads' responses times each coefficient.

    Where the second order is known, those of its pairs follow.

    Attributes
    ----------
    known : functions of the d parameters.
    of_loads : r functions of them.
    count : m coefficients, which follow the parameters and have no ends.
    second_order : of the loads, if any.
    """

    known: Functions
    of_loads: Functions
    count: int
    second_order: SecondOrder | None = None

    @property
    def n_functions(self) -> int:
        second = self.second_order
        of_pairs = 0 if second is None else second.n_pairs * second.displacement.functions.n_functions
        return self.known.n_functions + self.count * self.of_loads.n_functions + of_pairs

    @property
    def n_floats(self) -> int:
        of_pairs = 0 if self.second_order is None else self.second_order.displacement.functions.n_floats
        return self.known.n_floats + self.of_loads.n_floats + of_pairs

    @property
    def bounds(self) -> tuple[Array, Array]:
        lower, upper = self.known.bounds
        open_end = np.full(self.count, np.inf)
        return np.concatenate([lower, -open_end]), np.concatenate([upper, open_end])

    def _compiled(self, mu: Array) -> Array:
        d, second = self.known.dimension, self.second_order
        rows = _joined_rows(self.known.rows(mu[:d]), self.of_loads.rows(mu[:d]), mu[d:])
        if second is None:
            return rows
        of_pairs = second.displacement.functions.rows(mu[:d])
        return np.hstack([rows, _pair_rows(of_pairs, second.soft, np.ascontiguousarray(mu[d:]))])

    def mixed(self, matrix: Array) -> Self:
        raise NotImplementedError("functions of loads stay as they are")


@dataclass(frozen=True)
class _MomentOfLoads(Functions):
    """The three components of the loads' moment about the origin, as functions of the parameters and coefficients.

    Attributes
    ----------
    at_rest : (m, 3) of a unit of each load on the undeformed surface, N m.
    added : field of one point, 3 m components: what is added where the study's parameters have moved the surface.
    """

    at_rest: Array
    added: SeparatedField

    @property
    def n_functions(self) -> int:
        return 3

    @property
    def n_floats(self) -> int:
        return self.at_rest.size + self.added.n_floats

    @property
    def bounds(self) -> tuple[Array, Array]:
        (lower, upper), open_end = self.added.functions.bounds, np.full(len(self.at_rest), np.inf)
        return np.concatenate([lower, -open_end]), np.concatenate([upper, open_end])

    def _compiled(self, mu: Array) -> Array:
        d, shape = self.added.functions.dimension, self.at_rest.shape
        value, slopes = self.added.value_and_sensitivities(mu[:d], outside="linear")
        of_each, by_parameters = self.at_rest + value.reshape(shape), slopes.reshape(d, *shape)
        return np.vstack([mu[d:] @ of_each, np.einsum("m,dmc->dc", mu[d:], by_parameters), of_each])

    def mixed(self, matrix: Array) -> Self:
        raise NotImplementedError("functions of loads stay as they are")


@dataclass(frozen=True)
class ElasticEnergy:
    """The elastic energy of unknown loads against its scale: what makes some of them likelier than others.

    Attributes
    ----------
    loads : of the model.
    work : the scale, J: with it as temperature, loads are as likely as exp(-energy / work).
    model : without the loads among its parameters.
    traction : field of 3 components, N per undeformed square metre.
    """

    loads: UnknownLoads
    work: float
    model: ReducedModel
    traction: SeparatedField


#: Without a work scale, loads move the nodes by this share of the object's diagonal in the mean.
USUAL_DISPLACEMENT = 0.02


def usual_work(model: ReducedModel) -> float:
    """A work scale, J, with which unknown loads move the object at its defaults by a small part of its size."""
    assert model.unknown_loads is not None
    response = model.unknown_loads.responses["displacement"].value(model.default)
    moved = float(np.sum(response**2)) / len(model.nodes)
    size = float(np.linalg.norm(np.ptp(model.nodes, axis=0)))
    return (USUAL_DISPLACEMENT * size) ** 2 / moved


def with_unknown_loads(model: ReducedModel, work: float | None = None) -> ReducedModel:
    """The model with the coefficients of its unknown loads as further parameters.

    Their traction is one more field, and what they amount to is a reaction under the name `LOADS`.

    Parameters
    ----------
    model : built with [unknown_loads].
    work : the work scale, J; `usual_work` if None.

    Raises
    ------
    ModelFileError
        If the model has none.
    """
    from morph_dslam.model.reduced_model import MOMENT, REACTION

    loads = model.unknown_loads
    if loads is None:
        raise ModelFileError(
            f"the model '{model.name}' has no unknown loads: build it again with [unknown_loads] in its study"
        )
    work = usual_work(model) if work is None else work
    span = SPAN * float(np.sqrt(work))
    lowest = 0.0 if loads.inward else -span
    added = [Parameter(f"load {k + 1}", "ratio", "1", lowest, span, 0.0, "unknown load") for k in range(loads.count)]
    fields = {
        name: _joined(
            model.fields.get(name, _nothing(response, model)),
            response,
            loads.second_order if name == "displacement" else None,
        )
        for name, response in (loads.responses | _of_tractions(model, loads)).items()
        if name != ROOT
    }
    fields[REACTION + MOMENT + LOADS] = _moment(model, loads)
    return replace(
        model,
        parameters=(*model.parameters, *added),
        displacement=fields["displacement"],
        stresses={place: fields[f"stress_{place}"] for place in model.stresses},
        strain=fields.get("strain"),
        supports=model.supports | {LOADS: loads.nodes},
        reactions={name.removeprefix(REACTION): field for name, field in fields.items() if name.startswith(REACTION)},
        energy=ElasticEnergy(loads, work, model, fields["traction"]),
    )


def _of_tractions(model: ReducedModel, loads: UnknownLoads) -> dict[str, SeparatedField]:
    """Responses: the tractions at all nodes, and their force."""
    from morph_dslam.model.reduced_model import FORCE, REACTION

    everywhere = np.zeros((len(model.nodes), loads.count, 3))
    everywhere[loads.nodes] = np.swapaxes(loads.tractions, 1, 2)
    constant = _constant(model)

    def response(values: Array) -> SeparatedField:
        return SeparatedField(values.reshape(1, len(values), -1), constant)

    return {"traction": response(everywhere), REACTION + FORCE + LOADS: response(loads.resultants[None, :, :3])}


def _moment(model: ReducedModel, loads: UnknownLoads) -> SeparatedField:
    """The loads' moment about the origin in the deformed state, N m.

    A load goes with the surface as the study's parameters move it, and so do its arms. Its own displacement counts to
    second order, and is left out.
    """
    modes = model.displacement.modes[:, loads.nodes]
    outer = np.moveaxis(np.tensordot(modes, _nodal_forces(model, loads), axes=(1, 0)), 1, 2)
    crossed = outer[..., [1, 2, 0], [2, 0, 1]] - outer[..., [2, 0, 1], [1, 2, 0]]
    added = model.displacement.with_modes(crossed.reshape(len(modes), 1, -1))
    return SeparatedField(np.eye(3)[:, None], _MomentOfLoads(loads.resultants[:, 3:], added))


def _nodal_forces(model: ReducedModel, loads: UnknownLoads) -> Array:
    """Forces (k, m, 3), N, at the loads' nodes of a unit of each, which add up to its resultant."""
    forces = np.swapaxes(loads.tractions, 1, 2) * node_areas(model, loads.nodes)[:, None, None]
    sizes = np.linalg.norm(forces, axis=2)
    # The mesh's own integrals give the resultant, areas of triangles nearly so.
    missing = loads.resultants[:, :3] - forces.sum(axis=0)
    return forces + (sizes / np.maximum(sizes.sum(axis=0), 1e-300))[:, :, None] * missing


def triangles_between(model: ReducedModel, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """The surface's triangles (t, 3) all of whose corners are among ``nodes`` (k,)."""
    return model.triangles[np.isin(model.triangles, nodes).all(axis=1)]


def node_areas(model: ReducedModel, nodes: NDArray[np.int64]) -> Array:
    """Area (k,) of the undeformed surface, m2, that belongs to each of ``nodes`` (k,)."""
    triangles = triangles_between(model, nodes)
    a, b, c = np.moveaxis(model.nodes[triangles], 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6.0
    totals = np.bincount(triangles.ravel(), np.repeat(areas, 3), len(model.nodes))
    return np.asarray(totals[nodes], dtype=np.float64)


def _constant(model: ReducedModel) -> ParameterFunctions:
    """The function 1 of the parameters."""
    indices = np.zeros((1, len(model.parameters)), dtype=np.int64)
    return ParameterFunctions(model.lower, model.upper, indices, np.ones((1, 1)))


def _nothing(response: SeparatedField, model: ReducedModel) -> SeparatedField:
    """A field that vanishes where the study's own loads cause none."""
    return SeparatedField(np.zeros((1, response.modes.shape[1], 3)), _constant(model))


def _joined(field: SeparatedField, response: SeparatedField, second: SecondOrder | None) -> SeparatedField:
    """A field of the parameters with its response to each load."""
    parts = [field.modes, _one_by_one(response, field.modes.shape[2])]
    if second is not None:
        parts.append(_one_by_one(second.displacement, 3))
    count = response.modes.shape[2] // field.modes.shape[2]
    return SeparatedField(np.concatenate(parts), LoadedFunctions(field.functions, response.functions, count, second))


def _one_by_one(stacked: SeparatedField, c: int) -> NDArray[np.floating]:
    """Modes (k r, n, c) of each of k fields that are stacked as components: r modes (r, n, k c)."""
    r, n, columns = stacked.modes.shape
    return np.moveaxis(stacked.modes.reshape(r, n, columns // c, c), 2, 0).reshape(-1, n, c)


def supports_beside_loads(model: ReducedModel) -> list[str]:
    """Names of the supports that the study moves, and which share cells of the surface with the unknown loads."""
    if model.energy is None:
        return []
    modes, found = model.displacement.modes, list[str]()
    least = STILL * max(float(modes.max(initial=0.0)), -float(modes.min(initial=0.0)))
    loaded = np.isin(model.triangles, model.supports[LOADS]).any(axis=1)
    for name, held in model.supports.items():
        beside = bool((np.isin(model.triangles, held).any(axis=1) & loaded).any())
        if name != LOADS and beside and float(np.abs(modes[:, held]).max(initial=0.0)) > least:
            found.append(name)
    return found
