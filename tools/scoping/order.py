"""What the scope's server is told: where to serve, to whom, and what."""

from __future__ import annotations

import secrets
import socket
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

from jointctl.drivers.errors import DataError, UsageError
from jointctl.drivers.printable import printable


@dataclass(frozen=True)
class ScopeOrder:
    """What the server is told."""

    title: str
    host: str
    port: int
    token: str  # without it nothing is shown or taken
    cia402: bool = True
    feed_fd: int = -1  # -1: show `log` instead
    log: str = ""

    @property
    def url(self) -> str:
        """What to open."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}/?token={self.token}"


def scope_order(title: str, host: str, port: int, **more: Any) -> ScopeOrder:
    """A checked order with a new token: other users of this computer, too, would reach a page without one.

    Raises `UsageError` for a wrong port, `DataError` if the scope cannot be served.
    """
    if find_spec("nicegui") is None:
        raise DataError("the scope needs the package nicegui, which is not installed", "install the extra `scope`")
    if not 1 <= port <= 65535:
        raise UsageError(f"--port (={port}) must be in [1..65535]")
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except OSError as error:
        raise DataError(
            f"the scope cannot be served at {host}:{port}: {error.strerror or error}", "choose another --port"
        ) from None
    return ScopeOrder(printable(title), host, port, secrets.token_urlsafe(16), **more)
