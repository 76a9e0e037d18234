"""The guard of a serial line as its supervisor sees it, and a computer that is kept awake meanwhile."""

from __future__ import annotations

import contextlib
import json
import os
import select
import socket
import subprocess
import sys
from collections.abc import Iterator

from jointctl.drivers.elmo.serial_port import usb_serial_number
from jointctl.drivers.errors import JointctlError
from jointctl.firmware_py.realtime import WORDS, Word
from jointctl.firmware_py.states import StopRequest
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.elmo import ElmoSerial
from jointctl.tools.output import Output
from jointctl.tools.session.line_guard import GuardOrder
from jointctl.tools.session.loop_handle import SILENT_S, LoopHandle

# --- A computer that falls asleep leaves a serial drive with its last command ---
# A child under systemd-inhibit holds the lock of systemd-logind as long as its standard input is open, so it ends
# with this process, however that ends.  A lid that is closed heeds only a lock of its own (logind.conf,
# LidSwitchIgnoreInhibited).


WHAT = "sleep:handle-lid-switch"
HELD_TIMEOUT_S = 2.0
ENDED_S = 1.0
_COMMAND = (
    "systemd-inhibit", f"--what={WHAT}", "--who=jointctl", "--why=a joint is in motion", "--mode=block",
    "sh", "-c", "echo held && exec cat >/dev/null",
)  # fmt: skip


def _start() -> subprocess.Popen[bytes] | None:
    """The child, in a session of its own, where it neither asks for a password nor hears Ctrl-C; None if it fails."""
    try:
        child = subprocess.Popen(
            _COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True
        )
    except OSError:
        return None
    assert child.stdout is not None
    if select.select([child.stdout], [], [], HELD_TIMEOUT_S)[0] and child.stdout.read(1):
        return child
    _end(child)
    return None


def _end(child: subprocess.Popen[bytes]) -> None:
    assert child.stdin is not None
    assert child.stdout is not None
    child.stdin.close()
    try:
        child.wait(ENDED_S)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()
    child.stdout.close()


@contextlib.contextmanager
def kept_awake(config: Config, output: Output) -> Iterator[bool]:
    """Whether the computer is kept awake; nothing is done where the drive has a watchdog of its own."""
    if not config.is_serial:
        yield False
        return
    child = _start()
    if child is None:
        output.note(
            "systemd-inhibit does not work here: the computer is not kept from falling asleep, "
            "and the drive would hold its last command meanwhile"
        )
        yield False
        return
    output.note("the computer is kept from falling asleep until the end of the run")
    try:
        yield True
    finally:
        _end(child)


# --- The guard of a serial line as its supervisor sees it: start it before anything can move, let it go at the end ---


READY_TIMEOUT_S = 20.0
SPARE_S = 1.0  # the supervisor is to be first
GUARD_ENDED = "the guard of the line has ended: nobody switches the drive off if this program and the loop both die"


class GuardHandle:
    """Started by `start_guard`."""

    def __init__(self, drive: ElmoSerial, loop: LoopHandle) -> None:
        self._ended = False
        self._control, theirs = socket.socketpair()
        supervisor, ended = os.pidfd_open(os.getpid()), os.pidfd_open(loop.pid)
        passed = (theirs.fileno(), loop.block.fd, supervisor, ended)
        order = GuardOrder(
            port=os.path.abspath(drive.port), baud_rate_bitps=drive.baud_rate_bitps,
            reply_timeout_s=drive.reply_timeout_s, silent_s=SILENT_S + SPARE_S,
            control_fd=passed[0], block_fd=passed[1], supervisor_pidfd=passed[2], loop_pidfd=passed[3],
            supervisor_pid=os.getpid(), go_word=Word.GO, stop_word=Word.STOP, loop_word=Word.LOOP_NS,
            ended_word=Word.ENDED, held_up_word=Word.HELD_UP_NS, words=WORDS, stop_value=int(StopRequest.OFF),
            usb_serial_number=usb_serial_number(drive.port),
        )  # fmt: skip
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "jointctl.tools.session.line_guard", order.argument()],
                pass_fds=passed, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, start_new_session=True,
            )  # fmt: skip
        finally:
            theirs.close()
            os.close(supervisor)
            os.close(ended)

    @property
    def pid(self) -> int:
        """Process id of the guard."""
        return self._process.pid

    def wait_ready(self) -> None:
        """Until it watches; without it nothing may be enabled."""
        self._control.settimeout(READY_TIMEOUT_S)
        try:
            ready = self._control.recv(1) == b"+"
        except OSError:
            ready = False
        if not ready:
            raise JointctlError("the guard of the serial line did not start", "run again")

    def just_ended(self) -> bool:
        """True once, if it has gone before it was released."""
        ended = not self._ended and self._process.poll() is not None
        self._ended = self._ended or ended
        return ended

    def release(self, state: str) -> None:
        """The drive's state as the supervisor knows it; the guard ends, or tries on by itself where it is unknown."""
        with contextlib.suppress(OSError):
            self._control.sendall(json.dumps({"state": state}).encode() + b"\n")
        self._control.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(0.0 if state.startswith("unknown") else ENDED_S)


def start_guard(config: Config, loop: LoopHandle) -> GuardHandle | None:
    """A guard where the drive is a serial one: a CANopen drive watches the loop's heartbeat by itself."""
    return GuardHandle(config.drive, loop) if isinstance(config.drive, ElmoSerial) else None
