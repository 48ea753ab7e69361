"""Rendered desks: an object among clutter, beside or before a larger textured board, seen by a hand-held camera.

Everything follows from a seed: the object's shape, its few marks, what stands around it, the light, and the path and
the rolling shutter of the camera. benchmarks/rendered_desks.py registers the objects.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import meshio
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

import morph_dslam as md
from figurines import figurine
from morph_dslam.extend.models import SeparatedField

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Rng = np.random.Generator
PICTURES = ("chelsea", "rocket", "coffee", "astronaut")
N_FRAMES, KEY_FRAMES_APART = 81, 8
#: The first seed of a figurine, without a mark, in place of a shape with few.
FIGURINES = 1000
#: Boxes whose proportions differ by less than this (natural logarithm) are alike where a map has no scale.
ALIKE = 0.2
#: Faces that meet at a larger angle have a sharp edge, rad.
SHARP = 0.5


@dataclass(frozen=True)
class Shape:
    """An object.

    Attributes
    ----------
    points : (n, 3) corners, mm; the middle of their box is the origin.
    triangles : (m, 3).
    symmetry : Schoenflies symbol of the rotations that change nothing, about z or all axes; "Cinf" for a solid of
        revolution about z.
    lies : whether it may also lie on its side, turned by 90 degrees about x.
    """

    points: Array
    triangles: NDArray[np.int64]
    symmetry: str = "C1"
    lies: bool = True

    @property
    def rotations(self) -> list[Rotation]:
        """That map the object to itself; of a solid of revolution one alone."""
        return list(Rotation.create_group("C1" if self.symmetry == "Cinf" else self.symmetry))


def _centred(points: Array) -> Array:
    return points - (points.min(axis=0) + points.max(axis=0)) / 2.0


def _cells(edges: Sequence[Sequence[float]], filled: Iterable[tuple[int, int, int]]) -> tuple[Array, NDArray[np.int64]]:
    """The surface of the ``filled`` cells of a grid, whose planes along x, y and z are at ``edges``."""
    cells, points, triangles = set(filled), [], []
    for cell in sorted(cells):
        for axis in range(3):
            for side in (0, 1):
                beyond = tuple(cell[k] + (2 * side - 1) * (k == axis) for k in range(3))
                if beyond in cells:
                    continue
                corners = np.array([cell] * 4)
                corners[:, axis] += side
                corners[[1, 2], (axis + 1) % 3] += 1
                corners[[2, 3], (axis + 2) % 3] += 1
                quad = [0, 1, 2, 3] if side else [3, 2, 1, 0]
                triangles += [[len(points) + quad[k] for k in part] for part in ((0, 1, 2), (0, 2, 3))]
                points += [[edges[k][corner[k]] for k in range(3)] for corner in corners]
    return _centred(np.array(points, dtype=float)), np.array(triangles)


def _box(*size: float) -> tuple[Array, NDArray[np.int64]]:
    return _cells([(0.0, side) for side in size], [(0, 0, 0)])


def _hull(points: Sequence[Sequence[float]]) -> tuple[Array, NDArray[np.int64]]:
    corners = _centred(np.array(points, dtype=float))
    return corners, ConvexHull(corners).simplices.astype(np.int64)


def _prism(profile: Sequence[tuple[float, float]], depth: float) -> tuple[Array, NDArray[np.int64]]:
    """A convex profile in x and z, drawn out along y."""
    return _hull([(x, y, z) for x, z in profile for y in (0.0, depth)])


def _revolved(profile: Sequence[tuple[float, float]], count: int = 48) -> tuple[Array, NDArray[np.int64]]:
    """A closed profile of radius and height about z; it begins and ends on the axis."""
    angles = 2.0 * np.pi * np.arange(count) / count
    points = np.array([(r * np.cos(a), r * np.sin(a), z) for r, z in profile for a in angles])
    triangles = []
    for ring in range(len(profile) - 1):
        for k in range(count):
            p, q = ring * count + k, ring * count + (k + 1) % count
            # On the axis one of the two has no area.
            triangles += [[p, q, q + count]] * (profile[ring][0] > 0.0)
            triangles += [[p, q + count, p + count]] * (profile[ring + 1][0] > 0.0)
    return _centred(points), np.array(triangles)


def shapes() -> dict[str, Shape]:
    """All objects by name."""
    hexagon = [(40.0 * np.cos(a), 40.0 * np.sin(a)) for a in np.pi / 3.0 * np.arange(6)]
    ring = [(i, j, 0) for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    cup = [(0, 0), (32, 0), (42, 95), (38, 95), (28.5, 5), (0, 5)]
    frustum = [(x * sx, y * sy, z) for x, y, z in ((52, 36, 0), (26, 20, 85)) for sx in (-1, 1) for sy in (-1, 1)]
    boss = [(i, j, 0) for i in range(3) for j in range(3)] + [(1, 1, 1)]
    channel = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 0, 1), (2, 0, 1)]
    return {
        "cube": Shape(*_box(85, 85, 85), "O", False),
        "bracket": Shape(*_cells([(0, 20, 90), (0, 60), (0, 18, 100)], [(0, 0, 0), (1, 0, 0), (0, 0, 1)])),
        "frustum": Shape(*_hull(frustum), "C2", False),
        "stairs": Shape(
            *_cells([(0, 38, 72, 106), (0, 80), (0, 26, 52, 78)], [(i, 0, k) for i in range(3) for k in range(3 - i)])
        ),
        "box": Shape(*_box(115, 72, 46), "D2"),
        "cup": Shape(*_revolved(cup), "Cinf", False),
        "wedge": Shape(*_prism([(0, 0), (110, 0), (0, 62)], 74)),
        "channel": Shape(*_cells([(0, 18, 77, 95), (0, 70), (0, 16, 72)], channel), "C2"),
        "boss": Shape(*_cells([(0, 15, 55, 110), (0, 22, 60, 82), (0, 32, 78)], boss)),
        "hexagon": Shape(*_hull([(x, y, z) for x, y in hexagon for z in (0, 95)]), "D6"),
        "tee": Shape(
            *_cells([(0, 38, 66, 104), (0, 52), (0, 66, 92)], [(1, 0, 0), (0, 0, 1), (1, 0, 1), (2, 0, 1)]), "C2"
        ),
        "house": Shape(*_prism([(0, 0), (84, 0), (84, 46), (42, 88), (0, 46)], 104), "C2"),
        "frame": Shape(*_cells([(0, 20, 95, 115), (0, 20, 66, 86), (0, 40)], ring), "D2"),
    }


def shape_of(seed: int) -> tuple[str, Shape]:
    """A seed's object and its name: each in turn, or from `FIGURINES` on a figurine."""
    if seed >= FIGURINES:
        return "figurine", Shape(*figurine(seed), lies=False)
    named = list(shapes().items())
    return named[seed % len(named)]


def _colour(rng: Rng, low: int = 60, high: int = 220, share: float = 1.0) -> Array:
    """Any colour; of a lower ``share`` nearer to grey."""
    colour = rng.integers(low, high, 3).astype(np.float64)
    return share * colour + (1.0 - share) * colour.mean()


def _marked(rng: Rng, size: int = 480) -> Image:
    """The object's print: one colour with a few larger marks, so that few points can be followed on it."""
    ground = _colour(rng, 90, 210, 0.7)
    image = np.full((size, size, 3), ground, dtype=np.uint8)
    for _ in range(rng.integers(12, 17)):
        centre = tuple(int(x) for x in rng.uniform(0.08, 0.92, 2) * size)
        half = tuple(int(x) for x in rng.uniform(0.03, 0.08, 2) * size)
        colour = tuple(float(x) for x in _colour(rng, 20, 245))
        if rng.random() < 0.6:
            box = (tuple(map(float, centre)), tuple(2.0 * h for h in half), float(rng.uniform(0, 90)))
            cv2.fillPoly(image, [cv2.boxPoints(box).astype(np.int32)], colour)
        else:
            cv2.ellipse(image, centre, half, 0.0, 0.0, 360.0, colour, -1, cv2.LINE_AA)
    return image


def _yellow(rng: Rng, size: int = 64) -> Image:
    """A print of one bright colour."""
    return np.full((size, size, 3), rng.integers([20, 165, 200], [60, 200, 245]), dtype=np.uint8)


def _tags(rng: Rng, columns: int, rows: int) -> Image:
    """A board of tags."""
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    image = np.full((120 * rows, 120 * columns), 235, dtype=np.uint8)
    for k, number in enumerate(rng.permutation(500)[: columns * rows]):
        y, x = 120 * (k // columns) + 15, 120 * (k % columns) + 15
        image[y : y + 90, x : x + 90] = cv2.aruco.generateImageMarker(tags, int(number), 90)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)


def _page(rng: Rng, width: int, height: int) -> Image:
    """A printed page: lines of letters, some larger, and a picture's frame."""
    image = np.full((height, width, 3), 240, dtype=np.uint8)
    y, letters = 40, np.array(list("abcdefghijklmnopqrstuvwxyz      ABCDEFGHKLMNOPRST"))
    while y < height - 15:
        large = rng.random() < 0.15
        text = "".join(rng.choice(letters, width // (22 if large else 12) - 3))
        scale = 1.1 if large else 0.6
        cv2.putText(image, text, (15, y), cv2.FONT_HERSHEY_SIMPLEX, scale, (30, 30, 30), 2 if large else 1, cv2.LINE_AA)
        y += 44 if large else 26
    return image


def _wood(rng: Rng, size: int = 1400) -> Image:
    """A table top: bands of the grain, waved, over a brown."""
    y, x = np.mgrid[:size, :size].astype(np.float32)
    waves = cv2.GaussianBlur(rng.standard_normal((size, size)).astype(np.float32), (0, 0), 40.0)
    fine = cv2.GaussianBlur(rng.standard_normal((size, size)).astype(np.float32), (0, 0), sigmaX=14.0, sigmaY=1.2)
    grain = np.sin((y + 900.0 * waves) / 11.0 + 0.002 * x) * 7.0 + 160.0 * fine
    ground = np.array([70.0, 110.0, 150.0]) + rng.uniform(-25.0, 25.0)
    return np.clip(ground + grain[..., None], 0, 255).astype(np.uint8)


def _speckled(rng: Rng, size: int = 900) -> Image:
    """Paint or cloth: one colour with soft spots."""
    soft = cv2.GaussianBlur(rng.standard_normal((size, size)).astype(np.float32), (0, 0), 3.0)
    return np.clip(_colour(rng, share=0.4) + 90.0 * soft[..., None], 0, 255).astype(np.uint8)


def with_sharp_edges(model: md.ReducedModel) -> md.ReducedModel:
    """The model with each sharp edge's nodes once for either face, so that no shade runs over the edge."""
    mesh = trimesh.Trimesh(model.nodes, model.triangles, process=False)
    smooth = mesh.face_adjacency[mesh.face_adjacency_angles < SHARP]
    n = len(model.triangles)
    faces = connected_components(coo_array((np.ones(len(smooth)), smooth.T), shape=(n, n)))[1]
    keys = np.stack([model.triangles, np.broadcast_to(faces[:, None], (n, 3))], axis=-1).reshape(-1, 2)
    used, triangles = np.unique(keys, axis=0, return_inverse=True)
    still = SeparatedField(np.zeros((1, len(used), 3)), model.displacement.functions)
    nodes = model.nodes[used[:, 0]]
    return replace(model, nodes=nodes, triangles=triangles.reshape(-1, 3).astype(np.int64), displacement=still)


def write_desk(seed: int, folder: Path) -> list[Path]:
    """Write a seed's object, its pictures and its scene file; of the same seed always the same.

    Returns
    -------
    The files written: ``object.stl``, pictures, ``camera.yaml`` and ``scene.toml``, the model of which,
    ``sharp.morph``, is still to be made of the first (`with_sharp_edges`).
    """
    folder.mkdir(parents=True, exist_ok=True)
    rng, (_, shape) = np.random.default_rng([16, seed]), shape_of(seed)
    meshio.Mesh(shape.points, [("triangle", shape.triangles)]).write(folder / "object.stl")
    size = rng.uniform([270, 210], [420, 320])
    board = (_tags(rng, 4, 3), _page(rng, 900, 680), None)[rng.integers(3)]
    pictures = {
        "marks": _yellow(rng) if seed >= FIGURINES else _marked(rng),
        "wood": _wood(rng),
        "paint": _speckled(rng),
        "wall": _speckled(rng),
    }
    pictures |= {} if board is None else {"board": board}
    for name, picture in pictures.items():
        cv2.imwrite(str(folder / f"{name}.png"), picture)
    (folder / "camera.yaml").write_text(
        "width: 640\nheight: 480\nfx: 560.0\nfy: 560.0\ncx: 320.0\ncy: 240.0\n"
        f"readout_s: {rng.uniform(0.012, 0.03):.4f}\n"
    )
    light = rng.uniform([-0.8, -0.9], [0.8, -0.2])
    lines = [
        f'model = "sharp.morph"\ncamera = "camera.yaml"\nframes = {N_FRAMES}\nseed = {seed}\njpeg_quality = 93\n',
        '[surface]\ntexture = "marks.png"\n',
        f"[light]\ndirection = [{light[0]:.3f}, {light[1]:.3f}, 1.0]\n",
        "[sensor]\nblur_px = 0.5\nnoise = 2.0\n",
        *(f"[[exposure]]\nframe = {k}\ngain = {rng.uniform(0.85, 1.15):.3f}\n" for k in (0, 40, 80)),
        *_placed(rng, shape),
        *_surroundings(rng, shape, size, rng.choice(PICTURES) if board is None else "board.png"),
        *_camera_path(rng, shape),
    ]
    (folder / "scene.toml").write_text("\n".join(lines))
    names = ["object.stl", *(f"{name}.png" for name in pictures), "camera.yaml", "scene.toml"]
    return [folder / name for name in names]


def _placed(rng: Rng, shape: Shape) -> list[str]:
    """The object on the table at the origin, upright or on its side, turned."""
    tilt, turn = 90.0 * (shape.lies and rng.random() < 0.4), rng.uniform(0.0, 360.0)
    lowest = Rotation.from_euler("x", tilt, degrees=True).apply(shape.points)[:, 2].min()
    return [f"[[pose]]\nframe = 0\nposition_mm = [0, 0, {-lowest:.3f}]\nrotation_deg = [{tilt:.0f}, 0, {turn:.2f}]\n"]


def _rectangle(texture: str, centre: Array, right: Array, down: Array) -> str:
    vectors = {"centre_mm": centre, "right_mm": right, "down_mm": down}
    values = [f"{name} = [{', '.join(f'{x:.9f}' for x in vector)}]" for name, vector in vectors.items()]
    return "\n".join(["[[environment.rectangles]]", f'texture = "{texture}"', *values, ""])


def _surroundings(rng: Rng, shape: Shape, board: Array, print_of_board: str) -> list[str]:
    """A table, a wall, the board behind or beside the object, and clutter around both."""
    table = rng.choice(["wood.png", "wood.png", "paint.png", "gravel"])
    far, reach = rng.uniform(500.0, 900.0), float(np.linalg.norm(np.ptp(shape.points, axis=0))) / 2.0
    lines = [
        _rectangle(table, np.zeros(3), np.array([1500.0, 0, 0]), np.array([0, -1500.0, 0])),
        _rectangle("wall.png", np.array([0, far, 350.0]), np.array([2400.0, 0, 0]), np.array([0, 0, -900.0])),
    ]
    beside, side = rng.random() < 0.5, rng.choice([-1.0, 1.0])
    turn = Rotation.from_euler("xz", [-rng.uniform(0.0, 22.0), rng.uniform(-15.0, 15.0)], degrees=True)
    right, down = turn.apply(np.array([[board[0], 0, 0], [0, 0, -board[1]]]))
    shift = side * (reach + board[0] / 2.0 + 10.0) * 0.85 if beside else rng.uniform(-70.0, 70.0)
    behind = rng.uniform(10.0, 60.0) + 0.28 * board[0] if beside else reach + rng.uniform(50.0, 130.0)
    lines.append(_rectangle(print_of_board, np.array([shift, behind, -down[2] / 2.0 + 1.0]), right, down))
    return [*lines, *_clutter(rng, shape, reach, behind, -side)]


def _clutter(rng: Rng, shape: Shape, reach: float, behind: float, free_side: float) -> list[str]:
    """Boxes and books that hide little of the object, on the side where the board is not, and before it."""
    lines, count = [], int(rng.integers(2, 5))
    places = [(free_side * (reach + 75.0), 30.0), (free_side * (reach + 190.0), -40.0), (-free_side * 175.0, -110.0)]
    places.append((free_side * 60.0, behind + 130.0))
    for place in places[:count]:
        size = rng.uniform([45, 40, 30], [110, 90, 120])
        if place[1] < 0.0:
            size[2] = rng.uniform(12.0, 40.0)
        while _alike(size, np.ptp(shape.points, axis=0)):
            size[2] *= 1.2
        x, y = np.array(place) + rng.uniform(-15.0, 15.0, 2)
        texture = rng.choice([*PICTURES, "brick", "paint.png", "wall.png"])
        lines.append(
            f'[[environment.boxes]]\ntexture = "{texture}"\ncentre_mm = [{x:.1f}, {y:.1f}, {size[2] / 2:.2f}]\n'
            f"size_mm = [{size[0]:.1f}, {size[1]:.1f}, {size[2]:.2f}]\nturn_deg = {rng.uniform(-40.0, 40.0):.1f}\n"
        )
    return lines


def _alike(a: Array, b: Array) -> bool:
    """Whether boxes of these sizes (3,) have nearly the same proportions."""
    ratios = np.log(np.sort(a) / np.sort(b))
    return float(np.ptp(ratios)) < ALIKE


def _camera_path(rng: Rng, shape: Shape) -> list[str]:
    """A hand that moves the camera sidewise, up and nearer, and trembles."""
    half, about = np.radians(rng.uniform(9.0, 17.0)) * rng.choice([-1.0, 1.0]), np.radians(rng.uniform(-12.0, 12.0))
    distance, height = rng.uniform(350.0, 480.0), rng.uniform(150.0, 290.0)
    nearer, higher = rng.uniform(-60.0, 60.0), rng.uniform(-70.0, 70.0)
    centre = np.array([rng.uniform(-25.0, 25.0), 0.0, np.ptp(shape.points[:, 2]) / 2.0])
    lines = []
    for frame in range(0, N_FRAMES, KEY_FRAMES_APART):
        share = frame / (N_FRAMES - 1)
        turn, away = about + half * (2.0 * share - 1.0), distance + nearer * share
        hand = rng.normal(0.0, 3.0, 3)
        position = np.array([away * np.sin(turn), -away * np.cos(turn), height + higher * np.sin(2.5 * share)]) + hand
        values = [", ".join(f"{x:.1f}" for x in point) for point in (position, centre + rng.normal(0.0, 4.0, 3))]
        lines.append(f"[[camera_path]]\nframe = {frame}\nposition_mm = [{values[0]}]\ntarget_mm = [{values[1]}]\n")
    return lines
