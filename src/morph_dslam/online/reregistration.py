"""Placing an object anew in mid-sequence: where the user says so, or by its aid after a long loss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from morph_dslam.errors import RegistrationError, TrackingError
from morph_dslam.io.landmarks import Landmarks, load_landmarks
from morph_dslam.online.aids.start import place_by_aid
from morph_dslam.online.chain import Chain
from morph_dslam.online.frame_result import FrameResult
from morph_dslam.online.placement import Placement, place_by_landmarks
from morph_dslam.online.tracking_setup import Setup
from morph_dslam.sources import Frame

#: After so many lost frames on end the aid is tried, and again after as many more.
LONG_LOSS = 30


class Reregistration:
    """Decides before each frame which chain goes on.

    Parameters
    ----------
    at : frames in which to place the object anew, and the landmarks there; None for the run's own aid.

    Raises
    ------
    TrackingError
        If a frame has no landmarks and the run no aid.
    RegistrationError
        If a file of landmarks cannot be read.
    """

    def __init__(self, setup: Setup, placement: Placement, at: Sequence[tuple[int, Path | None]]) -> None:
        if setup.aid is None and any(landmarks is None for _, landmarks in at):
            raise TrackingError(
                "to place the object anew give landmarks of that frame (--reregister-at N=FILE), or start "
                "from a board, a picture or a guess, which are looked for there again"
            )
        self._setup, self._placement, self._n_lost = setup, placement, 0
        self._at = {frame: None if path is None else load_landmarks(path) for frame, path in at}
        self._notes: list[str] = []

    @property
    def notes(self) -> list[str]:
        """What was done, and where it was to be done and was not, for the reader of the run."""
        return [*self._notes, *(f"not placed anew in frame {n}: it was not tracked" for n in self._at)]

    def chain(self, frame: Frame, chain: Chain) -> Chain:
        """The chain that processes the frame: the one so far, or a new one whose reference is this frame."""
        wanted = frame.index in self._at
        after_loss = self._setup.aid is not None and self._n_lost > 0 and self._n_lost % LONG_LOSS == 0
        if not wanted and not after_loss:
            return chain
        landmarks = self._at.pop(frame.index, None)
        try:
            placed = self._placed(frame, landmarks)
        except RegistrationError as error:
            if wanted:
                self._notes.append(f"not placed anew in frame {frame.index}: {error}")
            return chain
        self._notes += [f"placed anew in frame {frame.index}", *placed.flags]
        self._n_lost = 0
        return self._setup.new_chain(placed, frame.image, True)

    def take_in(self, result: FrameResult) -> None:
        """Count the frames that are lost on end."""
        self._n_lost = self._n_lost + 1 if result.status == "lost" else 0

    def _placed(self, frame: Frame, landmarks: Landmarks | None) -> Placement:
        """The object in the frame, with the model and what else the run began with."""
        model, camera, options = self._placement.model, self._setup.camera, self._setup.options
        if landmarks is not None:
            found = place_by_landmarks(model, camera, landmarks, options.registration)
        else:
            assert self._setup.aid is not None
            image = np.asarray(frame.image, dtype=np.uint8)
            found = place_by_aid(self._setup.aid, model, camera, image)
        return replace(found, per_sequence=self._placement.per_sequence, place=self._placement.place)
