"""A tracked object in the images of a rolling shutter: where its points would be at the middle row's instant.

Rows are recorded one after the other while camera and object move on. An object that moves along the image then looks
stretched or sheared, which a deformable model takes for a deformation. A state is that of the middle row's instant.
A point's path in the image is that through its places in this state and in the last two, and a pixel is moved back
along it by the time of its row. It holds for what the camera, the object and its deformation do alike. The states must
be of one kind: by the texture's points alone, which have the error of their reference in common, or with what an
outline, depths and earlier frames tell beside these. The difference of the two kinds would pass for a motion.
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
    by_points : those of the same frames by the texture's points alone; empty where they are the same.
    now : the state in the frame of which ``earlier`` are, where others move alike; None for each by itself.
    """

    camera: Camera
    centre: Array
    earlier: tuple[tuple[float, State], ...]
    by_points: tuple[State, ...] = ()
    now: State | None = None

    @property
    def of_points(self) -> RowMotion:
        """The same, for a state by the texture's points alone."""
        if not self.by_points:
            return self
        gaps = [gap for gap, _ in self.earlier]
        return replace(self, earlier=tuple(zip(gaps, self.by_points, strict=True)), by_points=())

    def moving_as(self, by_points: State) -> RowMotion:
        """The same, for any state near that by the texture's points alone: the object moves as that does.

        What an outline tells beside these is found anew in each frame, and its errors would pass for a motion.
        """
        return replace(self.of_points, now=by_points)

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
        now, seconds = places(state if self.now is None else self.now), self.seconds(recorded)[:, None]
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
        """Pixels (p, 2) at the middle row's instant of points that were at ``last`` (p, 2) in the last state by them.

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


@dataclass(frozen=True)
class _Kept:
    """A frame's time, seconds, its state, and that by the texture's points alone."""

    time: float
    state: State
    by_points: State


class StateHistory:
    """Keeps the last states of an object, to tell how it moves in the next frame.

    Parameters
    ----------
    camera : with its readout time; of a global shutter nothing is kept.
    centre : (3,) of the undeformed object.
    """

    def __init__(self, camera: Camera, centre: Array) -> None:
        self._camera, self._centre = camera, centre
        self._states: deque[_Kept] = deque(maxlen=2)
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
        gaps = np.array([timestamp - kept.time for kept in self._states])
        between = np.diff(gaps, prepend=0.0)
        if not LEAST_GAP_S <= between[0] < MOST_GAP_S:
            self._not_used = ReadoutNotUsed(float(between[0]))
            return None
        n_used = 2 if len(gaps) == 2 and LEAST_GAP_S <= between[1] < MOST_GAP_S else 1
        used = list(self._states)[:n_used]
        earlier = tuple(zip(gaps[:n_used].tolist(), [kept.state for kept in used], strict=True))
        return RowMotion(self._camera, self._centre, earlier, tuple(kept.by_points for kept in used))

    def add(self, state: State | None, by_points: State | None = None) -> None:
        """Take in the state in the frame that was asked for last; None where it is not known.

        ``by_points`` : that by the texture's points alone; None where it is the same.
        """
        if state is None or self._now is None:
            self._states.clear()
        elif self._camera.readout_s:
            self._states.appendleft(_Kept(self._now, state, by_points or state))

    def replace_last(self, state: State) -> None:
        """Take in that the last frame's state is known better, or is known."""
        self.add(state, self._states.popleft().by_points if self._states else None)

    def change_points(self, by_points: State | None) -> None:
        """Take in that other points are followed from now on.

        ``by_points`` : the last frame's state by these alone; None where the states so far have bound them.
        """
        if by_points is not None and self._states:
            self._states = deque([replace(self._states[0], by_points=by_points)], maxlen=2)
        else:
            self._states = deque([replace(kept, by_points=kept.state) for kept in self._states], maxlen=2)
