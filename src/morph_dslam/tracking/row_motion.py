"""A tracked object in the images of a rolling shutter: where its points would be at the middle row's instant.

Rows are recorded one after the other while camera and object move on. An object that moves along the image then looks
stretched or sheared, which a deformable model takes for a deformation. A state is that of the middle row's instant.
A point's path in the image is that through its places in this state and in the last two, and a pixel is moved back
along it by the time of its row. It holds for what the camera, the object and its deformation do alike.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform
from morph_dslam.registration.rectification import rectified_image
from morph_dslam.slam.rolling_shutter import LEAST_GAP_S, MOST_GAP_S, after, row_times, twist_of
from morph_dslam.tracking.outcomes import ReadoutNotUsed
from morph_dslam.tracking.state import State

Array = NDArray[np.float64]
#: Places (p, 2) of points in the image in a state, pixels.
Places = Callable[[State], Array]
#: Rounds in which the row that shows a point is found, from that where it is at the middle row's instant.
ROUNDS = 2


@dataclass(frozen=True)
class RowMotion:
    """How an object moves while a frame is recorded.

    Attributes
    ----------
    camera : with its readout time.
    centre : (3,) of the undeformed object.
    earlier : the states before, the latest first, and how long before the frame, seconds; one or two.
    """

    camera: Camera
    centre: Array
    earlier: tuple[tuple[float, State], ...]

    def seconds(self, pixels: Array) -> Array:
        """When the rows of undistorted pixels (p, 2) are recorded, seconds (p,) after the middle row; NaN is 0."""
        return self.camera.readout_s * np.nan_to_num(row_times(self.camera.distort_pixels(pixels)[:, 1], self.camera))

    def shift(self, places: Places, state: State, recorded: Array) -> Array:
        """How far (p, 2) points have moved on from the middle row's instant to when ``recorded`` (p, 2) was seen.

        Parameters
        ----------
        places : of the points.
        state : in the frame.
        recorded : pixels, in the undistorted image.
        """
        now, seconds = places(state), self.seconds(recorded)[:, None]
        (gap, last), *others = self.earlier
        velocity = (now - places(last)) / gap
        moved = velocity * seconds
        for longer, before in others:
            # Newton's divided differences: the parabola through three places, at the time of the row.
            curvature = (velocity - (places(last) - places(before)) / (longer - gap)) / longer
            moved = moved + curvature * seconds * (seconds + gap)
        return np.nan_to_num(moved)

    def drift(self, places: Places, state: State) -> Array:
        """How far (p, 2) from their places in ``state`` the image shows points."""
        here, moved = places(state), np.zeros(2)
        for _ in range(ROUNDS):
            moved = self.shift(places, state, here + moved)
        return moved

    def since_last(self, last: Array, recorded: Array) -> Array:
        """Pixels (p, 2) at the middle row's instant of points that were at ``last`` (p, 2) in the last state.

        Nothing needs to be known of the state in the frame: what was seen at ``recorded`` moved on evenly.
        """
        gap = self.earlier[0][0]
        return last + (recorded - last) * (gap / (gap + self.seconds(recorded)))[:, None]

    def twist(self, pose: RigidTransform) -> Array:
        """The object's velocity (6,) in the camera's axes at a pose: rotation (rad/s), then translation (m/s)."""
        gap, last = self.earlier[0]
        return twist_of((pose @ last.camera_from_object.inverse).matrix, gap)

    def as_seen(self, state: State) -> State:
        """The state with the pose at the instant of the row that shows the object's centre; for drawing."""
        pose, twist = state.camera_from_object, self.twist(state.camera_from_object)
        middle = pose.apply(self.centre)[None]
        pixel = self.camera.project(middle)
        if not np.isfinite(pixel).all():
            return state
        for _ in range(ROUNDS):
            seconds = self.seconds(pixel)
            pixel = self.camera.project(after(middle, twist[None], seconds))
        turned = RigidTransform.from_matrix(_motion(twist, seconds[0]) @ pose.matrix)
        return replace(state, camera_from_object=turned)

    def rectified(self, grey: NDArray[np.uint8], state: State, positions: Array) -> NDArray[np.uint8]:
        """An undistorted image (h, w) as of the middle row's instant, around ``positions`` (p, 3), camera frame."""
        twist = self.twist(state.camera_from_object)
        return rectified_image(grey, self.camera, twist, self.camera.project(positions), positions[:, 2])


def _motion(twist: Array, seconds: float) -> Array:
    """What a velocity (6,) makes of the camera's axes in some time (4, 4)."""
    result = np.eye(4)
    result[:3, :3] = cv2.Rodrigues(twist[:3] * seconds)[0]
    result[:3, 3] = twist[3:] * seconds
    return result


class StateHistory:
    """Keeps the last states of an object, to tell how it moves in the next frame.

    Parameters
    ----------
    camera : with its readout time; of a global shutter nothing is kept.
    centre : (3,) of the undeformed object.
    """

    def __init__(self, camera: Camera, centre: Array) -> None:
        self._camera, self._centre = camera, centre
        self._states: deque[tuple[float, State]] = deque(maxlen=2)
        self._now: float | None = None
        self._not_used: ReadoutNotUsed | None = None

    @property
    def warnings(self) -> tuple[ReadoutNotUsed, ...]:
        """Of the frame that was asked for last: that its time did not tell how the object moves."""
        return () if self._not_used is None else (self._not_used,)

    def motion(self, timestamp: float | None) -> RowMotion | None:
        """How the object moves in the next frame, whose time is given, seconds; None where nothing tells of it."""
        self._now, self._not_used = timestamp, None
        if self._camera.readout_s and timestamp is None:
            self._not_used = ReadoutNotUsed()
        if not self._camera.readout_s or timestamp is None or not self._states:
            return None
        gaps = np.array([timestamp - then for then, _ in self._states])
        between = np.diff(gaps, prepend=0.0)
        if not LEAST_GAP_S <= between[0] < MOST_GAP_S:
            self._not_used = ReadoutNotUsed(float(between[0]))
            return None
        n_used = 2 if len(gaps) == 2 and LEAST_GAP_S <= between[1] < MOST_GAP_S else 1
        states = [state for _, state in self._states]
        return RowMotion(self._camera, self._centre, tuple(zip(gaps[:n_used].tolist(), states[:n_used], strict=True)))

    def add(self, state: State | None) -> None:
        """Take in the state in the frame that was asked for last; None where it is not known."""
        if state is None or self._now is None:
            self._states.clear()
        elif self._camera.readout_s:
            self._states.appendleft((self._now, state))

    def replace_last(self, state: State) -> None:
        """Take in that the last frame's state is known better, or is known."""
        if self._states:
            self._states.popleft()
        self.add(state)
