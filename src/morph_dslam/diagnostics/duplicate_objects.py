"""Whether what is followed may be another object with the same print.

Two such objects look the same; only where they are tells them apart, as long as one is followed without a
gap. So another one is looked for when something comes before the object, and for a second after it was found
by its features. Where there is one, the object is in two places; once it was covered or lost while there was
one, nothing tells any more which of them is followed, and that is said from then on.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morph_dslam.timing import StageClock
from morph_dslam.tracking.recovery import TWO_PLACES, Recovery
from morph_dslam.tracking.result import MAY_BE_ANOTHER, Image, PoseHypothesis

Array = NDArray[np.float64]

#: Frames after it was found by its features in which another one is looked for; until the last it is doubted
#: if it was found farther than this share of its size from where it was seen last.
LOOKS, FAR_SHARE = (1, 2, 4, 8, 15, 30), 0.5

#: While something is before the object another one is looked for in every so many frames.
LOOK_EVERY = 15


class DuplicateObjects:
    """Watches the frames in which the object is believed to be found.

    Parameters
    ----------
    nodes : (n, 3) of the undeformed object, metres.
    """

    def __init__(self, nodes: Array) -> None:
        self._centre = nodes.mean(axis=0)
        self._far = FAR_SHARE * float(np.linalg.norm(np.ptp(nodes, axis=0)))
        self._another = self._confused = False
        self._since_found, self._since_look, self._away = LOOKS[-1], LOOK_EVERY, 0.0
        self._middle: Array | None = None

    def refusal(
        self, picture: Image, attempt: PoseHypothesis, was_looked_for: bool, recovery: Recovery, clock: StageClock
    ) -> str:
        """Why an attempt is not to be believed after all; empty when it is.

        Parameters
        ----------
        was_looked_for : whether it was found by features, anywhere in the frame.
        """
        middle = attempt.estimate.state.camera_from_object.apply(self._centre)
        before, self._middle = self._middle, middle
        if attempt.prior is not None:  # the map tells which of them it is
            return ""
        self._since_found = 0 if was_looked_for else self._since_found + 1
        if was_looked_for:
            self._away = 0.0 if before is None else float(np.linalg.norm(middle - before))
        self._confused |= self._another and (was_looked_for or not recovery.most_agree(attempt))
        self._since_look += 1
        looks = self._since_found in LOOKS
        if not looks and recovery.partly_hidden(attempt):
            looks = self._since_look >= LOOK_EVERY
        if not looks:
            return ""
        self._since_look = 0
        other = recovery.another(picture, attempt, clock)
        if other is None:
            return ""
        self._another = True
        if self._since_found not in LOOKS:
            return ""
        self._since_found, self._confused = LOOKS[-1], True
        return TWO_PLACES

    def note_lost(self, why_not: str) -> None:
        """Take in that the object was not found."""
        self._another |= TWO_PLACES in why_not

    @property
    def doubt(self) -> str:
        """What is to be said of the frame; empty if it is the object for all that is known."""
        if self._confused:
            return f"{MAY_BE_ANOTHER}: both were seen, and it was covered or lost"
        if self._since_found < LOOKS[-1] and self._away > self._far:
            return f"{MAY_BE_ANOTHER}: it was found {1e3 * self._away:.0f} mm from where it was lost"
        return ""
