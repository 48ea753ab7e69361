"""Tractions on part of a body's boundary that it gives way to most, and how the body answers them.

A traction t with energy t' C t / 2, C the compliance of the deformed body, is softest where it moves the surface most
for the work that it does. The softest tractions solve the eigenvalue problem of the surface's mass M and compliance,
M C M v = theta M v: they are the static modes K u = M u / theta of the body that is loaded on that surface alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import ngsolve as ngs
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.spatial import KDTree

from morph_dslam.mechanics.spaces import DisplacementSpace
from morph_dslam.model.discrepancy import farthest_points

Array = NDArray[np.float64]
sla: Any = scipy.sparse.linalg
#: Width of a pressure over the distance between their places.
WIDTH = 0.4
#: Supports hold a surface against a traction if the dofs that are free are across it, to this part.
HELD_ACROSS = 1e-6
#: Softness, as a part of the largest, below which a traction moves nothing: it acts where supports hold.
SOFTLESS = 1e-10
#: Steps that spread the places evenly (Lloyd).
LLOYD = 50
#: Loads (k, n_dofs) at the dofs to the change (k, n_dofs) of the solution that they cause.
Respond = Callable[[Array], Array]


@dataclass(frozen=True)
class LoadedSurface:
    """The functions of one displacement component on a surface, and the directions in which tractions act.

    A traction is given by coefficients (a, k): of each function along each direction.

    Attributes
    ----------
    dofs : (k,) scalar dofs.
    mass : sparse (k, k), integrals of the functions' products over the undeformed surface, m2.
    nodes : (s,) of the mesh that are on the surface. Functions do not vanish at all others: of elements of second order
        they reach halfway down to the next corners.
    at_nodes : sparse (s, k), values there.
    from_nodes : sparse (k, s), coefficients of what has given values there.
    linear : (4, k) coefficients of the functions 1, x, y and z, the latter in metres.
    directions : (a, 3, k) unit vectors at each dof.
    n_scalar : scalar dofs of a component; those of x come first, then those of y and of z.
    n_dofs : of the problem.
    """

    dofs: NDArray[np.int64]
    mass: Any
    nodes: NDArray[np.int64]
    at_nodes: Any
    from_nodes: Any
    linear: Array
    directions: Array
    n_scalar: int
    n_dofs: int

    @classmethod
    def of(
        cls, space: DisplacementSpace, region: ngs.Region, nodes: NDArray[np.int64], n_dofs: int, inward: bool
    ) -> LoadedSurface:
        """The functions of a displacement's component that a ``region`` with these ``nodes`` (s,) sees.

        Tractions act along the inward normal only, or in any direction.
        """
        scalar = space.scalar
        mass = _mass(scalar, region, ngs.CF(1.0))
        dofs = np.flatnonzero(mass.diagonal() > 0.0)
        directions = np.repeat(np.eye(3)[:, :, None], len(dofs), axis=2)
        if inward:
            parts = [_mass(scalar, region, ngs.specialcf.normal(3)[i]).diagonal()[dofs] for i in range(3)]
            directions = -np.array([parts]) / np.linalg.norm(parts, axis=0)
        linear = np.vstack([space.constant, space.coordinates.T])[:, dofs]
        there = space.node_values[nodes][:, dofs], space.coefficients[dofs][:, nodes]
        return cls(dofs, mass[dofs][:, dofs], nodes, *there, linear, directions, scalar.ndof, n_dofs)

    @property
    def _places(self) -> NDArray[np.int64]:
        """Dofs (3, k) of the components."""
        return np.arange(3)[:, None] * self.n_scalar + self.dofs

    def _weighted(self, values: Array) -> Array:
        """The mass times (c, 3, k)."""
        return (self.mass @ values.reshape(-1, len(self.dofs)).T).T.reshape(values.shape)

    def components(self, tractions: Array) -> Array:
        """Vectors (c, 3, k) of tractions (c, a, k)."""
        return np.einsum("aik,cak->cik", self.directions, tractions)

    def loads(self, tractions: Array) -> Array:
        """Forces (c, n_dofs), N, at all dofs of tractions (c, a, k), Pa."""
        result = np.zeros((len(tractions), self.n_dofs))
        result[:, self._places] = self._weighted(self.components(tractions))
        return result

    def work(self, responses: Array) -> Array:
        """What unit tractions (a, k) do along changes (c, n_dofs) of a solution, (c, a, k), J/Pa."""
        return np.einsum("aik,cik->cak", self.directions, self._weighted(responses[:, self._places]))

    def products(self, tractions: Array) -> Array:
        """The mass of the directions' functions times tractions: (c, a, k) of (c, a, k)."""
        return np.einsum("aik,cik->cak", self.directions, self._weighted(self.components(tractions)))

    def nodal(self, tractions: Array) -> Array:
        """Vectors (c, s, 3) at the nodes of tractions (c, a, k)."""
        flat = self.at_nodes @ self.components(tractions).reshape(-1, len(self.dofs)).T
        return np.moveaxis(flat.reshape(-1, len(tractions), 3), 0, 1)

    def resultants(self, tractions: Array) -> Array:
        """Force, N, and moment about the origin, N m, (c, 6) of tractions (c, a, k)."""
        force, x, y, z = (self._weighted(self.components(tractions)) @ function for function in self.linear)
        about = np.stack([y[:, 2] - z[:, 1], z[:, 0] - x[:, 2], x[:, 1] - y[:, 0]], axis=1)
        return np.hstack([force, about])

    def can_move(self, free: NDArray[np.bool_]) -> bool:
        """Whether a traction can move the surface, of whose dofs (n_dofs,) those that are not ``free`` are held."""
        return bool((np.abs(self.directions) > HELD_ACROSS)[:, free[self._places]].any())

    def compliance(self, tractions: Array, respond: Respond) -> tuple[Array, Array]:
        """Compliance (c, c) in joules of tractions (c, a, k), and the responses (c, n_dofs) to each."""
        responses = respond(self.loads(tractions))
        work = np.einsum("cak,dak->cd", tractions, self.work(responses))
        return (work + work.T) / 2.0, responses


def _mass(scalar: ngs.FESpace, region: ngs.Region, weight: Any) -> Any:
    """Sparse integrals of products of the functions of a space, times ``weight``, over a region."""
    trial, test = scalar.TnT()
    form = ngs.BilinearForm(scalar)
    if region.VB() == ngs.BND:
        form += weight * trial.Trace() * test.Trace() * ngs.ds(definedon=region)
    else:
        form += weight * trial * test * ngs.dx(definedon=region)
    form.Assemble()
    rows, columns, values = form.mat.COO()
    places = np.array(rows), np.array(columns)
    return sp.csr_matrix((np.array(values), places), shape=(scalar.ndof, scalar.ndof))


def softest_tractions(surface: LoadedSurface, respond: Respond, count: int) -> tuple[Array, Array]:
    """The ``count`` softest tractions (c, a, k) of unit mean square over 1 m2, and their softness (c,), m/Pa.

    Fewer where the surface has not so many that move it.
    """
    shape = surface.directions.shape[0], len(surface.dofs)
    size = int(np.prod(shape))
    turned = [sp.diags(direction) for direction in surface.directions.reshape(-1, shape[1])]
    blocks = sp.bmat([[turned[3 * a + i] for a in range(shape[0])] for i in range(3)])
    mass = blocks.T @ sp.block_diag([surface.mass] * 3) @ blocks
    factors = sla.splu(mass.tocsc())

    def soft(values: Array) -> Array:
        return surface.work(respond(surface.loads(values.reshape(1, *shape)))).ravel()

    operators = [sla.LinearOperator((size, size), matvec=apply, dtype=float) for apply in (soft, factors.solve)]
    start = np.random.default_rng(0).standard_normal(size)
    softness, vectors = sla.eigsh(operators[0], min(count, size - 1), mass, Minv=operators[1], v0=start)
    order = np.argsort(softness)[::-1]
    order = order[softness[order] > SOFTLESS * softness.max()]
    return vectors.T[order].reshape(-1, *shape), softness[order]


def pressing_tractions(surface: LoadedSurface, nodes: Array, count: int) -> Array:
    """At most ``count`` pressures (c, 1, k) of 1 Pa, each about a place of its own, spread evenly over the surface.

    They are Gaussian bumps, as wide as their places are apart.

    Parameters
    ----------
    nodes : (n, 3) of the model's mesh, m.
    """
    places = nodes[surface.nodes]
    start = places[farthest_points(places, count)]
    centres, _ = kmeans2(places, start, iter=LLOYD, minit="matrix")
    gaps, _ = KDTree(centres).query(centres, k=2)
    width = WIDTH * float(np.median(gaps[:, 1]))
    distance = np.linalg.norm(places[:, None] - centres, axis=2)
    bumps = np.exp(-((distance / width) ** 2) / 2.0)
    return np.ascontiguousarray((surface.from_nodes @ bumps).T[:, None])


def common_tractions(surface: LoadedSurface, found: list[tuple[Array, Array]], count: int) -> Array:
    """At most ``count`` tractions (c, a, k) that span the softest ones of several states best.

    Each state's count by the displacement that a unit of work makes, so that soft ones count more.
    """
    scaled = np.concatenate([np.sqrt(softness)[:, None, None] * vectors for vectors, softness in found])
    gram = np.einsum("cak,dak->cd", surface.products(scaled), scaled)
    values, rotation = np.linalg.eigh(gram)
    kept = np.argsort(values)[::-1][:count]
    kept = kept[values[kept] > 1e-12 * values.max()]
    return np.tensordot((rotation[:, kept] / np.sqrt(values[kept])).T, scaled, axes=1)
