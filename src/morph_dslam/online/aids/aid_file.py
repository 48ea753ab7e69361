"""TOML files that help to place an object: what they have in common, and what is said of a mistake in one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from morph_dslam.errors import RegistrationError
from morph_dslam.io.toml_file import read_toml

#: A coordinate or an angle. None is meant by what is larger: in millimetres it would be ten kilometres.
Number = Annotated[float, Field(ge=-1e7, le=1e7)]
Vector = tuple[Number, Number, Number]


class Section(BaseModel):
    """A part of such a file; unknown keys are mistakes."""

    model_config = ConfigDict(extra="forbid")


AnySection = TypeVar("AnySection", bound=Section)


def read_aid(path: Path, what: str, kind: type[AnySection]) -> AnySection:
    """Read a file and check it.

    Parameters
    ----------
    what : the file is, for the message. kind : its content.

    Raises
    ------
    RegistrationError
        If it is missing, no TOML, or says something impossible.
    """
    content = read_toml(path, what, RegistrationError)
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        message = first["msg"].removeprefix("Value error, ")
        raise RegistrationError(f"{path}: {where}: {message}" if where else f"{path}: {message}") from error
