"""A textured wedge on a table, seen from around, with exact poses: images, map points, and who saw them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from morph_dslam.camera import Camera
from morph_dslam.geometry import RigidTransform
from morph_dslam.registration.scene import MapPoints, View, camera_from_object
from morph_dslam.render.model_view import looking_at
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.render.texture import render_textured
from morph_dslam.tracking.patches import normalize_contrast
from tests.support.bent_sheet import grid_triangles
from tests.support.rendered_sequence import printed_texture

CAMERA = Camera(480, 360, 420.0, 420.0, 239.5, 179.5)
#: Corners of the wedge, metres: no two of its views from around are alike.
_CORNERS = np.array(
    [
        [0, 0, 0], [0.09, 0, 0], [0.09, 0.06, 0], [0, 0.06, 0],
        [0.01, 0.01, 0.05], [0.05, 0.01, 0.03], [0.05, 0.05, 0.045], [0.01, 0.05, 0.07],
    ]
)  # fmt: skip
_FACES = [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]


def wedge(cells=8):
    """Nodes (n, 3), outward triangles (m, 3), and texture coordinates (n, 2), each face cut into cells."""
    nodes, triangles, coordinates, offset = [], [], [], 0
    a, b = (x.ravel() for x in np.meshgrid(np.linspace(0, 1, cells + 1), np.linspace(0, 1, cells + 1)))
    for number, face in enumerate(_FACES):
        c = _CORNERS[list(face)]
        weights = np.column_stack([(1 - a) * (1 - b), a * (1 - b), a * b, (1 - a) * b])
        nodes.append(weights @ c)
        triangles.append(grid_triangles(cells + 1, cells + 1) + offset)
        coordinates.append(np.column_stack([a, b]) * 150.0 + [150.0 * (number % 3) + 20, 160.0 * (number // 3) + 20])
        offset += len(a)
    nodes, triangles = np.concatenate(nodes), np.concatenate(triangles)
    # Nodes on shared edges are one, so that the surface is closed; textures may tear there.
    unique, first, inverse = np.unique(nodes.round(9), axis=0, return_index=True, return_inverse=True)
    return unique, inverse.ravel()[triangles], np.concatenate(coordinates)[first]


def cameras(n=8, distance=0.32, turn=1.6):
    """Poses camera_from_object of cameras around the object, looking down at it."""
    return [
        looking_at(np.array([0.04, 0.03, 0.025]), np.array([np.cos(a), np.sin(a), -0.6]), distance)
        for a in np.linspace(0.3, 0.3 + turn, n)
    ]


def visible_in(pose, points, nodes, triangles):
    """Pixels (n, 2) of points (n, 3), and which of them the mesh does not hide."""
    local, mesh = pose.apply(points), pose.apply(nodes)
    depth = rasterise(CAMERA.project(mesh), mesh[:, 2], triangles, CAMERA.height, CAMERA.width).depth
    pixels = CAMERA.project(local)
    columns, rows = np.rint(pixels).astype(int).T
    inside = (columns >= 0) & (columns < CAMERA.width) & (rows >= 0) & (rows < CAMERA.height)
    seen = np.zeros(len(points), dtype=bool)
    seen[inside] = local[inside, 2] <= depth[rows[inside], columns[inside]] + 2e-3
    return pixels, seen


#: Where one wedge stands.
ONE = (np.zeros(3),)


def scanned(world_from_object, objects=ONE, noise=3e-4, seed=0, with_images=False):
    """Map points and views of a table and wedges at ``objects`` (3,) on it, in the unit of the world.

    The map's points have noise (metres) in every direction.
    """
    rng = np.random.default_rng(seed)
    nodes, triangles, coordinates = wedge()
    scene = np.concatenate([nodes + place for place in objects]) if objects else np.zeros((0, 3))
    scene_triangles = np.concatenate(
        [triangles + k * len(nodes) for k in range(len(objects))] or [np.zeros((0, 3), dtype=np.int64)]
    )
    table = np.column_stack([rng.uniform(-0.15, 0.25, 400), rng.uniform(-0.15, 0.2, 400), np.zeros(400)])
    parts = [table]
    for place in objects:
        corners = nodes[triangles]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        chosen = rng.choice(len(areas), 320, p=areas / areas.sum())
        on_surface = np.einsum("pc,pcx->px", rng.dirichlet(np.ones(3), 320), corners[chosen])
        parts.append(on_surface[on_surface[:, 2] > 2e-3] + place)
    points = np.concatenate(parts)
    texture = normalize_contrast(printed_texture(400, 520, seed), 31)
    views, count, places = [], np.zeros(len(points)), np.zeros((len(points), 3))
    for pose in cameras():
        pixels, seen = visible_in(pose, points, scene, scene_triangles)
        normalized = np.full((CAMERA.height, CAMERA.width), 128, dtype=np.uint8)
        if with_images:
            local = pose.apply(scene)
            drawn = rasterise(CAMERA.project(local), local[:, 2], scene_triangles, CAMERA.height, CAMERA.width)
            image = render_textured(drawn, scene_triangles, np.tile(coordinates, (len(objects), 1)), texture)
            normalized = np.where(drawn.covered, image, np.uint8(128)).astype(np.uint8)
        camera_from_world = _camera_from_world(pose, world_from_object)
        views.append(View(len(views), normalized, camera_from_world, np.flatnonzero(seen), pixels[seen]))
        count[seen] += 1
        places[seen] += camera_from_world.inverse.translation
    kept = count >= 2
    rows = np.cumsum(kept) - 1
    views = [
        View(
            v.frame,
            v.normalized,
            v.camera_from_world,
            rows[v.point_ids[kept[v.point_ids]]],
            v.pixels[kept[v.point_ids]],
        )
        for v in views
    ]
    noisy = points + noise * rng.standard_normal(points.shape)
    return MapPoints(world_from_object.apply(noisy[kept]), places[kept] / count[kept, None]), views


def _camera_from_world(camera_from_object, world):
    """The rigid pose in the world's unit: camera lengths are scaled as the world is."""
    rotation = camera_from_object.rotation @ world.rotation.T
    translation = world.scale * camera_from_object.translation - rotation @ world.translation
    return RigidTransform(rotation, translation)


def shaded(views, world_from_object):
    """The views with images of a wedge whose faces have a grey each, before a grey table, with a little noise."""
    nodes, triangles, _ = wedge()
    rng, corners = np.random.default_rng(0), nodes[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    grey = 120.0 + normals @ [60.0, 35.0, 20.0]
    images = []
    for view in views:
        local = camera_from_object(view, world_from_object).apply(nodes)
        drawn = rasterise(CAMERA.project(local), local[:, 2], triangles, CAMERA.height, CAMERA.width, closed=True)
        image = np.where(drawn.covered, grey[drawn.triangle_ids], 200.0) + rng.normal(0.0, 2.0, drawn.covered.shape)
        image = cv2.GaussianBlur(image, (0, 0), 0.7)
        images.append(replace(view, normalized=normalize_contrast(image.clip(0, 255).astype(np.uint8))))
    return images
