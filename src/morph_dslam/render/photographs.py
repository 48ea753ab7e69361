"""Photographs that texture a scene: the user's own files, or those that scikit-image packages."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import SceneError, SourceError
from morph_dslam.sources.images import read_image


def _packaged_folder() -> Path | None:
    """The folder of scikit-image's photographs, or None where it is not installed."""
    spec = find_spec("skimage")
    return None if spec is None or spec.origin is None else Path(spec.origin).parent / "data"


def find_photograph(name: str, folder: Path) -> Path:
    """The file of a photograph.

    Parameters
    ----------
    name : a path relative to ``folder``, or the bare name of a photograph packaged with scikit-image, such
        as "coffee". A name with a suffix or a folder is always a path.

    Raises
    ------
    SceneError
        If there is no such file, or a packaged photograph is wanted and scikit-image is not installed.
    """
    path = folder / name
    if path.is_file():
        return path
    if Path(name).suffix or Path(name).name != name:
        raise SceneError(f"there is no image {path}")
    packaged = _packaged_folder()
    if packaged is None:
        raise SceneError(
            f"'{name}' is a photograph packaged with scikit-image, which is not installed: "
            'pip install "morph-dslam[demo]", or name an image file'
        )
    files = {file.stem: file for file in sorted(packaged.glob("*.png")) + sorted(packaged.glob("*.jpg"))}
    if name not in files:
        raise SceneError(
            f"scikit-image packages no photograph '{name}': use one of {', '.join(sorted(files))}, "
            "or an image file"
        )
    return files[name]


def resize_to_fill(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """The largest centred part of an image (h, w, ...) with these proportions, resized, (height, width, ...).

    A finer image would alias, so it is averaged down; a coarser one is smoothed up.
    """
    cropped = crop_to_aspect(image, width / height)
    shrinks = cropped.shape[1] > width
    resized = cv2.resize(
        cropped, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
    )
    return np.asarray(resized, dtype=np.uint8)


def crop_to_aspect(image: NDArray[np.uint8], aspect: float) -> NDArray[np.uint8]:
    """The largest centred part (k, l, ...) of an image (h, w, ...) with this width-to-height ratio."""
    height, width = image.shape[:2]
    kept_width = min(width, max(1, round(height * aspect)))
    kept_height = min(height, max(1, round(width / aspect)))
    left, top = (width - kept_width) // 2, (height - kept_height) // 2
    return image[top : top + kept_height, left : left + kept_width]


def load_photograph(name: str, folder: Path) -> NDArray[np.uint8]:
    """A photograph (H, W, 3) uint8, blue, green, red; raises SceneError as `find_photograph` does."""
    path = find_photograph(name, folder)
    try:
        return read_image(path, f"photograph '{name}'")
    except SourceError as error:
        raise SceneError(str(error)) from error
