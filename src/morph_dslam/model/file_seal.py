"""The seal of a model file: a checksum of all that follows, in the block that HDF5 leaves to its user.

HDF5 files may begin with a block of any content (HDF5 File Format Specification, "user block"). Ours holds a
line of text and the SHA-256 of the rest of the file. It is compared before the HDF5 library sees the file,
for that library can be led astray by damaged structures: endless allocations, and worse.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

#: Length of the block in bytes; HDF5 asks for a power of two from 512.
BLOCK = 512
_TITLE = b"morph-dslam reduced model\n"
#: How every HDF5 file begins that has no block before it.
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def _block(path: Path) -> bytes:
    with path.open("rb") as file:
        file.seek(BLOCK)
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return (_TITLE + f"sha256 {digest}\n".encode()).ljust(BLOCK, b"\0")


def seal(path: Path) -> None:
    """Write the checksum into the block of a complete HDF5 file that begins with an empty one."""
    block = _block(path)
    with path.open("r+b") as file:
        file.write(block)


def is_sealed(path: Path) -> bool:
    """Whether the file has the block at all; files of version 1 and 2 have none and start as HDF5 does.

    Raises
    ------
    ValueError
        If it begins as neither.
    """
    with path.open("rb") as file:
        start = file.read(len(_TITLE))
    if start.startswith(HDF5_SIGNATURE):
        return False
    if start != _TITLE:
        raise ValueError("it does not begin as a model file")
    return True


def check_seal(path: Path) -> None:
    """Compare a sealed file with its checksum.

    Raises
    ------
    ValueError
        If a single byte differs from what was sealed.
    """
    with path.open("rb") as file:
        found = file.read(BLOCK)
    if found != _block(path):
        raise ValueError("its content does not match its checksum")
