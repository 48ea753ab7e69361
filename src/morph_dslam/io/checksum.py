"""The checksum at the head of an HDF5 file, compared before the HDF5 library sees it.

Damaged structures can lead that library astray. The block before them, which HDF5 leaves to its user, holds a line of
text that says what the file is, and the SHA-256 of the rest.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py

from morph_dslam.io.hdf5_writing import written_hdf5

#: Length of the block in bytes; HDF5 asks for a power of two from 512.
BLOCK = 512
#: How every HDF5 file begins that has no block before it.
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def _block(path: Path, title: str) -> bytes:
    with path.open("rb") as file:
        file.seek(BLOCK)
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return f"{title}\nsha256 {digest}\n".encode().ljust(BLOCK, b"\0")


@contextmanager
def written_with_checksum(path: Path, title: str) -> Iterator[h5py.File]:
    """A new HDF5 file, which appears under its name with its checksum only when it is complete."""
    with written_hdf5(path, lambda partial: write_checksum(partial, title), userblock_size=BLOCK) as file:
        yield file


def write_checksum(path: Path, title: str) -> None:
    """Write the checksum into the block of a complete HDF5 file that begins with an empty one."""
    block = _block(path, title)
    with path.open("r+b") as file:
        file.write(block)


def is_other_hdf5(path: Path) -> bool:
    """Whether a file is HDF5 without such a block."""
    with path.open("rb") as file:
        return file.read(len(HDF5_SIGNATURE)) == HDF5_SIGNATURE


def begins_with(path: Path, title: str) -> bool:
    """Whether a file begins with the title, so that it is of this kind or damaged behind its head."""
    line = f"{title}\n".encode()
    with path.open("rb") as file:
        return file.read(len(line)) == line


def check_checksum(path: Path, title: str) -> None:
    """Raise ValueError, which says why, if a file does not begin with the title, or was changed later."""
    if not begins_with(path, title):
        raise ValueError("it does not begin as such a file")
    with path.open("rb") as file:
        found = file.read(BLOCK)
    if found != _block(path, title):
        raise ValueError("its content does not match its checksum")
