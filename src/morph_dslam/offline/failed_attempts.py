"""Attempts that did not converge, kept on disk, so that a build that comes back does not repeat them."""

from __future__ import annotations

import hashlib
from pathlib import Path

from morph_dslam.offline.snapshots import source_fingerprint, write_atomically

#: Code that decides whether an attempt converges.
_CODE = ("materials", "mechanics", "solvers", "studies")


class FailedAttempts:
    """Small text files beside the snapshots, one for each attempt, that hold the reason.

    Parameters
    ----------
    keys : of the samples, by index (`morph_dslam.offline.snapshots.snapshot_keys`).
    """

    def __init__(self, folder: Path, keys: list[str]) -> None:
        self._folder, self._keys = folder, keys
        self._code = source_fingerprint(_CODE)

    def _file(self, origin: int, sample: int) -> Path:
        start = self._keys[origin] if origin >= 0 else "root"
        name = hashlib.sha256(f"{self._code} {start} {self._keys[sample]}".encode()).hexdigest()[:24]
        return self._folder / f"{name}.failed"

    def reason(self, origin: int, sample: int) -> str | None:
        """Why ``sample`` could not be solved from ``origin`` (-1 for the root); None if never tried."""
        file = self._file(origin, sample)
        return file.read_text(errors="replace") if file.is_file() else None

    def record(self, origin: int, sample: int, reason: str) -> None:
        """Keep the reason of an attempt that failed."""
        write_atomically(self._file(origin, sample), reason.encode())
