"""`jointctl` without its imports, most of what a start costs: one process has them and forks for each command.

What it forks has streams, folder, session and environment of its own, ends as any other and leaves its exit code; its
command line in /proc is that of this file.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import gc
import importlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

from jointctl.drivers import stop_note

# `main` and what `run` imports on its way
IMPORTED = (
    "typer._adapters", "jointctl.tools.configuration.arm", "jointctl.tools.scoping.remote",
    "jointctl.tools.session.session", "jointctl.tools.session.canopen_drive",
)  # fmt: skip


class Forked:
    """What tests need of a `Popen`."""

    def __init__(self, order: dict[str, Any], streams: list[int]) -> None:
        self._news, news = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with news:
            socket.send_fds(_server(), [json.dumps(order).encode()], [news.fileno(), *streams])
        self.pid = self._number(60.0)
        self.returncode: int | None = None

    def _number(self, timeout_s: float | None) -> int:
        self._news.settimeout(timeout_s)
        text = self._news.recv(16)
        assert text, "the process that forks has ended"
        return int(text)

    def poll(self) -> int | None:
        with contextlib.suppress(BlockingIOError):
            self.wait(0.0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        if self.returncode is None:
            try:
                self.returncode = self._number(timeout)
            except TimeoutError:
                raise subprocess.TimeoutExpired(["jointctl"], timeout or 0.0) from None
            self._news.close()
        return self.returncode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


@functools.cache
def _server() -> socket.socket:
    """The process that forks ends when this one does."""
    ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with its:
        command = [sys.executable, "-P", __file__, str(its.fileno())]
        none = subprocess.DEVNULL
        process = subprocess.Popen(
            command, pass_fds=[its.fileno()], start_new_session=True, cwd="/", stdin=none, stdout=none, stderr=none
        )

    def end() -> None:
        ours.close()
        process.wait()

    atexit.register(end)
    return ours


def _next_command(orders: socket.socket) -> list[str]:
    """Forks for each order; returns in the new process, with the words of its command."""
    running: dict[int, tuple[int, int]] = {}  # by the descriptor that tells its end: process id, and who wants to know
    while True:
        for ended in select.select([orders, *running], [], [])[0]:
            if ended is not orders:
                pid, news = running.pop(ended)
                code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
                with contextlib.suppress(OSError):  # nobody wants to know
                    os.write(news, str(code).encode())
                os.close(news)
                os.close(ended)
                continue
            message, (news, *streams), _, _ = socket.recv_fds(orders, 1 << 18, 4)
            if not message:
                os._exit(0)
            pid = os.fork()
            if pid:
                running[os.pidfd_open(pid)] = pid, news
                os.write(news, str(pid).encode())
                for stream in streams:
                    os.close(stream)
                continue
            for number, stream in enumerate(streams):
                os.dup2(stream, number)
            orders.close()
            for other in (*streams, news, *running, *(to for _, to in running.values())):
                os.close(other)
            os.setsid()
            order = json.loads(message)
            os.chdir(order["folder"])
            os.environ.clear()
            os.environ.update(order["environment"])
            stop_note._first_ns = stop_note._started_ns(os.getpid())  # it acts for itself, and has just begun
            return list(order["words"])


def start(words: tuple[str, ...], folder: Path, streams: list[int], environment: dict[str, str]) -> Forked:
    """`streams`: descriptors of the standard ones."""
    return Forked({"words": words, "folder": str(folder), "environment": environment}, streams)


if __name__ == "__main__":
    for name in IMPORTED:
        importlib.import_module(name)
    from jointctl.tools.verbs.start import main

    gc.freeze()
    sys.argv = ["jointctl", *_next_command(socket.socket(fileno=int(sys.argv[1])))]
    main()
