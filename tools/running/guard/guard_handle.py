"""The guard of a serial line as its supervisor sees it: start it before anything can move, let it go at the end."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys

from jointctl.drivers.elmo.serial_port import usb_serial_number
from jointctl.drivers.errors import JointctlError
from jointctl.firmware_py.realtime import WORDS, Word
from jointctl.firmware_py.states import StopRequest
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.elmo import ElmoSerial
from jointctl.tools.running.guard.line_guard import GuardOrder
from jointctl.tools.running.loop.loop_handle import SILENT_S, LoopHandle

READY_TIMEOUT_S = 20.0
SPARE_S = 1.0  # the supervisor is to be first
ENDED_S = 1.0
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
                [sys.executable, "-P", "-m", "jointctl.tools.running.guard.line_guard", order.argument()],
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
