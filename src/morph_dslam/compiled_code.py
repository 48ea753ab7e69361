"""Where numba keeps what it has compiled, if it can keep it neither in this package's folder nor in the user's."""

import os
import stat
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path


def own_folder(package: Path, environment: Mapping[str, str]) -> Path | None:
    """A folder for compiled code that only this user may write; None where numba finds one itself.

    A container often runs as a user without a home, from files that only root may change. Numba then refuses to load
    compiled functions at all.

    Parameters
    ----------
    package : folder of the modules with compiled functions.
    environment : variables of this process.
    """
    if environment.get("NUMBA_CACHE_DIR") or os.access(package, os.W_OK):
        return None
    try:
        usual = Path(environment.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "numba"
        usual.mkdir(parents=True, exist_ok=True)
        if os.access(usual, os.W_OK):
            return None
    except (OSError, RuntimeError):  # there is no home
        pass
    folder = Path(tempfile.gettempdir()) / f"morph-dslam-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        # Whoever writes there decides what this process runs.
        if found.st_uid == os.getuid() and stat.S_IMODE(found.st_mode) == 0o700:
            return folder
    except OSError:
        pass
    return Path(tempfile.mkdtemp(prefix="morph-dslam-"))


def find_folder() -> None:
    """Tell numba, here and in processes that this one starts, where to keep compiled code, if it has no place."""
    folder = own_folder(Path(__file__).parent, os.environ)
    if folder is not None:
        os.environ["NUMBA_CACHE_DIR"] = str(folder)
        if "numba" in sys.modules:
            sys.modules["numba"].config.CACHE_DIR = str(folder)
