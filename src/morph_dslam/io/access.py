"""Who a server answers: by its own names, from its own pages, with its token."""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
from collections.abc import Iterable
from urllib.parse import urlsplit

#: The address of this computer that no other one reaches.
HOST = "127.0.0.1"
_ORIGIN = re.compile(r"https?://(\[[^/?\[\]]+\]|[^/?\[\]]+)(:\d*)?(?=[/?]|$)", re.IGNORECASE)


def new_token() -> str:
    """A token that cannot be guessed."""
    return secrets.token_urlsafe(24)


def same_token(given: str, token: str) -> bool:
    """Whether a token is the right one, in a time that tells nothing of it."""
    return hmac.compare_digest(given.encode(errors="replace"), token.encode())


def split_target(target: str) -> tuple[str, str]:
    """Path and query of a request's target, "/page?query", also in absolute form, with "http://name" before it.

    Servers must take both (RFC 9112, 3.2.2). A target that is no URL is a path that nothing has.
    """
    absolute = _ORIGIN.match(target)
    path, _, query = target[absolute.end() if absolute else 0 :].partition("?")
    return path or "/", query


class ServerNames:
    """The names that a server may be asked by.

    A page from elsewhere could otherwise look on under a name of its own for this server's address (DNS rebinding).

    Parameters
    ----------
    names : beside those of this computer alone.
    any_address : whether any numeric address will do: it is no name that another site could take for its own.
    """

    def __init__(self, names: Iterable[str] = (), any_address: bool = False) -> None:
        # Browsers ask in lower case, whatever case the computer's own name is in.
        self._names = {name.lower() for name in (HOST, "localhost", *names)}
        self._any_address = any_address

    def refusal(self, host: str, origin: str | None, scheme: str = "http") -> str | None:
        """Why a request is refused; None if it is not.

        Parameters
        ----------
        host : header of the request.
        origin : header of the request; None if it has none.
        scheme : of the server's own pages.
        """
        if not self._knows(host):
            return "this server is not known by that name"
        if origin is not None and origin != f"{scheme}://{host}":
            return "pages from elsewhere are not answered"
        return None

    def _knows(self, host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:  # brackets that close nothing
            return False
        return name in self._names or (self._any_address and _is_address(name))


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
