"""Registering an object anew in mid-sequence: where the user says so, or by its initializer after a long loss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from morph_dslam.errors import RegistrationError
from morph_dslam.notices import Notice
from morph_dslam.sources import Frame
from morph_dslam.tracking.multi_camera import RigTracker
from morph_dslam.tracking.outcomes import Status
from morph_dslam.tracking.placement import PlacedObject
from morph_dslam.tracking.result import FrameResult
from morph_dslam.tracking.run_notices import RunNotice, RunWarning
from morph_dslam.tracking.tracker import Tracker

#: After so many lost frames on end the initializer is tried, and again after as many more.
LONG_LOSS = 30


class Reregistration:
    """Decides before each frame whether an object goes on with a new tracker, whose reference is this frame.

    Parameters
    ----------
    placed : the object as the run began with it; ``placed.object.reregister_at`` are the frames.
    """

    def __init__(self, placed: PlacedObject) -> None:
        self._placed, self._n_lost = placed, 0
        self._before = placed.frame
        self._at = dict(placed.object.reregister_at)
        self._notices: list[Notice] = []

    @property
    def notices(self) -> list[Notice]:
        """What was done, and where it was to be done and was not."""
        why = "it was not tracked"
        missed = (RunNotice.of(RunWarning.NOT_REREGISTERED, frame=number, why=why) for number in self._at)
        return [*self._notices, *missed]

    def tracker(self, frames: Sequence[Frame], current: Tracker | RigTracker) -> Tracker | RigTracker:
        """The tracker for the next frames: the current one, or a new one."""
        part, number = self._placed.object, frames[0].index
        due = self._due(number)
        after_loss = part.initializer is not None and self._n_lost > 0 and self._n_lost % LONG_LOSS == 0
        if not due and not after_loss:
            return current
        landmarks = next((found for found in [self._at.pop(n) for n in due] if found is not None), None)
        try:
            registration = replace(part, model=self._placed.model).register(self._placed.cameras, frames, landmarks)
            tracker = self._placed.in_frames(registration, frames).new_tracker()
        except RegistrationError as error:
            if due:
                self._notices.append(RunNotice.of(RunWarning.NOT_REREGISTERED, frame=number, why=str(error)))
            return current
        self._notices += [RunNotice.of(RunWarning.REREGISTERED, frame=number), *registration.warnings]
        self._n_lost = 0
        tracker.estimator.known.take(current.estimator.known)  # what a sensor was said to tell holds on
        return tracker

    def _due(self, frame: int) -> list[int]:
        """The numbers for which this frame is the one; the initializer may be late where live frames are dropped."""
        before, self._before = self._before, frame
        return [n for n, landmarks in self._at.items() if n == frame or (landmarks is None and before < n < frame)]

    def learn(self, result: FrameResult) -> None:
        """Count the frames that are lost on end."""
        self._n_lost = self._n_lost + 1 if result.status is Status.LOST else 0
