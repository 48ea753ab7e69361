"""A second object in a map: the points on those that are registered already are left to them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import RegistrationError
from morph_dslam.io.camera_files import load_camera
from morph_dslam.model import ReducedModel, load_model
from morph_dslam.registration.mesh import POOR_AGREEMENT_PX, MeshRegistration, register_in_unit
from morph_dslam.registration.registration import MapRegistration
from morph_dslam.registration.scene import MapPoints, View, camera_from_object, scene_of_map, spread_views
from morph_dslam.render.overlay import draw_overlay
from morph_dslam.render.shading import lambert, vertex_normals
from morph_dslam.slam.map_files import load_map
from morph_dslam.tracking.anchoring import points_on_object
from morph_dslam.tracking.run_folder import make_folder, write_registration


def left_by_others(
    points: MapPoints, views: Sequence[View], others: Sequence[Path], map_path: Path
) -> tuple[MapPoints, list[View]]:
    """The points and views of a map without the points on objects that are registered in it.

    Parameters
    ----------
    others : files registration.json, of the same map.

    Raises
    ------
    RegistrationError
        If one is missing, of another map, or not one of `morph register`.
    ModelFileError
        If the model that one names cannot be read.
    """
    left = np.ones(len(points), dtype=bool)
    for path in others:
        place, model_path = _placed(path, map_path)
        left &= ~points_on_object(points.positions, place, load_model(model_path))[0]
    return points[left], [_with_points(view, left) for view in views]


def _with_points(view: View, left: NDArray[np.bool_]) -> View:
    """The view of the points that are left, by their new rows."""
    seen, rows = left[view.point_ids], np.cumsum(left) - 1
    return replace(view, point_ids=rows[view.point_ids[seen]], pixels=view.pixels[seen])


def _placed(path: Path, map_path: Path) -> tuple[MapRegistration, Path]:
    """Where a registered object is, and its model."""
    try:
        content = json.loads(path.read_text())
        place, own_map = MapRegistration.from_content(content), path.parent / content["map"]
        model = path.parent / content["model"]
    except OSError as error:
        raise RegistrationError(f"cannot read the registration {path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise RegistrationError(
            f"{path} does not say which object is where in which map ({error}): register it with this version"
        ) from error
    if own_map.resolve() != map_path.resolve():
        raise RegistrationError(f"{path} is of another map, {own_map}: register both objects in one map")
    return place, model


# `morph register`: from a saved map and a model to the place of the object in the map, with a picture.


N_PICTURES = 3


def run_registration(
    map_path: Path, model_path: Path, camera_path: Path, output: Path, beside: Sequence[Path] = ()
) -> dict[str, Any]:
    """Find a model's undeformed object in a map; writes ``registration.json`` and ``registration.jpg``.

    Parameters
    ----------
    map_path : the map.h5 of `morph slam`. model_path : a model file. camera_path : the camera of the map.
    output : the folder to write. beside : registrations of other objects, whose points are left to them.

    Returns
    -------
    The content of ``registration.json``.

    Raises
    ------
    RegistrationError
        If the object is not found, a file of ``beside`` is not one of this map, or the folder cannot be
        written.
    MapError, ModelFileError, CameraError
        If an input cannot be read.
    """
    camera, model = load_camera(camera_path), load_model(model_path)
    rigid_map = load_map(map_path, camera)
    points, views = left_by_others(*scene_of_map(rigid_map), beside, map_path)
    make_folder(output, "the registration", RegistrationError)
    nodes = model.positions(model.default)
    metric = rigid_map.is_metric
    found = register_in_unit(nodes, model.triangles, points, views, camera, metric, progress=True)
    content = _content(found, nodes) | {"keyframes": _keyframes(found, views)}
    content = write_registration(output, content, map_path, model_path)
    cv2.imwrite(str(output / "registration.jpg"), draw_registration(found, model, views, camera))
    return content


def _content(found: MeshRegistration, nodes: NDArray[np.float64]) -> dict[str, Any]:
    content: dict[str, Any] = {
        "world_from_object": found.world_from_object.matrix.tolist(),
        "map_units_per_metre": found.world_from_object.scale,
        "mean_node_m": nodes.mean(axis=0).tolist(),
        "score": found.score,
        "runner_up_score": found.runner_up,
        "ambiguous": found.ambiguous,
        "outline_share": found.outline.share if found.outline.count else None,
        "outline_fits": not found.outline.contradicts,
        "n_explained": found.n_explained,
        "rms_px": found.rms_px,
        "covariance": None if found.covariance is None else found.covariance.tolist(),
        "axis_of_revolution": None,
    }
    if found.axis is not None:
        axis = {"point_m": found.axis.point.tolist(), "direction": found.axis.direction.tolist()}
        content["axis_of_revolution"] = axis
    return content


def _keyframes(found: MeshRegistration, views: Sequence[View]) -> list[dict[str, Any]]:
    """The object's pose in every keyframe, metres, with its covariance where it has one of its own.

    With it, the derivatives of the pose by what all keyframes' errors have in common.
    """
    adjusted = found.keyframes
    error_factors = None if adjusted is None else adjusted.error_factors()
    row = {} if adjusted is None else {view.frame: k for k, view in enumerate(adjusted.views)}
    poses = []
    for view in views:
        pose, covariance = camera_from_object(view, found.world_from_object), None
        if adjusted is not None and view.frame in row:
            pose = adjusted.poses[row[view.frame]]
            covariance = adjusted.covariance_of(row[view.frame]).tolist()
        entry = {"frame": view.frame, "camera_from_object": pose.matrix.tolist(), "covariance": covariance}
        if error_factors is not None and view.frame in row:
            entry["error_factors"] = error_factors[row[view.frame]].tolist()
        poses.append(entry)
    return poses


def remarks(content: dict[str, Any]) -> list[str]:
    """What a reader of the registration must know."""
    lines = []
    if not content.get("outline_fits", True):
        lines.append(
            f"the outline does not fit: the keyframes show only {100 * content['outline_share']:.0f} % of it "
            "where it is; it may be the mesh of another object, and the size of the map's unit wrong. Look "
            "at registration.jpg"
        )
    elif content["ambiguous"]:
        lines.append(
            f"ambiguous: {_why_ambiguous(content)}; look at registration.jpg, and give landmarks if it is wrong"
        )
    if content["axis_of_revolution"] is not None:
        lines.append("the object is a body of revolution: the angle about its axis cannot be seen")
    if content["rms_px"] is None:
        lines.append("the keyframes show too little texture on the object to refine its place")
    return lines


def _why_ambiguous(content: dict[str, Any]) -> str:
    if content["rms_px"] is None:
        return "no image confirms this place, and scenery that has the object's shape in another size would do"
    if content["rms_px"] > POOR_AGREEMENT_PX:
        return f"the keyframes' images differ by {content['rms_px']:.2f} px on it"
    return "another place is nearly as good (see runner_up_score)"


def registration_line(content: dict[str, Any]) -> str:
    """The last line that the command prints."""
    agreement = "none" if content["rms_px"] is None else f"{content['rms_px']:.3f}"
    return (
        f"map_units_per_metre={content['map_units_per_metre']:.6g} score={content['score']:.0f} "
        f"runner_up={content['runner_up_score']:.0f} explained={content['n_explained']} rms_px={agreement} "
        f"ambiguous={'yes' if content['ambiguous'] else 'no'}"
    )


def draw_registration(
    found: MeshRegistration, model: ReducedModel, views: Sequence[View], camera: Camera
) -> NDArray[np.uint8]:
    """Keyframes side by side, the object drawn over the lower row, coloured by its height."""
    nodes = model.positions(model.default)
    world = found.world_from_object.apply(nodes)
    height = 1e3 * (nodes[:, 2] - nodes[:, 2].min())
    columns = []
    for view in spread_views(views, N_PICTURES):
        local = view.camera_from_world.apply(world)
        image = cv2.cvtColor(view.normalized, cv2.COLOR_GRAY2BGR)
        normals = vertex_normals(local, model.triangles)
        drawn = draw_overlay(
            np.asarray(image, dtype=np.uint8),
            camera.project(local),
            local[:, 2],
            model.triangles,
            height,
            (0.0, float(height.max())),
            label="z on the object [mm]",
            alpha=0.5,
            brightness=lambert(normals, np.array([-0.4, -0.6, -1.0]), 0.4),
        )
        columns.append(np.vstack([image, drawn]))
    return np.hstack(columns)
