"""What a file is: by its content, whatever it is called."""

from __future__ import annotations

import re
from pathlib import Path

#: How files of a kind begin, by the ending that their names have by rights.
_BEGINNINGS = {
    ".png": rb"\x89PNG\r\n",
    ".jpg": rb"\xff\xd8\xff",
    ".bmp": rb"BM.{4}\0{4}",
    ".tif": rb"II\*\0|MM\0\*",
    ".webp": rb"RIFF.{4}WEBP",
    ".pgm": rb"P[25]\s",
    ".ppm": rb"P[36]\s",
    ".mp4": rb".{4}ftyp",
    ".mkv": rb"\x1aE\xdf\xa3",
    ".avi": rb"RIFF.{4}AVI ",
    ".bag": rb"#ROSBAG V",
    ".mcap": rb"\x89MCAP",
    ".db3": rb"SQLite format 3\0",
    ".step": rb"\s*ISO-10303-21;",
    ".msh": rb"\s*\$(MeshFormat|Comments|NOD)\b",
    ".vtk": rb"# vtk DataFile",
    ".vtu": rb"\s*<(\?xml|!--|VTKFile).*?<?VTKFile[^>]*UnstructuredGrid",
    ".xdmf": rb"\s*<(\?xml|!|Xdmf).*?<?Xdmf\b",
    ".ply": rb"ply\r?\n",
    ".stl": rb"\s*solid\b.*?\bfacet\s+normal\b",
    ".obj": rb"(\s*#[^\n]*\n|\s*\n)*\s*(mtllib |v\s+[-+.\d]+\s+[-+.\d])",
    ".inp": rb"(\s*\*\*[^\n]*\n|\s*\n)*\s*\*[A-Za-z]",
}
_PATTERNS = {kind: re.compile(beginning, re.DOTALL) for kind, beginning in _BEGINNINGS.items()}
#: Names that are as good as those above.
_SAME = {".jpeg": ".jpg", ".tiff": ".tif", ".stp": ".step", ".xmf": ".xdmf"}
IMAGES = (".png", ".jpg", ".bmp", ".tif", ".webp", ".pgm", ".ppm")
VIDEOS = (".mp4", ".mkv", ".avi")
MESHES = (".inp", ".msh", ".vtk", ".vtu", ".step", ".stl", ".obj", ".ply")
#: Bytes that tell it.
_HEAD = 4096
#: A binary STL file has a header of so many bytes, a count, and so many bytes for each triangle.
_STL_HEADER, _STL_TRIANGLE = 80, 50


def file_kind(path: str | Path) -> str:
    """The ending that fits what is in a file, in small letters: ".png", ".stl"; one of several for the same.

    By its name where the content does not tell, or there is no file that can be read.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
        size = path.stat().st_size
    except OSError:
        head, size = b"", 0
    return content_kind(head, size) or named_kind(path)


def content_kind(head: bytes, size: int = 0) -> str | None:
    """The same of the first bytes of a file of a size; None where they do not tell it."""
    n_triangles = int.from_bytes(head[_STL_HEADER : _STL_HEADER + 4], "little")
    if n_triangles and size == _STL_HEADER + 4 + n_triangles * _STL_TRIANGLE:
        return ".stl"
    return next((kind for kind, pattern in _PATTERNS.items() if pattern.match(head)), None)


def named_kind(path: Path) -> str:
    """The same by a file's name alone."""
    suffix = path.suffix.lower()
    return _SAME.get(suffix, suffix)
