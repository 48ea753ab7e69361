"""Depth images by frame number: what the surfaces of a run are measured against."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import EvaluationError, SourceError
from morph_dslam.sources import open_source
from morph_dslam.sources.folder import numbered_images
from morph_dslam.sources.images import DepthScale, read_depth

DepthImage = NDArray[np.float32]


def read_depths(
    path: Path, frames: Sequence[int], values_per_metre: float | None = None
) -> Iterator[tuple[int, DepthImage]]:
    """Frame numbers among ``frames`` that have depth, each with its image (h, w): metres, NaN where unknown.

    Parameters
    ----------
    path : a ``depth.h5`` of `morph simulate`; a folder of numbered 16-bit images; or a recording with depth
        of its own, in the layout of TUM RGB-D or 7-Scenes.
    values_per_metre : of the images of a folder, which is taken for a recording without it.

    Raises
    ------
    EvaluationError
        If there is nothing of the kind, it is damaged, or a file is given a unit.
    """
    wanted = sorted(frames)
    try:
        if path.is_file():
            if values_per_metre is not None:
                raise EvaluationError(
                    f"--depth-per-metre is for a folder of depth images, and {path} is a file, whose depths "
                    "are metres: leave it out"
                )
            yield from _from_file(path, wanted)
        elif not path.is_dir():
            raise EvaluationError(f"there are no depth images at {path}")
        elif values_per_metre is not None:
            yield from _from_folder(path, wanted, values_per_metre)
        else:
            yield from _from_recording(path, wanted)
    except SourceError as error:
        raise EvaluationError(f"the depth images cannot be read: {error}") from error


def _from_file(path: Path, frames: Sequence[int]) -> Iterator[tuple[int, DepthImage]]:
    """Of dataset ``depth_m`` (t, h, w), which is 0 where the object is not seen."""
    try:
        with h5py.File(path, "r") as file:
            dataset = file["depth_m"]
            assert isinstance(dataset, h5py.Dataset)
            for frame in frames:
                if 0 <= frame < len(dataset):
                    depth = np.asarray(dataset[frame], dtype=np.float32)
                    yield frame, np.where(depth > 0.0, depth, np.float32(np.nan))
    except (OSError, KeyError, RuntimeError, AssertionError) as error:
        raise EvaluationError(
            f"{path} is not a depth.h5 of `morph simulate`, or damaged ({error}): simulate again"
        ) from error


def _from_folder(folder: Path, frames: Sequence[int], scale: float) -> Iterator[tuple[int, DepthImage]]:
    if not scale > 0.0:
        raise EvaluationError(f"depth images cannot have {scale:g} values a metre: give 1000 for millimetres")
    images = numbered_images(folder)
    for frame in frames:
        if frame in images:
            yield frame, read_depth(images[frame], f"frame {frame}", DepthScale(scale))


def _from_recording(path: Path, frames: Sequence[int]) -> Iterator[tuple[int, DepthImage]]:
    has_depth = False
    for frame in open_source(path):
        if frame.depth is not None:
            has_depth = True
            if frame.index in frames:
                yield frame.index, frame.depth
    if not has_depth:
        raise EvaluationError(
            f"{path} is no recording with depth; if it is a folder of depth images, say how many of their "
            "values make a metre with --depth-per-metre (1000 for millimetres)"
        )
