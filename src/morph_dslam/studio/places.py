"""A place of the object in the map of a scan: its evidence in words, and the object over keyframes.

These functions run in the worker process.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from morph_dslam import Registration, Scene, load_registration, load_scene
from morph_dslam.errors import StudioError
from morph_dslam.extend.geometry import RigidTransform
from morph_dslam.extend.registration import Landmarks, save_landmarks
from morph_dslam.studio import clicks
from morph_dslam.studio.clicks import opened_camera, opened_model
from morph_dslam.studio.project import read_once

#: Points of the object that stand for another place, spread over it.
_N_POINTS = 12


@read_once(1)
def _scene(path: Path, camera: Path) -> Scene:
    return load_scene(path, opened_camera(camera))


def map_keyframes(path: Path, camera: Path) -> list[int]:
    """Frame numbers of a map's keyframes."""
    return sorted(keyframe.index for keyframe in _scene(path, camera).keyframes)


def _registration(model: Path, path: Path) -> Registration:
    found = load_registration(path, opened_model(model))
    if found.map_registration is None:
        raise StudioError(f"{path.name} is of no map: find the object in the map of the scan")
    return found


def place_facts(model: Path, path: Path) -> dict[str, Any]:
    """What speaks for a place and against it; ``rivals`` are scores of other places over its own.

    Parameters
    ----------
    model : file.
    path : registration.json.
    """
    found = _registration(model, path)
    facts: dict[str, Any] = found.facts
    share, rms, score = facts.get("outline_share"), facts.get("rms_px"), facts["score"]
    evidence = []
    if share is not None:
        evidence.append(f"{share:.0%} of the clear stretches of its outline lie on edges of the keyframes.")
    if rms is not None:
        evidence.append(f"On it, the images of the keyframes agree to {rms:.2f} px.")
    if "n_explained" in facts:
        evidence.append(f"{facts['n_explained']} points of the map lie on its surface.")
    return {
        "ambiguous": found.ambiguous,
        "warnings": [warning.text for warning in found.warnings],
        "evidence": evidence,
        "rivals": [None if score <= 0 else rival.score / score for rival in found.rivals],
    }


def _pose(
    model: Path, camera: Path, map_path: Path, path: Path, frame: int | None, rival: int | None
) -> RigidTransform:
    """The object's pose in a keyframe, at the place that was found or at a rival."""
    found = _registration(model, path)
    keyframe = next((each for each in found.keyframes if each.frame == frame), None)
    if keyframe is None:
        numbers = ", ".join(str(each.frame) for each in found.keyframes)
        raise StudioError(f"frame {frame} is no keyframe of the map; these are: {numbers}")
    if rival is None:
        return keyframe.pose
    if rival >= len(found.rivals):
        raise StudioError(f"there is no other place {rival}: there are {len(found.rivals)}")
    assert found.map_registration is not None
    in_map = replace(found.map_registration, world_from_object=found.rivals[rival].world_from_object)
    (view,) = (each for each in _scene(map_path, camera).keyframes if each.index == frame)
    return in_map.pose_in(view.camera_from_world)


def place_overlay(model: Path, camera: Path, map_path: Path, path: Path, frame: int, rival: int | None = None) -> bytes:
    """The undeformed object over a keyframe, as `clicks.overlay`.

    Parameters
    ----------
    model, camera, map_path, path : files of the model, the camera, the map and the registration.
    frame : number of the keyframe.
    rival : number of another place; the one that was found by default.
    """
    pose = _pose(model, camera, map_path, path, frame, rival)
    return clicks.overlay(model, camera, opened_model(model).default.tolist(), pose.matrix.tolist())


def save_rival(model: Path, camera: Path, map_path: Path, path: Path, frame: int, rival: int, target: Path) -> None:
    """Write points of the object and where they are in a keyframe at another place, to register it there.

    Parameters
    ----------
    model, camera, map_path, path : files of the model, the camera, the map and the registration.
    frame : number of the keyframe.
    rival : number of the place.
    target : file of landmarks with frames.
    """
    pose, opened = _pose(model, camera, map_path, path, frame, rival), opened_model(model)
    lens, points = opened_camera(camera), opened.nodes[np.unique(opened.triangles)]
    there = pose.apply(points)
    pixels = lens.project_recorded(there)
    inside = (there[:, 2] > 0) & (pixels >= 0).all(axis=1) & (pixels < [lens.width, lens.height]).all(axis=1)
    chosen = np.flatnonzero(inside)
    if len(chosen) < clicks.FEWEST_PAIRS:
        raise StudioError(f"keyframe {frame} does not see the object at that place: take another keyframe")
    chosen = chosen[_spread(points[chosen])]
    save_landmarks(target, Landmarks(points[chosen], pixels[chosen], np.full(len(chosen), frame)))


def _spread(points: np.ndarray) -> list[int]:
    """Numbers of a few points, each the farthest from those before."""
    chosen = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())]
    nearest = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(_N_POINTS, len(points)):
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen


def save_pairs(pairs: Sequence[Sequence[float]], frame: int, target: Path) -> None:
    """Write pairs of a keyframe as a file of landmarks with frames."""
    landmarks = clicks.landmarks_of(pairs)
    save_landmarks(target, replace(landmarks, frames=np.full(len(landmarks.points), frame)))
