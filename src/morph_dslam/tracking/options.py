"""What the tracker follows and what it demands before it believes a frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from morph_dslam.tracking.depth import SCALE_STD, SIGMA_AT_1M
from morph_dslam.tracking.discrepancy import DiscrepancyOptions
from morph_dslam.tracking.estimator import EstimationOptions
from morph_dslam.tracking.option_values import CheckedOptions, Count, NotNegative, Positive, PositiveCount, Share

#: How an object's pose is found: by the map and its points, by the map alone, by its points alone, or once for the
#: whole sequence.
PoseFrom = Literal["map", "fixed", "free", "still"]
#: Where the search for a frame's state starts.
StartFrom = Literal["previous", "constant-velocity"]

#: Why stress is left out of pictures, and why several cameras refuse some options.
NOT_IN_EQUILIBRIUM = (
    "stress and strain are not drawn on a shape with a discrepancy, which is not in equilibrium under the study's loads"
)
NO_LOADS = "unknown loads are estimated from one camera: leave out --unknown-loads or --with"
NO_DISCREPANCY = "the discrepancy is estimated from one camera: leave out --discrepancy or --with"
#: Why a free object's pose cannot be fixed.
NO_MAP = "a pose is held fixed by a map: give the object's registration in it"


@dataclass(frozen=True)
class TrackerOptions(CheckedOptions):
    """What the tracker follows and what it demands before it believes a frame.

    Attributes
    ----------
    n_points : corners followed, spread over the reference view.
    inlier_sigmas, inlier_px : a point supports the estimate when its residual is below so many robust
        standard deviations, within these limits in pixels: a model that is a pixel off must not cost it good
        points, and occluders that happen to look alike must not get in where it fits well.
    search_above_px, searches : where the residuals' spread exceeds this, so many other shapes are tried in
        the frame as starts, in turn, lest the estimate stay in a local minimum; one otherwise.
    least_inliers, least_share : points that must support it, as a number or a share of all, if that is fewer.
    few_sigma_px : where less than half of all points support it, their residuals must spread less than this, as they
        are or without what neighbours have in common.
    least_anchored, anchored_share : where the map tells the pose, fewer points will do: at least this many,
        if they are this share of the points found and agree as closely as few must.
    pose : of an object in a map: "map", the camera is found in the map and the object with it; "fixed", and the
        map's pose is taken as exact; "free", it may be anywhere, as one that is in no map always may; "still",
        camera and object stand still, so that the registration's pose is that of every frame. A `Tracker` of one's
        own keeps that pose; `track` estimates it from all frames, and once more as they come where ``live``.
    moved_share, moved_sigmas, moved_patience : an anchored object has moved when its points show it farther
        off than this share of its size, and than so many standard deviations, in so many frames on end.
    look_every : a hidden or doubted object is looked for elsewhere in every so many frames.
    use_outline : whether the object's outline counts too; it needs a background that it stands out from. An object
        with too little texture is followed by it alone, and one in a map is so unasked.
    use_texture : whether texture counts; without it the outline does, ``use_outline`` or not.
    use_depth : whether the depth images of frames that have them count too.
    modulus_std : standard deviation of a factor common to all moduli, a share (0.05 for 5 %); it counts in the
        reactions.
    depth_sigma : standard deviation of one pixel's depth at 1 m, metres; it grows with the distance squared.
    depth_scale_std : standard deviation of what all depths are off by together, a share (0.01 for 1 %).
    use_discrepancy : whether to look for what the object's shape has beyond the model's.
    use_unknown_loads : whether loads that the study does not foresee are estimated too (`estimation.loads`).
    per_sequence : names of the parameters that are one over the whole sequence.
    random_walk : names of parameters that hardly change from frame to frame, each with the standard deviation
        of the change from one frame number to the next, SI: a prior on them. None by default.
    start : where the search for a frame's state starts: from the previous state, or from where the last two
        lead at constant velocity.
    new_views, max_views : whether frames in which the reference view shows too little of what is seen may
        become reference views too, and how many are kept, the first one included.
    further_views : whether other keyframes of the map of an anchored object are reference views with the one
        that it is placed in.

    Raises
    ------
    TrackingError
        If a value is none of those that its type names, or outside its range.
    """

    n_points: PositiveCount = 350
    inlier_sigmas: Positive = 6.0
    inlier_px: tuple[NotNegative, NotNegative] = (2.0, 8.0)
    least_inliers: Count = 30
    least_share: Share = 0.3
    few_sigma_px: NotNegative = 1.0
    least_anchored: Count = 12
    anchored_share: Share = 0.7
    pose: PoseFrom = "map"
    moved_share: NotNegative = 0.02
    moved_sigmas: NotNegative = 5.0
    moved_patience: PositiveCount = 3
    look_every: PositiveCount = 5
    search_above_px: NotNegative = 0.25
    searches: Count = 2
    use_outline: bool = False
    use_texture: bool = True
    use_depth: bool = False
    use_discrepancy: bool = False
    use_unknown_loads: bool = False
    per_sequence: tuple[str, ...] = ()
    random_walk: tuple[tuple[str, float], ...] = ()
    modulus_std: Share = 0.0
    start: StartFrom = "previous"
    new_views: bool = True
    max_views: PositiveCount = 12
    further_views: bool = True
    depth_sigma: Positive = SIGMA_AT_1M
    depth_scale_std: NotNegative = SCALE_STD
    discrepancy: DiscrepancyOptions = field(default_factory=DiscrepancyOptions)
    estimation: EstimationOptions = field(default_factory=EstimationOptions)

    @property
    def makes_views(self) -> bool:
        """Whether frames may become reference views: there is room for one beside the first."""
        return self.new_views and self.max_views > 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.use_texture:
            object.__setattr__(self, "use_outline", True)
