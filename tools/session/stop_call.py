"""What `jointctl stop` does about the program that controls a bus or line: it ends, by itself or by force.

The request is sent at once, and no one waits for an answer before the drive is stopped.  A program that acknowledges it
has its own time to brake and to switch off; one that does not, or takes longer, is ended by signal with all its
processes.  After `end` nothing of it can enable the drive.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import time
from collections.abc import Callable, Iterator

from jointctl.drivers.bus_lock import STARTING, is_marked, lock_holders, lock_name, marked_processes, wait_for_answers

LONGEST_S = 180.0  # that a program may ask for: two time-outs of a stop are at most 60 s each
STARTING_S = 60.0  # how long a program that was just started may take until it controls its bus: it may compile first
NOTED_S = 2.0  # after so long the user hears what is waited for
TERM_S = 1.0  # between SIGTERM and SIGKILL
KILL_S = 2.0
POLL_S = 0.02
ARMED = (
    "its drive keeps its watchdog, and may report a lost heartbeat (8130h): the next run takes it over; a fault that "
    "remains is reset by `jointctl clear-fault`"
)


class StopCall:
    """Asks the program that controls the bus to stop, at once; then `end` it.  To be used in a `with` block."""

    def __init__(self, interface: str, channel: str) -> None:
        self._place, self._name = (interface, channel), lock_name(interface, channel)
        self._ask()

    def _ask(self) -> None:
        self._holders = lock_holders(*self._place)
        for holder in self._holders:
            holder.send("stop")

    def __enter__(self) -> StopCall:
        return self

    def __exit__(self, *_: object) -> None:
        for holder in self._holders:
            holder.close()

    def end(self, note: Callable[[str], None], ended: Callable[[], None] = lambda: None) -> None:
        """The processes of a controller have ended when this returns, or `note` got why not.

        A program that was started before this call, and does not control the bus yet, is waited for and then ended.
        `ended` is called each time a controller has: it may have enabled the drive before.
        """
        starting = marked_processes(STARTING)
        self._end_controllers(note, ended)
        for _ in self._each_that_starts(starting, note):
            self._ask_again()
            self._end_controllers(note, ended)
        self._ask_again()
        self._end_controllers(note, ended)

    def _ask_again(self) -> None:
        self.__exit__()
        self._ask()

    @staticmethod
    def _each_that_starts(pids: list[int], note: Callable[[str], None]) -> Iterator[None]:
        """At once when one of them has its lock or has ended; which bus it is for shows only then.

        They may be another joint's, and take long: this joint's controller must not move while they are waited for.
        """
        began_s, noted = time.monotonic(), False
        while pids:
            left = [pid for pid in pids if is_marked(pid, STARTING)]
            if len(left) < len(pids):
                pids = left
                yield
                continue
            which = f"process {', '.join(map(str, pids))}, which is starting and may be about to control the bus"
            waited_s = time.monotonic() - began_s
            if waited_s >= STARTING_S:
                note(f"not waiting any longer for {which}: end it, or stop again when it runs")
                return
            if waited_s > NOTED_S and not noted:
                note(f"waiting for {which}")
                noted = True
            time.sleep(POLL_S)

    def _end_controllers(self, note: Callable[[str], None], ended: Callable[[], None]) -> None:
        wait_for_answers(self._holders)
        marked = marked_processes(self._name)
        if marked and not any(holder.is_controller for holder in self._holders):  # it may have come after the request
            self._ask_again()
            wait_for_answers(self._holders)
        controllers = [holder for holder in self._holders if holder.is_controller]
        for holder in controllers:
            if holder.refused:
                note(f"the program that controls the bus (pid {holder.pid}) cannot be ended: {holder.refused}")
            elif holder.within_s is not None:
                note(f"stopping the program that controls the bus (pid {holder.pid})")
        waited_for = [holder for holder in controllers if holder.within_s is not None]
        if waited_for:
            within_s = min(max(holder.within_s or 0.0 for holder in waited_for), LONGEST_S)
            give_up_s = time.monotonic() + within_s
            while time.monotonic() < give_up_s:
                waited_for = [holder for holder in waited_for if not holder.left]
                if not waited_for and not any(is_marked(pid, self._name) for pid in marked):
                    break
                time.sleep(POLL_S)
        self._end_by_force(note)
        if controllers or marked:
            ended()

    def _end_by_force(self, note: Callable[[str], None]) -> None:
        """SIGTERM, then SIGKILL, to every process that still acts for the controller."""
        pids = marked_processes(self._name)
        if not pids:
            return
        note(f"it does not end by itself: ending process {', '.join(map(str, pids))}; {ARMED}")
        for number, wait_s in ((signal.SIGTERM, TERM_S), (signal.SIGKILL, KILL_S)):
            pids = _signalled(marked_processes(self._name), self._name, number, wait_s)
        if pids:
            note(f"process {', '.join(map(str, pids))} cannot be ended; the drive may be enabled again")


def _signalled(pids: list[int], name: str, number: signal.Signals, wait_s: float) -> list[int]:
    """Those that still live `wait_s` after the signal.  A descriptor of a process cannot come to mean another one."""
    with contextlib.ExitStack() as stack:
        ends: dict[int, int] = {}
        for pid in pids:
            with contextlib.suppress(OSError):
                end = os.pidfd_open(pid)
                stack.callback(os.close, end)
                if is_marked(pid, name):  # it is still the one that was found
                    ends[end] = pid
                    signal.pidfd_send_signal(end, number)
        give_up_s = time.monotonic() + wait_s
        while ends and (left_s := give_up_s - time.monotonic()) > 0.0:
            for end in select.select(list(ends), [], [], left_s)[0]:
                del ends[end]
        return list(ends.values())
