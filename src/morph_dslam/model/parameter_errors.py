"""What a model's discretisation error amounts to in its parameters.

Elements that are too coarse are too stiff, so that an object seen in a shape needs more load in the model than in
truth. The parameters that bring the model's surface nearest to that of finer elements say how much. A certificate has
this at the states that were solved again. In others what each parameter moves of the surface for it is taken to be as
much for each millimetre of displacement: a load then errs in proportion to this, and a modulus by a constant share.

Parameters that move the surface nearly alike, as a load and a modulus do, may change by a lot of opposite sign, and do
so where the images alone tell both. Where something else tells one, the others make the error good without it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model.functions import Functions
from morph_dslam.model.reduced_model import ReducedModel
from morph_dslam.model.unknown_loads import with_unknown_loads

Array = NDArray[np.float64]
#: The certificate's entries of these errors, within that of the discretisation.
ENTRY, ERRORS, SIZES, LEFT = "parameters", "errors", "displacement_rms_mm", "left_rms_mm"
#: Within the latter those of a model with its unknown loads, which take up what the parameters leave.
WITH_LOADS = "with_unknown_loads"
#: Within each of them those where the pose is free: it makes good what is nearly a rigid motion, by which the
#: displacement in the object's frame is then off.
WITH_FREE_POSE, IN_OBJECT = "with_free_pose", "in_object_rms_mm"
#: And mean products of what two parameters move the surface by, from which follows what others make good without one.
PRODUCTS = "products_m2"
#: Unknown loads are found from a surface that is measured to this part of the object's extent, by many points.
MEASURED = 1e-5
#: Combinations of parameters that move the surface by less than this part of what others do are left out.
LEAST_EFFECT = 1e-3


@dataclass(frozen=True)
class EquivalentErrors:
    """What an error of the displacement amounts to.

    Attributes
    ----------
    changes : (d,) of the parameters, SI.
    left : of the error on the surface, root mean square length, metres.
    in_object : as ``left``, with what the pose makes good of it: in the object's frame that is an error.
    products : (d, d) mean products of what the parameters move the surface by, but for what the pose makes good, square
        metres over both units. Likely unknown loads are in it.
    """

    changes: Array
    left: float
    in_object: float
    products: Array


def equivalent_errors(model: ReducedModel, mu: Array, error: Array, free_pose: bool = False) -> EquivalentErrors:
    """Parameters' changes that move the surface most nearly as an error of the displacement does, and what is left.

    Unknown loads among the parameters are as likely as their energy has it.

    Parameters
    ----------
    model : whose sensitivities are taken.
    mu : (d,) the state, SI.
    error : (n, 3) true displacement minus the model's, at the nodes, metres.
    free_pose : whether the pose changes as well.
    """
    nodes, ranges = np.unique(model.triangles), np.array([p.upper - p.lower for p in model.parameters])
    value, slopes = model.fields["displacement"].value_and_sensitivities(mu)
    effects = slopes[:, nodes].reshape(len(ranges), -1).T * ranges
    rows, wanted = effects, error[nodes].ravel()
    if model.energy is not None:
        extent = float(np.linalg.norm(np.ptp(model.nodes, axis=0)))
        root = np.linalg.cholesky(model.energy.loads.compliance(mu[: -model.n_loads]) / model.energy.work)
        least = np.sqrt(len(nodes)) * MEASURED * extent * (root * ranges[-model.n_loads :, None]).T
        rows = np.vstack([effects, np.hstack([np.zeros((len(least), len(ranges) - len(least))), least])])
        wanted = np.append(wanted, np.zeros(len(least)))
    poses = rigid_motions((model.nodes + value)[nodes]) if free_pose else np.zeros((effects.shape[0], 0))
    rigid = np.vstack([poses, np.zeros((len(rows) - len(poses), poses.shape[1]))])
    # The parameters make good what is left of their effects and of the error by the best rigid motion of each.
    rows, wanted = (part - rigid @ (rigid.T @ part) for part in (rows, wanted))
    changes = np.linalg.lstsq(rows, wanted, rcond=LEAST_EFFECT)[0]
    in_object = error[nodes].ravel() - effects @ changes
    left = in_object - poses @ (poses.T @ in_object)
    found = np.asarray(ranges * changes, dtype=np.float64)
    products = np.asarray(rows.T @ rows / np.outer(ranges, ranges) / len(nodes), dtype=np.float64)
    return EquivalentErrors(found, _rms(left.reshape(-1, 3)), _rms(in_object.reshape(-1, 3)), products)


def rigid_motions(positions: Array) -> Array:
    """Shifts and small turns of points (n, 3) as orthonormal columns (3 n, 6)."""
    arms = positions - positions.mean(axis=0)
    motions = [motion for axis in np.eye(3) for motion in (np.tile(axis, (len(arms), 1)), np.cross(axis, arms))]
    return np.asarray(np.linalg.qr(np.reshape(motions, (6, -1)).T)[0], dtype=np.float64)


def parameter_errors(model: ReducedModel, states: Sequence[tuple[Array, Array, Array]]) -> dict[str, Any]:
    """The certificate's entry of what the discretisation error amounts to in the parameters, in plain JSON types.

    Parameters
    ----------
    model : of the study.
    states : that were solved again: parameters (d,), and displacements (n, 3) of the nodes by the study's elements and
        by finer ones, SI.

    Returns
    -------
    dict
        "errors", by parameter, of each state, SI; "displacement_rms_mm" of the surface there; "left_rms_mm" of the
        displacement's error that no change of the parameters makes good. "with_free_pose" is the same where a rigid
        motion makes it good too, and "in_object_rms_mm" there what is left with that motion. Of a model that may have
        unknown loads, "with_unknown_loads" is the same where these make it good too. "products_m2" of each state are
        those of `EquivalentErrors`, SI, which say what the others make good where something else tells some.
    """
    found = _entry(model, states)
    if model.unknown_loads is not None and model.energy is None:
        none = np.zeros(model.unknown_loads.count)
        found[WITH_LOADS] = _entry(
            with_unknown_loads(model), [(np.append(mu, none), own, finer) for mu, own, finer in states]
        )
    return found


def _entry(model: ReducedModel, states: Sequence[tuple[Array, Array, Array]]) -> dict[str, Any]:
    nodes, entries = np.unique(model.triangles), list[dict[str, Any]]()
    for free_pose in (False, True):
        matched = [equivalent_errors(model, mu, finer - own, free_pose) for mu, own, finer in states]
        found = np.array([one.changes for one in matched])
        errors = {parameter.name: found[:, k].tolist() for k, parameter in enumerate(model.parameters)}
        sizes, left = [1e3 * _rms(finer[nodes]) for _, _, finer in states], [1e3 * one.left for one in matched]
        products = [one.products.tolist() for one in matched]
        entries.append({ERRORS: errors, SIZES: sizes, LEFT: left, PRODUCTS: products})
    entries[1][IN_OBJECT] = [1e3 * one.in_object for one in matched]
    return entries[0] | {WITH_FREE_POSE: entries[1]}


def errors_alone(stated: Mapping[str, Any]) -> dict[str, Array]:
    """Errors of each parameter at the states (k,), SI, where all others are known, of an entry of a certificate."""
    changes, products = np.array(list(stated[ERRORS].values())).T, np.array(stated[PRODUCTS])
    own = np.einsum("kdd->kd", products)
    pushes = np.einsum("kde,ke->kd", products, changes)
    alone = np.divide(pushes, own, out=np.zeros_like(pushes), where=own > 0.0)
    return dict(zip(stated[ERRORS], alone.T, strict=True))


def surface_modes(model: ReducedModel) -> Array:
    """The displacement's modes (m, 3 s) at the surface's nodes (s,)."""
    nodes, field = np.unique(model.triangles), model.displacement
    return field.modes[:, nodes].reshape(field.n_modes, -1).astype(np.float64)


def mean_products(modes: Array) -> Array:
    """Mean products (m, m) of modes (m, 3 s) over s nodes, squared metres."""
    return np.asarray(modes @ modes.T / (modes.shape[1] // 3), dtype=np.float64)


def _rms(displacement: Array) -> float:
    """Root mean square length of vectors (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(displacement**2, axis=1))))


@dataclass(frozen=True)
class ParameterErrors:
    """Errors of estimated parameters by a model's discretisation.

    Attributes
    ----------
    errors : (k, d) at the states solved again, SI.
    sizes : (k,) root mean square displacement there, metres.
    left : (k,) squared, square metres: what no change of the parameters makes good.
    in_object : (k,) the same in the object's frame, where what the pose makes good is an error too.
    effects : (k, d, d) mean products of what the parameters move the surface by, as of `EquivalentErrors`; zeros where
        they are unknown.
    ranges : (d,) of the parameters.
    functions : of the displacement.
    products : (m, m) mean products of its modes on the surface, squared metres.
    n_loads : unknown loads among the last parameters.
    in_frame : the same of a pose that is known, where this is of a free one.
    """

    errors: Array
    sizes: Array
    left: Array
    in_object: Array
    effects: Array
    ranges: Array
    functions: Functions
    products: Array
    n_loads: int = 0
    in_frame: ParameterErrors | None = None

    @classmethod
    def of(cls, model: ReducedModel, free_pose: bool = False, products: Array | None = None) -> ParameterErrors | None:
        """Those of a model, perhaps where the pose is free; None where its certificate has none.

        ``products`` : as of another case of the same model; None to compute them.
        """
        stated = model.certificate.get("discretisation", {}).get(ENTRY)
        if stated is None or not model.parameters:
            return None
        stated = stated.get(WITH_LOADS, stated) if model.n_loads else stated
        in_frame = cls.of(model, False, products) if free_pose else None
        stated = stated.get(WITH_FREE_POSE, stated) if free_pose else stated
        sizes, none = 1e-3 * np.array(stated[SIZES]), [0.0] * len(stated[SIZES])
        left = (1e-3 * np.array(stated.get(LEFT, none))) ** 2
        in_object = (1e-3 * np.array(stated.get(IN_OBJECT, stated.get(LEFT, none)))) ** 2
        errors = np.array([stated[ERRORS].get(p.name, none) for p in model.parameters]).T
        moved = sizes > 0.0
        if not moved.any():
            return None
        if products is None:
            products = mean_products(surface_modes(model)) if in_frame is None else in_frame.products
        return cls(
            errors[moved],
            sizes[moved],
            left[moved],
            in_object[moved],
            _effects(model, stated)[moved],
            model.upper - model.lower,
            model.displacement.functions,
            products,
            model.n_loads,
            in_frame,
        )

    def holding(self, known: NDArray[np.int64], shares: Array | None = None) -> ParameterErrors:
        """The same where something else tells some parameters, so that the others make the error good.

        Parameters
        ----------
        known : (q,) numbers of the parameters.
        shares : (q, q) of a change of them that this keeps from an estimate; None where it keeps all.
        """
        taken, others = np.zeros_like(self.errors), np.setdiff1d(np.arange(len(self.ranges)), known)
        held = self.errors[:, known]
        taken[:, known] = held if shares is None else held @ shares.T
        scale = self.ranges[others]
        for change, effects in zip(taken, self.effects, strict=True):
            normal = effects[np.ix_(others, others)] * np.outer(scale, scale)
            wanted = effects[np.ix_(others, known)] @ change[known] * scale
            change[others] = -scale * np.linalg.lstsq(normal, wanted, rcond=LEAST_EFFECT**2)[0]
        found = self.errors - taken
        left = self.left + _squares(taken, self.effects)
        of_frame = self if self.in_frame is None else self.in_frame
        before, after = (_squares(of_frame.errors - part, of_frame.effects) for part in (self.errors, found))
        return replace(self, errors=found, left=left, in_object=np.maximum(self.in_object + after - before, 0.0))

    def at(self, mu: Array) -> tuple[Array, float, float]:
        """Covariance (d, d) of the parameters at a state ``mu`` (d,), SI, and what is left of the displacement's error.

        The latter root mean square lengths, metres: as the camera sees it, and in the object's frame.
        """
        factors, size = self.factors(mu), float(np.sqrt(self._squared(mu)))
        left, in_object = (np.sqrt(np.mean(part / self.sizes**2)) for part in (self.left, self.in_object))
        return factors @ factors.T, float(left) * size, float(in_object) * size

    def factors(self, mu: Array) -> Array:
        """Errors (d, k) of the parameters at a state ``mu`` (d,), SI, alike in all states: their squares add up."""
        size, own = float(np.sqrt(self._squared(mu))), len(mu) - self.n_loads
        found = self.errors * (size / self.sizes)[:, None]
        # By the same movement of the surface; one that hardly moves it is anywhere in its range, and no more.
        rows = self._rows(mu)[1 : 1 + own]
        moves = np.sqrt(np.maximum(np.einsum("dm,mn,dn->d", rows, self.products, rows), np.finfo(float).tiny))
        of_frame = self if self.in_frame is None else self.in_frame
        there = np.sqrt(np.einsum("kdd->kd", of_frame.effects)[:, :own])
        limits = np.maximum(np.abs(found[:, :own]), self.ranges[:own])
        moved = np.where(there > 0.0, found[:, :own] * there / moves, found[:, :own])
        found[:, :own] = np.clip(moved, -limits, limits)
        return np.asarray(found.T / np.sqrt(len(found)))

    def _squared(self, mu: Array) -> float:
        """Mean square displacement of the surface, squared metres.

        Where unknown loads push back what the study's own have moved, the body is strained by both.
        """
        row = self._rows(mu)[0]
        parts = [row]
        if self.n_loads:
            by_study = self._rows(np.append(mu[: -self.n_loads], np.zeros(self.n_loads)))[0]
            parts = [by_study, row - by_study]
        return max(float(sum(row @ self.products @ row for row in parts)), 0.0)

    def _rows(self, mu: Array) -> Array:
        """Values of the displacement's functions and their derivatives (1 + d, m)."""
        return self.functions.rows(self.functions.nearest_inside(mu))


def _effects(model: ReducedModel, stated: Mapping[str, Any]) -> Array:
    """Products (k, d, d) that a certificate states, by the model's parameters; zeros of those that it does not have."""
    names = [p.name for p in model.parameters]
    found = np.zeros((len(stated[SIZES]), len(names), len(names)))
    if PRODUCTS in stated:
        at = [names.index(name) for name in stated[ERRORS] if name in names]
        own = [k for k, name in enumerate(stated[ERRORS]) if name in names]
        found[np.ix_(range(len(found)), at, at)] = np.array(stated[PRODUCTS])[np.ix_(range(len(found)), own, own)]
    return found


def _squares(changes: Array, effects: Array) -> Array:
    """Mean square movements (k,) of the surface by changes (k, d) of the parameters, squared metres."""
    return np.asarray(np.einsum("kd,kde,ke->k", changes, effects, changes), dtype=np.float64)
