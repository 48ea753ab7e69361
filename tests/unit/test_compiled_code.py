"""Where compiled code is kept."""

import stat
import tempfile
from pathlib import Path

import pytest

from morph_dslam.compiled_code import own_folder

#: Where nothing can be made.
NOWHERE = {"XDG_CACHE_HOME": "/proc/nowhere"}


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_without_a_folder_to_write_to_compiled_code_is_kept_where_only_this_user_writes(temporary):
    folder = own_folder(Path("/proc/absent"), NOWHERE)
    assert folder is not None
    assert folder.parent == temporary
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert own_folder(Path("/proc/absent"), NOWHERE) == folder


@pytest.mark.parametrize("make", [lambda path: path.chmod(0o777), lambda path: (path.rmdir(), path.symlink_to("/tmp"))])
def test_a_folder_that_others_may_write_is_not_run_from(temporary, make):
    known = own_folder(Path("/proc/absent"), NOWHERE)
    assert known is not None
    make(known)
    folder = own_folder(Path("/proc/absent"), NOWHERE)
    assert folder is not None
    assert folder != known
    assert not folder.is_symlink()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_folders_that_can_be_written_are_left_to_numba(temporary):
    assert own_folder(temporary, NOWHERE) is None
    assert own_folder(Path("/proc/absent"), {"XDG_CACHE_HOME": str(temporary / "cache")}) is None
    assert own_folder(Path("/proc/absent"), NOWHERE | {"NUMBA_CACHE_DIR": "/proc/chosen"}) is None
    assert [path.name for path in temporary.iterdir()] == ["cache"]
