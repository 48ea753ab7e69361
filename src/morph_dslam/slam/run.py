"""`morph slam`: track the camera through a source, map the scene, write the run folder."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from morph_dslam.camera import Camera, StereoCamera
from morph_dslam.errors import MapError, SourceError
from morph_dslam.io.camera_files import load_camera_or_pair, save_camera
from morph_dslam.io.colmap import ColmapModel, read_colmap_model
from morph_dslam.io.folders import clear_run_folder, holds_run, make_run_folder, only_writer, replaced_files
from morph_dslam.io.trajectory import Trajectory, load_trajectory
from morph_dslam.io.video import VideoWriter
from morph_dslam.io.writing import check_no_input
from morph_dslam.slam.camera_terms import CameraTerm, with_terms_of
from morph_dslam.slam.frame_images import FrameImages
from morph_dslam.slam.options import SlamOptions
from morph_dslam.slam.result import SlamFrame
from morph_dslam.slam.run_files import draw_frame, write_run
from morph_dslam.slam.scene import Scene, finish_scene, load_scene, refine_camera, start_slam, track_frames
from morph_dslam.slam.slam import Slam
from morph_dslam.sources import FrameSource, FrameStream, open_source, open_stream
from morph_dslam.sources.frames import notes_of_source
from morph_dslam.sources.live import LiveStream
from morph_dslam.sources.recorded import depth_on_another_clock

#: What a run writes if it is asked for it.
_VIDEO, _CAMERA = "tracked.mp4", "camera.yaml"


@dataclass(frozen=True)
class _Start:
    """What a run begins with beside its source; see `run_slam`."""

    map_path: Path | None
    trajectory: Path | None
    images: Path | None

    @property
    def is_model(self) -> bool:
        """Whether the map is the folder of a COLMAP model."""
        path = self.map_path
        return path is not None and path.is_dir() and not (path / "map.h5").is_file()

    def check(self, options: SlamOptions, refine: Sequence[CameraTerm]) -> None:
        """Raise MapError if the choices contradict each other."""
        if options.extend and self.map_path is None and self.trajectory is None:
            raise MapError("--extend needs the map that is to grow: --map run/map.h5")
        if self.map_path is not None and self.trajectory is not None:
            raise MapError("a map comes either from --map or from --trajectory, not from both")
        if self.images is not None and self.trajectory is None and not self.is_model:
            raise MapError("--images says what a COLMAP model (--map MODEL) or poses (--trajectory) are of")
        if refine and (self.map_path is not None or self.trajectory is not None):
            raise MapError("--refine-camera makes a new map: leave out --map and --trajectory")

    def known(self, camera: Camera | StereoCamera) -> Scene | Trajectory | ColmapModel | None:
        """The map, or poses to make it with, if there are any."""
        if self.trajectory is not None:
            return load_trajectory(self.trajectory)
        if self.map_path is None:
            return None
        if self.is_model:
            return read_colmap_model(self.map_path)
        return load_scene(self.map_path, FrameImages(camera).camera)


def run_slam(
    source: str | Path,
    camera: str | Path,
    output: str | Path,
    first: int | None = None,
    last: int | None = None,
    *,
    options: SlamOptions | None = None,
    map_path: str | Path | None = None,
    trajectory: str | Path | None = None,
    images: str | Path | None = None,
    refine: Sequence[CameraTerm] = (),
    depth_per_metre: float | None = None,
    fps: float | None = None,
    video: bool = True,
    overwrite: bool = False,
    progress: bool = True,
) -> dict[str, Any]:
    """Track the camera through a recording, or a live camera's frames, and write the run folder.

    Frames of a recording that had no pose when they came are looked for once more in the finished map.
    An interrupt, or a source that ends early, keeps what was done: the run folder is completed with the frames
    so far and the exception goes on.

    Parameters
    ----------
    source : recording, or `webcam:0`
    camera : camera file, or that of a stereo pair
    output : run folder
    first, last : range of frame numbers, both included; all by default
    options : choices of the run
    map_path : map of an earlier run with the same camera, or folder of a COLMAP model; a new map by default
    trajectory : file of poses to make the map with instead
    images : recording that the model or the trajectory belongs to; the source by default
    refine : terms of the camera to estimate before; the camera goes into the run folder, ``camera.yaml``
    fps : frames a second of numbered images, which nothing else tells
    depth_per_metre : values a metre of the depth images; as its layout has them by default
    video : draw the video with the points followed
    overwrite : replace a run that is there already
    progress : whether to show a bar

    Returns
    -------
    The content of ``summary.json``.

    Raises MorphError if an input cannot be used (CameraError, SourceError, MapError) or the run folder holds a run
    (TrackingError).
    """
    camera, output = Path(camera), Path(output)
    map_path = None if map_path is None else Path(map_path)
    trajectory = None if trajectory is None else Path(trajectory)
    images = None if images is None else Path(images)
    options, start = options or SlamOptions(), _Start(map_path, trajectory, images)
    start.check(options, refine)
    if depth_per_metre is not None and not options.use_depth:
        raise MapError("--depth-per-metre says how depth images are to be read: leave it or --no-depth out")
    more_files = [*([_VIDEO] if video else []), *([_CAMERA] if refine else [])]
    gone = _more_of_run_before(output) if overwrite else []
    written = [*replaced_files(output, "slam"), *(output / name for name in (*more_files, *gone))]
    grown = map_path if options.extend else None  # it may take its own place
    given = [source, str(camera).partition("#")[0], None if grown else map_path, trajectory, images]
    check_no_input(written, given, MapError, folders_are_emptied=True)
    one_or_two = load_camera_or_pair(camera)
    stream = open_stream(source, first, last, fps, depth_per_metre)
    more: dict[str, Any] = {"inputs": {"source": str(source), "camera": str(camera)}}
    if depth_per_metre is not None:
        more["inputs"]["depth_per_metre"] = depth_per_metre
    with stream if isinstance(stream, LiveStream) else nullcontext(), only_writer(output):
        make_run_folder(output, overwrite, "slam", more_files)
        refined: Camera | None = None
        if refine:
            refined, more["refined_camera"] = _refined(stream, one_or_two, refine, options, progress)
            one_or_two = refined
        known, recorded = start.known(one_or_two), None
        if isinstance(known, Trajectory | ColmapModel):
            recorded = open_source(images or source, fps=None if images else fps)
        if progress:
            print("preparing (half a minute the first time, when the inner loops are compiled) ...", file=sys.stderr)
        slam, frames = start_slam(stream, one_or_two, options, known, recorded), list[SlamFrame]()
        notes = notes_of_source(stream, slam.camera.readout_s)
        if options.use_depth and (doubt := depth_on_another_clock(stream, source)):
            notes += (f"{doubt}; depth was left aside",)
        again: FrameSource | None = None
        n_before = stream.dropped if isinstance(stream, LiveStream) else 0
        try:
            _track(slam, stream, frames, output / _VIDEO if video else None, progress)
            again = stream if isinstance(stream, FrameSource) and known is None else None
        except MapError:
            frames.clear()  # nothing of a run whose depth contradicts the map may replace an earlier one
            raise
        except SourceError as error:
            if not frames:
                raise
            raise SourceError(f"{error}; the {len(frames)} frames before it are in {output}") from error
        finally:
            if isinstance(stream, LiveStream):
                more["n_dropped"] = stream.dropped - n_before
            summary: dict[str, Any] = {}
            if frames:
                scene = replace(finish_scene(slam, frames, again), refined=tuple(refine))
                if options.freeze_at is not None and options.freeze_at > frames[-1].index:
                    last = frames[-1].index
                    notes += (f"--freeze-at {options.freeze_at} had no effect: the last frame was {last}",)
                clear_run_folder(output, "slam", [output / name for name in gone if name not in more_files])
                if refined is not None:
                    save_camera(output / _CAMERA, refined)
                summary = write_run(output, scene, more, notes)
    return summary


def _more_of_run_before(output: Path) -> list[str]:
    """Names of what an earlier run in the folder wrote on request, and the next one deletes or replaces.

    A camera file in the folder of a run that made none is somebody's own.
    """
    if not holds_run(output, "slam"):
        return []
    with suppress(OSError, ValueError):
        if "refined_camera" in json.loads((output / "summary.json").read_text(encoding="utf-8")):
            return [_VIDEO, _CAMERA]
    return [_VIDEO]


def _refined(
    stream: FrameStream, given: Camera | StereoCamera, terms: Sequence[CameraTerm], options: SlamOptions, progress: bool
) -> tuple[Camera, dict[str, Any]]:
    """The camera with terms estimated from the recording, and what ``summary.json`` says of each."""
    if not isinstance(stream, FrameSource) or not isinstance(given, Camera):
        raise MapError("--refine-camera needs a recording of one camera, no live camera and no stereo pair")
    refined = refine_camera(stream, given, terms, options, progress)
    kept = {term for term in terms if with_terms_of(refined.camera, given, (term,)) == refined.camera}
    return refined.camera, {term: found.facts() | {"is_kept": term in kept} for term, found in refined.terms.items()}


def _track(slam: Slam, stream: FrameStream, frames: list[SlamFrame], video: Path | None, progress: bool) -> None:
    """Add each frame's record to ``frames``, which keeps them if the source ends early, and draw the video."""
    size = (slam.camera.width, slam.camera.height)
    with VideoWriter(video, stream.fps, size) if video else nullcontext() as writer:
        watch = (lambda image, frame: writer.write(draw_frame(image, frame))) if writer else None
        try:
            for frame in track_frames(slam, stream, progress, watch):
                frames.append(frame)
        except MapError:
            if writer:
                writer.discard()
            raise
