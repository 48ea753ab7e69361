"""Files that cannot be written: the message names the file, and no half of it stays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from morph_dslam.errors import MorphError, refusal


@contextmanager
def writing(kind: type[MorphError], path: Path | None = None) -> Iterator[None]:
    """Say which file cannot be written.

    Parameters
    ----------
    kind : of the error that is raised in place of the system's.
    path : the file, or the folder of the files that are written.
    """
    try:
        yield
    except OSError as error:
        raise kind(f"cannot write {refusal(error, path)}") from error


@contextmanager
def removed_on_failure(path: Path) -> Iterator[None]:
    """Delete a file that has not been written to its end."""
    try:
        yield
    except BaseException:
        with suppress(OSError):
            if path.is_file():  # and no device
                path.unlink()
        raise


def check_no_input(
    outputs: Iterable[Path],
    inputs: Iterable[str | Path | None],
    kind: type[MorphError],
    folders_are_emptied: bool = False,
) -> None:
    """Raise an error of a kind if a file that is to be written is one of those that are read.

    Parameters
    ----------
    outputs : files to write, whether they are there or not.
    inputs : files and folders that are read; None for what is not given.
    kind : of the error.
    folders_are_emptied : whether folders among the outputs lose the files that they hold.
    """
    given = [Path(path) for path in inputs if path is not None]
    for output in outputs:
        for path in given:
            with suppress(OSError):  # it is not there
                is_it = path.samefile(output)
                is_in_it = folders_are_emptied and output.resolve() in path.resolve().parents
                if is_it or is_in_it:
                    raise kind(
                        f"{path if is_in_it else output} is an input of this command, and would be overwritten: write "
                        "to another place"
                    )
