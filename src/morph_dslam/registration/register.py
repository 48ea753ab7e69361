"""Registration of a model's undeformed object in the map of a scene: what `morph register` does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError
from morph_dslam.geometry import RigidTransform, rotation_log
from morph_dslam.io.camera_files import load_camera
from morph_dslam.io.folders import check_free
from morph_dslam.io.landmarks import Landmarks, load_landmarks
from morph_dslam.io.writing import check_no_input
from morph_dslam.model import ReducedModel, load_model
from morph_dslam.registration.board_registration import register_board
from morph_dslam.registration.edges import Sighting
from morph_dslam.registration.guess import load_guess
from morph_dslam.registration.hints import GuessedPose, Hints
from morph_dslam.registration.landmark_binding import (
    FEWEST_FOR_FIT,
    HINT_SURFACE_SHARE,
    check_pixels,
    check_spread,
    on_surface,
)
from morph_dslam.registration.landmark_fit import check_at_rest
from morph_dslam.registration.mesh import MeshRegistration, doubted, register_in_unit, same_size
from morph_dslam.registration.messages import MeshOffSurface, OnlyInBox, OtherSize
from morph_dslam.registration.rectification import inverse_depths_at
from morph_dslam.registration.registration import (
    OTHER_MAP_SHIFT,
    OTHER_MAP_TURN,
    KeyframePose,
    MapRegistration,
    Registration,
    registration_in_map,
)
from morph_dslam.registration.registration_file import load_registration, read_content
from morph_dslam.registration.scene import (
    MapPoints,
    View,
    camera_from_object,
    map_warnings,
    points_and_views,
    views_apart,
    views_of,
)
from morph_dslam.registration.symmetry import turn_warning
from morph_dslam.render.overlay import draw_overlay
from morph_dslam.render.shading import lambert, vertex_normals
from morph_dslam.slam.rolling_shutter import middle_row_pixels, velocities
from morph_dslam.slam.scene import Scene, load_scene
from morph_dslam.threads import one_thread_for_algebra
from morph_dslam.tracking.anchoring import points_on_object

Array = NDArray[np.float64]
#: Landmarks in one frame from which a search begins.
FEWEST_CLICKS = 3
#: Points across and along a box, through a lens whose formula may fold at the rim.
BOX_POINTS = 33
#: Keyframes in the picture of a registration.
N_PICTURES = 3


@one_thread_for_algebra
def register(
    scene: Scene,
    model: ReducedModel,
    beside: Sequence[Registration] = (),
    progress: bool = False,
    *,
    landmarks: Landmarks | str | Path | None = None,
    distance: float | None = None,
    region: tuple[int, tuple[float, float, float, float]] | None = None,
    guess: str | Path | None = None,
) -> Registration:
    """Find a model's undeformed object in a mapped scene by its edges, its shape and its texture.

    Hints of where it is help, each alone or together.

    Parameters
    ----------
    scene : with the map.
    model : of the object.
    beside : other objects in this map, to which the points on them are left.
    progress : whether to show a progress bar.
    landmarks : three or more points of the object in one frame of the map's recording, or more in several frames; or
        the file that has them. They have frame numbers.
    distance : rough distance of the object from the camera, metres; it may be off by half.
    region : number of a keyframe, and left, top, right and bottom of a box around the whole object in it, pixels of the
        image as recorded, with any margin up to half the object's width on each side.
    guess : file that says about where the object is in a frame of the map's recording.

    Raises
    ------
    RegistrationError
        If the object is not found, a hint names a frame without a pose, or landmarks, distance or region cannot be
        right.
    """
    if distance is not None and not 0.0 < distance < np.inf:
        raise RegistrationError(f"the distance of the object is {distance:g} m: it has to be more than nothing")
    hints = Hints(
        () if landmarks is None else _sightings(landmarks, scene, model, guess is not None),
        distance,
        None if region is None else (region[0], _undistorted(region[1], scene.camera)),
        None if guess is None else _guessed(Path(guess), scene),
    )
    claimed = partial(without_points_on, beside)
    points, views = claimed(*points_and_views(scene))
    nodes = model.positions(model.default)
    found = register_in_unit(
        nodes, model.triangles, points, views, scene.camera, scene.is_metric, progress, hints, claimed
    )
    of_map = map_warnings(scene)
    found = doubted(found) if of_map else found
    facts = {
        "from": "map",
        "score": found.score,
        "runner_up_score": found.runner_up,
        "n_explained": found.n_explained,
        "rms_px": found.rms_px,
        "map_units_per_metre": found.world_from_object.scale,
        "outline_share": _outline_share(found),
    }
    in_map = MapRegistration(found.world_from_object, nodes.mean(axis=0), found.covariance)
    keyframes = _keyframes(found, views)
    warnings = (*found.warnings, *of_map)
    if off := mesh_off_surface(model):
        factors = mesh_error_factors(off, nodes, in_map.world_from_object.scale)
        in_map, keyframes = with_mesh_error(in_map, keyframes, factors)
        warnings += (off,)
    if scene.is_metric and not same_size(found.world_from_object.scale):
        warnings += (OtherSize(found.world_from_object.scale),)
    if landmarks is None and guess is None and (turned := turn_warning(model, found.axis)):
        warnings += (turned,)
    if region is not None and found.ambiguous:
        warnings += (OnlyInBox(region[0]),)
    placed = registration_in_map(model, in_map, keyframes, facts, warnings, found.axis, scene)
    return replace(placed, rivals=found.rivals)


def _undistorted(box: tuple[float, float, float, float], camera: Camera) -> tuple[float, float, float, float]:
    """The box around a box in the image as recorded, by left, top, right and bottom, in the undistorted image."""
    left, top, right, bottom = box
    across, along = np.meshgrid(np.linspace(left, right, BOX_POINTS), np.linspace(top, bottom, BOX_POINTS))
    pixels = camera.undistort_pixels(np.column_stack([across.ravel(), along.ravel()]))
    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    if not len(pixels):
        raise RegistrationError("the lens shows nothing in the box that was given")
    (left, top), (right, bottom) = pixels.min(axis=0).tolist(), pixels.max(axis=0).tolist()
    return left, top, right, bottom


def _outline_share(found: MeshRegistration) -> float | None:
    if found.edges is not None:
        return found.edges.share
    return found.outline.share if found.outline.count else None


def _sightings(
    landmarks: Landmarks | str | Path, scene: Scene, model: ReducedModel, has_guess: bool
) -> tuple[Sighting, ...]:
    """Landmarks by frames, with the camera's pose in each; raises RegistrationError if they cannot be right."""
    given = landmarks if isinstance(landmarks, Landmarks) else load_landmarks(Path(landmarks))
    if given.frames is None:
        raise RegistrationError("landmarks in a map need the numbers of their frames: a first column 'frame'")
    check_pixels(scene.camera, given)
    _check_number(given.frames, has_guess)
    surface = on_surface(model, given.points, HINT_SURFACE_SHARE)
    if not has_guess:
        check_spread(model, given.points)
    pixels = np.ascontiguousarray(scene.camera.undistort_pixels(given.pixels))
    sightings, poses, twists = [], _camera_poses(scene), _camera_velocities(scene)
    for frame in np.unique(given.frames).tolist():
        rows = given.frames == frame
        pose = _camera_in(poses, frame, "landmarks")
        there = pixels[rows]
        if frame in twists:
            there = _at_middle_row(scene, pose, twists[frame], there)
        there = np.ascontiguousarray(there)
        if len(there) >= FEWEST_FOR_FIT:
            check_at_rest(model, scene.camera, surface.take(rows), there, np.flatnonzero(rows) + 1)
        sightings.append(Sighting(frame, pose, given.points[rows], there))
    return tuple(sightings)


def _check_number(frames: NDArray[np.int64], has_guess: bool) -> None:
    """Refuse landmarks (k,) in these frames if they are too few to begin from."""
    if not len(frames):
        raise RegistrationError("the landmark file has no landmarks: give three or more in one frame")
    numbers, counts = np.unique(frames, return_counts=True)
    most = int(counts.argmax())
    if counts[most] < FEWEST_CLICKS and not has_guess:
        noun = "landmark" if counts[most] == 1 else "landmarks"
        raise RegistrationError(
            f"{counts[most]} {noun} in frame {numbers[most]}, and in no frame more: three or more in one frame are "
            "needed, or a guess beside them"
        )


def _at_middle_row(scene: Scene, camera_from_world: RigidTransform, twist: Array, pixels: Array) -> Array:
    """Pixels (n, 2) of a frame as of the instant of its middle row, at the depths of the map's points around them."""
    local = camera_from_world.apply(scene.points)
    known = scene.camera.project(local)
    seen = np.isfinite(known).all(axis=1)
    if not seen.any():
        return pixels
    depths = 1.0 / inverse_depths_at(pixels, known[seen], local[seen, 2])
    return middle_row_pixels(scene.camera, np.eye(4), twist, scene.camera.rays(pixels) * depths[:, None], pixels)


def _guessed(path: Path, scene: Scene) -> GuessedPose:
    """A guess, with the camera's pose in its frame."""
    given = load_guess(path)
    if given.guess.frame is None:
        raise RegistrationError(f"{path}: a guess in a map needs the number of its frame, 'frame = N' above [pose]")
    if given.guess.parameters:
        raise RegistrationError(f"{path}: the object is undeformed in a map: leave out [parameters]")
    pose = _camera_in(_camera_poses(scene), given.guess.frame, "guess")
    return GuessedPose(given.guess.frame, pose, given.pose)


def _camera_poses(scene: Scene) -> dict[int, Array]:
    """camera_from_world (4, 4) by the frames that the map has a pose for.

    Keyframes of a map that was known before have numbers of another recording than the path: a number that stands for
    two frames names none.
    """
    poses = dict(zip(scene.trajectory.indices.tolist(), scene.trajectory.camera_from_world, strict=True))
    for keyframe in scene.keyframes:
        other = poses.get(keyframe.index)
        if other is not None and _is_elsewhere(other, keyframe.camera_from_world, scene.points):
            del poses[keyframe.index]
        else:
            poses[keyframe.index] = keyframe.camera_from_world
    return poses


def _is_elsewhere(one: Array, other: Array, points: Array) -> bool:
    """Whether two camera_from_world (4, 4) in a map of points (n, 3) are surely not of one frame."""
    between = one @ np.linalg.inv(other)
    ahead = np.linalg.norm(RigidTransform.from_matrix(other).apply(points), axis=1)
    near = OTHER_MAP_SHIFT * float(np.median(ahead)) if len(points) else 0.0
    turn = np.linalg.norm(rotation_log(np.ascontiguousarray(between[:3, :3])))
    return bool(turn > OTHER_MAP_TURN or np.linalg.norm(between[:3, 3]) > near)


def _camera_velocities(scene: Scene) -> dict[int, Array]:
    """Velocities (6,) of a rolling shutter by frames of its path; none of a global one."""
    path = scene.trajectory
    if not scene.camera.readout_s:
        return {}
    return dict(zip(path.indices.tolist(), velocities(path.timestamps, path.camera_from_world), strict=True))


def _camera_in(poses: dict[int, Array], frame: int, hint: str) -> RigidTransform:
    """The camera's pose in a frame that a hint names; raises RegistrationError if the map has none."""
    if frame not in poses:
        nearest = min(poses, key=lambda other: abs(other - frame))
        raise RegistrationError(
            f"frame {frame} has no pose in the map: set the {hint} in frame {nearest}, the nearest that has one"
        )
    return RigidTransform.from_matrix(poses[frame])


def without_points_on(
    others: Sequence[Registration], points: MapPoints, views: Sequence[View]
) -> tuple[MapPoints, list[View]]:
    """The points and views of a map without the points on objects that are registered in it."""
    left = np.ones(len(points), dtype=bool)
    for other in others:
        if other.map_registration is None:
            raise RegistrationError(f"'{other.model.name}' is not registered in a map: leave it out of beside")
        left &= ~points_on_object(points.positions, other.map_registration, other.model)[0]
    rows = np.cumsum(left) - 1
    seen = [left[view.point_ids] for view in views]
    return points[left], [
        replace(view, point_ids=rows[view.point_ids[kept]], pixels=view.pixels[kept])
        for view, kept in zip(views, seen, strict=True)
    ]


def _keyframes(found: MeshRegistration, views: Sequence[View]) -> list[KeyframePose]:
    """The object's pose in every keyframe, with its covariance and error factors where it was adjusted."""
    adjusted = found.keyframes
    if adjusted is None:
        return [KeyframePose(view.frame, camera_from_object(view, found.world_from_object)) for view in views]
    factors, row = adjusted.error_factors(), {view.frame: k for k, view in enumerate(adjusted.views)}
    poses = []
    for view in views:
        k = row.get(view.frame)
        if k is None:
            poses.append(KeyframePose(view.frame, camera_from_object(view, found.world_from_object)))
        else:
            poses.append(KeyframePose(view.frame, adjusted.poses[k], adjusted.covariance_of(k), factors[k]))
    return poses


def mesh_off_surface(model: ReducedModel) -> MeshOffSurface | None:
    """How far a model's mesh is off the surface that it was made from, as its file says; None if it is not off."""
    found = model.certificate.get("mesh_deviation")
    return found and MeshOffSurface(float(found["volume"]), float(found["mean_m"]))


def mesh_error_factors(off: MeshOffSurface, nodes: Array, scale: float) -> Array:
    """Standard deviations (7,) of log scale, rotation vector (rad) and translation (map units).

    The object is taken for larger or nearer by the cube root of the volume, and the distance may be the same all over
    the side that is seen, which shifts it, or opposite at its ends, which tilts it.

    Parameters
    ----------
    off : how far the mesh is off.
    nodes : (n, 3) of the undeformed mesh, metres.
    scale : map units per metre.
    """
    radius = float(np.sqrt(np.mean(np.sum((nodes - nodes.mean(axis=0)) ** 2, axis=1))))
    return np.array([abs(off.volume) / 3.0, *3 * [off.mean / radius], *3 * [scale * off.mean]])


def with_mesh_error(
    in_map: MapRegistration, keyframes: Sequence[KeyframePose], factors: Array
) -> tuple[MapRegistration, list[KeyframePose]]:
    """A registration and its keyframes' poses with further error factors (7,), which all keyframes have in common."""
    if in_map.covariance is not None:
        in_map = replace(in_map, covariance=in_map.covariance + np.diag(factors**2))
    poses = []
    for view in keyframes:
        more = in_map.slopes(view.pose) * factors
        if view.covariance is not None and view.error_factors is not None:
            both = np.hstack([view.error_factors, more])
            view = replace(view, covariance=view.covariance + more @ more.T, error_factors=both)
        poses.append(view)
    return in_map, poses


def run_registration(
    map_path: str | Path,
    model_path: str | Path,
    camera_path: str | Path,
    output: str | Path,
    beside: Sequence[Path] = (),
    board: str | Path | None = None,
    *,
    landmarks: str | Path | None = None,
    distance: float | None = None,
    region: tuple[int, tuple[float, float, float, float]] | None = None,
    guess: str | Path | None = None,
    overwrite: bool = False,
) -> Registration:
    """Register an object from files to files: ``registration.json``, and ``registration.jpg`` without a board.

    Parameters
    ----------
    map_path : the map.h5 of `morph slam`.
    model_path : a model file.
    camera_path : the camera file of the map.
    output : the folder to write.
    beside : files of registrations of other objects in this map, to which the points on them are left.
    board : file of a board that stands in the scene, to register by; by the mesh if None.
    landmarks, distance, region, guess : hints, as of `register`.
    overwrite : whether to replace a registration that is in the folder.

    Raises
    ------
    RegistrationError
        If the object is not found, a file of ``beside`` is not one of this map, or the folder cannot be
        written, or holds a registration that is not to be replaced, or an input that would be.
    MapError, ModelFileError, CameraError
        If an input cannot be read.
    """
    map_path, model_path, camera_path, output = Path(map_path), Path(model_path), Path(camera_path), Path(output)
    board = None if board is None else Path(board)
    landmarks = None if landmarks is None else Path(landmarks)
    guess = None if guess is None else Path(guess)
    hints: dict[str, Any] = {"landmarks": landmarks, "distance": distance, "region": region, "guess": guess}
    if board is not None and (beside or any(hint is not None for hint in hints.values())):
        raise RegistrationError("a board says where the object is: leave out --beside and the hints")
    names = ("registration.json", "registration.jpg")
    given = [map_path, model_path, str(camera_path).partition("#")[0], *beside, board, landmarks, guess]
    check_no_input([output / name for name in names], given, RegistrationError)
    check_free(output, names, "a registration", overwrite, RegistrationError)
    camera, model = load_camera(camera_path), load_model(model_path)
    others = [_load_beside(path, map_path) for path in beside]
    scene = load_scene(map_path, camera)
    if board is not None:
        registration = register_board(scene, model, board)
    else:
        registration = register(scene, model, others, progress=True, **hints)
    picture = output / "registration.jpg"
    try:
        picture.unlink(missing_ok=True)  # that of a registration before, which a board's has none of
    except OSError as error:
        raise RegistrationError(f"cannot replace {picture}: {error.strerror}") from error
    registration.save(output / "registration.json", map_path, model_path)
    if board is None and not cv2.imwrite(str(picture), draw_registration(registration, scene)):
        raise RegistrationError(f"cannot write the picture {picture}")
    return registration


def _load_beside(path: Path, map_path: Path) -> Registration:
    """The registration of another object; raises RegistrationError if it is of another map."""
    registration, own_map = load_registration(path), read_content(path)["map"]
    if own_map is None or (path.parent / own_map).resolve() != map_path.resolve():
        raise RegistrationError(f"{path} is of another map, {own_map}: register both objects in one map")
    return registration


def registration_line(registration: Registration) -> str:
    """The size of the map's unit, and how well the place is known.

    Scores are left out: those of two searches, with hints and without, measure different things.
    """
    facts: dict[str, Any] = registration.facts
    agreement = "none" if facts["rms_px"] is None else f"{facts['rms_px']:.3f}"
    deviations = registration.pose_deviations()
    stated = "unknown" if deviations is None else f"{1e3 * deviations[0]:.2f}"
    angle = "unknown" if deviations is None else f"{np.degrees(deviations[1]):.2f}"
    return (
        f"map_units_per_metre={facts['map_units_per_metre']:.6g} rms_px={agreement} place_std_mm={stated} "
        f"angle_std_deg={angle} ambiguous={'yes' if registration.ambiguous else 'no'}"
    )


def draw_registration(registration: Registration, scene: Scene) -> NDArray[np.uint8]:
    """Keyframes of the scene side by side, the object drawn over the lower row, coloured by its z."""
    assert registration.map_registration is not None
    model = registration.model
    nodes = model.positions(model.default)
    placed = registration.map_registration.world_from_object
    world = placed.apply(nodes)
    height = 1e3 * nodes[:, 2]
    columns = []
    views = points_and_views(scene)[1]
    views = views_of(nodes, placed, views, scene.camera, len(views)) or views
    for view in views_apart(views, world.mean(axis=0), N_PICTURES, registration.frame):
        local = view.camera_from_world.apply(world)
        image = np.asarray(cv2.cvtColor(view.normalized, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
        drawn = draw_overlay(
            image,
            scene.camera.project(local),
            local[:, 2],
            model.triangles,
            height,
            (float(height.min()), float(height.max())),
            label="z on the object [mm]",
            alpha=0.5,
            brightness=lambert(vertex_normals(local, model.triangles), np.array([-0.4, -0.6, -1.0]), 0.4),
            caption=f"frame {view.frame}",
        )
        columns.append(np.vstack([image, drawn]))
    return np.hstack(columns)
