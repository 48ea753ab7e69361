"""The start: the object placed by clicked pairs of a point on the mesh and a pixel, and what is drawn over an image.

These functions run in the worker process.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morph_dslam import Camera, ReducedModel, Registration, load_camera, load_model, register_landmarks
from morph_dslam.errors import CameraError, RegistrationError, StudioError
from morph_dslam.explorer.server import BadRequest, ModelPages
from morph_dslam.extend.geometry import RigidTransform
from morph_dslam.extend.models import shown_kind
from morph_dslam.extend.registration import Landmarks, bind_landmarks, load_landmarks, save_landmarks
from morph_dslam.extend.tracking import State
from morph_dslam.io.camera_files import save_camera
from morph_dslam.io.packing import packed
from morph_dslam.studio.project import part_of, read_once, stamp
from morph_dslam.units import from_si

Array = NDArray[np.float64]
#: Pairs that a page may send.
MOST_PAIRS = 500
#: Fewer pairs than these do not give a pose.
FEWEST_PAIRS = 4
#: A quick fit that is worse than this, pixels, is fitted anew from all starts.
GOOD_PX = 3.0


@read_once(2)  # that of the project, and that of its run
def opened_model(path: Path) -> ReducedModel:
    """A model file, read once."""
    return load_model(path)


@read_once(2)
def opened_camera(path: Path) -> Camera:
    """A camera file, read once."""
    return load_camera(path)


def camera_facts(path: Path) -> dict[str, Any]:
    """What a page shows of a camera."""
    camera = opened_camera(path)
    return {
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "distortion": list(camera.distortion),
        "lens": camera.lens_model,
    }


def take_camera(path: Path, target: Path) -> None:
    """Write the camera of a file, which may be of another program, as a camera file of this one.

    How a file is read depends on its ending, which the target's may not be. Raises CameraError if it cannot be read.
    """
    part = part_of(target)
    save_camera(part, load_camera(path))
    part.replace(target)


def camera_problem(path: Path, width: int, height: int) -> str | None:
    """Why a camera file is not of a recording with images of a size; None if it may be."""
    try:
        opened_camera(path).check_image(np.broadcast_to(np.uint8(0), (height, width)), "the recording")
    except CameraError as error:
        return str(error)
    return None


def model_facts(path: Path) -> dict[str, Any]:
    """Name, sizes, errors and parameters of a model; ``factor`` turns SI into a parameter's own unit.

    That of ``stress`` turns the unit in which people read it into SI.
    """
    model = opened_model(path)
    stress = shown_kind(model, "stress")
    parameters = [
        {
            "name": p.name,
            "description": p.description,
            "unit": "" if p.unit == "1" else p.unit,
            "factor": from_si(1.0, p.unit, p.quantity),
            "lower": p.lower,
            "upper": p.upper,
            "default": p.default,
        }
        for p in model.parameters
    ]
    return {
        "name": model.name,
        "nodes": len(model.nodes),
        "parameters": parameters,
        "stress": {"unit": stress.unit, "factor": stress.si_factor} if model.stresses else None,
        "supports": sorted(model.supports),
    }


def model_surface(path: Path) -> bytes:
    """The undeformed surface of a model: ``nodes`` (n, 3) in metres and ``triangles`` (t, 3)."""
    model = opened_model(path)
    used, corners = _surface(model)
    return packed({"name": model.name}, nodes=model.nodes[used], triangles=corners)


def _surface(model: ReducedModel) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Nodes (n,) of the surface, and its triangles (t, 3) of positions among them."""
    used, corners = np.unique(model.triangles, return_inverse=True)
    return used, corners.reshape(-1, 3)


#: The state that was fitted last, by what it was fitted to.
_last: dict[tuple, State] = {}


def fit_clicks(
    model_path: Path, camera_path: Path, pairs: Sequence[Sequence[float]], at_rest: bool, quick: bool = False
) -> bytes:
    """The pose and the parameters that pairs give, how well each pair fits, and the overlay.

    Parameters
    ----------
    model_path, camera_path : files.
    pairs : (k, 5) millimetres on the undeformed object, then pixels of the image as recorded.
    at_rest : whether the object is undeformed in the image.
    quick : whether to start from the last fit alone, as long as that leads to a good one; a fit of the same pairs that
        is not quick finds what else they may mean.

    Returns
    -------
    Facts: ``residuals_px`` (k,), ``rms_px``, ``worst`` position, ``parameters`` in SI, ``warnings``; and what
    `overlay` returns. Without a fit, ``message`` says why.
    """
    landmarks = landmarks_of(pairs)
    missing = FEWEST_PAIRS - len(pairs)
    if missing > 0:
        return packed({"message": f"click {missing} more pair{'s' if missing > 1 else ''}"})
    model, camera = opened_model(model_path), opened_camera(camera_path)
    key = (model_path, stamp(model_path), camera_path, stamp(camera_path), at_rest)
    near = _last.get(key) if quick else None
    found = _registered(model, camera, landmarks, at_rest, near)
    _last.clear()
    _last[key] = found.state
    positions = _positions_of(model, landmarks.points, found.state.parameters)
    seen = camera.project_recorded(found.state.camera_from_object.apply(positions))
    residuals = np.linalg.norm(seen - landmarks.pixels, axis=1)
    facts = {
        "residuals_px": residuals.tolist(),
        "rms_px": float(np.sqrt(np.mean(residuals**2))),
        "worst": int(residuals.argmax()),
        "parameters": dict(zip((p.name for p in model.parameters), found.state.parameters.tolist(), strict=True)),
        "warnings": [warning.text for warning in found.warnings],
    }
    return _overlay(model_path, camera, found.state.parameters, found.state.camera_from_object, facts)


def _registered(
    model: ReducedModel, camera: Camera, landmarks: Landmarks, at_rest: bool, near: State | None
) -> Registration:
    """The object placed by landmarks, from a state close by if that will do."""
    if near is not None:
        with suppress(RegistrationError):  # there may be a better start
            found = register_landmarks(model, camera, landmarks, at_rest=at_rest, near=near)
            if found.facts["residual_rms_px"] <= GOOD_PX:
                return found
    return register_landmarks(model, camera, landmarks, at_rest=at_rest)


def landmarks_of(pairs: Sequence[Sequence[float]]) -> Landmarks:
    """Pairs of a page as landmarks; raises StudioError if they are none."""
    try:
        table = np.array(pairs, dtype=np.float64).reshape(-1, 5)
    except (TypeError, ValueError, OverflowError):
        raise StudioError("pairs are lists of five numbers: x, y, z in millimetres, u, v in pixels") from None
    if len(table) > MOST_PAIRS or not np.isfinite(table).all():
        raise StudioError(f"pairs are at most {MOST_PAIRS}, of finite numbers")
    return Landmarks(1e-3 * table[:, :3], np.ascontiguousarray(table[:, 3:]))


def _positions_of(model: ReducedModel, points: Array, mu: Array) -> Array:
    """Deformed positions (k, 3) of points near the undeformed surface, by `register_landmarks`'s own binding."""
    bound = bind_landmarks(model, points)
    return bound.rest + bound.field.value(mu)


def overlay(model_path: Path, camera_path: Path, parameters: Sequence[float], pose: Sequence[Sequence[float]]) -> bytes:
    """A model over an image, as recorded.

    Parameters
    ----------
    model_path, camera_path : files.
    parameters : (d,) SI.
    pose : (4, 4) camera_from_object, metres.

    Returns
    -------
    ``pixels`` (n, 2) of the surface's nodes, ``order`` (t,) of its triangles that face the camera, from the farthest to
    the nearest, ``values`` (n,) von Mises stress or displacement in ``unit``, ``displacement`` (n, 3) in metres.
    """
    transform = RigidTransform.from_matrix(np.array(pose, dtype=np.float64))
    return _overlay(model_path, opened_camera(camera_path), np.array(parameters), transform, {})


def _overlay(path: Path, camera: Camera, mu: Array, camera_from_object: RigidTransform, facts: dict[str, Any]) -> bytes:
    model = opened_model(path)
    used, triangles = _surface(model)
    displacement = model.displacement.value(mu)[used]
    points = camera_from_object.apply(model.nodes[used] + displacement)
    pixels = camera.project_recorded(points)
    corners = points[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    centres = corners.mean(axis=1)
    seen = np.isfinite(pixels[triangles]).all(axis=(1, 2))
    if model.cells:  # only solids have a back
        seen &= np.einsum("tx,tx->t", normals, centres) < 0.0
    order = np.flatnonzero(seen)[np.argsort(-centres[seen, 2])]
    if model.stresses:
        kind = shown_kind(model, "stress")
        values, unit = model.von_mises(mu)[used] / kind.si_factor, kind.unit
    else:
        values, unit = 1e3 * np.linalg.norm(displacement, axis=1), "mm"
    return packed(
        facts | {"unit": unit, "top": _top(path), "largest": float(values.max())},
        pixels=np.nan_to_num(pixels),
        order=order,
        values=values,
        displacement=displacement,
    )


@read_once(1)
def _pages(path: Path) -> ModelPages:
    return ModelPages(opened_model(path))


def explore_answer(path: Path, target: str) -> tuple[str, bytes] | None:
    """What `morph explore` answers to a path and query (content type, content), None where it has nothing."""
    try:
        return _pages(path).answer(target)
    except BadRequest as error:
        raise StudioError(str(error)) from error


def _top(path: Path) -> float:
    """The end of the colours, one for the whole box as in `morph explore`."""
    tops = {field.unit: field.top for field in _pages(path).surface.fields}
    in_mm = tops.pop("mm")
    return next(iter(tops.values()), in_mm)


@read_once(2)
def landmarks_problem(model_path: Path, path: Path) -> str | None:
    """Why the object of a model cannot be placed by a file of landmarks, as `morph track` says; None if it may be."""
    try:
        bind_landmarks(opened_model(model_path), load_landmarks(path).points)
    except RegistrationError as error:
        return f"{path.name} does not fit {model_path.name}: {error}"
    return None


def save_clicks(pairs: Sequence[Sequence[float]], target: Path) -> None:
    """Write pairs as the file of landmarks that `morph track` takes."""
    save_landmarks(target, landmarks_of(pairs))


def read_clicks(path: Path) -> list[list[float]]:
    """Pairs of a file of landmarks; empty if there is none."""
    if not path.is_file():
        return []
    found = load_landmarks(path)
    return np.column_stack([1e3 * found.points, found.pixels]).tolist()
