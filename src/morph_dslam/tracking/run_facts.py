"""What the summary of a run says of it beside its results: its files, its options, and what was made of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from morph_dslam.tracking.frame_starts import temporal_facts
from morph_dslam.tracking.options import TrackerOptions
from morph_dslam.tracking.placement import PlacedObject
from morph_dslam.tracking.run_options import ObjectOptions, TrackOptions
from morph_dslam.tracking.run_results import RunResults

#: Options that are among the inputs, or have an entry of their own, or change no result.
_NO_SETTINGS = {"frames", "camera", "other_cameras", "other_landmarks", "reference_image", "map_path"}
_NO_SETTINGS |= {"model", "landmarks", "registration", "initializer", "known", "inner"}
_NO_SETTINGS |= {"others", "tracker", "output", "overwrite"}


def run_facts(run: TrackOptions, number: int, part: PlacedObject, results: RunResults) -> dict[str, Any]:
    """What the summary of an object's run folder says beside its results.

    Parameters
    ----------
    run : the options.
    number : of the object among those of the run.
    part : the object as it was tracked.
    results : of all frames.

    Returns
    -------
    Entries of ``summary.json`` (docs/run-folder.md).
    """
    files, scene, options = run.objects[number], part.object.scene, part.options
    by_outline = any(result.by_outline for result in results.results)
    return temporal_facts(part.model.study_parameters, options) | {
        "new_reference_views": {
            "allowed": _makes_views(part, results),
            "made": sum(result.made_view for result in results.results),
            "frames_compared_with_them": sum(result.view > 0 for result in results.results),
        },
        "registration": part.registration.facts,
        "inputs": _inputs(run, files, None if scene is None else scene.path),
        "reference_keyframes": part.reference_keyframes,
        "reference_refined_over_the_sequence": results.refined,
        "outline_used": options.use_outline or by_outline,
        "depth_used": options.use_depth,
        "discrepancy_used": options.use_discrepancy,
        "unknown_loads_used": options.use_unknown_loads,
        "pose": options.pose if scene is not None or options.pose == "still" else "free",
        "settings": _settings(run, files, options),
    }


def _makes_views(part: PlacedObject, results: RunResults) -> bool:
    """Whether frames may become reference views: those of one camera, in which more than the outline is followed."""
    tracked = [result for result in results.results if result.tracked]
    by_outline = bool(tracked) and all(result.by_outline for result in tracked)
    return part.options.makes_views and len(part.cameras) == 1 and not by_outline


def _inputs(run: TrackOptions, files: ObjectOptions, map_path: Path | None) -> dict[str, Any]:
    """The files that the object was tracked with, by name: a path, or a list of them."""
    named = {"frames": run.frames, "model": files.model, "camera": run.camera, "landmarks": files.landmarks}
    named |= {"reference_image": run.reference_image, "registration": files.registration, **vars(files.initializer)}
    named |= {"map": map_path, "known": files.known, "inner": files.inner, "with": run.other_cameras}
    named["with_landmarks"] = run.other_landmarks if files is run else ()
    named["reregister_at"] = tuple(path for _, path in files.reregister_at if path is not None)
    return {name: _plain(value) for name, value in named.items() if value not in (None, ())}


def _settings(run: TrackOptions, files: ObjectOptions, options: TrackerOptions) -> dict[str, Any]:
    """All other options by their names in `TrackOptions`: of the run, and those of the object."""
    settings = {one.name: getattr(run, one.name) for one in fields(run) if one.name not in _NO_SETTINGS}
    settings |= {one.name: getattr(files, one.name) for one in fields(ObjectOptions) if one.name not in _NO_SETTINGS}
    return _plain(settings | {"others": [name for name, _ in run.others], "tracker": options})


def _plain(value: Any) -> Any:
    """A value as JSON has it; paths as text."""
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value))
    if isinstance(value, Mapping):
        return {name: _plain(one) for name, one in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, tuple | list):
        return [_plain(one) for one in value]
    return str(value) if isinstance(value, Path) else value
