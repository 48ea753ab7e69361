"""From which keyframes to look for points, where any that saw them will do.

Each keyframe costs as much as some hundred points: its image pyramid is built anew. In a map that grows the
newest keyframe is the template of nearly all points in view; in one that is complete they come from many.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.online.slam.rigid_map import Indices, RigidMap

Array = NDArray[np.float64]

#: Keyframes chosen for most points; one that adds fewer points than this is not worth its image.
MOST_VIEWS, LEAST_POINTS = 4, 10


class FewTemplates:
    """Chooses templates in a complete map."""

    def __init__(self, rigid_map: RigidMap) -> None:
        self._map = rigid_map
        self._seen = np.concatenate([keyframe.point_ids for keyframe in rigid_map.keyframes])
        counts = [len(keyframe.point_ids) for keyframe in rigid_map.keyframes]
        self._seen_by = np.repeat(np.arange(len(counts)), counts)

    def choose(self, ids: Indices) -> tuple[Indices, Array]:
        """Keyframe (n,) and pixels (n, 2) there to look for each point from.

        Keyframes that show most of the points left are taken one after the other; the last points keep the
        map's templates.
        """
        views, pixels = self._map.template_keyframe[ids], self._map.template_pixels[ids]
        left, n_keyframes = np.ones(len(ids), dtype=bool), len(self._map.keyframes)
        wanted = np.zeros(len(self._map.state), dtype=bool)
        for _ in range(MOST_VIEWS):
            wanted[:] = False
            wanted[ids[left]] = True
            counts = np.bincount(self._seen_by[wanted[self._seen]], minlength=n_keyframes)
            best = int(counts.argmax())
            if counts[best] < LEAST_POINTS:
                break
            keyframe = self._map.keyframes[best]
            rows, seen = keyframe.rows_of(ids)
            seen &= left
            views[seen], pixels[seen] = best, keyframe.pixels[rows[seen]]
            left &= ~seen
        return views, pixels
