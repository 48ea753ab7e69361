"""Several objects at their beginning, each with its model, its place, and the picture that it starts from.

Those that are anchored are so in one map of the scene.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from morph_dslam.errors import TrackingError
from morph_dslam.online.aids.start import AidFiles
from morph_dslam.online.attempt import Picture
from morph_dslam.online.runs.results import RunResults
from morph_dslam.online.several.hiding import Known, seen_parts
from morph_dslam.online.several.several_objects import ObjectsChain
from morph_dslam.online.start.placement import Placement
from morph_dslam.online.tracking_setup import ObjectOptions, Setup

_Options = TypeVar("_Options", bound=ObjectOptions)


@dataclass(frozen=True)
class OtherObject:
    """One more object.

    Attributes
    ----------
    name : of its folder in the run folder. model : file.
    start : file of landmarks in the reference frame, or the registration.json of `morph register`.
    """

    name: str
    model: Path
    start: Path

    @property
    def is_registered(self) -> bool:
        """Whether it starts from a registration in a map."""
        return self.start.suffix == ".json"

    def options(self, options: _Options) -> _Options:
        """The first object's options made its own; what they wish of parameters is for the first only."""
        return replace(
            options,
            model=self.model,
            landmarks=None if self.is_registered else self.start,
            placement=self.start if self.is_registered else None,
            map_path=options.map_path if self.is_registered else None,
            aids=AidFiles(),
            inner=(),
            per_sequence=(),
            random_walk=(),
            use_outline=False,
        )


def check_names(others: Sequence[OtherObject]) -> None:
    """Raise TrackingError unless the objects have different names that folders can have."""
    names = [other.name for other in others]
    for name in names:
        if names.count(name) > 1 or Path(name).name != name or name in ("", ".", "..", "plots"):
            raise TrackingError(
                f"'{name}' cannot be the name of another object's folder: give each a different, plain name"
            )


def check_one_map(setups: Sequence[Setup]) -> None:
    """Raise TrackingError if objects are anchored in different maps."""
    maps = {str(setup.map_path.resolve()): None for setup in setups if setup.map_path is not None}
    if len(maps) > 1:
        raise TrackingError(
            f"the objects are anchored in different maps, {' and '.join(maps)}: register them all in one"
        )


@dataclass(frozen=True)
class StartingObject:
    """An object and the ``picture`` that it starts from, a frame of this number or a keyframe of the map.

    ``in_sequence`` : whether the frames to track begin with it.
    """

    setup: Setup
    placement: Placement
    picture: NDArray[np.uint8] | Picture
    frame: int
    in_sequence: bool

    def new_run(self) -> RunResults:
        """Results of no frame so far."""
        constant = self.setup.tracker_options(self.placement).per_sequence
        return RunResults(self.placement.model, self.frame, per_sequence=constant)


def without_hidden(objects: Sequence[StartingObject]) -> list[StartingObject]:
    """The objects, known by nothing that another one hides in the pictures that they are known by."""
    seen = seen_parts([Known(part.setup, part.placement, part.frame) for part in objects])
    return [
        replace(part, setup=replace(part.setup, seen=own)) for part, own in zip(objects, seen, strict=True)
    ]


def objects_chain(objects: Mapping[str, StartingObject]) -> ObjectsChain:
    """All objects at their beginning, by name.

    Raises
    ------
    RegistrationError
        If two are registered in the same place, or one shows too few corners.
    """
    anchored = {name: part for name, part in objects.items() if part.setup.map_path is not None}
    placements = {name: part.placement for name, part in anchored.items()}
    first = next(iter(anchored.values()), None)
    anchor = None if first is None else first.setup.new_anchor(placements)
    trackers = {
        name: part.setup.new_tracker(
            part.placement, part.picture, part.in_sequence, part.setup.seen.get(part.frame)
        )
        for name, part in objects.items()
    }
    return ObjectsChain(next(iter(objects.values())).setup.camera, trackers, anchor)
