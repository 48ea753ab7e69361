"""Rendered films of a textured room with boxes, a plane, or nothing, with exact camera poses."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from morph_dslam.camera import Camera
from morph_dslam.geometry import fit_similarity
from morph_dslam.io.camera_files import save_camera
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.render.texture import render_textured
from morph_dslam.sources import Frame
from tests.support.bent_sheet import grid_triangles
from tests.support.rendered_sequence import printed_texture

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
#: Texture pixels a metre: about one for each pixel of the image at the usual distance of 2.5 m.
DENSITY = 210.0


def _rectangle(corner, right, down, texture_corner, cells=12):
    """Nodes, triangles and texture coordinates of a rectangle, cut so that clipping loses little."""
    corner, right, down = (np.asarray(x, dtype=float) for x in (corner, right, down))
    a, b = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 1, cells + 1), np.linspace(0, 1, cells + 1)))
    nodes = corner + a[:, None] * right + b[:, None] * down
    size = DENSITY * np.array([np.linalg.norm(right), np.linalg.norm(down)])
    return nodes, grid_triangles(cells + 1, cells + 1), np.column_stack([a, b]) * size + texture_corner


def _box(centre, size, rng):
    """The front, the sides, the top and the bottom of a box."""
    corners = {  # of the face: left, top and depth in halves of the size, then its sides
        "front": ((-1, -1, -1), (2, 0, 0), (0, 2, 0)),
        "left": ((-1, -1, 1), (0, 0, -2), (0, 2, 0)),
        "right": ((1, -1, -1), (0, 0, 2), (0, 2, 0)),
        "top": ((-1, -1, 1), (2, 0, 0), (0, 0, -2)),
        "bottom": ((-1, 1, -1), (2, 0, 0), (0, 0, 2)),
    }
    half = np.asarray(size) / 2.0
    faces = [(centre + half * a, half * b, half * c) for a, b, c in corners.values()]
    return [_rectangle(*face, rng.uniform(0, 600, 2), cells=4) for face in faces]


def room(rng):
    """Walls 4 m apart, the far one at 4 m, a floor, and boxes before them; y points down, z away."""
    parts = [
        _rectangle([-2, -1.5, 4], [4, 0, 0], [0, 2.8, 0], [0, 0]),
        _rectangle([-2, -1.5, 0], [0, 0, 4], [0, 2.8, 0], [300, 500]),
        _rectangle([2, -1.5, 4], [0, 0, -4], [0, 2.8, 0], [500, 200]),
        _rectangle([-2, 1.3, 4], [4, 0, 0], [0, 0, -4], [100, 600]),
    ]
    for centre in ([-0.9, 0.8, 2.6], [0.6, 0.6, 3.0], [1.2, -0.5, 2.4], [-0.3, -0.6, 3.2]):
        parts += _box(centre, rng.uniform(0.4, 0.8, 3), rng)
    return parts


def wall(_rng):
    """One plane, turned a little."""
    return [_rectangle([-3.0, -2.5, 2.2], [6.0, 0, 0.9], [0, 5.0, 0.2], [0, 0])]


def checkerboard(_rng):
    """The plane of `wall`, with squares of 9 cm all over: `RoomFilm` prints them for this scene."""
    return wall(_rng)


#: Metres after which the print of `repeated_wall` repeats itself: more than the camera sees at once.
PERIOD = 3.2


def repeated_wall(_rng):
    """A wall of 12 m, straight ahead, whose print repeats itself from left to right."""
    return [_rectangle([-3.0, -2.5, 2.4], [12.0, 0, 0], [0, 5.0, 0], [0, 0], cells=24)]


def room_with_sheet(rng):
    """The room with a sheet 1.6 m before the camera: the last part, of `SHEET_NODES` nodes."""
    return [*room(rng), _rectangle([-0.45, -0.35, 1.6], [0.9, 0, 0.1], [0, 0.7, 0], [650, 250])]


SHEET_NODES = 169


def closed_room(_rng):
    """Four walls 4 m apart around the origin, each with a print of its own, for a round trip."""
    return [
        _rectangle([-2, -1.4, 2], [4, 0, 0], [0, 2.8, 0], [0, 0]),
        _rectangle([2, -1.4, 2], [0, 0, -4], [0, 2.8, 0], [900, 0]),
        _rectangle([2, -1.4, -2], [-4, 0, 0], [0, 2.8, 0], [0, 900]),
        _rectangle([-2, -1.4, -2], [0, 0, 4], [0, 2.8, 0], [900, 900]),
    ]


def round_trip(n, radius=0.8, turns=1.08, bob=0.1):
    """Poses (n, 4, 4) of a camera that goes sideways first, then round a circle, and looks outwards."""
    n_sideways = 16
    sideways = [pose((x, 0.2 * x, radius)) for x in np.linspace(-0.35, 0.0, n_sideways, endpoint=False)]
    angles = 2.0 * np.pi * turns * np.linspace(0.0, 1.0, n - n_sideways)
    places = [(radius * np.sin(a), bob * np.sin(3.0 * a), radius * np.cos(a)) for a in angles]
    return np.array([*sideways, *(pose(p, (0.0, a, 0.0)) for p, a in zip(places, angles, strict=True))])


class RoomFilm:
    """Renders a scene, by default the `room`, from given places; ``prints`` different ones side by side.

    ``nodes`` may be moved between frames.
    """

    def __init__(self, seed=0, scene=room, camera=CAMERA, prints=1):
        self.rng, self.camera = np.random.default_rng(seed), camera
        parts = scene(self.rng)
        offsets = np.cumsum([0, *(len(nodes) for nodes, _, _ in parts)])
        self.nodes = np.concatenate([nodes for nodes, _, _ in parts])
        self.triangles = np.concatenate([t + o for (_, t, _), o in zip(parts, offsets, strict=False)])
        self.coordinates = np.concatenate([coordinates for _, _, coordinates in parts])
        if scene is checkerboard:
            squares = np.indices((95, 95)).sum(axis=0) % 2 == 0
            self.texture = np.kron(np.where(squares, 30, 220), np.ones((19, 19))).astype(np.uint8)
            return
        if scene is repeated_wall:
            self.texture = np.tile(printed_texture(1050, round(DENSITY * PERIOD), seed), (1, 4))
            return
        tiles = [printed_texture(900, 900, seed + 100 * (i % prints)) for i in range(4)]
        self.texture = np.block([tiles[:2], tiles[2:]])

    def frame(self, world_from_camera, noise=2.0, light=1.0):
        """Grey image (h, w) uint8."""
        buffers = self._rasterised(world_from_camera)
        image = light * render_textured(buffers, self.triangles, self.coordinates, self.texture).astype(float)
        image += noise * self.rng.standard_normal(image.shape)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    def depth(self, world_from_camera, noise=0.2):
        """Depth (h, w), metres, NaN where there is nothing; ``noise`` pixels of disparity at 8 cm."""
        scale = 0.08 * self.camera.fx
        disparity = scale / self._rasterised(world_from_camera).depth.astype(float)
        disparity += noise * self.rng.standard_normal(disparity.shape)
        return np.where(disparity > 0.5, scale / np.maximum(disparity, 0.5), np.nan).astype(np.float32)

    def _rasterised(self, world_from_camera):
        camera = self.camera
        local = (self.nodes - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]
        return rasterise(camera.project(local), local[:, 2], self.triangles, camera.height, camera.width)


def pose(position, rotation_vector=(0.0, 0.0, 0.0)):
    """world_from_camera (4, 4)."""
    result = np.eye(4)
    result[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    result[:3, 3] = position
    return result


def hand_held(n, seed=0, reach=0.5):
    """Poses (n, 4, 4) of a camera that sways and turns smoothly; ``reach`` metres to either side."""
    rng = np.random.default_rng(seed)
    time, phase = np.linspace(0.0, 1.0, n), rng.uniform(0.0, 0.6, 6)
    waves = np.sin(2.0 * np.pi * np.outer(time, [0.9, 0.7, 0.5, 0.6, 0.8, 0.5]) + phase) - np.sin(phase)
    positions = waves[:, :3] * [reach, 0.4 * reach, 0.5 * reach]
    turns = waves[:, 3:] * [0.06, 0.22, 0.05]
    return np.array([pose(p, t) for p, t in zip(positions, turns, strict=True)])


class Film:
    """Images as a recording in memory, 30 a second; ``more`` are further fields of each `Frame`."""

    name, fps = "film", 30.0

    def __init__(self, images, more=None, first=0):
        more = more or [{}] * len(images)
        self.frames = [
            Frame(first + i, (first + i) / 30.0, image, **m)
            for i, (image, m) in enumerate(zip(images, more, strict=True))
        ]
        self.has_registered_depth = any("depth" in m for m in more)

    def __len__(self):
        return len(self.frames)

    def __iter__(self):
        return iter(self.frames)


def follow(slam, images, more=None, first=0):
    """What `Slam` makes of each image."""
    frames = Film(images, more, first).frames
    return [slam.process_frame(f.image, f.index, f.timestamp, f.depth, f.right) for f in frames]


def write_film(folder, images, camera=CAMERA):
    """Images as numbered PNG files in ``film``, and ``camera.yaml``."""
    (folder / "film").mkdir(parents=True)
    for index, image in enumerate(images):
        cv2.imwrite(str(folder / "film" / f"{index:04d}.png"), image)
    save_camera(folder / "camera.yaml", camera)


def to_truth(trajectory, truth):
    """The similarity transform from a path to the true poses (n, 4, 4), by its frame numbers."""
    return fit_similarity(trajectory.positions, truth[trajectory.indices][:, :3, 3])


def path_errors(trajectory, truth):
    """Distances of the camera's centres after Sim(3), in parts of the length of the true path."""
    expected = truth[trajectory.indices][:, :3, 3]
    found = to_truth(trajectory, truth).apply(trajectory.positions)
    return np.linalg.norm(found - expected, axis=1) / np.linalg.norm(np.diff(expected, axis=0), axis=1).sum()


def off_the_walls(points):
    """How far points (n, 3) are outside of the room's walls, x = -2, 2, and z = 4, and its floor, y = 1.3, metres."""
    return np.maximum.reduce([np.abs(points[:, 0]) - 2.0, points[:, 2] - 4.0, points[:, 1] - 1.3])


def near_box(rng):
    """A large box 1.2 m before a wall at 3 m."""
    return [
        _rectangle([-3.0, -2.5, 3.0], [6.0, 0, 0.3], [0, 5.0, 0.2], [0, 0]),
        *_box(np.array([0.1, 0.15, 1.4]), np.array([0.5, 0.45, 0.4]), rng),
    ]


def rolling_frames(film, path, readout, bands=12):
    """Images by a rolling shutter of a camera on a path.

    ``path`` (k, 4, 4) has ``bands`` poses a frame interval; rows are read in ``readout`` intervals around a frame's.
    """
    images, height = [], film.camera.height
    edges = np.linspace(0, height, bands + 1).astype(int)
    for middle in range(bands, len(path) - bands, bands):
        image = np.empty((height, film.camera.width), dtype=np.uint8)
        for first, last in itertools.pairwise(edges.tolist()):
            instant = middle + bands * readout * (0.5 * (first + last) / height - 0.5)
            image[first:last] = film.frame(between(path, instant))[first:last]
        images.append(image)
    return images


def between(path, instant):
    """The pose of a path (k, 4, 4) at an instant between two of its poses."""
    k = int(np.clip(np.floor(instant), 0, len(path) - 2))
    turns = Slerp([0.0, 1.0], Rotation.from_matrix(path[k : k + 2, :3, :3]))
    result = np.eye(4)
    result[:3, :3] = turns(instant - k).as_matrix()
    result[:3, 3] = path[k, :3, 3] + (instant - k) * (path[k + 1, :3, 3] - path[k, :3, 3])
    return result
