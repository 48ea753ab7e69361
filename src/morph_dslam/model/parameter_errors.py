"""What a model's discretisation error amounts to in its parameters.

Elements that are too coarse are too stiff, so that an object seen in a shape needs more load in the model than in
truth. The parameters that bring the model's surface nearest to that of finer elements say how much. A certificate has
this at the states that were solved again; in others it is taken to be as much for each millimetre of displacement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
#: And those of a model whose time a clock tells, so that the other parameters alone make the error good.
AT_KNOWN_TIME = "at_known_time"
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
    """

    changes: Array
    left: float
    in_object: float


def equivalent_errors(
    model: ReducedModel, mu: Array, error: Array, known: Sequence[int] = (), free_pose: bool = False
) -> EquivalentErrors:
    """Parameters' changes that move the surface most nearly as an error of the displacement does, and what is left.

    Unknown loads among the parameters are as likely as their energy has it.

    Parameters
    ----------
    model : whose sensitivities are taken.
    mu : (d,) the state, SI.
    error : (n, 3) true displacement minus the model's, at the nodes, metres.
    known : numbers of the parameters that do not change.
    free_pose : whether the pose changes as well.
    """
    nodes, ranges = np.unique(model.triangles), np.array([p.upper - p.lower for p in model.parameters])
    value, slopes = model.fields["displacement"].value_and_sensitivities(mu)
    effects = slopes[:, nodes].reshape(len(ranges), -1).T * ranges
    effects[:, list(known)] = 0.0
    rows, wanted = effects, error[nodes].ravel()
    if model.energy is not None:
        extent = float(np.linalg.norm(np.ptp(model.nodes, axis=0)))
        root = np.linalg.cholesky(model.energy.loads.compliance(mu[: -model.n_loads]) / model.energy.work)
        least = np.sqrt(len(nodes)) * MEASURED * extent * (root * ranges[-model.n_loads :, None]).T
        rows = np.vstack([effects, np.hstack([np.zeros((len(least), len(ranges) - len(least))), least])])
        wanted = np.append(wanted, np.zeros(len(least)))
    poses = _rigid_motions((model.nodes + value)[nodes]) if free_pose else np.zeros((effects.shape[0], 0))
    rigid = np.vstack([poses, np.zeros((len(rows) - len(poses), poses.shape[1]))])
    # The parameters make good what is left of their effects and of the error by the best rigid motion of each.
    rows, wanted = (part - rigid @ (rigid.T @ part) for part in (rows, wanted))
    changes = np.linalg.lstsq(rows, wanted, rcond=LEAST_EFFECT)[0]
    in_object = error[nodes].ravel() - effects @ changes
    left = in_object - poses @ (poses.T @ in_object)
    found = np.asarray(ranges * changes, dtype=np.float64)
    return EquivalentErrors(found, _rms(left.reshape(-1, 3)), _rms(in_object.reshape(-1, 3)))


def _rigid_motions(positions: Array) -> Array:
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
        unknown loads, "with_unknown_loads" is the same where these make it good too. Of a model of one time,
        "at_known_time" is the same where the other parameters alone do: time may stand for a load almost as well in the
        state that was solved again, and not at other times.
    """
    found = _entry(model, states)
    if len(model.clocks) == 1 and len(model.parameters) > 1:
        found[AT_KNOWN_TIME] = _entry(model, states, model.clocks)
    if model.unknown_loads is not None and model.energy is None:
        none = np.zeros(model.unknown_loads.count)
        found[WITH_LOADS] = _entry(
            with_unknown_loads(model), [(np.append(mu, none), own, finer) for mu, own, finer in states]
        )
    return found


def _entry(
    model: ReducedModel, states: Sequence[tuple[Array, Array, Array]], known: Sequence[int] = ()
) -> dict[str, Any]:
    """By those parameters that are not ``known``."""
    nodes, entries = np.unique(model.triangles), list[dict[str, Any]]()
    for free_pose in (False, True):
        matched = [equivalent_errors(model, mu, finer - own, known, free_pose) for mu, own, finer in states]
        found = np.array([one.changes for one in matched])
        errors = {parameter.name: found[:, k].tolist() for k, parameter in enumerate(model.parameters)}
        sizes, left = [1e3 * _rms(finer[nodes]) for _, _, finer in states], [1e3 * one.left for one in matched]
        entries.append({ERRORS: errors, SIZES: sizes, LEFT: left})
    entries[1][IN_OBJECT] = [1e3 * one.in_object for one in matched]
    return entries[0] | {WITH_FREE_POSE: entries[1]}


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
    per_metre : (k, d) errors at the states solved again, SI, over the root mean square displacement there.
    left_share : of that displacement, root mean square over the states: what no change of the parameters makes good.
    object_share : the same in the object's frame, where what the pose makes good is an error too.
    functions : of the displacement.
    products : (m, m) mean products of its modes on the surface, squared metres.
    n_loads : unknown loads among the last parameters.
    """

    per_metre: Array
    left_share: float
    object_share: float
    functions: Functions
    products: Array
    n_loads: int = 0

    @classmethod
    def of(
        cls, model: ReducedModel, at_known_time: bool = False, free_pose: bool = False, products: Array | None = None
    ) -> ParameterErrors | None:
        """Those of a model, perhaps where its time is known or the pose free; None where its certificate has none.

        ``products`` : as of another case of the same model; None to compute them.
        """
        stated = model.certificate.get("discretisation", {}).get(ENTRY)
        if stated is None or not model.parameters:
            return None
        stated = stated.get(WITH_LOADS, stated) if model.n_loads else stated
        stated = stated.get(AT_KNOWN_TIME, stated) if at_known_time else stated
        stated = stated.get(WITH_FREE_POSE, stated) if free_pose else stated
        sizes, none = 1e-3 * np.array(stated[SIZES]), [0.0] * len(stated[SIZES])
        left = 1e-3 * np.array(stated.get(LEFT, none))
        in_object = 1e-3 * np.array(stated.get(IN_OBJECT, stated.get(LEFT, none)))
        errors = np.array([stated[ERRORS].get(p.name, none) for p in model.parameters]).T
        moved = sizes > 0.0
        if not moved.any():
            return None
        products = mean_products(surface_modes(model)) if products is None else products
        shares = [float(np.sqrt(np.mean((part[moved] / sizes[moved]) ** 2))) for part in (left, in_object)]
        functions = model.displacement.functions
        return cls(errors[moved] / sizes[moved, None], shares[0], shares[1], functions, products, model.n_loads)

    def at(self, mu: Array) -> tuple[Array, float, float]:
        """Covariance (d, d) of the parameters at a state ``mu`` (d,), SI, and what is left of the displacement's error.

        The latter root mean square lengths, metres: as the camera sees it, and in the object's frame.
        """
        factors, size = self.factors(mu), float(np.sqrt(self._squared(mu)))
        return factors @ factors.T, self.left_share * size, self.object_share * size

    def factors(self, mu: Array) -> Array:
        """Errors (d, k) of the parameters at a state ``mu`` (d,), SI, alike in all states: their squares add up."""
        return np.asarray(np.sqrt(self._squared(mu) / len(self.per_metre)) * self.per_metre.T)

    def _squared(self, mu: Array) -> float:
        """Mean square displacement of the surface, squared metres.

        Where unknown loads push back what the study's own have moved, the body is strained by both.
        """
        row = self._row(mu)
        parts = [row]
        if self.n_loads:
            by_study = self._row(np.append(mu[: -self.n_loads], np.zeros(self.n_loads)))
            parts = [by_study, row - by_study]
        return max(float(sum(row @ self.products @ row for row in parts)), 0.0)

    def _row(self, mu: Array) -> Array:
        """Values (m,) of the displacement's functions."""
        return self.functions.rows(self.functions.nearest_inside(mu))[0]
