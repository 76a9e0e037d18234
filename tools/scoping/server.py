"""The scope's web server: `python -m jointctl.tools.scoping.server`, started by `run --scope` and by `scope CONFIG`.

What it is to serve, and the token that it asks for, come as JSON on its standard input: what stands among the arguments
or in the environment of a process can be read by others.
"""

from __future__ import annotations

import asyncio
import json
import os
import socket
import sys
import threading
import time
from pathlib import Path
from typing import Any

from jointctl.tools.recording.run_log import Event
from jointctl.tools.recording.run_log_reader import read_run_log
from jointctl.tools.scoping.access import AccessControl
from jointctl.tools.scoping.feed import COUNT_AGAIN_S, EVENT, RECORDS, SETTINGS
from jointctl.tools.scoping.history import EVENTS, RING_RECORDS, History
from jointctl.tools.scoping.order import ScopeOrder
from jointctl.tools.session.display import ViewerRequest, viewer

_LONGEST = 1 << 20  # bytes of a message
MESSAGES = 20  # that a page which was cut off for a moment gets again
RECONNECT_S = 10.0  # a page that was cut off for less goes on where it was
_AFTER_END_S = 1.5  # for the pages to show the end of the run
COUNT_S = 0.5  # how often the open pages are counted
NICE = 5  # whoever looks on comes after the supervisor, but STOP has to arrive on a busy computer
RELOAD_S = 3.0  # nobody for so long: the last page is closed, not reloaded


class Feed(threading.Thread):
    """Receives what the supervisor sends, until it closes the socket; then ends the server."""

    def __init__(self, end: socket.socket, history: History) -> None:
        super().__init__(name="scope feed", daemon=True)
        self._end = end
        self._history = history
        self._stops = 0  # since the stage has changed

    def run(self) -> None:
        """See `Thread`."""
        while True:
            try:
                message = self._end.recv(_LONGEST)
            except OSError:
                message = b""
            if not message:
                break
            if message[:1] == RECORDS:
                self._history.take_bytes(message[1:])
            elif message[:1] == EVENT:
                self._history.take_event(Event(**json.loads(message[1:])))
            elif message[:1] == SETTINGS:
                found = json.loads(message[1:])
                if found.get("stage") == "running" != self._history.settings.get("stage"):
                    self._history.begin()
                if found.get("stage", self._history.settings.get("stage")) != self._history.settings.get("stage"):
                    self._stops = 0
                self._history.take_settings(found)
            self._history.heard_s = time.monotonic()
        self._history.ended = True
        time.sleep(_AFTER_END_S)
        os._exit(0)  # the server itself would wait for every open page

    def stop(self, who: str) -> int:
        """A press of STOP: 1 brake, 2 quick stop if it was pressed before, 0 if the supervisor does not take it."""
        strength = 2 if self._stops else 1
        if not self.ask(ViewerRequest("stop", who, {"strength": strength})):
            return 0
        self._stops += 1
        return strength

    def ask(self, request: ViewerRequest) -> bool:
        """Pass on what a viewer asks for, without waiting; False if it is not taken."""
        try:
            self._end.send(request.encoded(), socket.MSG_DONTWAIT)
        except OSError:
            return False
        return True


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

    async def stop(request: Any) -> Any:
        strength = feed.stop(viewer(request.client.host if request.client else None))
        if not strength:
            return PlainTextResponse("not taken: jointctl does not listen", 503)
        return PlainTextResponse("STOP taken; again: quick stop" if strength == 1 else "STOP taken: quick stop")

    return stop


async def count_viewers(feed: Feed) -> None:
    """Tell the supervisor how many pages are open, again and again; a reload is no absence."""
    from nicegui import Client

    told, told_s, seen_s = -1, 0.0, 0.0
    while True:
        count = sum(client.has_socket_connection for client in list(Client.instances.values()))
        now_s = time.monotonic()
        if count:
            seen_s = now_s
        if not count and now_s - seen_s <= RELOAD_S:
            count = told
        if count >= 0 and (count != told or now_s - told_s > COUNT_AGAIN_S):
            told, told_s = count, now_s
            feed.ask(ViewerRequest("viewers", "server", {"count": count}))
        await asyncio.sleep(COUNT_S)


def serve(order: ScopeOrder) -> None:
    """Until the run ends, or for a log until it is interrupted."""
    # the import takes seconds, and only this process needs it
    from nicegui import app, ui

    from jointctl.tools.scoping.page import build_page
    from jointctl.tools.scoping.stop_button import STOP_PATH

    feed: Feed | None = None
    if order.feed_fd >= 0:
        history = History(RING_RECORDS)
        feed = Feed(socket.socket(fileno=order.feed_fd), history)
        feed.start()
    else:
        history = history_of_log(order.log)

    @ui.page("/", title=f"jointctl: {order.title}")
    def index() -> None:
        build_page(order, history, feed)

    if feed is not None:
        app.add_route(STOP_PATH, stop_route(feed), methods=["POST"])
        app.on_startup(lambda: count_viewers(feed))
    app.add_middleware(AccessControl, token=order.token)
    ui.run(
        host=order.host, port=order.port, show=False, reload=False, show_welcome_message=False, dark=False,
        message_history_length=MESSAGES, reconnect_timeout=RECONNECT_S,
        uvicorn_logging_level="error",
    )  # fmt: skip


def main() -> int:
    """Entry point of the process."""
    os.nice(NICE)
    serve(ScopeOrder(**json.loads(sys.stdin.buffer.read())))
    return 0


if __name__ in ("__main__", "__mp_main__"):
    sys.exit(main())
