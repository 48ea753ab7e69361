"""The results of all frames of one object, in memory, and frames that contradict each other in them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from morph_dslam.model import ReducedModel, SeparatedField
from morph_dslam.model.discrepancy import Discrepancy, largest_deformation
from morph_dslam.tracking.binding import DrawnSurface
from morph_dslam.tracking.estimator import Estimate, State
from morph_dslam.tracking.named_points import NamedPoints
from morph_dslam.tracking.observability import beyond_first_order, largest_displacement, largest_von_mises
from morph_dslam.tracking.outcomes import PastForgotten, Status, may_be_mistaken
from morph_dslam.tracking.point_rotations import Surroundings
from morph_dslam.tracking.reactions import Reaction, Reactions, VectorEstimate
from morph_dslam.tracking.result import STAGES, FrameResult
from morph_dslam.tracking.sequence_filter import PATIENCE

Array = NDArray[np.float64]
_Known = TypeVar("_Known")
#: A largest value and its deviation where there is none.
_UNKNOWN = (float("nan"), float("nan"))
#: So many standard deviations of both together, with all that these contain, are a contradiction. The filter begins
#: anew by what is new in each frame alone; errors of the model that change with the state may be the whole difference.
APART = 3.0


@dataclass
class RunResults:
    """The results of all frames so far, in order.

    Attributes
    ----------
    model : that was tracked.
    reference_frame : number of the frame that the object is known from.
    refined : whether the reference state was refined over the frames.
    per_sequence : names of the parameters that are the same in all frames.
    revolution_angles : names of those that are angles about an axis of revolution, which go on beyond their bounds.
    modulus_std : standard deviation of a factor common to all moduli, a share.
    points : places of the object that are followed by name; None where there are none.
    at_rest : whether the object was said to be undeformed in the reference frame.
    frames : (f,) numbers.
    timestamps : (f,) seconds.
    results : (f,), without the residuals of single points and the deviations of discrepancies: runs may be long.
    """

    model: ReducedModel
    reference_frame: int
    refined: bool = False
    per_sequence: tuple[str, ...] = ()
    revolution_angles: tuple[str, ...] = ()
    modulus_std: float = 0.0
    points: NamedPoints | None = None
    at_rest: bool = False
    frames: list[int] = field(default_factory=list)
    timestamps: list[float] = field(default_factory=list)
    results: list[FrameResult] = field(default_factory=list)
    _largest: list[tuple[float, float]] = field(default_factory=list, repr=False)
    _stressed: list[tuple[float, float]] = field(default_factory=list, repr=False)
    _reactions: list[dict[str, Reaction]] = field(default_factory=list, repr=False)
    _points: list[tuple[list[VectorEstimate], list[VectorEstimate]] | None] = field(default_factory=list, repr=False)

    def add(self, frame: int, timestamp: float, result: FrameResult) -> None:
        if result.estimate is not None:
            result = replace(result, estimate=replace(result.estimate, residuals=np.empty((0, 2))))
        self.frames.append(frame)
        self.timestamps.append(timestamp)
        self.results.append(result)
        if result.discrepancy is not None and result.discrepancy.deviation is not None:
            self._known_points()
            self._known_displacements()
            self.results[-1] = replace(result, discrepancy=replace(result.discrepancy, deviation=None))

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def tracked(self) -> NDArray[np.bool_]:
        """Frames (f,) that have an estimate."""
        return np.array([result.tracked for result in self.results], dtype=bool)

    @property
    def mistaken_frames(self) -> frozenset[int]:
        """Numbers of frames whose results are not to be relied on."""
        pairs = zip(self.frames, self.results, strict=True)
        return frozenset(frame for frame, result in pairs if may_be_mistaken(result.warnings))

    @property
    def torn_frames(self) -> frozenset[int]:
        """Numbers of frames in which the surface was found to open or slip along a line, in them or before."""
        return frozenset(frame for frame, result in zip(self.frames, self.results, strict=True) if result.jumps)

    @property
    def hidden(self) -> NDArray[np.bool_]:
        """Frames (f,) in which only the pose is known, from the map."""
        return np.array([result.status is Status.HIDDEN for result in self.results], dtype=bool)

    def states(self) -> list[State | None]:
        """The state of every frame, None where it was hidden or lost."""
        return [result.estimate.state if result.estimate else None for result in self.results]

    def poses(self) -> Array:
        """camera_from_object (f, 4, 4), NaN where lost."""
        lost = np.full((4, 4), np.nan)
        return np.array([lost if result.pose is None else result.pose.matrix for result in self.results])

    def pose_std(self) -> Array:
        """(f, 6) of the rotation vector (rad) and the translation (m) of the pose, NaN where lost."""
        return np.array([result.pose_std for result in self.results]).reshape(-1, 6)

    def parameters(self) -> Array:
        """(f, d), SI, NaN where lost."""
        return self._of_estimates(lambda estimate: estimate.state.parameters, np.nan)

    def parameter_std(self) -> Array:
        """(f, d), SI, NaN where lost."""
        return self._of_estimates(lambda estimate: estimate.parameter_std, np.nan)

    def covariances(self) -> Array:
        """(f, d + 6, d + 6) of parameters, rotation vector and translation, SI, NaN where lost."""
        return np.array([result.covariance for result in self.results])

    def stated_std(self) -> Array:
        """(f, d), SI, of the parameters before the residuals widen them, NaN where lost."""
        return self._of_estimates(lambda estimate: estimate.stated_std, np.nan)

    def at_bound(self) -> NDArray[np.bool_]:
        """(f, d), false where lost, and for angles about an axis of revolution, which go on beyond their bounds."""
        has_bounds = np.array([one.name not in self.revolution_angles for one in self.model.parameters], dtype=bool)
        return self._of_estimates(lambda estimate: estimate.at_bound & has_bounds, False)

    def _of_estimates(self, value: Callable[[Estimate], NDArray], lost: float | bool) -> NDArray:
        """A value of each estimate's parameters (f, d), ``lost`` where there is none."""
        nothing = np.full(len(self.model.parameters), lost)
        return np.array([nothing if r.estimate is None else value(r.estimate) for r in self.results])

    def largest_displacements(self) -> Array:
        """The largest displacement of a node of the surface and its standard deviation (f, 2), metres."""
        return np.array(self._known_displacements()).reshape(-1, 2)

    def largest_stresses(self) -> Array:
        """The largest von Mises stress of a node of the surface and its standard deviation (f, 2), pascals.

        NaN where lost, and in models without stresses.
        """
        return np.array(self._known_stresses()).reshape(-1, 2)

    def reactions(self) -> dict[str, list[Reaction | None]]:
        """Of each support what it exerts in every frame, None where the object was hidden or lost."""
        frames = self._known_reactions()
        return {name: [frame.get(name) for frame in frames] for name in self._reactions_of_model.names}

    def point_displacements(self) -> dict[str, list[VectorEstimate | None]]:
        """Of each named point its displacement in every frame, object frame, metres, None where hidden or lost."""
        return self._of_points(0)

    def point_turns(self) -> dict[str, list[VectorEstimate | None]]:
        """Of each named point the rotation vector of its surroundings in every frame, object frame, radians.

        None where hidden or lost.
        """
        return self._of_points(1)

    def _of_points(self, part: int) -> dict[str, list[VectorEstimate | None]]:
        if self.points is None:
            return {}
        rows = self._known_points()
        names = enumerate(self.points.names)
        return {name: [None if row is None else row[part][k] for row in rows] for k, name in names}

    def _displacements_of_points(self, estimate: Estimate, discrepancy: Discrepancy | None) -> list[VectorEstimate]:
        assert self.points is not None
        field, mu = self._field_of_points, estimate.state.parameters
        values, slopes = field.value_and_sensitivities(mu)
        if discrepancy is not None:
            values = values + discrepancy.displacement(self.points.rest)
        d = len(slopes)
        covariance = estimate.image_covariance[:d, :d]
        if not np.isfinite(covariance).all():
            return [VectorEstimate.of(value, np.full((3, 3), np.inf)) for value in values]
        of_points = np.einsum("dpx,de,epy->pxy", slopes, covariance, slopes, optimize=True)
        for missed in beyond_first_order(field.value, slopes, mu, covariance, self.model):
            of_points += missed[:, :, None] * missed[:, None, :]
        of_points += estimate.model_displacement_in_object**2 / 3.0 * np.eye(3)
        if discrepancy is not None:
            of_points += discrepancy.covariances(self.points.rest)
        return [VectorEstimate.of(value, of_point) for value, of_point in zip(values, of_points, strict=True)]

    @cached_property
    def _around(self) -> Surroundings:
        assert self.points is not None
        return Surroundings.of(self.model, self.points.points)

    @cached_property
    def _field_of_points(self) -> SeparatedField:
        assert self.points is not None
        return self.model.restrict(self.points.points)

    def last_largest(self) -> tuple[float, float]:
        """The largest displacement (m) and von Mises stress (Pa) of the last frame, as above."""
        return self._known_displacements()[-1][0], self._known_stresses()[-1][0]

    def last_reactions(self) -> dict[str, Reaction | None]:
        """What each support exerts in the last frame, as above."""
        last = self._known_reactions()[-1]
        return {name: last.get(name) for name in self._reactions_of_model.names}

    # What is known of the frames so far is kept, so that a frame costs the same however long the run is.

    def _known_displacements(self) -> list[tuple[float, float]]:
        return self._added_to(
            self._largest, lambda found, beyond: largest_displacement(self._surface, found, beyond), _UNKNOWN
        )

    def _known_stresses(self) -> list[tuple[float, float]]:
        return self._added_to(
            self._stressed, lambda found, _: largest_von_mises(self._stressed_surface, found), _UNKNOWN
        )

    def _known_reactions(self) -> list[dict[str, Reaction]]:
        return self._added_to(self._reactions, lambda found, _: self._reactions_of_model(found, self.modulus_std), {})

    def _known_points(self) -> list[tuple[list[VectorEstimate], list[VectorEstimate]] | None]:
        """Displacements and turns of the named points."""
        for result in self.results[len(self._points) :] if self.points is not None else ():
            found, beyond = result.estimate, result.discrepancy
            self._points.append(
                None
                if found is None
                else (self._displacements_of_points(found, beyond), self._around.turns(found, beyond))
            )
        return self._points

    @cached_property
    def _reactions_of_model(self) -> Reactions:
        return Reactions(self.model)

    @cached_property
    def _surface(self) -> ReducedModel:
        return DrawnSurface.of(self.model).model

    @cached_property
    def _stressed_surface(self) -> ReducedModel:
        """The model with stresses of the nodes of the surface alone."""
        used = np.unique(self.model.triangles)
        stresses = {place: f.with_modes(f.modes[:, used]) for place, f in self.model.stresses.items()}
        return replace(self.model, stresses=stresses)

    def _added_to(
        self, known: list[_Known], of: Callable[[Estimate, Discrepancy | None], _Known], lost: _Known
    ) -> list[_Known]:
        """What is ``known`` of the frames so far (f), added to by that ``of`` those since, ``lost`` without one."""
        for result in self.results[len(known) :]:
            known.append(lost if result.estimate is None else of(result.estimate, result.discrepancy))
        return known

    def timings_ms(self) -> Array:
        """(f, len(STAGES) + 1): each stage, then the whole frame."""
        return np.array([[*(r.timings_ms[s] for s in STAGES), r.total_ms] for r in self.results])

    def residuals_px(self) -> Array:
        """Root mean square residual (f,), NaN where lost."""
        return np.array([result.residual_rms_px for result in self.results])

    def sigmas_px(self) -> Array:
        """Robust standard deviation of a pixel coordinate's residual (f,), NaN where lost."""
        return np.array([np.nan if r.estimate is None else r.estimate.sigma_px for r in self.results])

    def unexplained_px(self) -> Array:
        """What the model leaves of the residuals (f,), see `systematic_errors`; NaN where lost."""
        return np.array([result.unexplained_px for result in self.results])

    def reference_factors(self) -> Array:
        """By how much worse than stated the reference state is known (f,), by all frames until each."""
        return np.array([result.reference_factor for result in self.results])

    def beyond_model(self) -> Array:
        """Largest displacement (f,) of a node of the surface beyond the model's and a rigid motion, metres.

        NaN where it was not estimated.
        """
        nodes = self.model.nodes[np.unique(self.model.triangles)]
        found = [result.discrepancy for result in self.results]
        return np.array([np.nan if d is None else largest_deformation(nodes, d) for d in found])

    def counts(self) -> NDArray[np.int64]:
        """(f, 2): points that could be seen, and those that support the estimate."""
        return np.array([(r.n_points, r.n_inliers) for r in self.results], dtype=np.int64).reshape(-1, 2)


@dataclass(frozen=True)
class Contradiction:
    """Two values of one parameter.

    Attributes
    ----------
    parameter : its number in the model.
    before, after : value and standard deviation, SI, in the frame ``last`` and in the frame ``first``.
    last : number of the last frame that agreed with those before.
    first : number of the one from which on the others count.
    """

    parameter: int
    before: tuple[float, float]
    after: tuple[float, float]
    last: int
    first: int

    @property
    def deviations(self) -> float:
        """How many standard deviations of both together lie between the values."""
        return abs(self.after[0] - self.before[0]) / max(float(np.hypot(self.before[1], self.after[1])), 1e-300)


def contradictions(run: RunResults) -> list[Contradiction]:
    """Of each per-sequence parameter in which frames contradict each other, where they do so most."""
    tracked = np.flatnonzero(run.tracked)
    values, deviations = run.parameters(), run.parameter_std()
    found: dict[int, Contradiction] = {}
    for place, row in enumerate(tracked):
        if place < PATIENCE or not any(isinstance(one, PastForgotten) for one in run.results[row].warnings):
            continue
        agreed = tracked[place - PATIENCE]
        for k, parameter in enumerate(run.model.study_parameters):
            pairs = [(float(values[i, k]), float(deviations[i, k])) for i in (agreed, row)]
            one = Contradiction(k, pairs[0], pairs[1], run.frames[agreed], run.frames[row])
            if parameter.name in run.per_sequence and one.deviations > max(
                APART, found[k].deviations if k in found else 0.0
            ):
                found[k] = one
    return [found[k] for k in sorted(found)]
