"""Errors that a user can mend: each message says what is wrong, where, and how to mend it.

The command line prints the message alone and exits with status 2. Everything else that escapes is a defect.
"""

from __future__ import annotations

from enum import StrEnum
from os import PathLike
from typing import Any


class MorphError(Exception):
    """A mistake in the input that the user can mend; the base of all errors raised on purpose."""


class ArgumentError(MorphError, TypeError):
    """A function is given something of another kind than it takes."""


def check_kind(value: object, kind: type[Any] | tuple[type[Any], ...], what: str, instead: str) -> None:
    """Raise ArgumentError unless a value is of a kind.

    Parameters
    ----------
    value : the argument.
    kind : its class, or several.
    what : the argument's name, for the message.
    instead : what to give.
    """
    if not isinstance(value, kind):
        shown = repr(value) if isinstance(value, str | int | float | bool | None) else f"of type {type(value).__name__}"
        raise ArgumentError(f"{what} is {shown}: give {instead}")


def how_to_install(extra: str) -> str:
    """What to do where the packages of an extra of this package are missing; it is on no index."""
    return f"run `pip install '.[{extra}]'` in the project's folder"


def refusal(error: OSError, path: PathLike[str] | None = None) -> str:
    """What the system says of a file that it refuses; ``path`` is named where the system names none."""
    name = error.filename or path
    return f"{error.strerror or error}" if name is None else f"{name}: {error.strerror or error}"


class StudyError(MorphError):
    """The study file, its mesh or its parameter box is wrong."""


class SolverError(MorphError):
    """A mechanical problem could not be solved where the study asked for it."""


class WorkerError(MorphError):
    """A process that a sweep runs in was lost."""


class ModelFileError(MorphError):
    """A model file is missing, damaged, or of a version that this release cannot read."""


class ParameterError(MorphError):
    """A model is asked for parameters or fields that it does not have."""


class CameraError(MorphError):
    """The calibration is missing, malformed, or belongs to other images."""


class SourceError(MorphError):
    """Frames are missing, unreadable or cut short."""


class RegistrationFailure(StrEnum):
    """Why the images say no to a registration whose input is well formed."""

    NOT_FOUND = "not_found"
    WRONG_SIZE = "wrong_size"
    BOARD_NOT_SEEN = "board_not_seen"
    BOARD_DOES_NOT_FIT = "board_does_not_fit"
    PICTURE_NOT_SEEN = "picture_not_seen"
    GUESS_CONTRADICTED = "guess_contradicted"
    LANDMARKS_DO_NOT_FIT = "landmarks_do_not_fit"
    FEW_CORNERS = "few_corners"


class RegistrationError(MorphError):
    """The object could not be registered.

    Attributes
    ----------
    reason : RegistrationFailure or None
        What the images contradict; None where the input itself is wrong.
    """

    def __init__(self, message: str, reason: RegistrationFailure | None = None) -> None:
        super().__init__(message)
        self.reason = reason


class SceneError(MorphError):
    """The scene file of a simulation is wrong."""


class EvaluationError(MorphError):
    """Results and ground truth do not fit together."""


class IdentificationError(MorphError):
    """Measurements, and parameters to identify from them, do not fit together."""


class TrackingError(MorphError):
    """A tracking run cannot be written where it was asked for."""


class MapError(MorphError):
    """A map of the rigid scene is missing, damaged, of another version, or of another camera."""


class TrajectoryError(MorphError):
    """A camera trajectory is missing or malformed."""


class ExportError(MorphError):
    """An export asks for states outside the model's box, or cannot be written."""


class ExploreError(MorphError):
    """A model cannot be shown at the port that was asked for."""


class StreamError(MorphError):
    """Results cannot be sent where they were asked for."""


class StudioError(MorphError):
    """`morph studio` cannot start, or a request asks for what the project cannot give."""
