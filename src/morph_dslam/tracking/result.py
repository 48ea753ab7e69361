"""The result of one frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import ParameterError, TrackingError
from morph_dslam.geometry import RigidTransform
from morph_dslam.model import ReducedModel
from morph_dslam.model.discrepancy import Discrepancy
from morph_dslam.registration.registration import PosePrior
from morph_dslam.tracking.displacement_jumps import DisplacementJump, near_jumps
from morph_dslam.tracking.estimator import Estimate
from morph_dslam.tracking.observability import displacement_std, position_std, von_mises_std
from morph_dslam.tracking.outcomes import FoundBy, PoseSource, Rejection, Status, TrackingWarning, reason_text
from morph_dslam.tracking.reactions import Reaction, Reactions
from morph_dslam.tracking.row_motion import RowMotion
from morph_dslam.tracking.state import State

Array = NDArray[np.float64]
_Kind = TypeVar("_Kind", bound=TrackingWarning)
#: The stages of a frame that are timed, in order; "locate" finds the camera in the map.
STAGES = (
    "locate",
    "prepare",
    "flow",
    "estimate",
    "render",
    "correct",
    "search",
    "recover",
    "outline",
    "depth",
    "fuse",
    "discrepancy",
    "views",
)


@dataclass(frozen=True)
class FrameResult:
    """What one frame tells of an object.

    Attributes
    ----------
    model : the reduced model that it was tracked with.
    status : tracked; hidden, where the map gives the pose but too few points the parameters; or lost.
    estimate : pose, parameters and their covariance; None unless tracked.
    found_by : how the object was found; None unless tracked.
    rejection : why it was not; None when tracked.
    warnings : what a reader must know of this result.
    pose_from : what the pose comes from.
    by_outline : whether the outline is all that was seen of the object.
    few_corners : how many corners the object's texture shows in the reference, and how many are needed, where these are
        too few to follow it by; None where they are enough, or nobody asked for texture.
    pose_prior : the pose by the map, where that alone gives it.
    n_points : number of points that the picture shows and the object itself does not occlude.
    n_inliers : number of those that support the estimate.
    residual_rms_px : root mean square of the inliers' residuals, pixels, NaN unless tracked.
    unexplained_px : what the model leaves of the residuals, pixels, see `systematic_errors`; NaN unless tracked.
    reference_factor : by how much worse than stated the reference state is known, by all frames so far.
    view : number of the reference view that the frame was compared with, 0 for the first.
    made_view : whether the frame became a reference view itself.
    discrepancy : what the object's shape has beyond the model's; None where it was not estimated.
    jumps : where the surface was found to open or slip along a line, in this frame or before; as at a crack.
    motion : while a rolling shutter recorded the frame; None where it is not known, or of a global one.
    modulus_std : standard deviation of a factor common to all moduli, a share, as the tracker's options have it.
    timings_ms : by stage, milliseconds.
    total_ms : of the whole frame, milliseconds.
    """

    model: ReducedModel
    status: Status
    estimate: Estimate | None = None
    found_by: FoundBy | None = None
    rejection: Rejection | None = None
    warnings: tuple[TrackingWarning, ...] = ()
    pose_from: PoseSource = PoseSource.NONE
    by_outline: bool = False
    few_corners: tuple[int, int] | None = None
    pose_prior: PosePrior | None = None
    n_points: int = 0
    n_inliers: int = 0
    residual_rms_px: float = float("nan")
    unexplained_px: float = float("nan")
    reference_factor: float = 1.0
    view: int = 0
    made_view: bool = False
    discrepancy: Discrepancy | None = None
    jumps: tuple[DisplacementJump, ...] = ()
    motion: RowMotion | None = None
    modulus_std: float = 0.0
    timings_ms: dict[str, float] = field(default_factory=lambda: dict.fromkeys(STAGES, 0.0))
    total_ms: float = 0.0

    def __repr__(self) -> str:
        """One line: the status, and the parameters or why there are none."""
        if self.estimate is None:
            return f"FrameResult({self.status}, {self.reason!r})"
        values, deviations = self.parameters, self.parameter_std
        found = [
            f"{p.name}={p.display(values[p.name]):.4g}±{p.display(deviations[p.name]):.2g} {p.unit}"
            for p in self.model.study_parameters
        ]
        points = f"{self.n_inliers} of {self.n_points} points agree"
        return f"FrameResult({', '.join([self.status, self.model.name, *found, points])})"

    @property
    def shown_state(self) -> State | None:
        """The state to draw over the image, None unless tracked.

        Its pose is that at the instant of the rows that show the object, which a rolling shutter records earlier or
        later than the middle row.
        """
        if self.estimate is None:
            return None
        return self.estimate.state if self.motion is None else self.motion.as_seen(self.estimate.state)

    @property
    def tracked(self) -> bool:
        """Whether pose and parameters are estimated."""
        return self.estimate is not None

    @property
    def recovered(self) -> bool:
        """Whether the object was found again after a loss."""
        return self.found_by in (FoundBy.LAST_STATE, FoundBy.FEATURES)

    @property
    def reason(self) -> str:
        """For people: how the object was found, or why it was not, and the warnings."""
        return reason_text(self.status, self.found_by, self.rejection, self.warnings)

    def warning(self, kind: type[_Kind]) -> _Kind | None:
        """The first warning of a kind; None if there is none."""
        return next((warning for warning in self.warnings if isinstance(warning, kind)), None)

    @property
    def parameters(self) -> dict[str, float]:
        """Values by name, SI; NaN unless tracked."""
        names = [parameter.name for parameter in self.model.study_parameters]
        values = np.full(len(names), np.nan) if self.estimate is None else self.estimate.state.parameters
        return dict(zip(names, values.tolist(), strict=False))

    @property
    def parameter_std(self) -> dict[str, float]:
        """Standard deviations by name, SI; NaN unless tracked."""
        values = np.full(len(self.model.parameters), np.nan) if self.estimate is None else self.estimate.parameter_std
        return {p.name: float(value) for p, value in zip(self.model.study_parameters, values, strict=False)}

    @property
    def covariance(self) -> Array:
        """(d + 6, d + 6) of [parameters, rotation vector, translation], SI; NaN unless tracked."""
        if self.estimate is not None:
            return self.estimate.covariance
        return np.full((len(self.model.parameters) + 6,) * 2, np.nan)

    @property
    def image_covariance(self) -> Array:
        """The same of shape and pose: errors of mesh and reduction make parameters wrong, but no shapes.

        Where a sensor tells a parameter, it holds a part of them from being made good, and that part is in the shape.
        """
        return self.covariance if self.estimate is None else self.estimate.image_covariance

    @property
    def pose(self) -> RigidTransform | None:
        """camera_from_object, metres; None when lost."""
        if self.estimate is not None:
            return self.estimate.state.camera_from_object
        return None if self.pose_prior is None else self.pose_prior.pose

    @property
    def pose_std(self) -> Array:
        """Standard deviations (6,) of the pose's rotation vector (rad) and translation (m); NaN when lost."""
        if self.estimate is not None:
            return self.estimate.pose_std
        return np.full(6, np.nan) if self.pose_prior is None else np.sqrt(np.diag(self.pose_prior.covariance))

    def displacement(self) -> Array:
        """Of every node (n, 3) in the object frame, metres, with the discrepancy where it was estimated.

        Raises
        ------
        TrackingError
            If the frame was not tracked; the same of the methods below.
        """
        value = self.model.displacement.value(self._mu)
        return value if self.discrepancy is None else value + self.discrepancy.displacement(self.model.nodes)

    def displacement_std(self) -> Array:
        """Standard deviation (n,) of the displacement of every node, metres."""
        return self._with_discrepancy(displacement_std(self.model, self._tracked))

    def positions(self) -> Array:
        """Of every node (n, 3) in the camera frame, metres."""
        pose = self._tracked.state.camera_from_object
        return pose.apply(self.model.nodes + self.displacement())

    def position_std(self) -> Array:
        """Standard deviation (n,) of every node's position in the camera frame, metres: of shape and pose together.

        Both are the root of the mean square distance over all directions.
        """
        return self._with_discrepancy(position_std(self.model, self._tracked))

    def _with_discrepancy(self, deviations: Array) -> Array:
        """Deviations (n,) of the nodes' places with that of the discrepancy, where it was estimated."""
        if self.discrepancy is None:
            return deviations
        more = self.discrepancy.covariances(self.model.nodes).trace(axis1=1, axis2=2)
        return np.asarray(np.sqrt(deviations**2 + more), dtype=np.float64)

    def von_mises(self, place: str | None = None) -> Array:
        """Von Mises stress (n,) of every node, pascals.

        Parameters
        ----------
        place : "solid", or "top" or "bottom" of a sheet; by default the larger one of a sheet's faces.

        Raises
        ------
        ParameterError
            If the model has no stress there.
        """
        return np.max(self._sizes_of_stress(self._places(place)), axis=0)

    def near_jumps(self) -> NDArray[np.bool_]:
        """Nodes (n,) near which the surface opens or slips along a line: strain and stress do not hold there."""
        return near_jumps(self.jumps, self.model.nodes)

    def von_mises_std(self, place: str | None = None) -> Array:
        """Standard deviation (n,) of the von Mises stress of every node, pascals; as of `von_mises`.

        Raises
        ------
        ParameterError
            If the model has no stress there.
        """
        places = self._places(place)
        deviations = np.array([von_mises_std(self.model, self._tracked, at) for at in places])
        largest = np.argmax(self._sizes_of_stress(places), axis=0)
        return np.take_along_axis(deviations, largest[None], axis=0)[0]

    def strain(self) -> Array:
        """Green-Lagrange strain (n, 6) of every node, [xx, yy, zz, yz, xz, xy], tensor shears.

        Raises
        ------
        ParameterError
            If the model has no strain, as those of sheets.
        """
        if self.model.strain is None:
            raise ParameterError(f"the model '{self.model.name}' holds no strain")
        return self.model.strain.value(self._mu)

    def reactions(self, modulus_std: float | None = None) -> dict[str, Reaction]:
        """What supports exert on the object, by the name of the set; empty for a model without reactions.

        Parameters
        ----------
        modulus_std : standard deviation of a factor common to all moduli, a share (0.05 for 5 %); by default that of
            the tracker's options.

        Raises
        ------
        TrackingError
            If it is no share.
        """
        share = self.modulus_std if modulus_std is None else modulus_std
        if not 0.0 <= share <= 1.0:
            raise TrackingError(f"modulus_std is {share:g}: give a share from 0 to 1, 0.05 for 5 %")
        return Reactions(self.model)(self._tracked, share)

    def _places(self, place: str | None) -> list[str]:
        """Where the model has stress: at the place that is asked for, or at all of them."""
        known = list(self.model.stresses)
        if not known or place not in (None, *known):
            what = "stress" if place is None else f"stress '{place}'"
            raise ParameterError(f"the model '{self.model.name}' has no {what}; it has {', '.join(known) or 'none'}")
        return known if place is None else [place]

    def _sizes_of_stress(self, places: list[str]) -> Array:
        """Von Mises stress (p, n) of every node at places."""
        return np.array([self.model.von_mises(self._mu, at) for at in places])

    @property
    def _tracked(self) -> Estimate:
        if self.estimate is None:
            raise TrackingError(f"the object was not tracked in this frame: it is {self.status}, {self.reason}")
        return self.estimate

    @property
    def _mu(self) -> Array:
        return self._tracked.state.parameters
