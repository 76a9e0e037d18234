"""A client of its own process that gets every topic of a run: `python -m tests.bench.onlooker foxglove|ros2 PORT`.

It prints a line when the first message has come, and goes on until it is killed.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable

from tests.foxglove_client import FoxgloveClient
from tests.ros2_client import DIAGNOSTICS, JOINT_STATE, Ros2Client


def foxglove(port: int, seen: Callable[[], None]) -> None:
    client = FoxgloveClient(port).subscribe("/joint_states", "/joint", "/events")
    while True:
        client.until(lambda: client.messages, 60.0)
        client.messages.clear()
        seen()


def ros2(port: int, seen: Callable[[], None]) -> None:
    clients = [Ros2Client(f"tcp/127.0.0.1:{port}", domain=port % 200) for _ in range(2)]
    clients[0].collect("/joint_states", JOINT_STATE, lambda *_: seen())
    clients[1].collect("/diagnostics", DIAGNOSTICS, lambda *_: seen())
    while True:
        time.sleep(1.0)


def main(kind: str, port: str) -> None:
    first = threading.Event()

    def seen() -> None:
        if not first.is_set():
            first.set()
            print("seen", flush=True)

    {"foxglove": foxglove, "ros2": ros2}[kind](int(port), seen)


if __name__ == "__main__":
    main(*sys.argv[1:])
