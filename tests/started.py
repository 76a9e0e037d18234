"""A `jointctl` process, its streams in files.

It is forked from a process that has done the imports, which are most of what a short command costs.  The commands of
the pages (tests/docs) start as in a user's shell, and so does what has streams or an environment of its own.
"""

from __future__ import annotations

import atexit
import io
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

from tests.python_process import Finished, child, children

_WARM = multiprocessing.get_context("forkserver")
_WARM.set_forkserver_preload(["tests.warm_imports"])


def _command(arguments: tuple[str, ...], folder: Path, environment: dict[str, str], streams: tuple[Path, Path]) -> None:
    """What the process does: as a new one, in a session of its own."""
    os.setsid()
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.path[:] = [place for place in sys.path if place]
    sys.argv = ["jointctl", *arguments]
    for number, path in enumerate(streams, 1):
        fd = os.open(path, os.O_WRONLY)
        os.dup2(fd, number)
        os.close(fd)
    sys.stdout = io.TextIOWrapper(open(1, "wb", closefd=False), encoding="utf-8")  # noqa: SIM115
    sys.stderr = io.TextIOWrapper(open(2, "wb", closefd=False), encoding="utf-8", line_buffering=True)  # noqa: SIM115
    from jointctl.drivers import stop_note
    from jointctl.tools.verbs.start import main

    # nothing that it acts for began before itself
    multiprocessing.process._parent_process = None  # type: ignore[attr-defined]
    stop_note._first_ns = stop_note._started_ns(os.getpid())
    try:
        main()
    finally:
        threading._shutdown()  # type: ignore[attr-defined]
        atexit._run_exitfuncs()


class WarmProcess:
    """As much of `subprocess.Popen` as tests need."""

    def __init__(self, arguments: tuple[str, ...], folder: Path, streams: tuple[Path, Path]) -> None:
        for path in streams:  # read before the process has come to open them
            path.touch()
        self._process: ForkServerProcess = _WARM.Process(
            target=_command, args=(arguments, folder, dict(os.environ), streams)
        )
        self._process.start()
        assert self._process.pid is not None
        self.pid: int = self._process.pid

    @property
    def returncode(self) -> int | None:
        return self.poll()

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout_s: float | None = None) -> int:
        self._process.join(timeout_s)
        code = self._process.exitcode
        if code is None:
            raise subprocess.TimeoutExpired("jointctl", timeout_s or 0.0)
        return code

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


class Started:
    """A `jointctl` process in a session of its own, its streams in files."""

    process: WarmProcess | subprocess.Popen[bytes]

    def __init__(self, folder: Path, arguments: tuple[str, ...], script: Path | None = None, **options: Any) -> None:
        number = len(list(folder.glob("*.stderr")))
        self._files = folder / f"{number}.stdout", folder / f"{number}.stderr"
        if script is None and not options:
            self.process = WarmProcess(arguments, folder, self._files)
            return
        what = ["-m", "jointctl.tools.verbs"] if script is None else [str(script)]
        command = [sys.executable, "-P", *what, *arguments]
        with self._files[0].open("wb") as out, self._files[1].open("wb") as err:
            options = {"stdin": subprocess.DEVNULL, "stdout": out, "stderr": err, **options}
            self.process = subprocess.Popen(command, cwd=folder, start_new_session=True, **options)

    @property
    def err(self) -> str:
        return self._files[1].read_text()

    def saw(self, text: str, timeout_s: float = 180.0) -> Started:
        """Wait until stderr holds the text; the first start may have to compile."""
        return self.until(lambda: text in self.err, text, timeout_s)

    def until(self, condition: Callable[[], bool], what: str, timeout_s: float = 180.0) -> Started:
        """Wait until the condition holds; it must do so before the process ends."""
        give_up_s = time.monotonic() + timeout_s
        while not condition():
            assert self.process.poll() is None, f"ended with {self.process.returncode} before {what!r}: {self.err}"
            assert time.monotonic() < give_up_s, f"no {what!r} in: {self.err}"
            time.sleep(0.01)
        return self

    def signal(self, number: int, *, group: bool = False) -> None:
        """To the process, or to its group as the keys of a terminal do."""
        (os.killpg if group else os.kill)(self.process.pid, number)

    def finished(self, timeout_s: float = 180.0) -> Finished:
        code = self.process.wait(timeout_s)
        return Finished(code, self._files[0].read_text(), self.err)

    def children(self) -> list[int]:
        """Process ids of the direct children."""
        return children(self.process.pid)

    def child(self, module: str) -> int:
        """The direct child that runs this module."""
        return child(self.process.pid, module)

    def end(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
