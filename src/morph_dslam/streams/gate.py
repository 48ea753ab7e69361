"""Who may connect to a stream: who was given the token, by this server's own name, and no page from elsewhere."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs

from morph_dslam.errors import StreamError
from morph_dslam.io.access import HOST, ServerNames, new_token, same_token, split_target

#: An environment variable that keeps the token from run to run.
TOKEN_VARIABLE = "MORPH_STREAM_TOKEN"
#: Characters that such a token needs at least: with fewer it might be guessed.
SHORTEST_TOKEN = 16


def stream_token() -> str:
    """The token of the environment, or one that cannot be guessed.

    Raises
    ------
    StreamError
        If that of the environment is too short, or has characters that an address cannot hold.
    """
    given = os.environ.get(TOKEN_VARIABLE)
    if given is None:
        return new_token()
    if len(given) < SHORTEST_TOKEN or not given.replace("-", "").replace("_", "").isalnum() or not given.isascii():
        raise StreamError(
            f"{TOKEN_VARIABLE} must be {SHORTEST_TOKEN} or more letters, digits, '-' or '_': "
            "anybody who has it sees the results"
        )
    return given


@dataclass(frozen=True)
class Refusal:
    """Why a request is not answered.

    Attributes
    ----------
    status : of the answer.
    text : for people.
    """

    status: HTTPStatus
    text: str


class StreamGate:
    """Lets requests through that carry the token, in the address or in the cookie that the page has got for it.

    Parameters
    ----------
    token : that is asked for.
    host : that the server listens at; by another one than this computer's own it may be asked by any numeric address.
    port : that it listens at.
    names : by which it may be asked, beside those of this computer alone.
    """

    def __init__(self, token: str, host: str, port: int, names: Iterable[str] = ()) -> None:
        self._token, self._names = token, ServerNames(names, any_address=host != HOST)
        self.cookie = f"morph_stream_{port}"

    def refusal(self, path: str, headers: Mapping[str, str]) -> Refusal | None:
        """Why a request with these headers is refused; None if it is not."""
        refusal = self._names.refusal(headers.get("Host", ""), headers.get("Origin"))
        if refusal is not None:
            return Refusal(HTTPStatus.FORBIDDEN, refusal)
        if not (self.has_token(path) or same_token(self._cookie_of(headers), self._token)):
            return Refusal(
                HTTPStatus.UNAUTHORIZED, "open the address that `morph` printed: it carries the token (?token=...)"
            )
        return None

    def has_token(self, path: str) -> bool:
        """Whether an address carries the token."""
        return same_token(parse_qs(split_target(path)[1]).get("token", [""])[-1], self._token)

    def _cookie_of(self, headers: Mapping[str, str]) -> str:
        try:
            found = SimpleCookie(headers.get("Cookie", "")).get(self.cookie)
        except CookieError:
            return ""
        return "" if found is None else found.value
