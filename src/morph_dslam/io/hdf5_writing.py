"""HDF5 files that appear under their names when they are complete: a full disk ends no program."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

import h5py

from morph_dslam.io.writing import removed_on_failure

if sys.platform != "win32":
    import fcntl


#: What the name of a file ends with until it is complete.
PARTIAL = ".partial"
#: What stays as it is in the name of a member; "/" would start another group.
_PLAIN = " !#$&'()*+,:;=?@[]"


def member_name(name: str) -> str:
    """The name that a group's member has in a file: percent-encoded (RFC 3986); `urllib.parse.unquote` reads it."""
    return quote(name, safe=_PLAIN)


class _Drive(io.FileIO):
    """A file for the HDF5 library, which may end the program where a drive does not take what is left on closing.

    After a write that fails all others seem to succeed.

    Parameters
    ----------
    path : of the file, which is made anew.

    Attributes
    ----------
    failure : what the system said first; None if it took everything.

    Raises
    ------
    BlockingIOError
        If another program writes to the file.
    """

    failure: OSError | None = None

    def __init__(self, path: Path) -> None:
        super().__init__(os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666), "r+")
        try:
            self._lock()
            super().truncate(0)
        except OSError:
            self.close()
            raise

    def _lock(self) -> None:
        """Keep other programs out, as the HDF5 library does."""
        if sys.platform == "win32":
            return
        try:
            fcntl.flock(self, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise
        except OSError:  # no locks on this drive
            pass

    def close(self) -> None:
        if sys.platform != "win32" and not self.closed:
            with suppress(OSError):
                fcntl.flock(self, fcntl.LOCK_UN)  # processes forked meanwhile hold the file open too
        super().close()

    def write(self, data: Any, /) -> int:
        left = memoryview(data).cast("B")
        size = len(left)
        try:
            while self.failure is None and len(left):
                left = left[super().write(left) :]
        except OSError as error:
            self.failure = error
        return size

    def truncate(self, size: int | None = None, /) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.failure = self.failure or error
            return size or 0


@contextmanager
def written_hdf5(path: Path, complete: Callable[[Path], None] | None = None, **options: Any) -> Iterator[h5py.File]:
    """A new HDF5 file, which takes its name, from an earlier one too, when it is complete.

    Until then it stands beside, so that programs that have the earlier one open, and locked, go on with that. It is
    deleted if it cannot be written.

    Parameters
    ----------
    path : of the file.
    complete : what remains to be done with the closed file, by its path, before it gets its name.
    options : for `h5py.File`.

    Raises
    ------
    OSError
        Which names the file, if it cannot be written to its end; BlockingIOError if another program writes it.
    """
    partial = path.with_name(path.name + PARTIAL)
    with _Drive(partial) as drive, removed_on_failure(partial):
        try:
            with h5py.File(drive, "w", **options) as file:
                yield file
        finally:
            if drive.failure is not None:
                raise OSError(drive.failure.errno, drive.failure.strerror, str(partial)) from drive.failure
    with removed_on_failure(partial):
        if complete is not None:
            complete(partial)
        os.replace(partial, path)
