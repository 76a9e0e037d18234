"""An Elmo drive on its serial line in a session: its guard, its loop and the delay, its faults in words, no standby."""

from __future__ import annotations

import contextlib
import json
import math
import os
import select
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import numpy as np

from jointctl.drivers.drive import Drive
from jointctl.drivers.elmo.dialogue import (
    AMPLIFIER_MASK,
    SERVO_ON,
    motor_fault_text,
    motor_off_cause,
    usb_serial_number,
)
from jointctl.drivers.elmo.drive import ElmoDrive
from jointctl.drivers.elmo.settings import command_time_s
from jointctl.drivers.errors import BusError, JointctlError
from jointctl.drivers.port_users import keep_from_forks
from jointctl.firmware_py.cycle import WORDS, Histogram, Word
from jointctl.firmware_py.states import Fault, StopRequest
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.elmo import ElmoSection, elmo_section, elmo_settings, serial_line_share
from jointctl.tools.output import Output
from jointctl.tools.session.elmo_guard import GuardOrder, running_supervisor
from jointctl.tools.session.fault_words import FaultText, fault_text
from jointctl.tools.session.loop_handle import SILENT_S, LoopHandle
from jointctl.tools.session.loop_memory import quantile_s
from jointctl.tools.session.session_drive import SessionDrive


class ElmoSession(SessionDrive):
    """See `SessionDrive`."""

    def check_rate(self, config: Config) -> None:
        serial_line_share(config)

    def open(self, config: Config, gate: Callable[[], None] = lambda: None, private: bool = False) -> Drive:
        return ElmoDrive(elmo_settings(config), gate=gate)

    def loop_delay_s(self, config: Config, histograms: np.ndarray) -> float:
        """Round trip of PX and work at their 99th percentile, and TC on the line; the drive takes it at its end."""
        path_s = quantile_s(histograms[Histogram.ROUND_TRIP])
        if math.isnan(path_s):
            return 1.0 / config.loop.rate_Hz
        work_s = quantile_s(histograms[Histogram.WORK])
        return path_s + work_s + command_time_s(elmo_section(config).baud_rate_bitps)

    def guard(self, config: Config, loop: LoopHandle) -> GuardHandle:
        """See `SessionDrive`: the drive notices no death."""
        return GuardHandle(elmo_section(config), loop)

    def kept_awake(self, output: Output) -> AbstractContextManager[bool]:
        return kept_awake(output)

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
        status = round(value) if finite and fault is Fault.DRIVE_FAULT else 0
        if drive_error or status & AMPLIFIER_MASK:
            happened += f"; the drive says {motor_off_cause(status, drive_error)}"
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
        ours, theirs = socket.socketpair()
        self._control = keep_from_forks(ours)
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
        return self._process.pid

    def wait_ready(self) -> None:
        self._control.settimeout(READY_TIMEOUT_S)
        try:
            ready = self._control.recv(1) == b"+"
        except OSError:
            ready = False
        if not ready:
            raise JointctlError("the guard of the serial line did not start", "run again")

    def just_ended(self) -> bool:
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


# --- The words of faults; {word} is the status register (SR) ---


SERIAL_TEXTS: dict[Fault, FaultText] = {
    Fault.STALE_SAMPLE: FaultText(
        "no usable position reply came for {value:.0f} cycles, at once or again and again",
        # Linux hands over what a serial port received by a worker of ordinary priority, however urgent the loop is
        "cable or drive went silent, noise garbles the replies, or a busy computer hands them over late",
        "check the cable and its ground, and what else the computer does; the drive's own limits watched the joint "
        "in the meantime",
    ),
    Fault.DRIVE_FAULT: FaultText(
        "the drive switched its motor off because of a fault (SR {word})",
        "see the drive's motor fault",
        "remove the cause; jointctl resets nothing by itself",
    ),
    Fault.DRIVE_NOT_ENABLED: FaultText(
        "the motor was switched off without being asked (SR {word})",
        "inhibit input or STO was opened, another program on the line, or a restart of the drive",
        "check the inhibit and STO wiring and the supply",
    ),
    Fault.DRIVE_RESTARTED: FaultText(
        "the drive restarted while the loop was running: its unit mode is another one (SR {word})",
        "its supply dropped, or somebody reset it",
        "check the supply; the drive has lost its limits, start again",
    ),
    Fault.ENABLE_TIMEOUT: FaultText(
        "the drive did not switch its motor on in time (SR {word})",
        "no motor supply, STO open, or inhibit input active",
        "check voltage, STO and inhibit; MO=1 is refused until they are right",
    ),
    Fault.BUS_ERROR: FaultText(
        "the serial port is gone or takes no characters any more",
        "adapter or cable unplugged",
        "make sure that the joint stands: nothing could be said to the drive; then plug it in again",
    ),
    Fault.OFF_TIMEOUT: FaultText(
        "the drive did not confirm that its motor is off (SR {word})",
        "the line is cut or the drive is silent",
        "use the emergency stop; then check the line",
    ),
    Fault.NO_SAMPLES: FaultText(
        "not one position reply came from the drive",
        "the drive went silent after commissioning",
        "check the cable; run again",
    ),
    Fault.SAMPLES_MISSING: FaultText(
        "positions came, but never {value:.0f} of them in a row, as sequence.settle_s wants it before enabling",
        "noise garbles replies, or a busy computer hands them over late",
        "check the cable and its ground, and what else the computer does; or lower loop.rate_Hz",
    ),
    Fault.DRIVE_STAYS_ENABLED: FaultText(
        "the motor is on although nobody asked for it, and does not switch off (SR {word})",
        "another program on the line, or a drive that ignores MO=0",
        "use the emergency stop; check who else uses the port",
    ),
    Fault.SUSPENDED: FaultText(
        "the computer slept for {value:.1f} s while the loop was running; the drive held its last command "
        "in the meantime",
        "standby or hibernation: lid, power button, energy saving",
        "make sure that the joint stands; switch standby off, or try systemd-inhibit --what=sleep jointctl ...",
    ),
}
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
    return SERIAL_TEXTS.get(fault)


# --- A computer that is kept awake while a drive moves that would hold its last command ---
# A child under systemd-inhibit holds the lock of systemd-logind as long as its standard input is open, so it ends
# with this process, however that ends.  A lid that is closed heeds only a lock of its own (logind.conf,
# LidSwitchIgnoreInhibited).


WHAT = "sleep:handle-lid-switch"
HELD_TIMEOUT_S = 2.0
ENDED_S = 1.0
_INHIBIT = (
    "systemd-inhibit", f"--what={WHAT}", "--who=jointctl", "--why=a joint is in motion", "--mode=block",
    "sh", "-c", "echo held && exec cat >/dev/null",
)  # fmt: skip


def _hold_awake() -> subprocess.Popen[bytes] | None:
    """The child, in a session of its own, where it neither asks for a password nor hears Ctrl-C; None if it fails."""
    try:
        child = subprocess.Popen(
            _INHIBIT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True
        )
    except OSError:
        return None
    assert child.stdout is not None
    if select.select([child.stdout], [], [], HELD_TIMEOUT_S)[0] and child.stdout.read(1):
        return child
    _let_sleep(child)
    return None


def _let_sleep(child: subprocess.Popen[bytes]) -> None:
    assert child.stdin is not None
    assert child.stdout is not None
    child.stdin.close()
    try:
        child.wait(ENDED_S)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()
    child.stdout.close()


@contextmanager
def kept_awake(output: Output) -> Iterator[bool]:
    """Whether the computer is kept awake while a drive moves that would hold its last command."""
    child = _hold_awake()
    if child is None:
        output.note(
            "systemd-inhibit does not work here: the computer is not kept from falling asleep, "
            "and the drive would hold its last command in the meantime"
        )
        yield False
        return
    output.note("the computer is kept from falling asleep until the end of the run")
    try:
        yield True
    finally:
        _let_sleep(child)
