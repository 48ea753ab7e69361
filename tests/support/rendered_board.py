"""Pictures of printed boards by the project's rasteriser, through any lens, with exact truth."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from morph_dslam.geometry import RigidTransform
from morph_dslam.registration.board import FiducialBoard
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.render.scene_renderer import supersampled
from morph_dslam.render.texture import render_textured

#: Texels in a square, and mesh cells in one, so fine that lens distortion is straight within a cell.
TEXELS, CELLS = 24, 4
TEXELS_PER_METRE = 2000
SUPERSAMPLING = 3


def _texture(board):
    """The board with a white margin of one square; the square at the first corner is dark."""
    squares = np.full((board.rows + 3, board.columns + 3), 230, dtype=np.uint8)
    row, column = np.mgrid[: board.rows + 1, : board.columns + 1]
    squares[1:-1, 1:-1] = np.where((row + column) % 2 == 0, 25, 230)
    return np.kron(squares, np.ones((TEXELS, TEXELS), dtype=np.uint8))


def board_image(camera, board, camera_from_board, seed=0, blur=0.7, noise=1.5):
    """The picture (h, w, 3) of a checkerboard whose first inner corner is its origin."""
    cells = (CELLS * (board.columns + 3), CELLS * (board.rows + 3))
    return print_image(
        camera, _texture(board), cells, board.square / CELLS, 2.0 * board.square, camera_from_board, seed
    )


def fiducial_image(camera, board, camera_from_board, seed=0):
    """The picture (h, w, 3) of a board of markers with a white margin of half a pitch."""
    printed = board.image(TEXELS_PER_METRE)
    margin = round(0.5 * board.pitch * TEXELS_PER_METRE)
    texture = np.clip(np.pad(printed, margin, constant_values=255), 25, 230)
    cell = 0.01
    cells = [int(np.ceil(side / (cell * TEXELS_PER_METRE))) for side in texture.shape[::-1]]
    missing = [round(n * cell * TEXELS_PER_METRE) - side for n, side in zip(cells, texture.shape[::-1], strict=True)]
    texture = np.pad(texture, [(0, missing[1]), (0, missing[0])], constant_values=230)
    return print_image(camera, texture, cells, cell, margin / TEXELS_PER_METRE, camera_from_board, seed)


def print_image(camera, texture, cells, cell, margin, camera_from_print, seed=0, blur=0.7, noise=1.5):
    """The picture (h, w, 3) of a flat print: texels (h, w), cells (columns, rows) with sides of ``cell`` metres.

    The print's frame has its origin ``margin`` metres inside of the texture's upper left corner.
    """
    columns, rows = cells
    v, u = np.mgrid[: rows + 1, : columns + 1]
    at = np.column_stack([u.ravel(), v.ravel()]).astype(float)
    nodes = np.column_stack([cell * at - margin, np.zeros(len(at))])
    first = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    below = first + columns + 1
    triangles = np.concatenate(
        [np.column_stack([first, first + 1, below]), np.column_stack([first + 1, below + 1, below])]
    )
    fine = supersampled(camera, SUPERSAMPLING)
    points = camera_from_print.apply(nodes)
    buffers = rasterise(fine.project_recorded(points), points[:, 2], triangles, fine.height, fine.width)
    texels = texture.shape[1] / columns
    image = render_textured(buffers, triangles, texels * at - 0.5, texture)
    image[~buffers.covered] = 120
    image = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(image, (0, 0), blur).astype(float)
    image += noise * np.random.default_rng(seed).standard_normal(image.shape)
    return cv2.cvtColor(np.clip(np.rint(image), 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)


def board_poses(camera, board, n_views, largest_tilt, seed=0, fill=0.45):
    """Poses in which the whole board, with its margin, is in the image; tilts up to ``largest_tilt`` degrees.

    ``fill`` is about the part of the image's width that the board fills.
    """
    rng = np.random.default_rng(seed)
    middle = board.points.mean(axis=0)
    margin = board.square * np.array([[-2, -2], [-2, board.rows + 1], [board.columns + 1, -2]])
    margin = np.vstack([margin, board.square * np.array([[board.columns + 1, board.rows + 1]])])
    outline = np.column_stack([margin, np.zeros(4)])
    poses = []
    while len(poses) < n_views:
        direction, tilt = rng.uniform(0.0, 2.0 * np.pi), np.deg2rad(largest_tilt) * np.sqrt(rng.uniform())
        axis = np.array([np.cos(direction), np.sin(direction), 0.0])
        turn = Rotation.from_rotvec(tilt * axis) * Rotation.from_euler("z", rng.uniform(-0.6, 0.6))
        depth = camera.fx * board.square * board.columns / (fill * camera.width) * rng.uniform(0.8, 1.5)
        centre = depth * np.array([*rng.uniform(-0.5, 0.5, 2) * [camera.width, camera.height] / camera.fx, 1.0])
        pose = RigidTransform(turn.as_matrix(), centre - turn.as_matrix() @ middle)
        pixels = camera.project_recorded(pose.apply(outline))
        if ((pixels > 2.0) & (pixels < np.array([camera.width, camera.height]) - 3.0)).all():
            poses.append(pose)
    return poses


def turned_tags(board):
    """The board with each of its tags printed turned by 180 degrees, as AprilTag and ViSP have them."""

    class Turned(FiducialBoard):
        def image(self, pixels_per_metre):
            whole, marker = board.image(pixels_per_metre), 1e-3 * board.description.marker_mm
            side, pitch = (round(length * pixels_per_metre) for length in (marker, board.pitch))
            for row, column in np.ndindex(board.description.rows, board.description.columns):
                place = np.s_[row * pitch : row * pitch + side, column * pitch : column * pitch + side]
                whole[place] = whole[place][::-1, ::-1].copy()
            return whole

    return Turned(board.description)
