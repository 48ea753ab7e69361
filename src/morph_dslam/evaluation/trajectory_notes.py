"""Mistakes in camera paths that their comparison shows: conventions of poses, clocks, units."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from morph_dslam.io.trajectory import Trajectory
from morph_dslam.sources.recorded import DEPTH_SCALE

Array = NDArray[np.float64]
#: Another convention is meant if with it turns differ by so many times less, and by more than so many degrees without.
CLEARLY, LEAST_DEG = 3.0, 1.0
#: Turns are compared over this part of the path.
SPAN = 0.1
#: Fewer pairs than this part of the shorter path are worth a word.
FEW_PAIRS = 0.5
#: Metric paths are alike in size up to this factor.
ALIKE = 1.25


def pose_notes(estimate: Trajectory, truth: Trajectory) -> Iterator[str]:
    """What is wrong with the poses of matched paths, if those of one are of another convention."""
    own, true = (path.world_from_camera[:, :3, :3] for path in (estimate, truth))
    given = _turn_difference(own, true)
    others = {
        "the poses of one path are inverted, camera from world: save them as world from camera": (
            _turn_difference(own, true.transpose(0, 2, 1))
        ),
        "the quaternions of the truth begin with qw: write qx qy qz qw": _turn_difference(own, _with_w_first(true)),
        "the quaternions of the estimate begin with qw: write qx qy qz qw": _turn_difference(_with_w_first(own), true),
    }
    text = min(others, key=lambda name: others[name])
    if given > max(CLEARLY * others[text], LEAST_DEG):
        yield f"{text}; the turns of the paths then differ by {others[text]:.2g} degrees, not by {given:.2g}"


def pair_notes(n_pairs: int, estimate: Trajectory, truth: Trajectory) -> Iterator[str]:
    """What a reader must know if few poses of the whole paths belong together in time."""
    if n_pairs < FEW_PAIRS * min(len(estimate), len(truth)):
        yield (
            f"only {n_pairs} of {len(estimate)} poses have a true one at their time, and the errors are theirs: "
            f"{clock_advice(estimate, truth)}"
        )


def clock_advice(estimate: Trajectory, truth: Trajectory) -> str:
    """What to do if few poses of the paths belong together in time."""
    whole = [bool((path.timestamps % 1.0 == 0.0).all()) for path in (estimate, truth)]
    if whole[0] != whole[1]:
        numbered = "estimate" if whole[0] else "truth"
        return f"the {numbered} is stamped with whole numbers, of frames probably: stamp it with seconds"
    return "give the truth of this recording, on its clock"


def size_notes(scale: float, rigid_rmse: float, similar_rmse: float) -> Iterator[str]:
    """What is wrong with the unit of a metric path.

    Parameters
    ----------
    scale : of the similarity, truth over estimate
    rigid_rmse, similar_rmse : of the positions after the rigid motion, and after the similarity
    """
    if not 1.0 / ALIKE < scale < ALIKE and similar_rmse < 0.5 * rigid_rmse:
        yield (
            f"the true path is {scale:.4g} times as large as the estimated one: in a metric map correct {DEPTH_SCALE}, "
            "or the baseline of the stereo pair"
        )


def _turn_difference(first: Array, second: Array) -> float:
    """Root mean square difference between the turns of two series of rotations (n, 3, 3), degrees."""
    step = max(1, int(SPAN * len(first)))
    turns = [rotations[:-step].transpose(0, 2, 1) @ rotations[step:] for rotations in (first, second)]
    angles = Rotation.from_matrix(turns[0].transpose(0, 2, 1) @ turns[1]).magnitude()
    return float(np.degrees(np.sqrt(np.mean(angles**2))))


def _with_w_first(rotations: Array) -> Array:
    """What (n, 3, 3) their files meant if the quaternions in these begin with qw."""
    return Rotation.from_quat(np.roll(Rotation.from_matrix(rotations).as_quat(), -1, axis=1)).as_matrix()
