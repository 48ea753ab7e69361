"""Who may ask: a browser that was given the token, by this server's own name, from this server's own pages."""

from __future__ import annotations

from dataclasses import dataclass

from starlette.datastructures import Headers, QueryParams
from starlette.requests import cookie_parser
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from morph_dslam.io.access import ServerNames, new_token, same_token

_COOKIE = "morph_studio"
_SAFE = ("GET", "HEAD")
#: Scheme of the pages that may open a WebSocket.
_SCHEMES = {"ws": "http", "wss": "https"}
#: Bytes of a request that is no upload.
MOST_BODY = 4_000_000


@dataclass
class Access:
    """What lets a browser in.

    Attributes
    ----------
    invitation : token that an address carries.
    session : token of the cookie that it is exchanged for.
    once : whether an invitation works once, and is then replaced.
    """

    invitation: str
    session: str
    once: bool = False

    @classmethod
    def single(cls) -> Access:
        """Invitations that work once each."""
        return cls(new_token(), new_token(), once=True)

    def takes(self, given: str) -> bool:
        """Whether this is the invitation."""
        accepted = same_token(given, self.invitation)
        if accepted and self.once:
            self.invitation = new_token()
        return accepted

    def knows(self, given: str) -> bool:
        """Whether this is the session's token."""
        return same_token(given, self.session)


class Gate:
    """Lets requests through to an application if they carry the token, and adds headers that keep others out.

    The token comes once in the address (``?token=...``), which sets a cookie for this server alone. Then the cookie is
    asked for. A page from elsewhere can neither read the address nor send the cookie; a name of its own for this
    address, or a request from its pages, is refused too.

    Parameters
    ----------
    application : behind the gate.
    access : what is asked for.
    names : that the server may be asked by.
    policy : Content-Security-Policy of all answers that have none of their own.
    """

    def __init__(self, application: ASGIApp, access: Access, names: ServerNames, policy: str) -> None:
        self._application, self._access, self._names, self._policy = application, access, names, policy

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""
        if scope["type"] == "lifespan":
            await self._application(scope, receive, send)
            return
        if scope["type"] == "websocket":
            refused = self._refusal({**scope, "scheme": _SCHEMES[scope["scheme"]], "method": "WEBSOCKET"})
            await (self._application(scope, receive, send) if refused is None else _refuse(receive, send))
            return
        if scope["type"] != "http":
            return
        refusal = self._refusal(scope)
        await (refusal or self._application)(scope, receive, self._with_headers(send))

    def _refusal(self, scope: Scope) -> Response | None:
        headers, query = Headers(scope=scope), QueryParams(scope.get("query_string", b""))
        origin = headers.get("origin")
        refusal = self._names.refusal(headers.get("host", ""), origin, scope["scheme"])
        if refusal is not None:
            return PlainTextResponse(refusal, 403)
        given, cookie = query.get("token"), f"{_COOKIE}_{headers['host'].rpartition(':')[2]}"
        if given is not None and scope["path"] == "/" and scope["method"] in _SAFE and self._access.takes(given):
            answer = RedirectResponse("/", 303)
            is_secure = scope["scheme"] == "https"
            answer.set_cookie(cookie, self._access.session, httponly=True, samesite="strict", secure=is_secure)
            return answer
        if not self._access.knows(cookie_parser(headers.get("cookie", "")).get(cookie, "")):
            return PlainTextResponse("open the address that `morph studio` printed: it carries the token", 401)
        if scope["method"] not in _SAFE and origin is None:
            return PlainTextResponse("a change must come from the studio's own page", 403)
        return None

    def _with_headers(self, send: Send) -> Send:
        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                known = {name.lower() for name, _ in message["headers"]}
                extra = {
                    b"x-content-type-options": b"nosniff",
                    b"referrer-policy": b"no-referrer",
                    b"cache-control": b"no-store",
                    b"cross-origin-resource-policy": b"same-origin",
                    b"content-security-policy": self._policy.encode(),
                }
                message["headers"] = [*message["headers"], *((k, v) for k, v in extra.items() if k not in known)]
            await send(message)

        return guarded


async def _refuse(receive: Receive, send: Send) -> None:
    """Refuse a WebSocket before it is opened: the browser gets status 403."""
    await receive()
    await send({"type": "websocket.close", "code": 1008})
