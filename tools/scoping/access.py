"""Who may see the scope: whoever has the token that jointctl printed, on this computer as elsewhere.

As a plain ASGI layer it sees web sockets as well.  Against pages of other sites in the same browser, an Origin must be
the scope's own; such a page has no cookie of ours either.
"""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Awaitable, Callable, Iterator, MutableMapping
from typing import Any
from urllib.parse import parse_qs, urlsplit

COOKIE = "jointctl_scope"  # how their names begin
Scope = MutableMapping[str, Any]
Application = Callable[[Scope, Any, Any], Awaitable[None]]
# the address holds the token: it goes to no other site, and into no cache
_PRIVATE = ((b"referrer-policy", b"no-referrer"), (b"cache-control", b"no-store"))


def allowed(scope: Scope, token: str) -> bool:
    """Whether a request may pass: it has the token, in its address or in a cookie."""
    headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope.get("headers", [])}
    origin = headers.get("origin", "")
    try:
        if origin and urlsplit(origin).netloc != headers.get("host", ""):
            return False
    except ValueError:  # no address at all
        return False
    given = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [])
    words = [*given, *_cookies(headers.get("cookie", ""))]
    return bool(token) and any(secrets.compare_digest(word.encode(), token.encode()) for word in words)


def cookie_name(token: str) -> str:
    """A name of its own for each server: cookies are for all ports of a computer, and a page must not lose its STOP
    because another scope was opened in the same browser."""
    return f"{COOKIE}_{hashlib.sha256(token.encode()).hexdigest()[:8]}"


def _cookies(header: str) -> Iterator[str]:
    """Our values; what other pages of this computer have left beside them does no harm."""
    for part in header.split(";"):
        name, _, value = part.strip().partition("=")
        if name.startswith(COOKIE):
            yield value


class AccessControl:
    """ASGI layer: refuses with 403, and remembers a good token in a cookie."""

    def __init__(self, app: Application, token: str) -> None:
        self._app = app
        self._token = token

    async def __call__(self, scope: Scope, receive: Any, send: Any) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        if not allowed(scope, self._token):
            await _refuse(scope, send)
            return

        async def with_cookie(message: MutableMapping[str, Any]) -> None:
            if message["type"] == "http.response.start":
                value = f"{cookie_name(self._token)}={self._token}; HttpOnly; SameSite=Strict; Path=/"
                kept = [(key, found) for key, found in message.get("headers", []) if key.lower() != b"cache-control"]
                message["headers"] = [*kept, *_PRIVATE, (b"set-cookie", value.encode())]
            await send(message)

        await self._app(scope, receive, with_cookie)


async def _refuse(scope: Scope, send: Any) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})
        return
    await send({"type": "http.response.start", "status": 403, "headers": [(b"content-type", b"text/plain")]})
    await send({"type": "http.response.body", "body": b"open the address that jointctl printed, token included\n"})
