"""Snapshots on disk: one file for each solved sample, named by what it depends on.

The name is a hash of the study's fingerprint and the coordinates, so a build that was stopped goes on where
it was, and a changed study solves again only what the change touches. A file is a zip archive of arrays
(numpy's .npz), which has a CRC-32 of each.
"""

from __future__ import annotations

import hashlib
import io
import os
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import StudyError
from morph_dslam.io.writing import removed_on_failure, writing
from morph_dslam.studies.problem import ParametricStudy, Snapshot

Array = NDArray[np.float64]
#: Raised by whoever changes what a solver computes: snapshots of another number are solved anew.
SOLVER_VERSION = 3
#: Ending of a file that is being written; one left behind is a build's that was killed.
PARTIAL = ".partial"
#: Bytes in a zip archive before a member's name, and at most so many between the name and the data.
ZIP_HEADER, ZIP_EXTRA = 30, 20


def snapshot_key(study: ParametricStudy, coordinates: Array) -> str:
    """Name of a sample: hash of the study's fingerprint and the coordinates (d,)."""
    return snapshot_keys(study.fingerprint(), [coordinates])[0]


def snapshot_keys(fingerprint: str, samples: Iterable[Array]) -> list[str]:
    """Names of many samples (n, d) of a study with this fingerprint."""
    texts = [fingerprint + np.round(sample, 12).tobytes().hex() for sample in samples]
    return [hashlib.sha256(text.encode()).hexdigest()[:24] for text in texts]


def save_snapshot(path: str | Path, snapshot: Snapshot, state: dict[str, Array]) -> None:
    """Write a snapshot and the arrays of the solver's state; the file appears only when it is complete."""
    path = Path(path)
    write_atomically(path, encode_snapshot(snapshot, state))


def encode_snapshot(snapshot: Snapshot, state: dict[str, Array]) -> bytes:
    """Content of a snapshot's file. Fields are kept in single precision, the state in full."""
    arrays: dict[str, NDArray] = {"coordinates": snapshot.coordinates}
    arrays |= {f"field/{name}": values.astype(np.float32) for name, values in snapshot.fields.items()}
    arrays |= {f"slope/{name}": values.astype(np.float32) for name, values in snapshot.sensitivities.items()}
    arrays |= {f"output/{name}": np.asarray(values) for name, values in snapshot.outputs.items()}
    arrays |= {f"state/{name}": values for name, values in state.items()}
    content = io.BytesIO()
    np.savez(content, **arrays)  # type: ignore[arg-type]
    return content.getvalue()


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file that is either there in full or not at all, whenever the program is killed.

    Raises
    ------
    StudyError
        If it cannot be written.
    """
    partial = path.with_suffix(f".{os.getpid()}{PARTIAL}")
    with writing(StudyError, path), removed_on_failure(partial):
        with partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())  # the name must not reach the disk before the content
        os.replace(partial, path)


def damage(path: Path) -> str | None:
    """What is wrong with a snapshot's file, found by reading all of it; None if it is sound."""
    try:
        with zipfile.ZipFile(path) as archive:
            if _hides_members(archive):
                return "its table of contents is wrong"
            wrong = archive.testzip()
    except (zipfile.BadZipFile, EOFError, OSError, ValueError, NotImplementedError, RuntimeError) as error:
        return str(error)
    return f"the checksum of {wrong} does not match" if wrong else None


def _hides_members(archive: zipfile.ZipFile) -> bool:
    """Whether bytes before the table of contents belong to no member that it lists."""
    members = sorted(archive.infolist(), key=lambda member: member.header_offset)
    starts = [0, *(member.header_offset for member in members), archive.start_dir]
    taken = [0, *(ZIP_HEADER + len(member.filename) + member.compress_size for member in members)]
    between = np.diff(starts) - taken
    return bool(np.any(between < 0) or np.any(between > ZIP_EXTRA))


def load_snapshot(path: str | Path) -> Snapshot:
    """What `save_snapshot` wrote; fields, in single precision, are read each time they are asked for.

    So a thousand snapshots take no memory, and whoever gathers one field of them needs no more than that.
    """
    path = Path(path)
    with np.load(path) as file:
        stored = [StoredArrays(path, file.files, prefix) for prefix in ("field", "slope")]
        return Snapshot(file["coordinates"], *stored, _under(file, "output"))  # type: ignore[arg-type]


class StoredArrays(Mapping[str, NDArray]):
    """Arrays of a snapshot's file by name, and others that were joined to them with ``|``."""

    def __init__(
        self, path: Path, names: Iterable[str], prefix: str, added: Mapping[str, NDArray] | None = None
    ) -> None:
        self._path, self._prefix, self._all = path, prefix, list(names)
        self._names = [name.removeprefix(prefix + "/") for name in self._all if name.startswith(prefix + "/")]
        self._added = dict(added or {})

    def __getitem__(self, name: str) -> NDArray:
        if name in self._added:
            return self._added[name]
        if name not in self._names:
            raise KeyError(name)
        with np.load(self._path) as file:
            return file[f"{self._prefix}/{name}"]

    def __contains__(self, name: object) -> bool:
        return name in self._added or name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys([*self._names, *self._added]))

    def __len__(self) -> int:
        return len({*self._names, *self._added})

    def __or__(self, other: Mapping[str, NDArray]) -> StoredArrays:
        return StoredArrays(self._path, self._all, self._prefix, {**self._added, **other})


def load_outputs(path: Path) -> dict[str, Array]:
    """The results of a snapshot that are no fields, by name."""
    with np.load(path) as file:
        return _under(file, "output")


def load_state(path: Path) -> dict[str, Array]:
    """The arrays of the solver's state of a snapshot, to start a neighbour from."""
    with np.load(path) as file:
        return _under(file, "state")


def _under(file: np.lib.npyio.NpzFile, prefix: str) -> dict[str, NDArray]:
    """The arrays whose names start with ``prefix/``, without it."""
    names = [name for name in file.files if name.startswith(prefix + "/")]
    return {name.removeprefix(prefix + "/"): file[name] for name in names}
