"""The guard of a serial line, `python -m jointctl.tools.session.elmo_guard JSON`: a small process.

A serial drive does not notice that the programs behind it have died: it holds its last torque command for ever.  So a
third process waits, in a session of its own, and says TC=0, JV=0, ST, MO=0

* when loop and supervisor are both dead, however they died (the kernel tells it: pidfd);
* when the loop has been silent for `silent_s` and the supervisor has done nothing about it;
* when the supervisor could not reach the drive at the end of a run: for `REACH_S`, also on a port that comes back,
  unless an adapter with another USB serial number has its name then;
* when `jointctl stop` asks for it (`guard_call`) and the loop does not obey at once.

It cannot help where the computer loses its power or the cable is cut: only the drive's own limits work then.
It imports no numba, so that it starts quickly and stays small."""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import select
import signal
import socket
import sys
import time
from dataclasses import asdict, dataclass
from typing import Any

from jointctl.drivers.bus_lock import ANSWER_S, listener, may_ask, parsed_line, send_line
from jointctl.drivers.elmo.dialogue import (
    SWITCH_OFF,
    Dialogue,
    SerialPort,
    open_descriptor,
    switch_off,
    usb_serial_number,
)
from jointctl.drivers.errors import BusError, JointctlError
from jointctl.tools.child_process import say

# --- Speaking with the guard of a serial line from another terminal ---
# The guard listens on an abstract Unix socket named after the device: nothing is left behind, and the kernel tells
# each side whose process the other is.  Asked by the same user or root only.  Messages are single lines of JSON:
#
#     {"ask": "stop"}  ->  {"supervisor_pid": 123}   at once
#                      ->  {"state": "off"}          once the run has ended
#     {"ask": "who"}   ->  {"supervisor_pid": 123}


_LONGEST_LINE_BYTES = 4096
ENDED_S = 25.0  # for a run to end, and a drive that is silent to be tried again


def received_line(peer: socket.socket, timeout_s: float = ANSWER_S) -> dict[str, Any] | None:
    """One message; None where none comes in time or it is none."""
    data, give_up_s = b"", time.monotonic() + timeout_s
    try:
        while not data.endswith(b"\n") and len(data) < _LONGEST_LINE_BYTES:
            peer.settimeout(max(give_up_s - time.monotonic(), 1e-3))  # 0 would mean: never wait
            part = peer.recv(1)
            if not part:
                break
            data += part
    except OSError:
        return None
    return parsed_line(data)


def guard_address(port: str) -> bytes:
    """Of the device itself, whatever links lead to it.  Raises OSError where there is none."""
    found = os.stat(port)
    return b"\0jointctl-line-%x-%x" % (found.st_dev, found.st_rdev)


class GuardCall(contextlib.AbstractContextManager["GuardCall"]):
    """A call to the guard of a port; `supervisor_pid` is None where no run of ours has it, or its guard is mute."""

    def __init__(self, port: str, ask: str) -> None:
        self.supervisor_pid: int | None = None
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.settimeout(ANSWER_S)
            self._socket.connect(guard_address(port))
            if not may_ask(self._socket):
                return
            send_line(self._socket, {"ask": ask})
        except OSError:
            return
        message = received_line(self._socket)
        if message is not None and isinstance(message.get("supervisor_pid"), int):
            self.supervisor_pid = message["supervisor_pid"]

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def outcome(self) -> str | None:
        """The drive's state once the run has ended; None where nothing was heard of it."""
        message = received_line(self._socket, ENDED_S)
        return None if message is None else str(message.get("state"))


def running_supervisor(port: str) -> int | None:
    """Process id of the run that has the port."""
    with GuardCall(port, "who") as call:
        return call.supervisor_pid


# --- The process itself ---


REACH_S = 60.0  # how long a drive that does not answer is tried again: time to plug a cable in
OBEY_S = 5.0  # how long a run may take to end after `jointctl stop`
LATE_S = 0.2  # a loop without a cycle for so long does not obey at once
REPEAT_S = 0.5
POLL_S = 0.25  # the death of a process wakes it at once
QUICK_POLL_S = 0.05
HEARD_S = 0.2
_NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class GuardOrder:
    """The orders of the guard.  `*_word`: places of the shared int64 words; descriptors are inherited."""

    port: str
    baud_rate_bitps: int
    reply_timeout_s: float
    silent_s: float
    control_fd: int  # the supervisor's word: {"state": ...}, then the guard's work is done
    block_fd: int
    supervisor_pidfd: int
    loop_pidfd: int
    supervisor_pid: int
    go_word: int
    stop_word: int
    loop_word: int
    ended_word: int
    held_up_word: int
    words: int
    stop_value: int  # StopRequest.OFF
    usb_serial_number: str | None = None  # of the port's adapter, where it has one

    def argument(self) -> str:
        return json.dumps(asdict(self))


class LineGuard:
    """`run` until the work is done; returns the exit code."""

    def __init__(self, order: GuardOrder) -> None:
        self._order = order
        self._tty = open_descriptor(order.port)
        self._words = memoryview(mmap.mmap(order.block_fd, 8 * order.words)).cast("q")
        self._control = socket.socket(fileno=order.control_fd)
        self._server = self._bound(guard_address(order.port))
        self._callers: list[socket.socket] = []
        self._asked_s: float | None = None  # when `jointctl stop` came
        self._told_s = -REPEAT_S  # when the line was last commanded to switch off
        self._dead: set[int] = set()
        self._state: str | None = None  # of the drive, by the supervisor's word

    @staticmethod
    def _bound(address: bytes) -> socket.socket | None:
        """None where another guard has the name: that of a run that ended just now."""
        try:
            return listener(address, 4)
        except OSError:
            return None

    def run(self) -> int:
        """Watch until the supervisor says that the drive is off, or until both are dead and it has been reported."""
        with contextlib.suppress(OSError):  # a supervisor that has left already has said its word before
            self._control.sendall(b"+")
        poll = select.poll()
        order = self._order
        for fd in (order.supervisor_pidfd, order.loop_pidfd, order.control_fd):
            poll.register(fd, select.POLLIN)
        poll.register(self._tty, 0)
        if self._server is not None:
            poll.register(self._server, select.POLLIN)
        while True:
            for fd, _ in poll.poll(1000 * (POLL_S if self._asked_s is None else QUICK_POLL_S)):
                if fd in (order.supervisor_pidfd, order.loop_pidfd):
                    self._dead.add(fd)
                    poll.unregister(fd)
                elif fd == order.control_fd:
                    self._take_word()
                    poll.unregister(fd)
                elif fd == self._tty:  # unplugged: a descriptor that stays open would keep the name of the port
                    poll.unregister(fd)
                    self._close_tty()
                else:
                    self._take_caller()
            outcome = self._outcome()
            if outcome is not None:
                self._answer(outcome)
                return 0

    # --- what is known ---

    @property
    def _nobody(self) -> bool:
        return len(self._dead) == 2

    def _word(self, place: int) -> int:
        return int(self._words[place])

    def _loop_silent_s(self) -> float:
        """Time since the loop's last cycle; 0 before it was let go and after its regular end."""
        order = self._order
        if not self._word(order.go_word) or self._word(order.ended_word):
            return 0.0
        return (time.monotonic_ns() - self._word(order.loop_word)) / _NANOSECONDS

    def _outcome(self) -> str | None:
        """The drive's state in words once there is nothing left to guard; None while there is."""
        loop_over = self._order.loop_pidfd in self._dead or self._word(self._order.ended_word)
        if self._state is not None and (loop_over or not self._word(self._order.go_word)):
            return self._reach() if self._state.startswith("unknown") else self._state
        if self._nobody:
            return self._reach()
        silent_s = self._loop_silent_s()
        if silent_s > self._order.silent_s:
            self._words[self._order.held_up_word] = round(silent_s * _NANOSECONDS)
            self._words[self._order.stop_word] = self._order.stop_value
            self._tell()
        if self._asked_s is not None:
            asked_for_s = time.monotonic() - self._asked_s
            if not self._word(self._order.go_word) or silent_s > LATE_S or asked_for_s > 1.0:
                self._tell()
            if asked_for_s > OBEY_S:
                self._end_both()
        return None

    # --- what is done ---

    def _tell(self) -> None:
        """Unheard: the replies belong to another program that reads the line."""
        if time.monotonic() < self._told_s + REPEAT_S:
            return
        self._told_s = time.monotonic()
        with contextlib.suppress(OSError):
            os.write(self._tty, SWITCH_OFF)

    def _close_tty(self) -> None:
        if self._tty >= 0:
            os.close(self._tty)
        self._tty = -1

    def _end_both(self) -> None:
        """They had their time.  A pidfd cannot mean another process."""
        for fd in (self._order.loop_pidfd, self._order.supervisor_pidfd):
            with contextlib.suppress(OSError):
                signal.pidfd_send_signal(fd, signal.SIGKILL)

    def _reach(self) -> str:
        """Nobody else has the line now: switch off and hear that it is, on a port that comes back as well."""
        order = self._order
        self._told_s = -REPEAT_S
        self._tell()
        give_up_s = time.monotonic() + REACH_S
        while True:
            port: SerialPort | None = None
            try:
                self._require_same_device()
                port = SerialPort(order.port, order.baud_rate_bitps)
                state = switch_off(port, Dialogue(port, order.reply_timeout_s))
                say(f"line guard: the drive on {order.port} is {state}")
                return state
            except JointctlError as error:
                reason = error.message
            finally:
                if port is not None:
                    port.close()
            self._close_tty()
            if time.monotonic() > give_up_s:
                say(f"line guard: the drive on {order.port} could not be switched off: {reason}")
                return f"unknown: {reason}"
            time.sleep(REPEAT_S)

    def _require_same_device(self) -> None:
        """`BusError` where the port's name belongs to another adapter now: what is behind it is none of ours."""
        known, found = self._order.usb_serial_number, usb_serial_number(self._order.port)
        if known and found and found != known:
            raise BusError(f"another adapter has this name now (serial number {found} instead of {known})")

    # --- words from outside ---

    def _take_word(self) -> None:
        """The end of the connection without a word is the supervisor's, also where its process goes on (exec)."""
        message = received_line(self._control, HEARD_S)
        if message is None:
            self._dead.add(self._order.supervisor_pidfd)
        else:
            self._state = str(message.get("state", "unknown: no word"))

    def _take_caller(self) -> None:
        assert self._server is not None
        caller, _ = self._server.accept()
        message = received_line(caller, HEARD_S) if may_ask(caller) else None
        if message is None:
            caller.close()
            return
        self._send(caller, {"supervisor_pid": self._order.supervisor_pid})
        if message.get("ask") != "stop":
            caller.close()
            return
        self._callers.append(caller)
        if self._asked_s is None:
            self._asked_s = time.monotonic()
            self._words[self._order.stop_word] = self._order.stop_value
            if not self._word(self._order.go_word):  # it may wait for an answer of its user
                with contextlib.suppress(OSError):
                    signal.pidfd_send_signal(self._order.supervisor_pidfd, signal.SIGTERM)

    def _answer(self, state: str) -> None:
        for caller in self._callers:
            self._send(caller, {"state": state})
            caller.close()

    @staticmethod
    def _send(caller: socket.socket, message: dict[str, Any]) -> None:
        with contextlib.suppress(OSError):
            send_line(caller, message)


def main() -> int:
    """Entry point of the process; the signals of a terminal are not for it."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP})
    try:
        return LineGuard(GuardOrder(**json.loads(sys.argv[1]))).run()
    except JointctlError as error:
        say(f"line guard: {error}")
        return error.exit_code


if __name__ == "__main__":
    sys.exit(main())
