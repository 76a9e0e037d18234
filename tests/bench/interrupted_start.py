"""A stop signal at each N-th call of the start of a verb: `python -m tests.bench.interrupted_start N [SIGTERM]`.

The verb runs in this process until it finds that there is no such bus.  It is forked at the chosen calls, and the fork
gets the signal right there: in a destructor, in the callback of an import's lock, in a library.  Python drops what a
signal raises in some of these places, and the verb would go on to move its joint.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import time
from types import CodeType, FrameType
from typing import NamedTuple

from jointctl.drivers.errors import INTERRUPTED, BusError
from jointctl.tools.verbs import start

ENDS_WITHIN_S = 100.0  # beside processes with real-time priority one may stand still for long
# where Python drops it, and where the verb has ended already: each of these is tried, once for each file
CALLED_BY_PYTHON = {"__del__", "cb", "_remove", "callback"}
LAST_WORDS = {"Output.error", "Output._say"}
WORDS = b"interrupted\n"


class Ended(NamedTuple):
    """How the verb ended that got the signal in one call; `code` None = it did not."""

    call: int
    where: str
    code: int | None
    said: bytes

    @property
    def as_documented(self) -> bool:
        return self.code == INTERRUPTED and self.said == WORDS


class Interrupted:
    """Profiles the main thread; `ended` has a row for each fork."""

    def __init__(self, every: int, number: signal.Signals) -> None:
        self._every, self._number, self._pid = every, number, os.getpid()
        self._tried: set[tuple[str, str]] = set()
        self.calls = 0
        self.ended: list[Ended] = []

    def profile(self, frame: FrameType, event: str, _: object) -> None:
        if event != "call" or frame.f_code.co_filename == __file__:
            return
        if not isinstance(signal.getsignal(self._number), start.Interruption):
            return  # not yet, or the verb has the signals itself
        self.calls += 1
        if self.calls % self._every == 0 or self._is_chosen(frame.f_code):
            self._interrupt(f"{frame.f_code.co_qualname} ({frame.f_code.co_filename})")

    def _is_chosen(self, code: CodeType) -> bool:
        place = code.co_qualname, code.co_filename
        if place in self._tried or not (code.co_name in CALLED_BY_PYTHON or code.co_qualname in LAST_WORDS):
            return False
        self._tried.add(place)
        return True

    def _interrupt(self, where: str) -> None:
        reading, writing = os.pipe()
        if not (pid := os.fork()):
            sys.setprofile(None)
            for fd in (1, 2):
                os.dup2(writing, fd)
            os.close(reading)
            os.close(writing)
            signal.raise_signal(self._number)
            return
        os.close(writing)
        said, give_up_s = b"", time.monotonic() + ENDS_WITHIN_S
        while (left_s := give_up_s - time.monotonic()) > 0.0:
            if select.select([reading], [], [], left_s)[0]:
                if not (part := os.read(reading, 1 << 16)):
                    break
                said += part
        os.close(reading)
        if left_s <= 0.0:
            os.kill(pid, signal.SIGKILL)
        _, status = os.waitpid(pid, 0)
        code = None if left_s <= 0.0 else os.waitstatus_to_exitcode(status)
        self.ended.append(Ended(self.calls, where, code, said))


def interrupted(every: int, number: signal.Signals) -> Interrupted:
    """Of `jointctl run` on a bus that is not there."""
    sys.argv = ["jointctl", "run", "virtual", "-c", f"nobody-{os.getpid()}", "-y"]
    tried, pid = Interrupted(every, number), os.getpid()
    sys.setprofile(tried.profile)
    try:
        start.main()
    except SystemExit as end:
        if os.getpid() != pid or end.code != BusError.exit_code:
            raise
    finally:
        sys.setprofile(None)
    return tried


def main() -> int:
    tried = interrupted(int(sys.argv[1]), signal.Signals[sys.argv[2]] if len(sys.argv) > 2 else signal.SIGINT)
    for ended in tried.ended:
        if not ended.as_documented:
            print(f"call {ended.call}, {ended.where}: code {ended.code}, {ended.said.decode(errors='replace')}")
    wrong = sum(not ended.as_documented for ended in tried.ended)
    print(f"{tried.calls} calls, {len(tried.ended)} interrupted, {wrong} not as documented")
    return 1 if wrong or not tried.ended else 0


if __name__ == "__main__":
    sys.exit(main())
