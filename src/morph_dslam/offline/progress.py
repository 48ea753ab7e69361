"""What a build is doing, for whoever waits: one line for each phase, between the progress bars."""

from __future__ import annotations

import sys

from tqdm import tqdm


def announce(phase: str) -> None:
    """Print the name of the phase that begins, on the stream of the progress bars and above them."""
    tqdm.write(phase, file=sys.stderr)
