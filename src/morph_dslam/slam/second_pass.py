"""The camera in a recording's frames that came before its map, or were lost, found in the finished map.

From one moving camera a map begins only when the views have moved apart: until then no frame has a pose. The first
view is one of the map's keyframes, so that these frames are found once the map is there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from morph_dslam.slam.options import LEAST_INLIERS
from morph_dslam.slam.result import SlamFrame, SlamStatus
from morph_dslam.slam.slam import Slam
from morph_dslam.sources import FrameSource

#: A pose that was not found when the frame came needs more points: chance agreement of a few is likelier there, in the
#: dark say, and no frame after it would tell.
LATE_INLIERS = 2 * LEAST_INLIERS


def find_rest(slam: Slam, frames: Sequence[SlamFrame], source: FrameSource) -> list[SlamFrame]:
    """Records of all frames of a map, with poses for those that had none where the finished map shows their camera.

    They keep the times and the numbers of their first pass.

    Parameters
    ----------
    slam : what made the map, which is finished
    frames : what each frame gave when it came
    source : the recording that they are of

    Raises SourceError if the recording cannot be read again.
    """
    missing = {frame.index: row for row, frame in enumerate(frames) if not slam.is_placed(frame)}
    if not slam.map.keyframes or not missing:
        return list(frames)
    records, finder, last = list(frames), slam.finder(), max(missing)
    for image in source:
        if image.index in missing:
            row = missing[image.index]
            found = finder.process_frame(image.image, image.index, image.timestamp, image.depth, image.right)
            if found.pose is not None and found.n_points >= LATE_INLIERS:
                times = {name: getattr(frames[row], name) for name in ("timings_ms", "total_ms", "waited_ms")}
                records[row] = replace(found.record(is_final=False), status=SlamStatus.FOUND_LATER, **times)
        if image.index == last:
            break
    return records
