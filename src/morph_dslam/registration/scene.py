"""A map of the rigid scene as registration takes it: points with where they were seen from, and views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform, SimilarityTransform
from morph_dslam.registration.messages import MapNotRigid
from morph_dslam.registration.rectification import rectified_image
from morph_dslam.slam.rigid_map import GOOD
from morph_dslam.slam.rolling_shutter import middle_row_pixels
from morph_dslam.slam.scene import Scene
from morph_dslam.slam.scene_rigidity import SceneNotRigid
from morph_dslam.tracking.depth import SCALE_STD

Array = NDArray[np.float64]
#: A view sees an object of which at least this part projects into its image.
SEEN_SHARE = 0.5
#: Standard deviation of what all lengths of a metric map are off by together, a share: as much as all depths are.
METRIC_SCALE_STD = SCALE_STD


@dataclass(frozen=True)
class MapPoints:
    """Points (n, 3) of a map, and from where (n, 3) each was seen, world."""

    positions: Array
    viewpoints: Array

    def __getitem__(self, rows: NDArray) -> MapPoints:
        return MapPoints(self.positions[rows], self.viewpoints[rows])

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True)
class View:
    """A keyframe.

    Attributes
    ----------
    frame : its number in the recording.
    normalized : (h, w) uint8 its contrast-normalized image, undistorted.
    camera_from_world : its pose.
    point_ids : (k,) rows of the map points seen.
    pixels : (k, 2) where.
    depths : (m, 3) column, row and depth, metres, where a depth image measured it.
    """

    frame: int
    normalized: NDArray[np.uint8]
    camera_from_world: RigidTransform
    point_ids: NDArray[np.int64]
    pixels: Array
    depths: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 3), dtype=np.float32))


def map_warnings(scene: Scene) -> tuple[MapNotRigid, ...]:
    """What a scene's map says against all that is placed in it."""
    return tuple(MapNotRigid(found.correlation) for found in scene.notices if isinstance(found, SceneNotRigid))


def points_and_views(scene: Scene) -> tuple[MapPoints, Sequence[View]]:
    """Points and views of a scene's map; each point's viewpoint is the mean place of the keyframes that saw it.

    What a rolling shutter recorded is moved to the instant of the middle row, which the poses belong to.
    """
    rigid_map = scene.map
    good = np.flatnonzero(rigid_map.state == GOOD)
    row = np.full(len(rigid_map.state), -1)
    row[good] = np.arange(len(good))
    views, total, count = [], np.zeros((len(good), 3)), np.zeros(len(good))
    for keyframe in (rigid_map.keyframes[k] for k in rigid_map.kept_keyframes):
        pose = RigidTransform.from_matrix(keyframe.camera_from_world)
        seen = row[keyframe.point_ids]
        kept = seen >= 0
        view = View(keyframe.index, keyframe.normalized, pose, seen[kept], keyframe.pixels[kept], keyframe.depths)
        views.append(_of_one_instant(view, scene.camera, keyframe.twist, rigid_map.positions[good]))
        total[seen[kept]] += pose.inverse.translation
        count[seen[kept]] += 1.0
    used = count > 0
    everywhere = total.sum(axis=0) / max(count.sum(), 1.0)
    viewpoints = np.where(used[:, None], total / np.maximum(count, 1.0)[:, None], everywhere)
    return MapPoints(rigid_map.positions[good], viewpoints), views


def _of_one_instant(view: View, camera: Camera, twist: Array, positions: Array) -> View:
    """A view of a rolling shutter as of the middle row's instant; as it is if the camera's velocity (6,) is unknown."""
    if not camera.readout_s or not np.isfinite(twist).all():
        return view
    seen = positions[view.point_ids]
    pixels = middle_row_pixels(camera, view.camera_from_world.matrix, twist, seen, view.pixels)
    known, depths = view.pixels, view.camera_from_world.apply(seen)[:, 2]
    samples = view.depths
    if len(samples):
        known, depths = samples[:, :2].astype(float), samples[:, 2].astype(float)
        samples = samples.copy()
        samples[:, :2] = middle_row_pixels(camera, np.eye(4), twist, camera.rays(known) * depths[:, None], known)
    image = rectified_image(view.normalized, camera, twist, known, depths)
    return replace(view, normalized=image, pixels=pixels, depths=samples)


def spread_views(views: Sequence[View], most: int) -> list[View]:
    """At most so many of the views, spread over all."""
    chosen = np.unique(np.linspace(0, len(views) - 1, min(most, len(views))).round().astype(int))
    return [views[index] for index in chosen]


def views_apart(views: Sequence[View], point: Array, most: int, kept: int | None = None) -> list[View]:
    """At most so many of the views, in their order, that look at a point from the most different sides.

    Parameters
    ----------
    views : to choose from.
    point : (3,) world.
    most : how many.
    kept : frame of the one that is chosen first, if it is among them.
    """
    centres = np.array([view.camera_from_world.inverse.translation for view in views]).reshape(-1, 3)
    directions = (centres - point) / np.linalg.norm(centres - point, axis=1)[:, None]
    chosen = [next((k for k, view in enumerate(views) if view.frame == kept), 0)] if views else []
    while len(chosen) < min(most, len(views)):
        nearest = (directions @ directions[chosen].T).max(axis=1)
        nearest[chosen] = np.inf
        chosen.append(int(nearest.argmin()))
    return [views[k] for k in sorted(chosen)]


class HasPose(Protocol):
    """What has a camera's pose in the map."""

    @property
    def camera_from_world(self) -> RigidTransform:
        """The pose."""
        ...


def camera_from_object(view: HasPose, world_from_object: SimilarityTransform) -> RigidTransform:
    """The object's pose in a view, metres."""
    camera, placed = view.camera_from_world, world_from_object
    return RigidTransform(camera.rotation @ placed.rotation, camera.apply(placed.translation) / placed.scale)


def views_of(nodes: Array, placed: SimilarityTransform, views: Sequence[View], camera: Camera, most: int) -> list[View]:
    """At most so many of the views that have the object in their image, spread over all.

    ``nodes`` are its (n, 3), metres.
    """
    seeing = []
    for view in views:
        local = camera_from_object(view, placed).apply(nodes[:: max(1, len(nodes) // 200)])
        pixels = camera.project(local)
        inside = (local[:, 2] > 0.0) & ((pixels >= 0.0) & (pixels < [camera.width, camera.height])).all(axis=1)
        if inside.mean() >= SEEN_SHARE:
            seeing.append(view)
    return spread_views(seeing, most)
