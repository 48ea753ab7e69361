"""The camera as a tracked object shows it, where no map of the scene has checked it.

The points that were followed are taken as those of a rigid object: what the estimated deformation moves them by in the
image is taken out. Their places, the poses and the camera are then adjusted together, as for a map of a scene. What the
registration and the model's mesh are off by is alike in all frames and would pass for a wrong camera: it is adjusted,
too, as far as its deviations let it. What else a model of a deformation is off by looks like a wrong principal point or
lens: an object that deforms checks the focal length and the readout time only. The latter shows even where the model
fails, which may be because of it: what it does grows with the row and with the velocity, and changes its sign with
both.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.slam.camera_terms import TERMS, CameraEstimate, CameraTerm
from morph_dslam.slam.rigid_map import GOOD, Followed, RigidMap
from morph_dslam.slam.self_calibration import OffByFactors, estimate_camera
from morph_dslam.tracking.refinement import Keyframe
from morph_dslam.tracking.state import BoundPoints

Array = NDArray[np.float64]
#: What an object that deforms can check.
OF_DEFORMABLE: tuple[CameraTerm, ...] = ("focal", "readout")


class CameraCheck:
    """Keeps where an object's points were seen, frame by frame, to estimate the camera from them.

    Parameters
    ----------
    camera : as given.
    deforms : whether the object has parameters.
    """

    def __init__(self, camera: Camera, deforms: bool) -> None:
        self._camera, self._terms = camera, OF_DEFORMABLE if deforms else TERMS
        self._rest = np.empty((0, 3))
        self._times: list[float] = []
        self._world_from_camera: list[Array] = []
        self._seen: list[Followed] = []
        self._off: list[OffByFactors] = []

    def add(self, timestamp: float, points: BoundPoints, seen: Keyframe, errors: OffByFactors | None = None) -> None:
        """Take in a frame.

        Parameters
        ----------
        timestamp : seconds, later than those before.
        points : p of the first reference view, the same in all frames.
        seen : where the frame shows them.
        errors : by how much what their deformation moves them by is off; None where nothing is known of that.
        """
        if len(points) != len(seen.pixels) or (len(self._rest) and not np.array_equal(points.rest, self._rest)):
            return
        pose = seen.state.camera_from_object
        deformed, rest = (
            self._camera.project(local) for local in (points.in_camera(seen.state), pose.apply(points.rest))
        )
        # What the readout time does is to be seen, not what is left of it.
        pixels = (seen.pixels if seen.recorded is None else seen.recorded) - deformed + rest
        ids = np.flatnonzero((seen.weights > 0.0) & np.isfinite(pixels).all(axis=1))
        self._rest = points.rest
        self._times.append(timestamp)
        self._world_from_camera.append(pose.inverse.matrix)
        self._seen.append(Followed(ids, pixels[ids]))
        if errors is not None:
            self._off.append(errors)

    def estimate(self, model_fails: bool = False) -> CameraEstimate | None:
        """The camera by all frames; None where they tell nothing.

        ``model_fails`` : whether the model leaves residuals in some of them.
        """
        if not self._seen:
            return None
        points = RigidMap()
        points.add_points(self._rest, np.zeros((len(self._rest), 2)), 0, GOOD)
        path = Trajectory(np.array(self._times), np.array(self._world_from_camera))
        off = self._off if len(self._off) == len(self._seen) else None
        found = estimate_camera(points, self._camera, path, self._seen, self._terms, off)
        if not model_fails:
            return found
        readout = found.terms["readout"]
        return CameraEstimate(self._camera, {"readout": readout}) if readout.is_wrong else None
