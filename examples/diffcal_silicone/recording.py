"""Reads a hanging bar of the silicone recordings: its mesh, where it hung, and the depth image of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import morph_dslam as md

Array = NDArray[np.float64]

#: Of the depth image, metres.
DEPTH_UNIT = 0.25e-3
#: The recordings' meshes are in centimetres.
MESH_UNIT = 1e-2
#: Nodes beyond this are held by the clamp, metres in the mesh's frame.
CLAMP_X = 0.07
#: The clamp's jaws reach over the bar by about so much, metres: what lies there is not the bar.
JAW = 0.03
#: A pixel whose neighbours differ by more is an edge, where a depth sensor reports points in the air, metres.
DEPTH_EDGE = 0.01


@dataclass(frozen=True)
class HangingBar:
    """One recording; x along the bar towards the clamp, y up, in the mesh's frame.

    Attributes
    ----------
    nodes : (n, 3) undeformed, metres.
    tetrahedra : (m, 4).
    camera_from_object : (4, 4).
    intrinsics : (3, 3).
    depth : (h, w) metres, 0 where nothing was measured.
    points : (p, 3) measured on the bar, in the mesh's frame, metres.
    """

    nodes: Array
    tetrahedra: NDArray[np.int64]
    camera_from_object: Array
    intrinsics: Array
    depth: Array
    points: Array


def load_bar(data: Path, recording: str = "h_m_c", mesh: str = "cantilever/cantilever_f1494_v749") -> HangingBar:
    """Read a recording.

    Raises
    ------
    MorphError
        If a file is missing or not what it should be.
    """
    folder = data / recording
    mesh_path = data / "CAD_models" / f"{mesh}.tet"
    depth_paths = sorted(folder.glob("depth_view*.png"))
    if not (folder / "views.npz").is_file() or not mesh_path.is_file() or not depth_paths:
        raise md.MorphError(
            f"{data} does not hold the recording {recording}: {folder / 'views.npz'}, "
            f"{folder / 'depth_viewNN.png'} and {mesh_path} are needed"
        )
    nodes, tetrahedra = _read_tet(mesh_path)
    with np.load(folder / "views.npz") as views:
        world_from_object = views["object_transform"].copy()
        world_from_object[:3, 3] *= MESH_UNIT
        view = int(depth_paths[0].stem.removeprefix("depth_view"))
        camera_from_object = views["world_to_depthcam"][view] @ world_from_object
        intrinsics = views["K_depth"]
    image = cv2.imread(str(depth_paths[0]), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise md.MorphError(f"{depth_paths[0]} is not an image")
    depth = image.astype(float) * DEPTH_UNIT
    points = _points_on_bar(depth, intrinsics, camera_from_object, nodes)
    return HangingBar(nodes, tetrahedra, camera_from_object, intrinsics, depth, points)


def _read_tet(path: Path) -> tuple[Array, NDArray[np.int64]]:
    """Vertices ("v x y z") in metres and tetrahedra ("t a b c d", from 0), turned positive."""
    rows = [line.split() for line in path.read_text().splitlines() if line.strip()]
    try:
        nodes = MESH_UNIT * np.array([row[1:4] for row in rows if row[0] == "v"], dtype=float)
        tetrahedra = np.array([row[1:5] for row in rows if row[0] == "t"], dtype=np.int64)
        edges = nodes[tetrahedra[:, 1:]] - nodes[tetrahedra[:, :1]]
    except (ValueError, IndexError) as error:
        raise md.MorphError(f"{path} is not a list of vertices and tetrahedra: {error}") from error
    inverted = np.linalg.det(edges) < 0.0
    tetrahedra[inverted] = tetrahedra[inverted][:, [0, 2, 1, 3]]
    return nodes, tetrahedra


def _points_on_bar(depth: Array, intrinsics: Array, camera_from_object: Array, nodes: Array) -> Array:
    """Measured points, in the mesh's frame, where the free part of the hanging bar can be."""
    highest = cv2.dilate(depth, np.ones((3, 3)))
    lowest = cv2.erode(np.where(depth > 0.0, depth, np.inf), np.ones((3, 3)))
    v, u = np.nonzero((depth > 0.0) & (highest - lowest < DEPTH_EDGE))
    z = depth[v, u]
    rays = np.linalg.solve(intrinsics, np.stack([u, v, np.ones(len(u))]))
    camera = (rays * z).T
    points = (camera - camera_from_object[:3, 3]) @ camera_from_object[:3, :3]
    low, high = nodes.min(axis=0), nodes.max(axis=0)
    reach = CLAMP_X - low[0]
    thickness = high[2] - low[2]
    near = (points[:, 0] > low[0] - 0.2 * reach) & (points[:, 0] < CLAMP_X - JAW)
    near &= (points[:, 1] > low[1] - reach) & (points[:, 1] < high[1] + 0.2 * reach)
    near &= np.abs(points[:, 2] - (low[2] + high[2]) / 2.0) < 1.5 * thickness
    return points[near]
