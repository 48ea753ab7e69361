"""What trackers are given by scripts: arguments of the right kind, options that suit them, pictures and depth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import ArgumentError, RegistrationError, TrackingError, check_kind
from morph_dslam.model import ReducedModel
from morph_dslam.registration.registration import Registration
from morph_dslam.sources import Frame
from morph_dslam.sources.frames import check_time
from morph_dslam.tracking.hypothesis import Image
from morph_dslam.tracking.options import NO_MAP, TrackerOptions
from morph_dslam.tracking.patches import normalize_contrast

#: Nodes that are farther apart than this share of the object's size belong to different meshes.
OTHER_MESH = 1e-3
#: How much wider than it is seen something occludes, pixels: what is compared of a point reaches as far.
MARGIN_PX = 5


def check_tracker(model: object, registration: object, options: object) -> None:
    """Raise ArgumentError unless these are what a tracker of one or several cameras takes, and of one object."""
    check_kind(model, ReducedModel, "model", "the model that load_model reads from the file")
    given = "what register_landmarks, register_board, register or load_registration returns"
    check_kind(registration, Registration, "registration", given)
    check_kind(options, (TrackerOptions, type(None)), "options", "TrackerOptions(...)")
    assert isinstance(model, ReducedModel)
    assert isinstance(registration, Registration)
    if difference := _difference(model, registration):
        raise ArgumentError(
            f"the registration is of another object than the model '{model.name}': {difference}; give the model that "
            "was registered, or register this one"
        )


def _difference(model: ReducedModel, registration: Registration) -> str:
    """In what the registration's mesh, or its parameters, are not the model's; empty if they are."""
    known = registration.model
    if known is model:
        return ""
    if len(known.nodes) != len(model.nodes):
        return f"its mesh has {len(known.nodes)} nodes, and the model's {len(model.nodes)}"
    apart = float(np.linalg.norm(known.nodes - model.nodes, axis=1).max())
    if apart > OTHER_MESH * np.linalg.norm(np.ptp(model.nodes, axis=0)):
        return f"nodes of its mesh are up to {1e3 * apart:.3g} mm from those of the model's"
    # An angle about an axis that the registration left open is in its model alone.
    names, given = (
        [p.name for p in one.parameters if p.name not in registration.per_sequence] for one in (known, model)
    )
    if names != given:
        return f"its parameters are {', '.join(names) or 'none'}, and the model's {', '.join(given) or 'none'}"
    return ""


def check_camera(camera: object) -> None:
    """Raise ArgumentError unless it is a camera."""
    check_kind(camera, Camera, "camera", "the camera that load_camera reads from the file, or Camera(...)")


def check_pose(options: TrackerOptions, registration: Registration, in_map: bool) -> None:
    """Raise TrackingError unless the options' pose can be had.

    Parameters
    ----------
    options : of the tracker.
    registration : of the object.
    in_map : whether the tracker is given a map, or keyframes of one, beside the registration.
    """
    if options.pose == "still" and registration.scene is not None:
        raise TrackingError(
            "an object in a mapped scene stands still in its map already, and the camera need not: take the pose "
            "'map' or 'fixed' in place of 'still'"
        )
    if options.pose == "fixed" and registration.map_registration is None and not in_map:
        raise TrackingError(f"pose='fixed': {NO_MAP}")


def check_look(registration: Registration, is_given: bool) -> None:
    """Raise RegistrationError if an object was registered in a map, and nothing tells what it looks like there.

    The first frame that is tracked would be taken for the one of the registration, which is a keyframe of the map, and
    every result would be off by what the camera moved between the two.

    Parameters
    ----------
    registration : of the object.
    is_given : whether the tracker is given a picture, keyframes or a map beside the registration.
    """
    if registration.map_registration is not None and registration.scene is None and not is_given:
        of_frame = "" if registration.frame is None else f" of frame {registration.frame}"
        raise RegistrationError(
            "the registration was made in a map, and without its scene a tracker does not know what the object looks "
            "like: read it as load_registration(path, model, scene) with scene = md.load_scene('map.h5', camera), or "
            f"give the picture{of_frame} as reference="
        )


def widened(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """What something occludes: its depth (h, w), infinite where it is not, and that of a margin around it."""
    square = np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8)
    return np.asarray(cv2.erode(depth, square), dtype=np.float32)


def occluders_of(given: object, camera: Camera) -> NDArray[np.float32] | None:
    """What hides the object, as trackers take it: depth (h, w) in the undistorted image, infinite where nothing does.

    Parameters
    ----------
    given : a mask (h, w) of bool in the picture as recorded, True where something hides the object; or the depth (h, w)
        of what may, metres, in the undistorted image: infinite, NaN or 0 where there is nothing; None for neither.
    camera : of the picture.

    Raises
    ------
    CameraError
        If it is neither, or of another size.
    """
    if given is None:
        return None
    where = "occluder_depth (a mask is an array of bool)"
    if isinstance(given, np.ndarray) and given.dtype == np.bool_:
        hidden = given.astype(np.uint8)
        camera.check_image(hidden, where)
        hidden = camera.undistort_unblended(hidden, 0.0)
        # Whatever the object's own depth is, it is in front.
        return widened(np.where(hidden > 0, np.float32(0.0), np.float32(np.inf)))
    depth = camera.checked_depth(given, where).astype(np.float32, copy=False)  # type: ignore[arg-type]
    known = depth > 0.0
    return depth if known.all() else np.where(known, depth, np.float32(np.inf))


@dataclass(frozen=True)
class Picture:
    """A frame, checked.

    Attributes
    ----------
    image : (h, w, 3) or (h, w) uint8, as recorded.
    depth : (h, w) metres; None where there is none, or it is not used.
    """

    image: NDArray[np.uint8]
    depth: NDArray[Any] | None = None

    @classmethod
    def of(cls, frame: Frame | NDArray[np.uint8], camera: Camera, use_depth: bool = False) -> Picture:
        """What a tracker takes of a frame, or of its image alone.

        Raises
        ------
        CameraError
            If the image is not one of the camera's, or the depth, if it is to be used, is not one that belongs to it.
        SourceError
            If a frame's time is no number of seconds.
        """
        if not isinstance(frame, Frame):
            return cls(camera.checked_picture(frame, "the frame"))
        where = f"frame {frame.index}"
        check_time(frame, where)
        depth = frame.depth if use_depth else None
        if depth is not None:
            depth = camera.checked_depth(depth, f"the depth of {where}")
        return cls(camera.checked_picture(frame.image, where), depth)

    @property
    def grey(self) -> NDArray[np.uint8]:
        """(h, w)."""
        if self.image.ndim == 2:
            return np.ascontiguousarray(self.image)
        return np.asarray(cv2.cvtColor(self.image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)

    def made_ready(self, undistortion: tuple[NDArray[Any], NDArray[Any]] | None) -> Image:
        """As trackers compare it: without distortion, by the camera's maps, and of even contrast."""
        grey = self.grey
        if undistortion is not None:
            grey = np.asarray(cv2.remap(grey, *undistortion, interpolation=cv2.INTER_LINEAR), dtype=np.uint8)
        return Image(grey, normalize_contrast(grey))
