"""Who may see the scope: pages from this computer, or whoever has the token.

As a plain ASGI layer it sees web sockets as well.  Against pages of other sites in the same browser, the Host must be
the one that is served and an Origin must be the scope's own.
"""

from __future__ import annotations

import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from http.cookies import SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

from tools.scoping.order import LOOPBACK

COOKIE = "jointctl_scope"
Scope = MutableMapping[str, Any]
Application = Callable[[Scope, Any, Any], Awaitable[None]]


def allowed(scope: Scope, token: str) -> bool:
    """Whether a request may pass; `token` "" means that only this computer is served."""
    headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope.get("headers", [])}
    host = headers.get("host", "")
    origin = headers.get("origin", "")
    if origin and urlsplit(origin).netloc != host:
        return False
    if not token:
        return (urlsplit(f"//{host}").hostname or "") in LOOPBACK
    given = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])[0]
    cookie = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
    return any(
        secrets.compare_digest(word.encode(), token.encode()) for word in (given, cookie.value if cookie else "")
    )


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
            if message["type"] == "http.response.start" and self._token:
                value = f"{COOKIE}={self._token}; HttpOnly; SameSite=Strict; Path=/"
                message["headers"] = [*message.get("headers", []), (b"set-cookie", value.encode())]
            await send(message)

        await self._app(scope, receive, with_cookie)


async def _refuse(scope: Scope, send: Any) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})
        return
    await send({"type": "http.response.start", "status": 403, "headers": [(b"content-type", b"text/plain")]})
    await send({"type": "http.response.body", "body": b"open the address that jointctl printed, token included\n"})
