"""The scope's web server: `python -m tools.scoping.server JSON`, started by `run --scope` and by `scope LOG`."""

from __future__ import annotations

import json
import os
import socket
import sys
import threading
import time
from pathlib import Path

from tools.recording.run_log import Event, read_run_log
from tools.scoping.access import AccessControl
from tools.scoping.feed import EVENT, RECORDS, ScopeOrder
from tools.scoping.history import EVENTS, RING_RECORDS, History

_LONGEST = 1 << 20  # bytes of a message
_AFTER_END_S = 1.5  # for the pages to show the end of the run


class Feed(threading.Thread):
    """Receives what the supervisor sends, until it closes the socket; then ends the server."""

    def __init__(self, end: socket.socket, history: History) -> None:
        super().__init__(name="scope feed", daemon=True)
        self._end = end
        self._history = history

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
                self._history.events.append(Event(**json.loads(message[1:])))
        self._history.ended = True
        time.sleep(_AFTER_END_S)
        os._exit(0)  # the server itself would wait for every open page

    def stop(self, strength: int) -> None:
        """The word of the STOP button: 1 brake, 2 quick stop."""
        try:
            self._end.send(str(strength).encode())
        except OSError:
            self._history.ended = True  # nobody listens: the run is over


def history_of_log(path: str) -> History:
    """The end of a run log, as long as the ring."""
    log = read_run_log(Path(path))
    history = History(max(len(log.records), 1))
    history.take(log.records)
    history.events.extend(log.events[-EVENTS:])
    history.ended = True
    return history


def serve(order: ScopeOrder) -> None:
    """Until the run ends, or for a log until it is interrupted."""
    # the import takes seconds, and only this process needs it
    from nicegui import app, ui

    from tools.scoping.page import build_page

    feed: Feed | None = None
    if order.feed_fd >= 0:
        history = History(RING_RECORDS)
        feed = Feed(socket.socket(fileno=order.feed_fd), history)
        feed.start()
    else:
        history = history_of_log(order.log)

    @ui.page("/", title=f"jointctl: {order.title}")
    def index() -> None:
        build_page(order, history, feed.stop if feed is not None else None)

    app.add_middleware(AccessControl, token=order.token)
    ui.run(
        host=order.host, port=order.port, show=False, reload=False, show_welcome_message=False, dark=None,
        uvicorn_logging_level="error",
    )  # fmt: skip


def main() -> int:
    """Entry point of the process."""
    os.nice(10)  # whoever looks on comes last
    serve(ScopeOrder(**json.loads(sys.argv[1])))
    return 0


if __name__ in ("__main__", "__mp_main__"):
    sys.exit(main())
