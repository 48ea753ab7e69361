"""A rigid scene that a camera moved through: mapped from its frames, saved, loaded, summed up."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence, Sized
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from morph_dslam.camera import Camera, StereoCamera
from morph_dslam.errors import MapError, SourceError
from morph_dslam.io.camera_doubts import camera_doubts
from morph_dslam.io.colmap import ColmapModel
from morph_dslam.io.trajectory import Trajectory
from morph_dslam.notices import Notice
from morph_dslam.slam import rolling_shutter
from morph_dslam.slam.bundle_adjustment import Observations, adjust
from morph_dslam.slam.camera_notes import camera_notes, known_map_notes
from morph_dslam.slam.camera_terms import (
    CHECKED,
    TERMS,
    CameraEstimate,
    CameraTerm,
    TermEstimate,
    terms_of,
    with_terms_of,
)
from morph_dslam.slam.frame_images import least_distances, orientations
from morph_dslam.slam.known_map_checks import check_depth_ratio, focal_note, moved_part
from morph_dslam.slam.local_map import correct_map
from morph_dslam.slam.map_files import load_map_and_trajectory, map_from_colmap, map_from_trajectory, save_map
from morph_dslam.slam.options import SlamOptions
from morph_dslam.slam.pose import inverse, refine_pose
from morph_dslam.slam.relocalization import bit_counts
from morph_dslam.slam.result import STAGES, SlamFrame, SlamStatus
from morph_dslam.slam.rigid_map import Followed, Keyframe, RigidMap
from morph_dslam.slam.run_notes import run_notes, why_without_poses
from morph_dslam.slam.scene_rigidity import SceneNotRigid, motion_in_scene
from morph_dslam.slam.second_pass import find_rest
from morph_dslam.slam.self_calibration import estimate_camera
from morph_dslam.slam.slam import Slam
from morph_dslam.slam.templates import Templates, image_pyramid
from morph_dslam.slam.tracking import similar_views
from morph_dslam.sources import FrameSource, FrameStream, open_source, open_stream
from morph_dslam.sources.frames import has_registered_depth
from morph_dslam.sources.live import LiveStream
from morph_dslam.threads import one_thread_for_algebra, threads_side_by_side
from morph_dslam.tracking.patches import patch_correlation

Array = NDArray[np.float64]
#: Maps that a camera is estimated from, each made with the estimate before.
REFINING_RUNS = 2
#: Terms of which a small departure is nearly a turn of the camera.
LIKE_A_TURN: tuple[CameraTerm, ...] = ("centre", "tangential")
#: What is called with each undistorted image (h, w[, 3]) and what it gave.
Watch = Callable[[NDArray[np.uint8], SlamFrame], None]


@dataclass(frozen=True)
class Scene:
    """A mapped scene.

    Attributes
    ----------
    camera : camera of the undistorted images
    map : points and keyframes
    trajectory : the camera's path, by frame numbers (``indices``) and ``timestamps``
    frames : what each frame gave, without its points; empty where the scene was loaded
    slam : what made the map, and finds the camera in further frames; None where the scene was loaded
    path : of the file that it was loaded from; None where it was just mapped
    refined : terms of the camera that were estimated from the same recording before
    """

    camera: Camera
    map: RigidMap
    trajectory: Trajectory
    frames: tuple[SlamFrame, ...] = ()
    slam: Slam | None = None
    path: Path | None = None
    refined: tuple[CameraTerm, ...] = ()

    @cached_property
    def _estimates(self) -> dict[tuple[CameraTerm, ...], CameraEstimate | None]:
        """Of the camera, by terms: each takes seconds."""
        return {}

    @property
    def points(self) -> Array:
        """Map points (n, 3), metres, or in units of the first view's median depth or of the given poses."""
        return self.map.positions[self.map.good]

    @property
    def keyframes(self) -> list[Keyframe]:
        """The views that the map keeps."""
        return [self.map.keyframes[k] for k in self.map.kept_keyframes]

    @property
    def is_metric(self) -> bool:
        """Whether lengths are metres."""
        return self.map.is_metric

    def camera_estimate(self, terms: Sequence[CameraTerm] = CHECKED) -> CameraEstimate | None:
        """The camera as the recording shows it.

        Where too few frames or points tell of it, all terms are unobservable. None without a path, in a map that was
        known before, and of a stereo pair.
        """
        return None if self.slam is None or self.slam.knows_map else self._estimate(terms)

    def _estimate(self, terms: Sequence[CameraTerm]) -> CameraEstimate | None:
        """The camera as the recording shows it, in a map that was known before too."""
        if self.slam is None or self.slam.frame_images.is_stereo or not len(self.trajectory):
            return None
        key = tuple(terms)
        if key not in self._estimates:
            seen = _seen(self.slam, self.frames, self.trajectory)
            self._estimates[key] = estimate_camera(self.map, self.camera, self.trajectory, seen, key)
        return self._estimates[key]

    @cached_property
    def notices(self) -> tuple[Notice, ...]:
        """That the scene did not stay rigid, or a part of a known map was moved, if a recording shows it.

        The first is kept with the map, and is true of it in all later recordings.
        """
        estimate, slam = self.camera_estimate(), self.slam
        if slam is not None and slam.knows_map:
            # Another lens or zoom puts points of a part of the picture elsewhere, too.
            if self._notes_in_known_map:
                return self.map.notices
            part = moved_part(self.map, self.camera, self.trajectory, slam.seen_in_known_map, slam.astray_in_known_map)
            return self.map.notices if part is None else (*self.map.notices, part)
        if self.slam is None or estimate is None:
            return self.map.notices
        seen = _seen(self.slam, self.frames, self.trajectory)
        found = motion_in_scene(self.map, self.camera, estimate.camera, self.trajectory, seen)
        return () if found is None else (found,)

    @property
    def camera_notes(self) -> tuple[str, ...]:
        """What is hardly right with the camera, and what the recording of the map shows of it, or does not show.

        Where the scene did not stay rigid, that is said instead: its recording tells nothing of the camera.
        """
        estimate, found = self.camera_estimate(), tuple(notice.text for notice in self.notices)
        if estimate is None:
            notes = (*found, *self.map.camera_notes)
        else:
            notes = found or tuple(camera_notes(estimate, refined=self.refined))
        if self.slam is None:
            return tuple(dict.fromkeys(notes))
        if self.slam.knows_map and not len(self.trajectory):
            notes = found  # others are of another recording, and perhaps of another camera
        elif self.slam.knows_map:
            notes = (*self._notes_in_known_map, *notes)
        doubts = () if self.slam.frame_images.is_stereo else camera_doubts(self.camera)
        return tuple(dict.fromkeys((*doubts, *notes)))

    @cached_property
    def _notes_in_known_map(self) -> tuple[str, ...]:
        """What the recording shows of its camera, of which the map was made with another recording."""
        lens, both = self._estimate(("radial",)), self._estimate(("focal", "radial"))
        if self.slam is None or lens is None or both is None:
            return ()
        seen = _seen(self.slam, self.frames, self.trajectory)
        note = focal_note(both, self.map, self.camera, self.trajectory, seen)
        return (*known_map_notes(lens), *(() if note is None else (note,)))

    def _median_depth(self) -> float | None:
        """Of the points in the views that the map keeps, along the optical axis; None without any."""
        depths = []
        for keyframe in self.keyframes:
            points = self.map.positions[self.map.good_of(keyframe.seen).ids]
            depths.append(points @ keyframe.camera_from_world[2, :3] + keyframe.camera_from_world[2, 3])
        together = np.concatenate(depths) if depths else np.empty(0)
        return float(np.median(together)) if len(together) else None

    def _unit(self) -> str:
        """What one unit of a map is that is not metric."""
        if self.slam is not None and self.slam.knows_map:
            return "the unit of the given map or poses"
        return "the median depth of the map's first view is 1"

    def save(self, path: str | Path) -> None:
        """Write map and path into one file, which `load_scene` and the commands read."""
        try:
            self.map.camera_notes = self.camera_notes or self.map.camera_notes
            self.map.notices = tuple(notice for notice in self.notices if isinstance(notice, SceneNotRigid))
        finally:  # a check of the camera that fails must not cost the map
            save_map(Path(path), self.map, self.camera, self.trajectory)

    def summary(self) -> dict[str, Any]:
        """Counts, errors and times, as in ``summary.json`` of a run."""
        content: dict[str, Any] = {
            "n_tracked": len(self.trajectory),
            "n_keyframes": len(self.keyframes),
            "n_map_points": len(self.map.good),
            "scale": "metres" if self.is_metric else self._unit(),
            "median_depth_m": self._median_depth() if self.is_metric else None,
        }
        return content | (_summary_of_run(self, self.slam) if self.slam is not None else {})


def load_scene(path: str | Path, camera: Camera) -> Scene:
    """Read a scene that `Scene.save` or `morph slam` wrote (``map.h5``).

    Raises MapError if the file is missing, damaged, empty, of another version, or of a camera with other intrinsics.
    """
    return Scene(camera, *load_map_and_trajectory(Path(path), camera), path=Path(path))


@one_thread_for_algebra
def map_scene(
    source: FrameStream | str | Path,
    camera: Camera | StereoCamera,
    options: SlamOptions | None = None,
    progress: bool = False,
    *,
    known: Scene | Trajectory | ColmapModel | None = None,
    images: FrameSource | None = None,
    watch: Watch | None = None,
) -> Scene:
    """Track a camera through a rigid scene and map the scene.

    A recording's map is made in step with its frames, a live camera's beside them, until an interrupt. Frames of a
    recording that had no pose when they came are looked for in the finished map (`second_pass`).

    Parameters
    ----------
    source : frames, or what `open_source` opens
    camera : of the frames; a stereo pair for frames with right images
    options : choices of the run
    progress : whether to show a bar
    known : map to find the camera in, instead of making a new one; or camera poses or a COLMAP model to make it from
    images : recording that poses or model are of; the source by default
    watch : called with each undistorted image and what it gave, with its points

    Raises MorphError if an input cannot be used: SourceError, CameraError, or MapError if map, poses or model do not
    fit.
    """
    opened = open_stream(source) if isinstance(source, str | Path) else source
    is_live = isinstance(opened, LiveStream)
    with opened if isinstance(opened, LiveStream) and opened is not source else nullcontext():
        slam, frames = start_slam(opened, camera, options or SlamOptions(), known, images), []
        try:
            frames.extend(track_frames(slam, opened, progress, watch))
        except KeyboardInterrupt:
            if not is_live:
                raise
    return finish_scene(slam, frames, opened if isinstance(opened, FrameSource) and known is None else None)


def start_slam(
    source: FrameStream,
    camera: Camera | StereoCamera,
    options: SlamOptions,
    known: Scene | Trajectory | ColmapModel | None = None,
    images: FrameSource | None = None,
) -> Slam:
    """What tracks the camera through a source; parameters as of `map_scene`."""
    warm_up()
    with_depth = options.use_depth and isinstance(camera, Camera) and has_registered_depth(source)
    slam = Slam(camera, options, with_depth, threaded=isinstance(source, LiveStream))
    if isinstance(known, Scene):
        slam.use_map(known.map.copied() if slam.options.extend else known.map)
        slam.is_of_other_recording = True
    elif known is not None:
        images = images or (source if isinstance(source, FrameSource) else None)
        if images is None:
            raise SourceError(f"{source.name} is live: give the recording that the poses are of")
        make = map_from_trajectory if isinstance(known, Trajectory) else map_from_colmap
        slam.use_map(make(known, images, slam.frame_images))  # type: ignore[arg-type]
        slam.is_of_other_recording = images.name != source.name
    return slam


def track_frames(
    slam: Slam, source: FrameStream, progress: bool = False, watch: Watch | None = None
) -> Iterator[SlamFrame]:
    """Records of all frames, one after the other; parameters as of `map_scene`.

    Raises MapError if measured depths contradict a known map.
    """
    total = len(source) if isinstance(source, Sized) else None
    with threads_side_by_side() if slam.threaded else nullcontext():
        for frame in tqdm(source, total=total, desc="tracking", unit="frame", disable=not progress):
            result = slam.process_frame(frame.image, frame.index, frame.timestamp, frame.depth, frame.right)
            check_depth_ratio(slam.depth_ratio)
            if watch is not None:
                watch(slam.undistort(frame.image), result)
            yield result.record(is_final=slam.is_frozen and not slam.camera.readout_s)


def finish_scene(slam: Slam, frames: Sequence[SlamFrame], recording: FrameSource | None = None) -> Scene:
    """Refine the map, once the sequence is over, and the path by it.

    Parameters
    ----------
    slam : what made the map
    frames : what each frame gave
    recording : that they are of, to look again for the camera where they have no pose
    """
    frames = slam.refine_map(frames)
    frames = frames if recording is None else find_rest(slam, frames, recording)
    trajectory = trajectory_of(slam, frames)
    for _ in range(rolling_shutter.ROUNDS if slam.camera.readout_s and not slam.is_frozen else 0):
        correct_map(slam.map, slam.camera, trajectory, slam.n_known if slam.is_of_other_recording else 0)
        trajectory = trajectory_of(slam, frames)
    if slam.is_of_other_recording and len(slam.map.keyframes) > slam.n_known:
        _number_apart(slam, frames)
    return Scene(slam.camera, slam.map, trajectory, tuple(frames), slam)


def _number_apart(slam: Slam, frames: Sequence[SlamFrame]) -> None:
    """Add a power of ten to the known keyframes' numbers, so that no frame of the recording has one of them."""
    taken = max((frame.index for frame in frames), default=0)
    more = 10 ** len(str(taken))
    for keyframe in slam.map.keyframes[: slam.n_known]:
        keyframe.index += more
    slam.map.renumbered += (more,)


def trajectory_of(slam: Slam, frames: Sequence[SlamFrame]) -> Trajectory:
    """The camera's path through all frames that have a pose, by what the map knows now.

    With a rolling shutter, whose readout time the camera has, poses are those of the middle rows' instants.
    """
    posed = [(frame, slam.camera_from_world(frame)) for frame in frames]
    found = [(frame, inverse(pose)) for frame, pose in posed if pose is not None]
    times, indices = [frame.timestamp for frame, _ in found], [frame.index for frame, _ in found]
    poses = np.array([pose for _, pose in found]).reshape(-1, 4, 4)
    path = Trajectory(np.array(times), poses, np.array(indices, dtype=np.int64))
    if not slam.camera.readout_s:
        return path
    return rolling_shutter.correct_path(slam.map, slam.camera, path, _seen(slam, frames, path))


def _seen(slam: Slam, frames: Sequence[SlamFrame], path: Trajectory) -> list[Followed]:
    """The map points that the frames of a path saw, keyframes as the map has them: that is more exact."""
    # Keyframes of a known map have numbers of another recording.
    by_index = {frame.index: frame.points for frame in frames} | slam.seen_in_known_map
    by_index |= slam.map.seen_in_keyframes(slam.n_known)
    return [slam.map.good_of(by_index[index]) for index in path.indices.tolist()]


def refine_camera(
    source: FrameSource | str | Path,
    camera: Camera,
    terms: Sequence[CameraTerm] = TERMS,
    options: SlamOptions | None = None,
    progress: bool = False,
) -> CameraEstimate:
    """A camera's intrinsics, lens and readout time from a recording of a rigid scene.

    The scene is mapped, the camera estimated, and both once more with what was found. Terms that the recording does not
    show stay as given, and principal point and tangential terms unless the recording refutes them: both are nearly a
    turn of the camera, so that a small departure is worth little and spoils the other terms.

    Parameters
    ----------
    source : a recording, or what `open_source` opens
    camera : as it was taken to be
    terms : to estimate; the others are taken to be right
    options : of the maps
    progress : whether to show bars

    Raises MapError if the recording gives too small a map, or the camera has none of the terms.
    """
    opened = open_source(source) if isinstance(source, str | Path) else source
    terms_found, refined = dict[CameraTerm, TermEstimate](), camera
    free: list[CameraTerm] = terms_of(camera, terms)
    if not free:
        raise MapError("a fisheye lens has no tangential terms: leave out --refine-camera tangential")
    for number in range(REFINING_RUNS):
        scene = map_scene(opened, refined, options, progress)
        estimate = _estimated(scene, free, opened.name)
        _take_in(terms_found, estimate)
        while number == 0 and (kept := _least_refuted(estimate, free)) is not None:
            free.remove(kept)
            if not free:
                return CameraEstimate(camera, terms_found)
            estimate = _estimated(scene, free, opened.name)
            _take_in(terms_found, estimate)
        hidden: list[CameraTerm] = [term for term in free if not estimate.terms[term].is_observable]
        free = terms_of(camera, [term for term in free if term not in hidden])
        refined = with_terms_of(with_terms_of(refined, estimate.camera, free), camera, hidden)
        if not free:
            break
    return CameraEstimate(refined, terms_found)


def _estimated(scene: Scene, terms: Sequence[CameraTerm], name: str) -> CameraEstimate:
    estimate = scene.camera_estimate(terms)
    if estimate is None:
        raise MapError(
            f"the camera cannot be estimated from {name}: no frame has a pose; film a textured, rigid scene, or leave "
            "out --refine-camera"
        )
    return estimate


def _least_refuted(estimate: CameraEstimate, free: Sequence[CameraTerm]) -> CameraTerm | None:
    """That of `LIKE_A_TURN` which the recording refutes least, if it does not."""
    kept: list[CameraTerm] = [term for term in LIKE_A_TURN if term in free and not estimate.terms[term].is_refuted]
    return min(kept, key=lambda term: estimate.terms[term].departure / estimate.terms[term].departure_std, default=None)


def _take_in(terms: dict[CameraTerm, TermEstimate], estimate: CameraEstimate) -> None:
    """Take newer estimates of terms; what was given stays what it was at first."""
    for term, found in estimate.terms.items():
        terms[term] = replace(found, given=terms[term].given if term in terms else found.given)


def _summary_of_run(scene: Scene, slam: Slam) -> dict[str, Any]:
    placed = set(scene.trajectory.indices.tolist())
    found = [frame for frame in scene.frames if frame.index in placed]
    start = next((frame.index for frame in found if frame.status is not SlamStatus.FOUND_LATER), None)
    after = [frame for frame in scene.frames if start is not None and frame.index >= start]
    times = np.array([frame.total_ms for frame in after] or [0.0])
    waits = np.array([frame.waited_ms for frame in after] or [0.0])
    errors = [frame.pose.rms_px for frame in found if frame.pose is not None]
    estimate = None if scene.notices else scene.camera_estimate()
    return {
        "n_frames": len(scene.frames),
        "start_frame": start,
        "n_after_start": len(after),
        "status": dict(Counter(str(frame.status) for frame in scene.frames)),
        "n_restarts": slam.n_restarts,
        "map_frozen": slam.is_frozen,
        "frozen_by_itself_at": slam.frozen_at,
        "n_loops_closed": slam.n_loops,
        "camera": {term: found.facts() for term, found in estimate.terms.items()} if estimate else None,
        "median_rms_px": float(np.median(errors)) if errors else None,
        "median_ms": float(np.median(times)),
        "p95_ms": float(np.percentile(times, 95)),
        "stage_median_ms": {s: float(np.median([f.timings_ms[s] for f in after] or [0.0])) for s in STAGES},
        "longest_wait_for_mapper_ms": float(np.max(waits)),
        "p99_wait_for_mapper_ms": float(np.percentile(waits, 99)),
        "settings": asdict(slam.options),
        "why_without_poses": why_without_poses(slam, scene.frames, after),
        "notices": [notice.content() for notice in scene.notices],
        "flags": [*run_notes(slam, scene.frames, after), *scene.camera_notes],
    }


def warm_up() -> None:
    """Compile the inner loops, so that no frame has to wait for it."""
    rng = np.random.default_rng(0)
    points, intrinsics = rng.uniform([-1, -1, 3], [1, 1, 4], size=(20, 3)), np.array([100.0, 100.0, 0.0, 0.0])
    pixels = points[:, :2] / points[:, 2:] * 100.0
    refine_pose(np.eye(4), points, pixels, intrinsics)
    seen = Observations(np.repeat([0, 1], 20), np.tile(np.arange(20), 2), np.concatenate([pixels, pixels]))
    adjust(np.stack([np.eye(4)] * 2), points, seen, intrinsics, np.array([True, False]), iterations=1)
    image, centre = rng.integers(0, 255, (32, 32)).astype(np.uint8), np.array([[16.0, 16.0]])
    patch_correlation(image, image, centre, centre, 5)
    orientations(image, centre)
    templates, pyramid, ids = Templates(intrinsics), image_pyramid(np.tile(image, (4, 4))), np.zeros(1, dtype=np.int64)
    templates.outdated(ids, ids, np.eye(4), (np.eye(4)[None], ids), points, centre)
    templates.make(ids, centre, pyramid)
    templates.align(ids, pyramid, centre, 0)
    similar_views(np.eye(4), np.eye(4)[None], ids, points[:1])
    words, rows = rng.integers(0, 255, (4, 32)).astype(np.uint8), np.arange(4)
    least_distances(words, rows, words, rows)
    bit_counts(words, rows, len(words))
