"""Real recordings, which are not part of the project: tests that use them skip where they are absent."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def real_data(name):
    """The folder of a recording under $MORPH_DATA or ../shared/data; skips the test if it is not there."""
    folder = Path(os.environ.get("MORPH_DATA", ROOT.parent / "shared" / "data")) / name
    if not folder.is_dir():
        pytest.skip(f"no recording {folder}; MORPH_DATA names the folder of recordings")
    return folder
