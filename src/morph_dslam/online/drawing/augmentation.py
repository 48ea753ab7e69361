"""The augmented video of a run: every frame with the object over it, in one range of colours."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from morph_dslam.camera import PinholeCamera
from morph_dslam.io.video import VideoWriter
from morph_dslam.online.drawing.augmented_view import AugmentedView, with_caption
from morph_dslam.online.runs.results import RunResults
from morph_dslam.sources import FrameSource

#: At most so many states are looked at for the range of colours.
MOST_STATES = 60


def write_video(
    path: Path, source: FrameSource, camera: PinholeCamera, run: RunResults, view: AugmentedView
) -> None:
    """Draw every frame of the run; hidden and lost frames are shown as they are, with the reason."""
    states = run.states()
    known = [state for state in states if state is not None]
    limits = view.range_of(known[:: max(1, len(known) // MOST_STATES)])
    maps = camera.undistortion_maps()
    # The source comes last: zip then stops before it asks for a frame that may be missing.
    rows = zip(states, run.results, source, strict=False)
    with VideoWriter(path, source.fps, (camera.width, camera.height)) as video:
        for state, result, frame in tqdm(rows, total=len(run), desc="drawing", unit="frame"):
            image = frame.image
            if maps is not None:
                image = np.asarray(cv2.remap(image, *maps, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
            if state is None:
                video.write(with_caption(image, f"frame {frame.index}: {result.reason}"))
            else:
                video.write(view.draw(image, state, limits, f"frame {frame.index}", result.discrepancy))
