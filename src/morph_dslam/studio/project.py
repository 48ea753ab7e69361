"""A project folder: which files it holds, what they are called, and no way out of it."""

from __future__ import annotations

import hashlib
import json
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, wraps
from pathlib import Path
from typing import Any, TypeVar

from morph_dslam.errors import StudioError

#: Files that the steps write, by what they are.
STUDY, MESH, MODEL, REPORT = "study.toml", "mesh.inp", "model.morph", "model.report.html"
CAMERA, LANDMARKS, RUN, FRAME_LOG = "camera.yaml", "landmarks.csv", "run", "track.jsonl"
#: Folders of pictures: a recording as numbered images, and views of a calibration board.
FRAMES, BOARD = "frames", "board"
#: Frames of a live camera: number 0 is that of the start. Pairs that were clicked on another recording before.
LIVE, EARLIER_LANDMARKS = "live", "landmarks-before.csv"
#: Folder of the recording of the still scene.
SCAN = "scan"
#: How folders begin where uploads wait until they have been looked at: hidden, so they are no files of the project yet.
UPLOADING = ".upload-"
_CHOICES, _DAMAGED = "studio.json", "studio-damaged{}.json"
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_. ()+-]{0,99}")
_MEGABYTE = 1_000_000
_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
Result = TypeVar("Result")


@dataclass(frozen=True)
class UploadKind:
    """What may be uploaded as something.

    Attributes
    ----------
    suffixes : endings of names that are taken.
    largest : bytes.
    folder : of the project that it goes to.
    """

    suffixes: tuple[str, ...]
    largest: int
    folder: str = ""


UPLOADS = {
    "object": UploadKind(
        (".stl", ".obj", ".ply", ".step", ".stp", ".inp", ".msh", ".vtk", ".vtu"), 300 * _MEGABYTE
    ),
    "camera": UploadKind((".yaml", ".yml", ".txt"), _MEGABYTE),
    "recording": UploadKind(_VIDEOS, 8000 * _MEGABYTE),
    "scan": UploadKind(_VIDEOS, 8000 * _MEGABYTE, SCAN),
    "frame": UploadKind(_PICTURES, 100 * _MEGABYTE, FRAMES),
    "board": UploadKind((*_PICTURES, *_VIDEOS), 2000 * _MEGABYTE, BOARD),
    "photo": UploadKind((".jpg", ".jpeg"), 100 * _MEGABYTE),
    "landmarks": UploadKind((".csv",), _MEGABYTE),
}  # fmt: skip
#: What the steps write themselves, and no upload may replace.
_OWN = {STUDY, MESH, MODEL, REPORT, FRAME_LOG, _CHOICES}


class Project:
    """The files of one project.

    Parameters
    ----------
    folder : is made if it does not exist; the one around it must be there.

    Raises
    ------
    StudioError
        If it cannot be made, or nothing can be written into it.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder).resolve()
        if not self.folder.parent.is_dir():
            raise StudioError(
                f"cannot make the project folder {folder}: there is no folder {self.folder.parent}; check the path, or "
                "make that folder first"
            )
        if self.folder.exists() and not self.folder.is_dir():
            raise StudioError(f"{folder} is a file: name a folder for the project")
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            raise StudioError(f"cannot make the project folder {folder}: {error.strerror or error}") from error
        try:
            tempfile.TemporaryFile(dir=self.folder).close()
        except OSError as error:
            raise StudioError(
                f"nothing can be written into the project folder {folder} ({error.strerror or error}): choose another "
                "folder, or change its permissions"
            ) from error

    def path(self, name: str) -> Path:
        """A path inside of the project.

        Parameters
        ----------
        name : relative to the folder, with "/" between its parts.

        Raises
        ------
        StudioError
            If a part is hidden, goes up, or leads out of the folder through a link.
        """
        parts = name.split("/")
        if not all(_NAME.fullmatch(part) for part in parts):
            raise StudioError(
                f"{_shown(name)} is no name of a file in the project: use letters, digits, spaces and _ . ( ) + -, not "
                "beginning with a dot"
            )
        path = self.folder.joinpath(*parts)
        if not path.resolve().is_relative_to(self.folder):
            raise StudioError(f"{_shown(name)} leads out of the project folder")
        return path

    def has(self, name: str) -> bool:
        """Whether the project has this file or folder."""
        return self.path(name).exists()

    def needed(self, name: str, advice: str) -> Path:
        """The path of a file or folder; raises StudioError, with the advice, if it is not there."""
        if not self.has(name):
            raise StudioError(f"{name} is not there: {advice}")
        return self.path(name)

    def upload_path(self, kind: str, name: str) -> tuple[Path, UploadKind]:
        """Where an upload goes, and how large it may be.

        Raises
        ------
        StudioError
            If the kind is unknown, the ending is not one of it, or the name is one that a step writes.
        """
        if kind not in UPLOADS:
            raise StudioError(f"nothing is uploaded as {_shown(kind)}; known are {', '.join(UPLOADS)}")
        allowed = UPLOADS[kind]
        if "/" in name or Path(name).suffix.lower() not in allowed.suffixes:
            raise StudioError(
                f"{_shown(name)} is not taken here; use a file that ends in {', '.join(allowed.suffixes)}"
            )
        path = self.path(f"{allowed.folder}/{name}" if allowed.folder else name)
        if name in _OWN and not allowed.folder:
            raise StudioError(f"{name} is written by the studio itself: give your file another name")
        return path, allowed

    @contextmanager
    def uploading(self, name: str) -> Iterator[Path]:
        """Where an upload is written until it has been looked at, under the name that messages about it say."""
        with tempfile.TemporaryDirectory(prefix=UPLOADING, dir=self.folder) as folder:
            yield Path(folder) / name

    @property
    def choices(self) -> dict[str, Any]:
        """What was chosen in the pages and stands in no other file; a file that is damaged is set aside.

        Raises
        ------
        StudioError
            If the file is there and may not be read.
        """
        return self._read_choices()

    def _read_choices(self) -> dict[str, Any]:
        path = self.path(_CHOICES)
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        except OSError as error:
            raise StudioError(f"{path} cannot be read ({error.strerror or error}): change its permissions") from error
        except (ValueError, RecursionError):
            content = None
        if isinstance(content, dict):
            return content
        free = (self.path(_DAMAGED.format(number)) for number in ("", *(f"-{k}" for k in range(2, 1000))))
        path.replace(next(other for other in free if not other.exists()))
        self.set_aside_pairs()  # the frame that they belong to stood in that file
        return {}

    @property
    def damage(self) -> str | None:
        """What to tell of a damaged file of choices that was set aside; None if there is none."""
        self._read_choices()
        found = [name for name in self.files() if re.fullmatch(_DAMAGED.format("(-[0-9]+)?"), name)]
        if not found:
            return None
        return (
            f"{_CHOICES} was damaged, and is kept as {' and '.join(found)}: choose the object and the recording anew; "
            f"or stop the studio, mend the file and name it {_CHOICES} again. Delete it when it is of no use any more."
        )

    def choose(self, **values: Any) -> None:
        """Remember choices; None forgets one."""
        kept = {key: value for key, value in (self.choices | values).items() if value is not None}
        self.write(_CHOICES, json.dumps(kept, indent=2) + "\n")

    def write(self, name: str, text: str) -> None:
        """Write a text file, whole or not at all."""
        path = self.path(name)
        part = part_of(path)
        part.write_text(text, encoding="utf-8")
        part.replace(path)

    @property
    def recording(self) -> str | None:
        """Name of the video or of the folder of images that is tracked, None if there is none."""
        name = self.choices.get("recording")
        return name if isinstance(name, str) and self.has(name) else None

    def take_recording(self, name: str, is_another: bool = False) -> None:
        """Track this recording from now on; pairs that were clicked on another one are set aside.

        Parameters
        ----------
        name : of the recording.
        is_another : whether it is not the one that had this name before.
        """
        before = self.choices.get("recording")
        if before is not None and (before != name or is_another):
            self.set_aside_pairs()
        self.choose(recording=name, reference_frame=None)

    def set_aside_pairs(self) -> None:
        """Keep the pairs as those of an earlier recording: their pixels mean nothing in another one."""
        landmarks = self.path(LANDMARKS)
        if landmarks.is_file():
            landmarks.replace(self.path(EARLIER_LANDMARKS))
            self.choose(pairs_were_of=self.choices.get("recording", ""))
        self.choose(reference_frame=None, at_rest=None, recording_number=self.recording_number + 1)

    @property
    def recording_number(self) -> int:
        """Another one whenever pairs that were clicked before mean nothing any more."""
        return int(self.choices.get("recording_number", 0))

    @property
    def aside(self) -> str | None:
        """What to tell of pairs that were set aside; None if none were, or others give the start since."""
        name, is_by_scan = self.choices.get("pairs_were_of"), self.choices.get("start") == "scan"
        if name is None or is_by_scan or self.has(LANDMARKS) or not self.has(EARLIER_LANDMARKS):
            return None
        of = f"an earlier recording ({name})" if name else "a frame that is not known any more"
        return (
            f"The pairs were clicked on {of}, and are kept in {EARLIER_LANDMARKS}: click pairs on this recording, and "
            "save them."
        )

    def outdate_run(self) -> None:
        """Remember that what the present run was tracked in has been replaced."""
        seal = self._run_seal()
        if seal is not None:
            self.choose(outdated_run=seal)

    @property
    def is_run_outdated(self) -> bool:
        """Whether what the run was tracked in has been replaced since."""
        seal = self._run_seal()
        return seal is not None and seal == self.choices.get("outdated_run")

    def _run_seal(self) -> str | None:
        """Checksum of the summary, of which no two runs have the same; None if there is no run."""
        try:
            return hashlib.sha256(self.path(f"{RUN}/summary.json").read_bytes()).hexdigest()
        except OSError:
            return None

    def files(self) -> list[str]:
        """Names of the files and folders, hidden ones left out."""
        return sorted(path.name for path in self.folder.iterdir() if _NAME.fullmatch(path.name))


def part_of(path: Path) -> Path:
    """Where a file of a project is written until all of it is there: hidden, so it is none of the project's yet."""
    return path.with_name(f".{path.name}.part")


def stamp(path: Path) -> tuple[int, int]:
    """What changes when a file is written again; zeros if there is none."""
    try:
        found = path.stat()
    except OSError:
        return 0, 0
    return found.st_mtime_ns, found.st_size


def read_once(most: int) -> Callable[[Callable[..., Result]], Callable[..., Result]]:
    """Keep what a function of paths gives, for so many of them, until a file, or one in a folder, is written again."""

    def keeping(function: Callable[..., Result]) -> Callable[..., Result]:
        @lru_cache(maxsize=most)
        def kept(seals: tuple, *paths: Path) -> Result:
            return function(*paths)

        @wraps(function)
        def read(*paths: Path) -> Result:
            return kept(tuple(map(_seal, paths)), *paths)

        return read

    return keeping


def _seal(path: Path) -> tuple:
    return tuple((file.name, *stamp(file)) for file in sorted(path.iterdir())) if path.is_dir() else stamp(path)


def _shown(name: str) -> str:
    """A name as messages show it: short, and without what a terminal would act on."""
    return repr(name if len(name) <= 80 else name[:77] + "...")
