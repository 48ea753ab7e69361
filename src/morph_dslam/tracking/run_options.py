"""What a run is asked for: objects, cameras, frames, and what becomes of the results."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from morph_dslam.registration.initialization import InitializerFiles
from morph_dslam.registration.landmarks import CLICK_PX
from morph_dslam.tracking.drawing import DrawOptions
from morph_dslam.tracking.named_points import Place
from morph_dslam.tracking.option_values import FileOptions
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.still import CameraTerm


@dataclass(frozen=True, kw_only=True)
class ObjectOptions(FileOptions):
    """One object, by files: its model, and where it is at first (one of three); text is taken for paths too.

    Attributes
    ----------
    model : model file.
    landmarks : points of the object and their pixels in the reference frame.
    registration : registration.json of `morph register`.
    snap : whether the object's outline in the frame of the landmarks corrects them.
    initializer : a board, a picture of its print or a guess, which find it in the reference frame.
    at_rest : whether the object is undeformed in the frame of its landmarks, its parameters at their defaults.
    reregister_at : frames in which to register it anew, with landmarks there, or None for the initializer.
    inner : structures inside of it (`morph inner`), whose positions are written and drawn.
    points : names of places of it whose displacements are written and plotted, each with its coordinates in the
        undeformed object, metres.
    known : table of parameters that something else measures, by frame.
    time_zero : time of the recording at which the model's time begins, seconds: its parameter of time is known then.
    tracker : what is measured, and what earlier frames add.
    """

    model: Path
    landmarks: Path | None = None
    registration: Path | None = None
    at_rest: bool = False
    snap: bool = False
    initializer: InitializerFiles = field(default_factory=InitializerFiles)
    reregister_at: tuple[tuple[int, Path | None], ...] = ()
    inner: tuple[Path, ...] = ()
    points: tuple[Place, ...] = ()
    known: Path | None = None
    time_zero: float | None = None
    tracker: TrackerOptions = field(default_factory=TrackerOptions)


@dataclass(frozen=True, kw_only=True)
class TrackOptions(ObjectOptions):
    """A run: the first object, and all else.

    Attributes
    ----------
    frames : recording of the first camera; live also a webcam, "webcam:0".
    camera : camera file; of several cameras the first of a Kalibr camchain, "camchain.yaml#cam0".
    output : run folder of the first object; those of the others are in it.
    others : more objects, each with the name of its folder.
    other_cameras : recordings of the other cameras of the camchain, in its order; frames belong together by time where
        all recordings have times of their own, else by number.
    other_landmarks : of the first object in the reference frames of those cameras, in the same order, of as many as
        have any.
    map_path : map that the objects are registered in; by default the one that each registration names.
    first : number of the first frame to track; by default that of the recording, or of the registration.
    last : number of the last frame to track; by default that of the recording.
    fps : frames a second of numbered images, which nothing else tells; 30 by default.
    depth_per_metre : values a metre of the first camera's depth images; as its layout has them by default.
    reference_frame : number of the frame that landmarks and initializers belong to, the first one by default;
        of a registered object before several cameras one in which it is undeformed.
    reference_image : of a live run, the image that landmarks and initializers belong to; by default the first frame
        that comes.
    click_px : standard deviation of a landmark's pixel.
    refine_reference : whether to refine the reference state over the whole sequence, and track once more.
    refine_camera : terms of the camera to estimate with a pose that is one over the sequence.
    live : whether frames are dropped that come faster than they are tracked.
    seconds : after which a live run ends.
    serve : port at which browsers on this computer see a live run; 0 for any.
    video : whether to draw the augmented video.
    drawing : what is drawn.
    overwrite : whether to replace a run that is in the folder, and an earlier frame log or recording of a stream.
    streams : where results go as they come, for other programs (docs/streams.md).
    frame_log : file that gets a line of JSON for each frame, and each object, as soon as it is tracked.
    """

    frames: Path | str
    camera: Path | str
    output: Path
    others: tuple[tuple[str, ObjectOptions], ...] = ()
    other_cameras: tuple[Path, ...] = ()
    other_landmarks: tuple[Path, ...] = ()
    map_path: Path | None = None
    first: int | None = None
    last: int | None = None
    fps: float | None = None
    depth_per_metre: float | None = None
    reference_frame: int | None = None
    reference_image: Path | None = None
    click_px: float = CLICK_PX
    refine_reference: bool = False
    refine_camera: tuple[CameraTerm, ...] = ()
    live: bool = False
    seconds: float | None = None
    serve: int | None = None
    video: bool = True
    drawing: DrawOptions = field(default_factory=DrawOptions)
    overwrite: bool = False
    streams: tuple[str, ...] = ()
    frame_log: Path | None = None

    @property
    def objects(self) -> tuple[ObjectOptions, ...]:
        """All of them, the first one first."""
        return (self, *(part for _, part in self.others))

    @property
    def input_files(self) -> list[Path]:
        """All files and folders that the run reads, whether they are there or not."""
        found = [self.frames, str(self.camera).partition("#")[0], *self.other_cameras]
        found += [*self.other_landmarks, self.map_path, self.reference_image]
        for part in self.objects:
            found += [part.model, part.landmarks, part.registration, *vars(part.initializer).values(), *part.inner]
            found.append(part.known)
            found += [path for _, path in part.reregister_at]
        return [Path(path) for path in found if path is not None]

    @property
    def in_two_passes(self) -> bool:
        """Whether the recording is tracked again with what all of its frames tell."""
        still = any(part.tracker.pose == "still" for part in self.objects)
        return self.refine_reference or (still and not self.live)

    @property
    def folders(self) -> tuple[Path, ...]:
        """The run folder of each."""
        return (self.output, *(self.output / name for name, _ in self.others))

    @property
    def shown_in_folders(self) -> list[tuple[str, ...]]:
        """Names of the files in each run folder that this run writes and not every one does."""
        # A live run draws all objects into one video.
        videos = [
            ("augmented.mp4",) if self.video and (k == 0 or not self.live) else () for k in range(len(self.folders))
        ]
        return [(*video, "latency.csv") if self.live else video for video in videos]

    @property
    def stream_names(self) -> tuple[str, ...]:
        """By which streams call each object: the first one by its model file."""
        others, first = [name for name, _ in self.others], self.model.stem
        while first in others:
            first += "_"
        return (first, *others)
