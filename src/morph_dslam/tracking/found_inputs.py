"""The inputs of a run that lie in one folder, found by what the files hold."""

from __future__ import annotations

import csv
import json
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

from morph_dslam.errors import MorphError, SourceError, TrackingError
from morph_dslam.io.camera_files import load_camera
from morph_dslam.io.file_kinds import VIDEOS, file_kind
from morph_dslam.io.landmarks import HEADER
from morph_dslam.sources import open_source

#: Where a recording's images are kept by `morph simulate` and the studio.
_FRAMES = "frames"
#: Sections that only studies have.
_OF_A_STUDY = {"mesh", "sheet", "shell", "external"}
#: Keys that only one kind of file has that says where an object is, by the option that takes it; scenes have them too.
_STARTS = {"board": {"dictionary"}, "picture": {"image"}, "guess": {"pose"}}
_OF_A_SCENE = {"sensor", "camera", "surface"}


@dataclass(frozen=True)
class FoundInputs:
    """What a folder holds.

    Attributes
    ----------
    folder : where it was looked for.
    recordings : videos and folders of images.
    cameras : camera files.
    models : model files.
    studies : study files.
    starts : what says where the object is: the name of the option, and the file.
    """

    folder: Path
    recordings: tuple[Path, ...]
    cameras: tuple[Path, ...]
    models: tuple[Path, ...]
    studies: tuple[Path, ...]
    starts: tuple[tuple[str, Path], ...]

    @property
    def recording(self) -> Path:
        """The only one, or that called `frames`; raises SourceError if there is none, or several."""
        chosen = [path for path in self.recordings if path.name == _FRAMES] or self.recordings
        if len(chosen) != 1:
            why = f"several recordings: {', '.join(map(str, chosen))}" if chosen else "no recording"
            raise SourceError(
                f"{self.folder} holds {why}; give one of them in place of the folder, and name the other inputs"
            )
        return chosen[0]

    @property
    def camera(self) -> Path:
        """The only one; raises TrackingError if it is not."""
        return self._only("camera", self.cameras)

    @property
    def model(self) -> Path:
        """The only one; raises TrackingError if it is not."""
        return self._only("model", self.models)

    @property
    def start(self) -> tuple[str, Path]:
        """The only one; raises TrackingError if it is not."""
        if len(self.starts) == 0:
            raise TrackingError(
                f"{self.folder} does not say where the object is: mark some of its points in a frame (--landmarks), or "
                "register it in a map (--registration)"
            )
        if len(self.starts) > 1:
            named = ", ".join(f"--{name} {path}" for name, path in self.starts)
            raise TrackingError(f"{self.folder} says in several ways where the object is; name one: {named}")
        return self.starts[0]

    def _only(self, what: str, paths: Sequence[Path]) -> Path:
        if not paths:
            raise TrackingError(f"{self.folder} holds no {what}: name it with --{what}")
        if len(paths) > 1:
            raise TrackingError(f"{self.folder} holds several: {', '.join(map(str, paths))}; name one with --{what}")
        return paths[0]


def find_inputs(folder: str | Path) -> FoundInputs:
    """What a folder holds of a run's inputs.

    Files are known by their keys, columns and first bytes; of folders below it only recordings, and what
    `morph register` writes, count. Hidden ones do not.
    """
    folder = Path(folder)
    described = {path: _keys(path, tomllib.loads) for path in _files(folder, ".toml")}
    studies = tuple(path for path, keys in described.items() if _OF_A_STUDY & keys)
    below = [path for path in _entries(folder) if path.is_dir()]
    places = [*_files(folder, ".json"), *(path / "registration.json" for path in below)]
    starts = [("registration", path) for path in places if "world_from_object" in _keys(path, json.loads)]
    starts += [("landmarks", path) for path in _files(folder, ".csv") if _first_row(path) == list(HEADER)]
    starts += [
        (name, path)
        for path, keys in described.items()
        for name, own in _STARTS.items()
        if own <= keys and not keys & (_OF_A_STUDY | _OF_A_SCENE)
    ]
    inside = [path for path in _entries(folder) if path.is_dir() or file_kind(path) in VIDEOS]
    recordings = [path for path in inside if _is_recording(path)] or [folder] * _is_recording(folder)
    cameras = tuple(path for path in _files(folder, ".yaml", ".yml", ".txt") if _is_camera(path))
    return FoundInputs(folder, tuple(recordings), cameras, tuple(_files(folder, ".morph")), studies, tuple(starts))


def _files(folder: Path, *endings: str) -> list[Path]:
    return [path for path in _entries(folder) if path.suffix.lower() in endings and path.is_file()]


def _entries(folder: Path) -> list[Path]:
    """What is in a folder, without hidden files, as those that some systems put beside each file."""
    return [path for path in sorted(folder.iterdir()) if not path.name.startswith(".")]


def _keys(path: Path, parse: Callable[[str], object]) -> set[str]:
    """Of the mapping that a file holds; none if it holds none."""
    try:
        content = parse(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, yaml.YAMLError):
        return set()
    return {str(key) for key in content} if isinstance(content, dict) else set()


def _first_row(path: Path) -> list[str]:
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        return [cell.strip() for cell in next(csv.reader(file), [])]


def _is_camera(path: Path) -> bool:
    """Whether a file holds one, or was meant to: what is wrong with it is told when it is used."""
    try:
        load_camera(path)
    except MorphError:
        return path.suffix.lower() != ".txt" and bool({"fx", "camera_matrix", "cam0"} & _keys(path, yaml.safe_load))
    return True


def _is_recording(path: Path) -> bool:
    try:
        open_source(path)
    except MorphError:
        return False
    return True
