"""In which pictures of a scan each camera of a rig has the undeformed object, if the rig filmed the scan.

The registration has the object in the first camera's keyframes. What the other cameras filmed in the same
instants shows it too, from where the rig has them; each camera chooses among its own pictures.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

from morph_dslam.camera import PinholeCamera
from morph_dslam.online.attempt import Picture
from morph_dslam.online.estimation.estimator import Estimator
from morph_dslam.online.reference.further_views import FurtherViews, choose_further
from morph_dslam.online.reference.reference_view import KnownView
from morph_dslam.online.several.rig import RigCamera
from morph_dslam.online.slam.frame_images import FrameImages
from morph_dslam.online.slam.options import SlamOptions
from morph_dslam.online.start.scan_pictures import views_of
from morph_dslam.online.tracking_setup import Setup
from morph_dslam.sources import open_source


def further_of_rig(
    setup: Setup, cameras: Sequence[RigCamera], others: Sequence[Path]
) -> list[FurtherViews] | None:
    """What each camera has beside the keyframe that the object is placed in; None where nothing is known.

    Parameters
    ----------
    setup : of the first camera, whose recording shows the map's keyframes. others : the other recordings.
    """
    if setup.further is None or setup.placement is None:
        return None
    model, views = setup.placement.model, views_of(setup.placement, setup.keyframes, setup.seen)
    options, found = setup.tracker_options(setup.placement), [setup.further]
    for part, path in zip(cameras[1:], others, strict=True):
        pictures = pictures_from(path, part.camera, [view.frame for view in views if view.frame is not None])
        own = [
            _seen_by(part, view, pictures[view.frame], len(model.parameters))
            for view in views
            if view.frame in pictures
        ]
        found.append(choose_further(Estimator(model, part.camera), own[0], own[1:], options))
    return found


def pictures_from(path: Path, camera: PinholeCamera, numbers: Collection[int]) -> dict[int, Picture]:
    """Frames of a recording by number, made ready; those that it does not hold are left out.

    Raises
    ------
    SourceError
        If it cannot be read. CameraError if a frame has not the camera's size.
    """
    images, pictures = FrameImages(camera, SlamOptions()), {}
    for frame in open_source(path):
        if frame.index in numbers:
            view = images.prepare(frame.image, frame.index, frame.timestamp)
            pictures[frame.index] = Picture(view.grey, view.flat)
        if frame.index >= max(numbers):
            break
    return pictures


def _seen_by(part: RigCamera, view: KnownView, picture: Picture, n_parameters: int) -> KnownView:
    """The first camera's view as another camera has it, in its own picture."""
    causes = None if view.causes is None else part.chain(n_parameters) @ view.causes
    return replace(view, picture=picture, state=part.seen(view.state), causes=causes)
