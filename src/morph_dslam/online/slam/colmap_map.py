"""A map from a COLMAP model and the images that it was made from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import MapError
from morph_dslam.io.colmap_model import ColmapImage, ColmapModel
from morph_dslam.online.slam.descriptors import OCTAVES, describe
from morph_dslam.online.slam.frame_images import FrameImages, FrameView
from morph_dslam.online.slam.options import SlamOptions
from morph_dslam.online.slam.pose import reprojection_errors
from morph_dslam.online.slam.projection import inside
from morph_dslam.online.slam.rigid_map import GOOD, Followed, Keyframe, RigidMap
from morph_dslam.sources import FrameSource

Array = NDArray[np.float64]

#: Observations that miss their points by more are left out; if half of them do, the cameras differ.
MOST_ERROR_PX = 4.0


def map_from_colmap(
    model: ColmapModel, source: FrameSource, images: FrameImages, options: SlamOptions
) -> RigidMap:
    """The points of a model, with the frames of a recording that are its images as keyframes.

    A frame is an image if its number is the last one in the image's name. Lengths are the model's.

    Raises
    ------
    MapError
        If none of the frames is an image of the model, or its points are not where the camera has them.
    """
    wanted = {image.number: image for image in model.images}
    rigid_map, errors, numbers = RigidMap(), [], []
    nowhere = np.zeros((len(model.points), 2))
    rigid_map.add_points(model.points, nowhere, 0, GOOD)
    for frame in source:
        numbers.append(frame.index)
        if frame.index in wanted:
            view = images.prepare(frame.image, frame.index, frame.timestamp)
            errors.append(_add_keyframe(rigid_map, wanted[frame.index], view, model, images, options))
    if not rigid_map.keyframes:
        raise MapError(
            f"none of the {len(wanted)} images of the COLMAP model ({min(wanted)}-{max(wanted)}, by the "
            f"numbers in their names) is among the frames {numbers[0]}-{numbers[-1]} of {source.name}: "
            "give the recording that it was made from with --images"
        )
    typical = float(np.median(np.concatenate(errors)))
    if not typical < MOST_ERROR_PX:
        raise MapError(
            f"the points of the COLMAP model miss their pixels by {typical:.1f} px in {source.name}: give "
            "the camera that it was made with (--camera MODEL/cameras.txt), and its own images with --images"
        )
    rigid_map.remove(np.flatnonzero(rigid_map.n_observations() < 1))
    return rigid_map


def _add_keyframe(
    rigid_map: RigidMap,
    image: ColmapImage,
    view: FrameView,
    model: ColmapModel,
    images: FrameImages,
    options: SlamOptions,
) -> Array:
    """Add an image of the model; returns by how much its points (n, 3) miss their pixels (n,)."""
    # A point may have several keypoints in an image: the first counts.
    ids, rows = np.unique(image.point_ids, return_index=True)
    pixels = images.camera.undistort_pixels(image.pixels[rows])
    intrinsics = np.asarray(images.camera.intrinsics)
    errors = reprojection_errors(image.camera_from_world, model.points[ids], pixels, intrinsics)
    good = (errors < MOST_ERROR_PX) & inside(pixels, view.flat.shape, options.patch_half + 2)
    seen = Followed(ids, pixels)[good]
    keyframe = Keyframe(
        view.index, view.timestamp, view.flat, image.camera_from_world, seen.ids, seen.pixels, seen.right
    )
    rigid_map.add_keyframe(keyframe)
    described, keyframe.descriptors = describe(view.grey, keyframe.pixels, OCTAVES)
    keyframe.described_ids = keyframe.point_ids[described]
    return errors
