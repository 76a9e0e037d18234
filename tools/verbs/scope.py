"""`jointctl scope LOG`: a run log in the scope's page, served on this computer until Ctrl-C."""

from __future__ import annotations

from pathlib import Path

from tools.output import Output
from tools.recording.run_log import read_run_log
from tools.scoping.feed import scope_order

HOST, PORT = "127.0.0.1", 8642


def scope(path: Path, output: Output, *, host: str = HOST, port: int = PORT) -> int:
    """Serve a run log; the page can zoom, but there is nothing to stop.  Returns the exit code."""
    read_run_log(path)  # what is wrong with it is to be told here
    order = scope_order(path.stem, host, port, log=str(path))
    output.note(f"scope: {order.url}  (Ctrl-C ends it)")
    from tools.scoping.server import serve

    serve(order)
    return 0
