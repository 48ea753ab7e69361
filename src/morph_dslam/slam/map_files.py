"""Maps in files, and maps made from frames whose poses another program found."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from morph_dslam.camera import Camera
from morph_dslam.errors import MapError
from morph_dslam.io.checksum import check_checksum, is_other_hdf5, written_with_checksum
from morph_dslam.io.colmap import ColmapImage, ColmapModel
from morph_dslam.io.file_kinds import file_kind
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.notices import Notice
from morph_dslam.slam.frame_images import FrameImages, FrameView
from morph_dslam.slam.given_poses import PoseCheck
from morph_dslam.slam.mapping import Mapper, do_all
from morph_dslam.slam.options import INLIER_PX, LEAST_START_POINTS, PATCH_HALF
from morph_dslam.slam.pose import PoseEstimate, inside, reprojection_errors
from morph_dslam.slam.rigid_map import GOOD, NOWHERE, POINT_ARRAYS, Followed, Keyframe, RigidMap
from morph_dslam.slam.rolling_shutter import velocities
from morph_dslam.slam.scene_rigidity import SceneNotRigid
from morph_dslam.slam.templates import image_pyramid
from morph_dslam.slam.tracking import Tracked, Tracker, ViewsOf
from morph_dslam.sources import FrameSource
from morph_dslam.tracking.patches import LEVELS

Array = NDArray[np.float64]
#: Frames and poses belong together if they are at most this far apart in time, seconds.
MOST_TIME_DIFFERENCE = 0.01
#: Depth of points of which nothing is known, in lengths of the path: images then move by rotation alone.
FAR = 100.0
#: Points are found again where the poses have them in at least this share of frames: 0.9 with exact
#: poses, 0.15 with poses that are a tenth of a second late.
LEAST_FOUND = 0.4


def map_from_trajectory(trajectory: Trajectory, source: FrameSource, images: FrameImages) -> RigidMap:
    """Points triangulated from the frames of a recording that have a pose, with these poses.

    Lengths are the trajectory's. Poses that have frame numbers instead of times belong to the frames of these numbers.

    Raises MapError if fewer than three frames have a pose, or too few points obey the poses.
    """
    is_numbered, instants = trajectory.is_numbered, trajectory.timestamps
    # Numbers are whole: the nearest one is that of another frame where it is off.
    most_apart = 0.5 if is_numbered else MOST_TIME_DIFFERENCE
    if is_numbered:
        trajectory = replace(trajectory, timestamps=instants / source.fps)
    rigid_map = RigidMap()
    rigid_map.has_given_lengths = True
    mapper = Mapper(rigid_map, images.camera, hold_poses=True, unknown_depth=FAR * trajectory.length)
    tracker = _PosedTracker(rigid_map, images.camera)
    check = PoseCheck(trajectory.world_from_camera, np.asarray(images.camera.intrinsics))
    times, n_posed = [], 0
    poses = trajectory.camera_from_world
    # A motion capture system gives many poses while one image is read out.
    twists = velocities(trajectory.timestamps, poses, abs(images.camera.readout_s))
    for frame in source:
        times.append(float(frame.index) if is_numbered else frame.timestamp)
        nearest = int(np.abs(instants - times[-1]).argmin())
        if abs(instants[nearest] - times[-1]) > most_apart:
            continue
        n_posed += 1
        pose, twist = poses[nearest], twists[nearest]
        view = images.prepare(frame.image, frame.index, frame.timestamp)
        check.add(view, nearest)
        if not rigid_map.keyframes:
            mapper.begin_at(view, pose, twist)
            tracker.place(pose, rigid_map.keyframes[-1].seen, view.timestamp)
            continue
        tracked = tracker.track_at(view, pose, twist)
        if mapper.wants_keyframe(tracked, view.index):
            do_all(mapper.insert(tracked, view))
            tracker.points = rigid_map.keyframes[-1].seen
    if n_posed < 3:
        raise _too_few_posed(n_posed, times, instants, is_numbered, source.name)
    _check(source, rigid_map, check.fault())
    mapper.complete()
    return rigid_map


def _too_few_posed(n_posed: int, times: list[float], instants: Array, is_numbered: bool, name: str) -> MapError:
    """That too few frames have a pose; ``times`` of frames and ``instants`` of poses are seconds, or numbers."""
    ends = times[0], times[-1], instants[0], instants[-1]
    if is_numbered:
        first, last, first_pose, last_pose = (f"{number:.0f}" for number in ends)
        why = f"their numbers are {first} to {last}, those of the poses {first_pose} to {last_pose}"
    else:
        first, last, first_pose, last_pose = (f"{time:.3f}" for time in ends)
        why = (
            f"they are from {first} to {last} s, the trajectory's from {first_pose} to {last_pose} s, and may differ "
            f"by {1e3 * MOST_TIME_DIFFERENCE:.0f} ms"
        )
    return MapError(f"only {n_posed} of {len(times)} frames of {name} have a pose: {why}")


def _check(source: FrameSource, rigid_map: RigidMap, fault: str | None) -> None:
    """Refuse what gives no map, or a wrong one; ``fault``: of the poses."""
    share = float(rigid_map.n_found.sum() / max(rigid_map.n_expected.sum(), 1))
    misfit = f"the poses of the trajectory do not fit the images of {source.name}"
    if fault:
        raise MapError(f"{misfit}: they {fault}")
    if share < LEAST_FOUND or len(rigid_map.good) < LEAST_START_POINTS:
        raise MapError(
            f"{misfit}: {len(rigid_map.good)} points were made, found again in {share:.0%} of the frames. Check that "
            "poses are world from camera (x right, y down, z forward) at the frames' timestamps, that most "
            "frames have one, and the camera file"
        )


class _PosedTracker(Tracker):
    """Follows points through frames of known pose."""

    def track_at(self, view: FrameView, camera_from_world: Array, twist: Array) -> Tracked:
        """The points of the next frame, at its pose (4, 4), where the camera has a velocity (6,), NaN if unknown."""
        self._twist = twist
        found = self._follow(view.pyramid, self._followable(), camera_from_world, LEVELS + 1)
        found = found.joined(self._search(view.pyramid, camera_from_world, found.ids))
        known = found[self._map.state[found.ids] == GOOD]
        pixels = self._at_middle_row(known, camera_from_world).pixels
        errors = reprojection_errors(camera_from_world, self._map.positions[known.ids], pixels, self._intrinsics)
        rms = float(np.sqrt(np.mean(errors**2))) if len(errors) else 0.0
        pose = PoseEstimate(camera_from_world, np.zeros((6, 6)), errors < INLIER_PX, rms)
        result = replace(self._tracked(view.normalized.shape, pose, found, NOWHERE), twist=twist)
        self.camera_from_world, self.points = camera_from_world, result.points
        return result


FORMAT, VERSION = "morph-dslam map", 4
KEYFRAME_ARRAYS = ("normalized", "camera_from_world", "point_ids", "pixels", "right", "described_ids", "descriptors")
#: Maps of earlier releases have none.
LATER_KEYFRAME_ARRAYS = ("depths", "twist")
#: Lenses whose images of a point are closer are taken for the same, pixels.
LENSES_ALIKE_PX = 0.5
TRAJECTORY_ARRAYS = ("timestamps", "world_from_camera", "indices")


def save_map(path: Path, rigid_map: RigidMap, camera: Camera, trajectory: Trajectory | None = None) -> None:
    """Write points, keyframes with their contrast-normalized images, their camera, and its path, as HDF5."""
    with written_with_checksum(path, FORMAT) as file:
        file.attrs.update({"format": FORMAT, "version": VERSION, "usual_rms_px": rigid_map.usual_rms_px})
        file.attrs["camera_notes"] = json.dumps(rigid_map.camera_notes)
        file.attrs["notices"] = json.dumps([notice.content() for notice in rigid_map.notices])
        file.attrs["baseline_px"] = rigid_map.baseline_px
        file.attrs["has_given_lengths"] = rigid_map.has_given_lengths
        file.attrs["renumbered"] = json.dumps(rigid_map.renumbered)
        file.attrs.update({"intrinsics": camera.intrinsics, "size": (camera.width, camera.height)})
        file.attrs.update({"distortion": camera.distortion, "lens_model": camera.lens_model})
        file.attrs["readout_s"] = camera.readout_s
        kept = rigid_map.kept_keyframes
        # Keyframes that were taken out are left out; points that were refer to nothing.
        renumbered = np.zeros(len(rigid_map.keyframes), dtype=np.int64)
        renumbered[kept] = np.arange(len(kept))
        for name in POINT_ARRAYS:
            array = getattr(rigid_map, name)
            file[f"points/{name}"] = renumbered[array] if name.endswith("keyframe") else array
        for number, keyframe in enumerate(rigid_map.keyframes[k] for k in kept):
            group = file.create_group(f"keyframes/{number:06d}")
            group.attrs.update({"index": keyframe.index, "timestamp": keyframe.timestamp})
            for name in KEYFRAME_ARRAYS + LATER_KEYFRAME_ARRAYS:
                packed = {"compression": "gzip", "compression_opts": 1} if name == "normalized" else {}
                group.create_dataset(name, data=getattr(keyframe, name), **packed)
        for name in TRAJECTORY_ARRAYS if trajectory is not None else ():
            file[f"trajectory/{name}"] = getattr(trajectory, name)


def load_map_and_trajectory(path: Path, camera: Camera) -> tuple[RigidMap, Trajectory]:
    """Read a map and the path of the run that made it, which is empty where the file holds none.

    Raises MapError if it is missing, damaged, empty, of another version, or of a camera with other intrinsics or
    another readout time. Another lens is noted in the map's ``camera_notes``: images may have been undistorted before.
    """
    with _opened(path) as file:
        none = Trajectory(np.empty(0), np.empty((0, 4, 4)))
        if "trajectory" not in file:
            return _read(path, file, camera), none
        path_of_run = {name: np.asarray(file[f"trajectory/{name}"]) for name in TRAJECTORY_ARRAYS}
        return _read(path, file, camera), replace(none, **path_of_run)


def has_known_scale(path: Path) -> bool:
    """Whether the lengths of a map are metres, or those of given poses.

    Raises MapError if it is missing or damaged, or of another version.
    """
    with _opened(path) as file:
        return RigidMap(float(np.asarray(file.attrs["baseline_px"]))).is_metric or _has_given_lengths(file)


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    """The file of a map; MapError if it is none, or what is read from it turns out to be damaged."""
    if path.is_dir():
        raise MapError(f"{path} is a folder: give the map in it, {path / 'map.h5'}")
    if not path.is_file():
        raise MapError(f"there is no map {path}")
    if file_kind(path) == ".ply":
        raise MapError(f"{path} is a point cloud for viewers, no map: give {path.with_name('map.h5')}")
    try:
        if not is_other_hdf5(path):  # maps of earlier versions have no checksum
            check_checksum(path, FORMAT)
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT:
                raise MapError(f"{path} is no map of `morph slam`; give the map.h5 of a run folder")
            if file.attrs["version"] != VERSION:
                raise MapError(f"{path} has version {file.attrs['version']}; this release reads {VERSION}: map again")
            yield file
    except (OSError, KeyError, ValueError) as error:
        raise MapError(
            f"{path} is no map of `morph slam`, or damaged: copy it again, or map the scene again"
        ) from error


def _check_camera(path: Path, file: h5py.File, camera: Camera) -> None:
    """Refuse a camera with other intrinsics, or another readout time, than that of the map."""
    intrinsics, size = np.asarray(file.attrs["intrinsics"]), tuple(np.asarray(file.attrs["size"]).tolist())
    if size != (camera.width, camera.height) or not np.allclose(intrinsics, camera.intrinsics, rtol=1e-6):
        raise MapError(
            f"{path} was made with fx, fy, cx, cy = {', '.join(f'{x:.2f}' for x in intrinsics)} at "
            f"{size[0]}x{size[1]} pixels: use the camera file it was made with, for pictures "
            "that are of it. Resample those of another zoom, crop or camera to it (docs/slam.md), or map them by "
            "themselves"
        )
    # Maps of earlier releases do not say with which they were made.
    readout_s = float(np.asarray(file.attrs.get("readout_s", camera.readout_s)))
    if not np.isclose(readout_s, camera.readout_s, rtol=1e-6, atol=1e-9):
        raise MapError(
            f"{path} was made with readout_s = {readout_s:g}, the camera file has {camera.readout_s:g}: use the camera "
            "file it was made with, or map the scene again with this one"
        )


def _lens_note(path: Path, file: h5py.File, camera: Camera) -> tuple[str, ...]:
    """What to say where the map was made with another lens; nothing of maps of earlier releases, which have none."""
    if "distortion" not in file.attrs:
        return ()
    distortion = tuple(np.asarray(file.attrs["distortion"], dtype=float).tolist())
    of_map = replace(camera, distortion=distortion, lens_model=str(file.attrs["lens_model"]))
    columns, rows = np.meshgrid(np.linspace(0, camera.width - 1, 17), np.linspace(0, camera.height - 1, 13))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    apart = float(np.linalg.norm(of_map.distort_pixels(pixels) - camera.distort_pixels(pixels), axis=1).max())
    if apart < LENSES_ALIKE_PX:
        return ()
    return (
        f"{path.name} was made with another lens: its distortion differs from the camera file's by up to {apart:.1f} "
        "px, which is right only if one of the two recordings was undistorted before",
    )


def _has_given_lengths(file: h5py.File) -> bool:
    """Whether the lengths of a map are those of given poses; maps of earlier releases do not say."""
    return bool(np.asarray(file.attrs.get("has_given_lengths", False)))


def _notices(file: h5py.File) -> tuple[Notice, ...]:
    """What its recording showed to be wrong with a map; nothing of maps of earlier releases, which do not say."""
    contents = json.loads(str(file.attrs.get("notices", "[]")))
    return tuple(SceneNotRigid(**{each.name: found[each.name] for each in fields(SceneNotRigid)}) for found in contents)


def _read(path: Path, file: h5py.File, camera: Camera) -> RigidMap:
    _check_camera(path, file, camera)
    keyframes = file.get("keyframes")
    if not isinstance(keyframes, h5py.Group):
        raise MapError(f"{path} is empty: the run that wrote it never began a map")
    rigid_map = RigidMap(float(np.asarray(file.attrs["baseline_px"])))
    rigid_map.has_given_lengths = _has_given_lengths(file)
    rigid_map.renumbered = tuple(json.loads(str(file.attrs.get("renumbered", "[]"))))
    rigid_map.usual_rms_px = float(np.asarray(file.attrs["usual_rms_px"]))
    notes = json.loads(str(file.attrs.get("camera_notes", "[]")))
    rigid_map.camera_notes = (*notes, *_lens_note(path, file, camera))
    rigid_map.notices = _notices(file)
    for name in POINT_ARRAYS:
        setattr(rigid_map, name, np.asarray(file[f"points/{name}"]))
    rigid_map.merged_into = np.arange(len(rigid_map.state))
    for name in keyframes:
        arrays = [np.asarray(keyframes[f"{name}/{array}"]) for array in KEYFRAME_ARRAYS]
        later = [array for array in LATER_KEYFRAME_ARRAYS if f"{name}/{array}" in keyframes]
        index, timestamp = (np.asarray(keyframes[name].attrs[key]).item() for key in ("index", "timestamp"))
        optional = {array: np.asarray(keyframes[f"{name}/{array}"]) for array in later}
        rigid_map.keyframes.append(Keyframe(index, timestamp, *arrays, **optional))
    return rigid_map


#: Points of a model look alike in two of its pictures at least in this share of cases: nine tenths in right pictures, a
#: twentieth by chance.
LEAST_ALIKE = 0.2
#: Observations that miss their points by more are left out; if half of them do, the cameras differ.
MOST_ERROR_PX = 4.0


def map_from_colmap(model: ColmapModel, source: FrameSource, images: FrameImages) -> RigidMap:
    """The points of a model, with the frames of a recording that are its images as keyframes.

    A frame is an image if its number is the last one in the image's name. Lengths are the model's.

    Raises MapError if none of the frames is an image of the model, two images have one number, or its points are not
    where the camera has them.
    """
    wanted = {image.number: image for image in model.images}
    if len(wanted) < len(model.images):
        one, other = next(pair for pair in pairwise(model.images) if pair[0].number == pair[1].number)
        raise MapError(
            f"images of the COLMAP model have one number, {one.name} and {other.name}: a frame is an image by the last "
            "number in its name, so leave only the images of one recording in images.txt"
        )
    rigid_map, errors, numbers = RigidMap(), [], []
    nowhere = np.zeros((len(model.points), 2))
    rigid_map.add_points(model.points, nowhere, 0, GOOD)
    for frame in source:
        numbers.append(frame.index)
        if frame.index in wanted:
            view = images.prepare(frame.image, frame.index, frame.timestamp)
            errors.append(_add_keyframe(rigid_map, wanted[frame.index], view, model, images))
    if not rigid_map.keyframes:
        raise MapError(
            f"none of the {len(wanted)} images of the COLMAP model ({min(wanted)}-{max(wanted)}, by the "
            f"numbers in their names) is among the frames {numbers[0]}-{numbers[-1]} of {source.name}: "
            "give the recording that it was made from with --images"
        )
    typical = float(np.median(np.concatenate(errors)))
    if not typical < MOST_ERROR_PX:
        raise MapError(
            f"the points of the COLMAP model miss their pixels by {typical:.1f} px in {source.name}: give "
            "the camera that it was made with (--camera MODEL/cameras.txt), and its own images with --images"
        )
    rigid_map.remove(np.flatnonzero(rigid_map.n_observations() < 1))
    _check_pictures(rigid_map, images.camera, source)
    return rigid_map


def _check_pictures(rigid_map: RigidMap, camera: Camera, source: FrameSource) -> None:
    """Refuse pictures that are not the model's: its points look alike in no two of them."""
    tracker, n_seen, n_found = Tracker(rigid_map, camera), 0, 0
    for number in range(1, len(rigid_map.keyframes)):
        keyframe = rigid_map.keyframes[number]
        shared = rigid_map.shared_points(keyframe.point_ids)[:number]
        other = rigid_map.keyframes[int(shared.argmax())]
        views = ViewsOf(rigid_map, np.array([shared.argmax()]))
        seen = keyframe.seen[np.isin(keyframe.point_ids, other.point_ids)]
        seen = seen[tracker.is_similar_view(seen.ids, keyframe.camera_from_world, views)]
        found = tracker.find(image_pyramid(keyframe.normalized), seen, keyframe.camera_from_world, 1, views)
        rows, _ = keyframe.rows_of(found.ids)
        n_seen += len(seen.ids)
        n_found += int((np.linalg.norm(found.pixels - keyframe.pixels[rows], axis=1) < MOST_ERROR_PX).sum())
    if n_seen >= LEAST_START_POINTS and n_found < LEAST_ALIKE * n_seen:
        raise MapError(
            f"the images of the COLMAP model are not those of {source.name}: only {n_found / n_seen:.0%} of its points "
            "look alike in two images. Give the recording that it was made from with --images"
        )


def _add_keyframe(
    rigid_map: RigidMap, image: ColmapImage, view: FrameView, model: ColmapModel, images: FrameImages
) -> Array:
    """Add an image of the model; returns by how much its points (n, 3) miss their pixels (n,)."""
    # A point may have several keypoints in an image: the first counts.
    ids, rows = np.unique(image.point_ids, return_index=True)
    pixels = images.camera.undistort_pixels(image.pixels[rows])
    intrinsics = np.asarray(images.camera.intrinsics)
    errors = reprojection_errors(image.camera_from_world, model.points[ids], pixels, intrinsics)
    good = (errors < MOST_ERROR_PX) & inside(pixels, view.normalized.shape, PATCH_HALF + 2)
    seen = Followed(ids, pixels)[good]
    keyframe = Keyframe.of_view(view, image.camera_from_world, seen)
    rigid_map.add_keyframe(keyframe)
    do_all(keyframe.describe(view.grey))
    return errors
