"""A project folder: which files it holds, what they are called, and no way out of it."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from morph_dslam.errors import StudioError

#: Files that the steps write, by what they are.
STUDY, MESH, MODEL, REPORT = "study.toml", "mesh.inp", "model.morph", "model.report.html"
CAMERA, LANDMARKS, RUN, FRAME_LOG = "camera.yaml", "landmarks.csv", "run", "track.jsonl"
#: Folders of pictures: a recording as numbered images, and views of a calibration board.
FRAMES, BOARD = "frames", "board"
#: Frames of a live camera: number 0 is that of the start. Pairs that were clicked on another frame before.
LIVE, EARLIER_LANDMARKS = "live", "landmarks-before.csv"
#: Folder of the recording of the still scene.
SCAN = "scan"
_CHOICES = "studio.json"
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_. ()+-]{0,99}")
_MEGABYTE = 1_000_000
_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")


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
    folder : is made if it does not exist.

    Raises
    ------
    StudioError
        If it cannot be made.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder).resolve()
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StudioError(f"cannot make the project folder {folder}: {error.strerror or error}") from error

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

    @property
    def choices(self) -> dict[str, Any]:
        """What was chosen in the pages and stands in no other file."""
        try:
            content = json.loads(self.path(_CHOICES).read_text())
        except (OSError, ValueError):
            content = {}
        return content if isinstance(content, dict) else {}

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

    def files(self) -> list[str]:
        """Names of the files and folders, hidden ones left out."""
        return sorted(path.name for path in self.folder.iterdir() if _NAME.fullmatch(path.name))


def part_of(path: Path) -> Path:
    """Where a file of a project is written until all of it is there: hidden, so it is none of the project's yet."""
    return path.with_name(f".{path.name}.part")


def _shown(name: str) -> str:
    """A name as messages show it: short, and without what a terminal would act on."""
    return repr(name if len(name) <= 80 else name[:77] + "...")
