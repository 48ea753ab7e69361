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
from morph_dslam.online.start.placement import Placement, place_by_landmarks
from morph_dslam.online.tracking_setup import Setup
from morph_dslam.sources import Frame

#: After so many lost frames on end the aid is tried, and again after as many more.
LONG_LOSS = 30


class Reregistration:
    """Decides before each frame which chain goes on.

    Parameters
    ----------
    at : frames in which to place the object anew, and the landmarks there; None for the run's own aid.
    begin : the reference frame; frames before it are not waited for.

    Raises
    ------
    TrackingError
        If a frame has no landmarks and the run no aid.
    RegistrationError
        If a file of landmarks cannot be read.
    """

    def __init__(
        self, setup: Setup, placement: Placement, at: Sequence[tuple[int, Path | None]], begin: int = 0
    ) -> None:
        if setup.aid is None and any(landmarks is None for _, landmarks in at):
            raise TrackingError(
                "to place the object anew give landmarks of that frame (--reregister-at N=FILE), or start "
                "from a board, a picture or a guess, which are looked for there again"
            )
        self._setup, self._placement, self._n_lost = setup, placement, 0
        self._before = begin
        self._at = {frame: None if path is None else load_landmarks(path) for frame, path in at}
        self._notes: list[str] = []

    @property
    def notes(self) -> list[str]:
        """What was done, and where it was to be done and was not, for the reader of the run."""
        return [*self._notes, *(f"not placed anew in frame {n}: it was not tracked" for n in self._at)]

    def chain(self, frame: Frame, chain: Chain) -> Chain:
        """The chain that processes the frame: the one so far, or a new one whose reference is this frame."""
        due = self._due(frame.index)
        after_loss = self._setup.aid is not None and self._n_lost > 0 and self._n_lost % LONG_LOSS == 0
        if not due and not after_loss:
            return chain
        given = [self._at.pop(n) for n in due]
        try:
            placed = self._placed(frame, next((found for found in given if found is not None), None))
            tracker = self._setup.new_tracker(placed, frame.image, True)
        except RegistrationError as error:
            if due:
                self._notes.append(f"not placed anew in frame {frame.index}: {error}")
            return chain
        self._notes += [f"placed anew in frame {frame.index}", *placed.flags]
        self._n_lost = 0
        return chain.with_tracker(tracker)

    def _due(self, frame: int) -> list[int]:
        """The numbers for which this frame is the one; the aid may be late where live frames were dropped."""
        before, self._before = self._before, frame
        return [
            n for n, landmarks in self._at.items() if n == frame or (landmarks is None and before < n < frame)
        ]

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
