"""Pictures of a checkerboard by the project's rasteriser, through any lens, with exact truth."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from morph_dslam.geometry import RigidTransform
from morph_dslam.render.rasteriser import rasterise
from morph_dslam.render.scene_renderer import supersampled
from morph_dslam.render.texture import render_textured

#: Texels in a square, and mesh cells in one, so fine that lens distortion is straight within a cell.
TEXELS, CELLS = 24, 4
SUPERSAMPLING = 3


def _texture(board):
    """The board with a white margin of one square; the square at the first corner is dark."""
    squares = np.full((board.rows + 3, board.columns + 3), 230, dtype=np.uint8)
    row, column = np.mgrid[: board.rows + 1, : board.columns + 1]
    squares[1:-1, 1:-1] = np.where((row + column) % 2 == 0, 25, 230)
    return np.kron(squares, np.ones((TEXELS, TEXELS), dtype=np.uint8))


def board_image(camera, board, camera_from_board, seed=0, blur=0.7, noise=1.5):
    """The picture (h, w, 3) of a board whose first inner corner is its origin."""
    columns, rows = CELLS * (board.columns + 3), CELLS * (board.rows + 3)
    v, u = np.mgrid[: rows + 1, : columns + 1]
    squares = np.column_stack([u.ravel(), v.ravel()]) / CELLS
    nodes = board.square * np.column_stack([squares - 2.0, np.zeros(len(squares))])
    first = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    below = first + columns + 1
    triangles = np.concatenate(
        [np.column_stack([first, first + 1, below]), np.column_stack([first + 1, below + 1, below])]
    )
    fine = supersampled(camera, SUPERSAMPLING)
    points = camera_from_board.apply(nodes)
    buffers = rasterise(fine.project_recorded(points), points[:, 2], triangles, fine.height, fine.width)
    image = render_textured(buffers, triangles, TEXELS * squares - 0.5, _texture(board))
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
