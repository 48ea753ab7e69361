"""Simulated sequences: a video of a model in motion, with everything about it known.

The folder written holds `frames/`, `camera.yaml`, `landmarks.csv`, `truth.npz` and `depth.h5`; where the
camera moves also `groundtruth.txt`, and with a depth sensor `depth/` and the lists of a TUM RGB-D recording.
The truth is computed from the model, never read off the images. With a rolling shutter it is that of the middle
row's instant. Depth is that of an ideal pinhole's image.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.camera import Camera
from morph_dslam.errors import SceneError
from morph_dslam.io.camera_files import load_camera, parse_camera, save_camera
from morph_dslam.io.hdf5_writing import written_hdf5
from morph_dslam.io.landmarks import Landmarks, save_landmarks
from morph_dslam.io.trajectory import Trajectory, save_trajectory
from morph_dslam.io.writing import check_no_input, writing
from morph_dslam.model import ReducedModel, SurfacePoints, load_model
from morph_dslam.model.reduced_model import spread_over
from morph_dslam.render.environment import VALUES_PER_METRE, Motion, StaticScene, plan_motion, sensor_depth
from morph_dslam.render.picking import pick_surface
from morph_dslam.render.rasteriser import rasterise, visible_points
from morph_dslam.render.scene_file import Scene, interpolate_key_frames, load_scene_file
from morph_dslam.render.scene_renderer import Instant, SceneRenderer, band_seconds, in_disc, pixel_axes, supersampled
from morph_dslam.render.texture import is_sheet, landmark_nodes, regular_points, spread_nodes
from morph_dslam.sources.frames import Frame

Array = NDArray[np.float64]
N_TRUTH_POINTS = 300
#: Landmarks of an object that deforms, and of a rigid one.
MIN_LANDMARKS, MIN_LANDMARKS_RIGID = 8, 4
#: A point so far behind the surroundings, metres, is hidden; less may be their own slope within a pixel.
HIDDEN_BY = 3e-3
#: By this part of its depth a point may seem to be behind itself.
ROUNDING = 1e-9
#: The file by which a simulation is known, and one that was not finished; what else it writes beside frames.
_TRUTH, _UNFINISHED = "truth.npz", "truth.npz.partial"
_WRITTEN = ("camera.yaml", "landmarks.csv", "depth.h5", "rgb.txt", "depth.txt", "groundtruth.txt")


@dataclass(frozen=True)
class _World:
    """A scene with everything that it names read and checked.

    Attributes
    ----------
    motion : in every frame, at the middle row's instant.
    between : at the instant of each band of rows, frame by frame.
    gains : (T,) of the exposure.
    """

    scene: Scene
    folder: Path
    model: ReducedModel
    camera: Camera
    motion: Motion
    between: Motion
    gains: Array
    surroundings: StaticScene | None

    def node_positions(self, frame: int) -> Array:
        """Nodes (n, 3) in the camera frame, metres."""
        return self.motion.camera_from_object[frame].apply(self.model.positions(self.motion.parameters[frame]))

    def nearest_depth(self) -> float:
        """The least depth of any node in any frame, metres."""
        return min(self.node_positions(frame)[:, 2].min() for frame in range(self.scene.frames))

    def depth_image(self, points: Array) -> NDArray[np.float32]:
        """Depth (h, w) in metres of nodes (n, 3) in the camera frame, infinity where there is no surface."""
        pixels = self.camera.project(points)
        return rasterise(pixels, points[:, 2], self.model.triangles, self.camera.height, self.camera.width).depth

    def surroundings_depth(self, frame: int) -> NDArray[np.float32]:
        """Depth (h, w) in metres of what stands around the object, infinity where nothing does."""
        if self.surroundings is None or self.motion.camera_from_world is None:
            return np.full((self.camera.height, self.camera.width), np.inf, dtype=np.float32)
        return self.surroundings.buffers(self.motion.camera_from_world[frame], self.camera).depth

    def occluded(self, frame: int, columns: NDArray, rows: NDArray) -> NDArray[np.bool_]:
        """Which pixels the occluder covers; ``columns`` and ``rows`` broadcast against each other."""
        centres, occluder = self.motion.occluder_centres, self.scene.occluder
        if centres is None or occluder is None:
            return np.zeros(np.broadcast_shapes(columns.shape, rows.shape), dtype=bool)
        return in_disc(columns, rows, centres[frame], occluder.radius_px)

    def visible(self, frame: int, points: Array, nodes: Array, behind: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Which surface points are in the image with nothing in front of them.

        What the object hides of itself is found by the points' rays, exactly. A depth image would not do: on a slope
        its depth changes from pixel to pixel by more than a thin object is thick.

        Parameters
        ----------
        frame : its number.
        points : (p, 3) in the camera frame, metres.
        nodes : (n, 3) of the model's mesh there.
        behind : (h, w) depth of the surroundings.
        """
        pixels, depths = self.camera.project(points), points[:, 2]
        seen = visible_points(pixels, depths, behind, HIDDEN_BY)
        first, nearest = pick_surface(nodes, self.model.triangles, points), np.full(len(points), np.inf)
        met = first.triangles >= 0
        corners = nodes[self.model.triangles[first.triangles[met]], 2]
        nearest[met] = np.einsum("pc,pc->p", first.weights[met], corners)
        seen &= depths <= nearest * (1.0 + ROUNDING)
        return seen & ~self.occluded(frame, *self.camera.project_recorded(points).T)

    def renderer(self) -> SceneRenderer:
        """What makes the images."""
        return SceneRenderer(self.scene, self.model, self.camera, self.folder, self.nearest_depth(), self.surroundings)

    def image(self, frame: int, renderer: SceneRenderer) -> NDArray[np.uint8]:
        """The image (h, w, 3) of a frame."""
        count = len(self.between.parameters) // self.scene.frames
        seen = [self._instant(k) for k in range(count * frame, count * (frame + 1))]
        return renderer.render(seen, frame, self.gains[frame])

    def _instant(self, number: int) -> Instant:
        """What a band of rows sees, counted from the first of frame 0."""
        motion = self.between
        nodes = motion.camera_from_object[number].apply(self.model.positions(motion.parameters[number]))
        centres, cameras = motion.occluder_centres, motion.camera_from_world
        return Instant(
            nodes, None if centres is None else centres[number], None if cameras is None else cameras[number]
        )

    def measured_depth(
        self, frame: int, depth: NDArray[np.float32], occluded: NDArray[np.bool_]
    ) -> NDArray[np.uint16] | None:
        """What the depth sensor gives (h, w); None without one.

        ``depth`` (h, w) is that of the object and its surroundings, and ``occluded`` (h, w) where the occluder is.
        """
        if self.scene.depth_sensor is None:
            return None
        seen = np.where(occluded, np.float32(np.inf), depth)
        return sensor_depth(seen, self.scene.depth_sensor, (self.scene.seed, frame))


def _load_world(scene_path: Path) -> _World:
    scene, folder = load_scene_file(scene_path), scene_path.parent
    if isinstance(scene.camera, str):
        camera = load_camera(folder / scene.camera)
    else:
        camera = parse_camera(scene.camera, f"{scene_path}: camera")
    if scene.depth_sensor is not None and (any(camera.distortion) or camera.readout_s):
        raise SceneError(
            f"{scene_path}: a depth sensor's images are those of an ideal pinhole with a global shutter; leave "
            "distortion and readout_s out of the camera, or the depth sensor out of the scene"
        )
    model = load_model(folder / scene.model)
    try:
        motion = plan_motion(scene, model)
        instants = np.arange(scene.frames)[:, None] + scene.fps * band_seconds(camera)
        between = plan_motion(scene, model, instants.ravel())
        surroundings = _surroundings(scene, folder, camera, motion)
    except SceneError as error:
        raise SceneError(f"{scene_path}: {error}") from error
    world = _World(scene, folder, model, camera, motion, between, _gains(scene), surroundings)
    for frame in range(scene.frames):
        points = world.node_positions(frame)
        if points[:, 2].min() <= 0.0:
            raise SceneError(
                f"{scene_path}: in frame {frame} the object reaches behind the camera (z = "
                f"{1e3 * points[:, 2].min():.4g} mm): move it ahead with the pose's position_mm"
            )
    return world


def _gains(scene: Scene) -> Array:
    """Of the exposure in every frame (T,), on a spline through the logarithms of the key frames."""
    if not scene.exposure:
        return np.ones(scene.frames)
    logs = np.log([key.gain for key in scene.exposure])
    return np.exp(interpolate_key_frames([key.frame for key in scene.exposure], logs, np.arange(scene.frames)))


def _surroundings(scene: Scene, folder: Path, camera: Camera, motion: Motion) -> StaticScene | None:
    if scene.environment is None or motion.camera_from_world is None:
        return None
    positions = np.array([pose.inverse.translation for pose in motion.camera_from_world])
    finer, light = supersampled(camera, scene.supersampling), scene.light
    return StaticScene(scene.environment, folder, finer, positions, np.array(light.direction), light.ambient)


def _check_folder(output: Path) -> None:
    """Raise SceneError if a folder that holds no simulation has files of the names that one writes."""
    if (output / _TRUTH).exists() or (output / _UNFINISHED).exists():
        return
    of_frames = [path for folder in ("frames", "depth") for path in _frames_in(output / folder)]
    found = [path for path in (*of_frames, *(output / name for name in _WRITTEN)) if path.exists()]
    if found:
        raise SceneError(
            f"{found[0]} is there and would be gone, and {output} holds no earlier simulation ({_TRUTH}): name another "
            "folder"
        )


def _frames_in(folder: Path) -> list[Path]:
    found = folder.iterdir() if folder.is_dir() else ()
    return [path for path in found if re.fullmatch(r"\d{6}\.(png|jpg)", path.name)]


def _prepare_folder(output: Path) -> None:
    """Make the folders, and clear frames of an earlier simulation, which would mix with the new ones."""
    for folder in (output / "frames", output / "depth"):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        with written_hdf5(output / "depth.h5"):
            pass
    except BlockingIOError as error:
        raise SceneError(
            f"cannot write {output / 'depth.h5'}: is another simulation writing to this folder? Name another folder, "
            "or wait for it"
        ) from error
    # Until the truth is written this says whose the frames are.
    (output / _UNFINISHED).touch()
    (output / _TRUTH).unlink(missing_ok=True)
    for path in (*_frames_in(output / "frames"), *_frames_in(output / "depth")):
        path.unlink()
    for name in ("depth.h5", "rgb.txt", "depth.txt", "groundtruth.txt"):
        (output / name).unlink(missing_ok=True)


def _landmarks(world: _World) -> Landmarks:
    """Landmarks that frame 0 shows: mesh nodes and their pixels."""
    nodes = landmark_nodes(world.model) if is_sheet(world.model) else spread_nodes(world.model)
    positions = world.node_positions(0)
    nodes = nodes[world.visible(0, positions[nodes], positions, world.surroundings_depth(0))]
    least = MIN_LANDMARKS if world.model.parameters else MIN_LANDMARKS_RIGID
    if len(nodes) < least:
        raise SceneError(
            f"frame 0 shows {len(nodes)} landmarks of the object, and a tracker needs {least}: "
            "let the first key frames show all of it, without the occluder"
        )
    return Landmarks(world.model.nodes[nodes], world.camera.project_recorded(positions[nodes]))


def _truth_points(model: ReducedModel) -> SurfacePoints:
    """The surface points whose true positions are written: a grid on a sheet, spread over a solid."""
    if is_sheet(model):
        return regular_points(model, N_TRUTH_POINTS)
    return spread_over(model.nodes, model.triangles, N_TRUTH_POINTS)


def _truth_positions(world: _World, points: SurfacePoints) -> Array:
    """Positions (T, p, 3) of surface points in the camera frame in all frames, metres."""
    field, rest = world.model.restrict(points), world.model.rest_positions(points)
    motion = world.motion
    return np.stack(
        [
            pose.apply(rest + field.value(mu))
            for pose, mu in zip(motion.camera_from_object, motion.parameters, strict=True)
        ]
    )


def _write_truth(output: Path, world: _World, positions: Array, visible: NDArray[np.bool_]) -> None:
    """Write what is known of surface points (T, p, 3), and the poses and parameters behind them."""
    with (output / _UNFINISHED).open("wb") as file:
        np.savez_compressed(
            file,
            frame=np.arange(world.scene.frames),
            points_mm=positions * 1e3,
            pixels=np.stack([world.camera.project_recorded(frame) for frame in positions]),
            visible=visible,
            parameters=world.motion.parameters,
            camera_from_object=np.stack([pose.matrix for pose in world.motion.camera_from_object]),
        )
    (output / _UNFINISHED).replace(output / _TRUTH)


def _create_depth(file: h5py.File, world: _World) -> h5py.Dataset:
    camera = world.camera
    dataset = file.create_dataset(
        "depth_m",
        shape=(world.scene.frames, camera.height, camera.width),
        dtype=np.float32,
        chunks=(1, camera.height, camera.width),
        compression="gzip",
        compression_opts=1,
        shuffle=True,
    )
    dataset.attrs["description"] = "depth along the optical axis in metres; 0 where the object is not seen"
    return dataset


def _write_image(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16], options: Sequence[int] = ()) -> None:
    if not cv2.imwrite(str(path), image, options):
        raise SceneError(f"cannot write {path}: is the disk full?")


def _render_frames(
    world: _World, renderer: SceneRenderer, output: Path, truth: Array, progress: bool
) -> NDArray[np.bool_]:
    """Write all images and depths; says which truth points (T, p) are visible."""
    scene, camera = world.scene, world.camera
    columns, rows = pixel_axes(camera.height, camera.width)
    jpg, png = [cv2.IMWRITE_JPEG_QUALITY, scene.jpeg_quality], [cv2.IMWRITE_PNG_COMPRESSION, 3]
    visible = np.zeros(truth.shape[:2], dtype=bool)
    with written_hdf5(output / "depth.h5") as file:
        depths = _create_depth(file, world)
        for frame in tqdm(range(scene.frames), desc="rendering", unit="frame", disable=not progress):
            nodes = world.node_positions(frame)
            path = output / "frames" / f"{frame:06}.{scene.image_format}"
            _write_image(path, world.image(frame, renderer), jpg if path.suffix == ".jpg" else png)
            depth, behind = world.depth_image(nodes), world.surroundings_depth(frame)
            both, occluded = np.minimum(depth, behind), world.occluded(frame, columns, rows)
            visible[frame] = world.visible(frame, truth[frame], nodes, behind)
            hidden = np.isinf(depth) | (behind < depth) | occluded
            depths[frame] = np.where(hidden, np.float32(0.0), depth)
            measured = world.measured_depth(frame, both, occluded)
            if measured is not None:
                _write_image(output / "depth" / f"{frame:06}.png", measured)
    return visible


def _write_lists(output: Path, world: _World) -> None:
    """Write the camera's true path, and the lists that make a recording with depth of the folder."""
    times = np.arange(world.scene.frames) / world.scene.fps
    if world.motion.camera_from_world is not None:
        poses = np.array([pose.inverse.matrix for pose in world.motion.camera_from_world])
        save_trajectory(output / "groundtruth.txt", Trajectory(times, poses))
    if world.scene.depth_sensor is None:
        (output / "depth").rmdir()
        return
    for name, folder, suffix in (("rgb", "frames", world.scene.image_format), ("depth", "depth", "png")):
        lines = [f"{time:.6f} {folder}/{frame:06}.{suffix}" for frame, time in enumerate(times)]
        (output / f"{name}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


class SimulatedSequence:
    """The frames of a scene file, rendered as they are asked for, and the truth about them; nothing is written.

    Parameters
    ----------
    scene_path : the scene file.

    Attributes
    ----------
    name : of the scene file.
    fps : frames a second.
    camera : that films.
    model : that is filmed.
    landmarks : nodes of the model that frame 0 shows, and their pixels.
    parameters : (T, d) the model's, in each frame.
    camera_from_object : (T,) the model's pose in each frame, metres.
    has_registered_depth : whether the scene has a depth sensor.

    Raises
    ------
    SceneError, CameraError, ModelFileError
        As `simulate` does.
    """

    def __init__(self, scene_path: str | Path) -> None:
        self._world = world = _load_world(Path(scene_path))
        self.name, self.fps, self.camera, self.model = str(scene_path), world.scene.fps, world.camera, world.model
        self.landmarks, self.parameters = _landmarks(world), world.motion.parameters
        self.camera_from_object = tuple(world.motion.camera_from_object)
        self.has_registered_depth = world.scene.depth_sensor is not None

    def __len__(self) -> int:
        return self._world.scene.frames

    def __iter__(self) -> Iterator[Frame]:
        world, renderer = self._world, self._world.renderer()
        for number in range(len(self)):
            nodes, depth = world.node_positions(number), None
            if self.has_registered_depth:
                both = np.minimum(world.depth_image(nodes), world.surroundings_depth(number))
                occluded = world.occluded(number, *pixel_axes(self.camera.height, self.camera.width))
                measured = world.measured_depth(number, both, occluded)
                assert measured is not None
                depth = np.where(measured > 0, measured / np.float32(VALUES_PER_METRE), np.float32(np.nan))
            yield Frame(number, number / self.fps, world.image(number, renderer), depth=depth)


def simulate(scene_path: str | Path, output: str | Path, progress: bool = True) -> None:
    """Render a scene and write it with its truth.

    Parameters
    ----------
    scene_path : the scene file.
    output : the folder to write; made if missing. An earlier simulation in it is replaced.
    progress : show a progress bar.

    Raises
    ------
    SceneError
        If the scene file is wrong, the motion it prescribes leaves the model's range or the camera's view, or the
        folder cannot be written to, holds files of such names that no simulation has written, or an input.
    CameraError, ModelFileError
        If the camera or the model that it names cannot be read.
    """
    world, output = _load_world(Path(scene_path)), Path(output)
    named = [name for name in (world.scene.model, world.scene.camera) if isinstance(name, str)]
    check_no_input([output / name for name in _WRITTEN], [world.folder / name for name in named], SceneError)
    renderer = world.renderer()
    with writing(SceneError, output):
        _check_folder(output)
        _prepare_folder(output)
        save_camera(output / "camera.yaml", world.camera)
        save_landmarks(output / "landmarks.csv", _landmarks(world))
        truth = _truth_positions(world, _truth_points(world.model))
        visible = _render_frames(world, renderer, output, truth, progress)
        _write_lists(output, world)
        _write_truth(output, world, truth, visible)
