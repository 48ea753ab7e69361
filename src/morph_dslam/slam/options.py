"""Choices of a run of camera tracking and mapping, and the settings that its parts share."""

from __future__ import annotations

from dataclasses import dataclass

#: Half width, pixels, of patches that must agree, and how well: their correlation.
PATCH_HALF, LEAST_CORRELATION = 6, 0.6
#: Points that miss by more, pixels, do not belong to the rigid scene.
INLIER_PX = 4.0
#: A pose from fewer points counts as lost.
LEAST_INLIERS = 20
#: Fewest points that a map begins with.
LEAST_START_POINTS = 80


@dataclass(frozen=True)
class SlamOptions:
    """Choices of a run.

    Attributes
    ----------
    use_depth : whether to use depth images that belong to the colour pixels, where a recording has them
    extend : let a known map grow, instead of keeping it as it is
    freeze_at : frame number from which the map is kept as it is; never by default
    freeze_when_deforming : keep the map from when something in the scene begins to move or to deform
    restart_after : frames after which a young map that stays lost is given up
    """

    use_depth: bool = True
    extend: bool = False
    freeze_at: int | None = None
    freeze_when_deforming: bool = False
    restart_after: int = 90
