"""An Elmo drive on its serial line in a session: opening it, its guard, its delay, and its faults in words."""

from __future__ import annotations

import contextlib
import json
import math
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

import numpy as np

from jointctl.drivers.drive import Drive
from jointctl.drivers.elmo.codes import SERVO_ON, motor_fault_text
from jointctl.drivers.elmo.drive import ElmoDrive
from jointctl.drivers.elmo.serial_port import usb_serial_number
from jointctl.drivers.elmo.settings import command_time_s
from jointctl.drivers.errors import BusError, JointctlError
from jointctl.firmware_py.cycle import WORDS, Histogram, Word
from jointctl.firmware_py.states import Fault, StopRequest
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.elmo import ElmoSection, elmo_section, elmo_settings, serial_line_share
from jointctl.tools.session.elmo_guard import GuardOrder, running_supervisor
from jointctl.tools.session.fault_words import FAULT_TEXTS, FaultText, fault_text
from jointctl.tools.session.loop_delay import QUANTILE, quantile_s
from jointctl.tools.session.loop_handle import SILENT_S, LoopHandle, LoopOrder, SharedBlock
from jointctl.tools.session.session_drive import SessionDrive

if TYPE_CHECKING:
    from jointctl.tools.session.loops import ReadyLoop


class ElmoSession(SessionDrive):
    """See `SessionDrive`."""

    def check_rate(self, config: Config) -> None:
        serial_line_share(config)

    def open(self, config: Config, gate: Callable[[], None] = lambda: None) -> Drive:
        return ElmoDrive(elmo_settings(config), gate=gate)

    def port_record(self) -> type:
        from jointctl.drivers.elmo.cyclic import ElmoPort

        return ElmoPort

    def loop(self, order: LoopOrder, block: SharedBlock) -> AbstractContextManager[ReadyLoop]:
        from jointctl.tools.session.loops import serial_loop

        return serial_loop(order, block)

    def loop_delay_s(self, config: Config, histograms: np.ndarray) -> float:
        """Round trip of PX and work at their 99th percentile, and TC on the line; the drive takes it at its end."""
        path_s = quantile_s(histograms[Histogram.ROUND_TRIP], QUANTILE)
        if math.isnan(path_s):
            return 1.0 / config.loop.rate_Hz
        work_s = quantile_s(histograms[Histogram.WORK], QUANTILE)
        return path_s + work_s + command_time_s(elmo_section(config).baud_rate_bitps)

    def guard(self, config: Config, loop: LoopHandle) -> GuardHandle:
        """See `SessionDrive`: the drive notices no death."""
        return GuardHandle(elmo_section(config), loop)

    def refuse_beside_run(self, config: Config) -> None:
        port = elmo_section(config).port
        pid = running_supervisor(port)
        if pid is not None:
            raise BusError(
                f"a run is active on {port} (pid {pid}): no fault is cleared in the meantime",
                "wait for its end, or end it with `jointctl stop`",
            )

    def fault_text(
        self, config: Config, fault: Fault, value: float, drive_error: int, encoder_error: int = 0
    ) -> FaultText:
        text = serial_fault_text(fault, value) or fault_text(fault, value, 0)
        finite = math.isfinite(value)
        happened = text.happened.format(value=value, word=f"{round(value):X}h") if finite else text.happened
        if drive_error:
            happened += f"; the drive says {motor_fault_text(drive_error)}"
        return FaultText(happened, text.cause, text.next_step)

    def error_text(self, code: int) -> str:
        return f"motor fault: {motor_fault_text(code)}"

    def load_row(self, share: float) -> tuple[str, str]:
        return "line load", f"{share:.1%} of the characters from the drive"


# --- The guard of the line as its supervisor sees it: start it before anything can move, let it go at the end ---


READY_TIMEOUT_S = 20.0
RELEASED_S = 1.0
SPARE_S = 1.0  # the supervisor is to be first


class GuardHandle:
    """Started by `ElmoSession.guard`; see `Guard`."""

    def __init__(self, drive: ElmoSection, loop: LoopHandle) -> None:
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
                [sys.executable, "-P", "-m", "jointctl.tools.session.elmo_guard", order.argument()],
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
            self._process.wait(0.0 if state.startswith("unknown") else RELEASED_S)


# with the servo on in the last SR nothing says that the drive has switched off: the loop has given up believing it
STATUS_LOST_TEXT = FaultText(
    "the drive's status stayed away although positions came; the last one said that its motor is on (SR {word})",
    "replies lost to noise, or a busy computer that hands them over late",
    "check the cable and its ground, and what else the computer does",
)


def serial_fault_text(fault: Fault, value: float) -> FaultText | None:
    """The text of a fault on a serial line; None where it is that of a bus.  `value` is SR where there is one."""
    if fault is Fault.DRIVE_NOT_ENABLED and math.isfinite(value) and round(value) & SERVO_ON:
        return STATUS_LOST_TEXT
    return FAULT_TEXTS[fault].serial
