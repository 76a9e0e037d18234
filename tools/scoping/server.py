"""The scope's web server: `python -m jointctl.tools.scoping.server`, started by `run --scope` and by `scope CONFIG`.

What it is to serve, and the token that it asks for, come as JSON on its standard input: what stands among the arguments
or in the environment of a process can be read by others.  Who has the token that jointctl printed may see the page, no
one else, on this computer as elsewhere.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import secrets
import socket
import sys
import time
from collections.abc import Awaitable, Callable, Iterator, MutableMapping
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from jointctl.tools.recording.run_log_reader import read_run_log
from jointctl.tools.scoping.feed import COUNT_AGAIN_S, OVER, SHOW_END_S, ScopeOrder
from jointctl.tools.scoping.history import EVENTS, RING_RECORDS, History
from jointctl.tools.scoping.supervisor_link import Feed, stand_aside
from jointctl.tools.session.display import ViewerRequest, viewer

if TYPE_CHECKING:
    from starlette.requests import Request

MESSAGES = 20  # that a page which was cut off for a moment gets again
RECONNECT_S = 10.0  # a page that was cut off for less goes on where it was
COUNT_S = 0.5  # how often the open pages are counted
RELOAD_S = 3.0  # nobody for so long: the last page is closed, not reloaded
LOOK_S = 0.1  # how often the pages are asked whether they show the end
ANSWER_S = 1.0  # for a page to say so
COOKIE = "jointctl_scope"  # how their names begin
Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Application = Callable[[Scope, Receive, Send], Awaitable[None]]
# the address holds the token: it goes to no other site, and into no cache
_PRIVATE = ((b"referrer-policy", b"no-referrer"), (b"cache-control", b"no-store"))


# --- access ---


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
    """ASGI layer: refuses with 403, and remembers a good token in a cookie.

    As a plain ASGI layer it sees web sockets as well.  Against pages of other sites in the same browser, an Origin must
    be the scope's own; such a page has no cookie of ours either.
    """

    def __init__(self, app: Application, token: str) -> None:
        self._app = app
        self._token = token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        if not allowed(scope, self._token):
            await _refuse(scope, send)
            return

        async def with_cookie(message: Message) -> None:
            if message["type"] == "http.response.start":
                value = f"{cookie_name(self._token)}={self._token}; HttpOnly; SameSite=Strict; Path=/"
                kept = [(key, found) for key, found in message.get("headers", []) if key.lower() != b"cache-control"]
                message["headers"] = [*kept, *_PRIVATE, (b"set-cookie", value.encode())]
            await send(message)

        await self._app(scope, receive, with_cookie)


async def _refuse(scope: Scope, send: Send) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})
        return
    await send({"type": "http.response.start", "status": 403, "headers": [(b"content-type", b"text/plain")]})
    await send({"type": "http.response.body", "body": b"open the address that jointctl printed, token included\n"})


# --- the server ---


def history_of_log(path: str) -> History:
    """The end of a run log, as long as the ring."""
    log = read_run_log(Path(path))
    history = History(max(len(log.records), 1))
    history.take(log.records)
    for event in log.events[-EVENTS:]:
        history.take_event(event)
    history.ended = True
    return history


def stop_route(feed: Feed) -> Any:
    """The answer to a press of STOP."""
    from starlette.responses import PlainTextResponse

    async def stop(request: Request) -> Any:
        strength = feed.stop(viewer(request.client.host if request.client else None))
        if not strength:
            return PlainTextResponse("not taken: jointctl does not listen", 503)
        return PlainTextResponse("STOP taken; again: quick stop" if strength == 1 else "STOP taken: quick stop")

    return stop


async def count_viewers(feed: Feed) -> None:
    """Tell the supervisor how many pages are open, again and again; a reload is no absence."""
    from nicegui import Client

    sent, sent_s, seen_s = -1, 0.0, 0.0
    while True:
        count = sum(client.has_socket_connection for client in list(Client.instances.values()))
        now_s = time.monotonic()
        if count:
            seen_s = now_s
        if not count and now_s - seen_s <= RELOAD_S:
            count = sent
        if count >= 0 and (count != sent or now_s - sent_s > COUNT_AGAIN_S):
            sent, sent_s = count, now_s
            feed.ask(ViewerRequest("viewers", "server", {"count": count}))
        await asyncio.sleep(COUNT_S)


async def await_end_shown(feed: Feed, history: History, met: set[str]) -> None:
    """The server ends when every page shows that the program is over: each is asked for its last sign of life.

    One that is cut off or still on its way is waited for as well.  `met`: the clients that had a connection; one
    without that is no page after some time, it has asked for the address alone.
    """
    from nicegui import Client

    from jointctl.tools.scoping.scope_page import IS_OVER

    async def shows_end(client: Client) -> bool:
        if not client.has_socket_connection:
            return client.id not in met and time.time() - client.created > RECONNECT_S
        with contextlib.suppress(TimeoutError):
            return bool(await client.run_javascript(IS_OVER, timeout=ANSWER_S))
        return False

    while not (history.ended and history.settings.get("stage") == OVER):
        await asyncio.sleep(LOOK_S)
    while not all(await asyncio.gather(*map(shows_end, list(Client.instances.values())))):
        await asyncio.sleep(LOOK_S)
    await asyncio.sleep(COUNT_S)  # for the last of the picture
    feed.shown.set()


def serve(order: ScopeOrder) -> None:
    """Until the run ends, or for a log until it is interrupted."""
    # the import takes seconds, and only this process needs it
    from nicegui import app, ui

    from jointctl.tools.scoping.scope_page import STOP_PATH, build_page

    feed: Feed | None = None
    met: set[str] = set()
    if order.feed_fd >= 0:
        history = History(RING_RECORDS, order.joints)
        feed = Feed(socket.socket(fileno=order.feed_fd), history, SHOW_END_S)
        feed.start()
    else:
        history = history_of_log(order.log)

    @ui.page("/", title=f"jointctl: {order.title}")
    def index() -> None:
        client = ui.context.client
        client.on_connect(lambda: met.add(client.id))
        build_page(order, history, feed)

    if feed is not None:
        app.add_route(STOP_PATH, stop_route(feed), methods=["POST"])
        app.on_startup(lambda: count_viewers(feed))
        app.on_startup(lambda: await_end_shown(feed, history, met))
    app.add_middleware(AccessControl, token=order.token)
    ui.run(
        host=order.host, port=order.port, show=False, reload=False, show_welcome_message=False, dark=False,
        language="en-US", message_history_length=MESSAGES, reconnect_timeout=RECONNECT_S,
        uvicorn_logging_level="error",
    )  # fmt: skip


def main() -> int:
    order = ScopeOrder(**json.loads(sys.stdin.buffer.read()))
    stand_aside(order.loop_cpu)
    serve(order)
    return 0


if __name__ in ("__main__", "__mp_main__"):
    sys.exit(main())
