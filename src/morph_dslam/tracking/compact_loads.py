"""Which compact loads frames ask for: pressures on small parts of a surface, a few of which explain what is seen.

What presses on a body mostly does so at a few places. So loads are a sum of two: compact ones, normal forces on spots
of several sizes at places spread over the surface, each with a variance of its own; and all others, as likely as
exp(-energy / work). Variances and work maximise the evidence of the last frames. Most variances are zero then: spots
are added, changed and removed one by one (Tipping and Faul, AISTATS 2003), here for several frames with one set of
variances. Frames rarely show which of several spots acts: a near one, or a larger force on one that is hidden. So the
variance of each that was found is shared out among all that could stand in its place, by their evidence (averaging over
models: Hoeting et al., Statistical Science 14, 1999).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from morph_dslam.model import ReducedModel
from morph_dslam.model.discrepancy import farthest_points
from morph_dslam.model.unknown_loads import UnknownLoads, node_areas, triangles_between
from morph_dslam.render.shading import vertex_normals

Array = NDArray[np.float64]
#: Places for each load and at most; sizes of the spots there (standard deviations) over the places' distance.
PLACES_A_LOAD, MOST_PLACES, SIZES = 4, 400, (1.0, 2.0, 3.0)
#: A spot, or another variance of one, must raise the logarithm of the evidence by so much; most changes in a frame.
LEAST_GAIN, MOST_CHANGES = 3.0, 30
#: The work scale may change by these factors from frame to frame, but not to less than this many times the least
#: energy that is seen.
WORK_FACTORS, LEAST_WORK = 2.0 ** np.arange(-3.0, 4.0), 1.0
#: Combinations of loads of which a frame shows less than this share of what was known before do not count, nor those of
#: which it shows less than this share of what it shows of the one seen best.
LEAST_SEEN, ROUNDING = 0.01, 1e-13
#: The information on a spot is at least this share of that on the one seen best.
LEAST_SHARPNESS = 1e-7
#: Steps to the variance that several frames have in common.
STEPS = 3
#: A spot that could stand in another's place with less than this share of the evidence of all that could is left out.
LEAST_PLAUSIBLE = 1e-3


def spot_displacements(model: ReducedModel, loads: UnknownLoads) -> Array:
    """What each of m loads moves a surface in its normal direction at the model's defaults, in the mean over s spots.

    By reciprocity these (m, s), in metres, are also the work of a unit force on each spot along each load's response.
    """
    nodes, count = loads.nodes, min(MOST_PLACES, PLACES_A_LOAD * loads.count, len(loads.nodes))
    positions = model.nodes[nodes]
    places = positions[farthest_points(positions, count)]
    distance = np.linalg.norm(positions[:, None] - places, axis=2)
    gap = float(np.median(KDTree(places).query(places, k=2)[0][:, 1]))
    spots = np.hstack([np.exp(-0.5 * (distance / (size * gap)) ** 2) for size in SIZES])
    spots *= node_areas(model, nodes)[:, None]
    responses = loads.responses["displacement"]
    of_nodes = responses.with_modes(responses.modes[:, nodes]).value(model.default).reshape(len(nodes), loads.count, 3)
    normals = vertex_normals(model.nodes, triangles_between(model, nodes))[nodes]
    along = np.einsum("nmc,nc->mn", of_nodes, normals)
    return np.asarray(along @ (spots / spots.sum(axis=0)), dtype=np.float64)


@dataclass(frozen=True)
class LoadCovariance:
    """The covariance of m loads, whatever acted before: C^-1 (w C + D V D') C^-1.

    Attributes
    ----------
    compliance : C (m, m), J
    work : w, J.
    spots : D V^(1/2) (m, k) of the k spots that act, J.
    """

    compliance: Array
    work: float
    spots: Array

    @property
    def value(self) -> Array:
        """(m, m)."""
        factor = np.linalg.cholesky(self.work * self.compliance + self.spots @ self.spots.T)
        root = np.linalg.solve(self.compliance, factor)
        return np.asarray(root @ root.T, dtype=np.float64)


@dataclass(frozen=True)
class LoadPrediction:
    """What is known of m loads before a frame is seen.

    Attributes
    ----------
    mean : (m,).
    covariance : (m, m).
    """

    mean: Array
    covariance: Array

    @cached_property
    def root(self) -> Array:
        """Lower triangle L (m, m): the covariance is L L'."""
        return np.asarray(np.linalg.cholesky(self.covariance), dtype=np.float64)

    @cached_property
    def whitening(self) -> Array:
        """L^-1 (m, m), which makes loads independent and of unit variance."""
        return np.asarray(np.linalg.inv(self.root), dtype=np.float64)

    @cached_property
    def inverse(self) -> Array:
        """Of the covariance, (m, m)."""
        return self.whitening.T @ self.whitening


@dataclass(frozen=True)
class SeenLoads:
    """What one frame shows of m loads, without any prior, in loads that are independent in energy and in it.

    Attributes
    ----------
    information : (r,) of each of these, 1/J.
    spots : (r, s) of s spots of unit force, so that the information of spots is its square.
    values : (r,) that were seen, of unit variance.
    """

    information: Array
    spots: Array
    values: Array

    @classmethod
    def of(
        cls, information: Array, loads: Array, known: LoadPrediction, compliance: Array, displacements: Array
    ) -> SeenLoads | None:
        """From loads that were estimated with a prior; None if that is the prior alone.

        Parameters
        ----------
        information : (m, m), inverse of their covariance, which has the prior's times a factor in it.
        loads : (m,) as estimated.
        known : the prior.
        compliance : (m, m), J.
        displacements : (m, s) of s spots; see `spot_displacements`.
        """
        values, vectors = np.linalg.eigh(known.root.T @ information @ known.root)
        # What is seen least is taken to be known from the prior alone; so its factor follows.
        measured = values - values[0]
        seen = measured > max(LEAST_SEEN * values[0], ROUNDING * values[-1])
        if not seen.any():
            return None
        scale, combinations = np.sqrt(measured[seen]), vectors[:, seen].T @ known.whitening
        rows = scale[:, None] * combinations
        values_seen = (values[seen] * (combinations @ loads) - values[0] * (combinations @ known.mean)) / scale
        by_compliance = np.linalg.solve(compliance, rows.T)
        energies, turn = np.linalg.eigh(rows @ by_compliance)
        return cls(energies, turn.T @ (by_compliance.T @ displacements), turn.T @ values_seen)


class _Evidence:
    """The spots' part in the evidence of one frame, as their variances change one by one.

    Attributes
    ----------
    sharpness, pull : (s,) b' C^-1 b and b' C^-1 y of each spot b, C the covariance of what is seen, y.
    """

    def __init__(self, seen: SeenLoads, work: float) -> None:
        self._seen, self._inverse = seen, 1.0 / (1.0 + work * seen.information)
        self._changes: list[tuple[float, Array]] = []
        self.sharpness = self._inverse @ seen.spots**2
        self._least = LEAST_SHARPNESS * float(self.sharpness.max())
        self.sharpness = np.maximum(self.sharpness, self._least)
        self.pull = (self._inverse * seen.values) @ seen.spots

    def change(self, k: int, increase: float) -> None:
        """Take in that the variance of spot ``k`` grew by so much (Sherman and Morrison)."""
        column = (self._inverse * self._seen.spots[:, k]) @ self._seen.spots
        for factor, earlier in self._changes:
            column -= factor * earlier[k] * earlier
        factor = increase / (1.0 + increase * column[k])
        self._changes.append((factor, column))
        self.pull -= factor * self.pull[k] * column
        self.sharpness = np.maximum(self.sharpness - factor * column**2, self._least)


def spot_variances(frames: list[SeenLoads], work: float) -> Array:
    """Variances (s,) of the spots, N2, beside loads of this work scale, J, as the evidence of some frames has them."""
    variances = np.zeros(frames[0].spots.shape[1])
    evidences = _evidences(frames, work, variances)
    for _ in range(MOST_CHANGES):
        best, gain = _best_variances(evidences, variances)
        k = int(gain.argmax())
        if gain[k] < LEAST_GAIN:
            break
        for evidence in evidences:
            evidence.change(k, float(best[k] - variances[k]))
        variances[k] = best[k]
    found = np.flatnonzero(variances).tolist()
    return sum((_stand_ins(frames, work, variances, k) for k in found), np.zeros_like(variances))


def _stand_ins(frames: list[SeenLoads], work: float, variances: Array, k: int) -> Array:
    """Variances (s,) of the spots that could stand in the place of spot ``k`` beside the others, times their shares.

    The shares are those of the models with one of them each, equally likely before the frames were seen.
    """
    others = variances.copy()
    others[k] = 0.0
    best, gain = _best_variances(_evidences(frames, work, others), others)
    could = (others == 0.0) & (best > 0.0)
    shares = np.where(could, np.exp(gain - gain[could].max(initial=0.0)), 0.0)
    shares[shares < LEAST_PLAUSIBLE * shares.sum()] = 0.0
    return best * shares / max(float(shares.sum()), 1e-300)


def _evidences(frames: list[SeenLoads], work: float, variances: Array) -> list[_Evidence]:
    """The spots' part in the evidence of each frame, where they have these variances (s,)."""
    evidences = [_Evidence(seen, work) for seen in frames]
    for k in np.flatnonzero(variances).tolist():
        for evidence in evidences:
            evidence.change(k, float(variances[k]))
    return evidences


def _best_variances(evidences: list[_Evidence], variances: Array) -> tuple[Array, Array]:
    """The variance (s,) of each spot that is best while those of the others stay, and what its evidence gains (s,)."""
    sharpness, pull = np.array([one.sharpness for one in evidences]), np.array([one.pull for one in evidences])
    # As if the spot were left out.
    rest = np.maximum(1.0 - variances * sharpness, 1e-6)
    sharpness, pull = sharpness / rest, pull / rest
    # Of one frame alone the best is known; that of several is a mean with weights that depend on it.
    alone = (pull / sharpness) ** 2 - 1.0 / sharpness
    best = np.maximum(alone.mean(axis=0), 0.0)
    for _ in range(STEPS):
        weights = (sharpness / (1.0 + best * sharpness)) ** 2
        best = np.maximum((weights * alone).sum(axis=0) / weights.sum(axis=0), 0.0)

    def evidence(variance: Array) -> Array:
        grown = variance * sharpness
        return 0.5 * (variance * pull**2 / (1.0 + grown) - np.log1p(grown)).sum(axis=0)

    return best, evidence(best) - evidence(variances)


def log_evidence(frames: list[SeenLoads], variances: Array, work: float) -> float:
    """Of all frames, but for a constant, by the variances of the spots (s,), N2, and a work scale, J."""
    on, total = variances > 0.0, 0.0
    for seen in frames:
        inverse = 1.0 / (1.0 + work * seen.information)
        spots = seen.spots[:, on] * np.sqrt(variances[on])
        inner = np.eye(spots.shape[1]) + (spots.T * inverse) @ spots
        explained = (spots.T * inverse) @ seen.values
        total += np.log(inverse).sum() - np.linalg.slogdet(inner)[1]
        total += explained @ np.linalg.solve(inner, explained) - (inverse * seen.values) @ seen.values
    return 0.5 * float(total)


def best_work(frames: list[SeenLoads], variances: Array, work: float) -> float:
    """The work scale near ``work``, J, that has most evidence beside spots of these variances (s,), N2."""
    tried = np.maximum(work * WORK_FACTORS, LEAST_WORK / max(seen.information[-1] for seen in frames))
    return float(tried[np.argmax([log_evidence(frames, variances, scale) for scale in tried])])
