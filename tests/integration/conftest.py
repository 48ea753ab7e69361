"""Recordings that several test files share."""

import pytest

from tests.support.rendered_anchored_rig import make_rig_recording


@pytest.fixture(scope="session")
def rig_recording(tmp_path_factory):
    """Folder and truth of `make_rig_recording`."""
    folder = tmp_path_factory.mktemp("rig")
    return folder, make_rig_recording(folder)
