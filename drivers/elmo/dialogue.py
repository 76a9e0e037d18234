r"""The ASCII interpreter of the drive: question and answer, one command at a time, without and with a port.

    PX\r      -> PX\r12345;         value, with echo
    MO=1\r    -> MO=1\r;            done
    UM=9\r    -> UM=9\r<byte>?;     refused; EC gives the reason, and the byte is that code

A command is two letters, optional [index], optional =value, ended by CR here: the drive takes ; as well, but then
the echo would end with the character that ends a reply.  A reply ends with `;`.  With echo off only the part after CR
comes.  The echo is also the only proof that a reply belongs to a command: there is no checksum and no number.

`Interpreter` does no I/O: its caller moves the bytes and passes the time.  Memory is bounded: a reply longer than
`REPLY_MAX` is garbage.  An error byte of 59 (`;`) would end the reply early; no error code of that value is known.
`Dialogue` talks through a port, with retries where a repetition does no harm.  The drive's codes are shown in words.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import re
import termios
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Any, Protocol

import serial
from serial.tools import list_ports

from jointctl.drivers.errors import BusError, DeviceError, JointctlError, NoDeviceError
from jointctl.drivers.port_users import keep_from_forks, users_text

# --- The drive's numbers: error codes (EC), motor fault (MF), status register (SR), unit modes (UM) in words ---
# Source: the command reference of the drive family as far as two public drivers and the project's facts sheet state it.
# A code that is not listed is shown as its number: the list is not complete.

# the characters of the ASCII interpreter's language, for kernels, which handle bytes
CR, SEMICOLON, QUESTION_MARK = 0x0D, 0x3B, 0x3F
PLUS, MINUS, POINT, EQUALS = 0x2B, 0x2D, 0x2E, 0x3D
ZERO, NINE = 0x30, 0x39

# EC: why the last command was refused
ERROR_CODES: dict[int, str] = {
    2: "bad command",
    3: "bad index",
    12: "not available in this unit mode",
    19: "syntax error",
    21: "operand out of range",
    23: "command cannot be assigned",
    28: "out of limit",
    51: "inhibit or abort input active",
    57: "motor must be off",
    58: "motor must be on",
    60: "bad unit mode",
    66: "amplifier not ready",
    168: "speed too large to start the motor",
}
MOTOR_MUST_BE_ON = 58

# MF: why the motor was switched off; single bits, and one field of four bits for the amplifier
MOTOR_FAULT_BITS: dict[int, str] = {
    0x1: "feedback",
    0x2: "commutation",
    0x4: "Hall sensors",
    0x8: "peak current exceeded",
    0x10: "inhibit input",
    0x80: "speed tracking error (ER[2])",
    0x100: "position tracking error (ER[3])",
    0x800: "heartbeat lost",
    0x20000: "overspeed (HL[2], LL[2])",
    0x200000: "motor stuck",
    0x400000: "position limit (HL[3], LL[3])",
}
AMPLIFIER_FIELD = 0xF000
AMPLIFIER_FAULTS: dict[int, str] = {
    0x3: "undervoltage",
    0x5: "overvoltage",
    0x7: "safe torque off (STO)",
    0xB: "short circuit",
    0xD: "overtemperature",
}

# SR: fields of the status register
AMPLIFIER_MASK = 0xF
SERVO_ON = 1 << 4
FAULT_LATCHED = 1 << 6
UNIT_MODE_SHIFT = 7
UNIT_MODE_MASK = 0x7
CURRENT_LIMITED = 1 << 13


class UnitMode(IntEnum):
    """UM; only to be changed with the motor off."""

    TORQUE = 1
    SPEED = 2
    POSITION = 5


def error_text(code: int) -> str:
    """`EC 21 (operand out of range)`."""
    return f"EC {code} ({ERROR_CODES.get(code, 'not in the list')})"


def motor_fault_names(fault: int) -> list[str]:
    """Every cause in an MF value; empty for 0."""
    names = [name for bit, name in MOTOR_FAULT_BITS.items() if fault & bit]
    field = (fault & AMPLIFIER_FIELD) >> 12
    if field:
        names.append(AMPLIFIER_FAULTS.get(field, f"amplifier code {field:X}h"))
    rest = fault & ~(AMPLIFIER_FIELD | sum(MOTOR_FAULT_BITS))
    if rest:
        names.append(f"unknown bits {rest:X}h")
    return names


def motor_fault_text(fault: int) -> str:
    """`MF 20000h (overspeed (HL[2], LL[2]))`; `no motor fault` for 0."""
    if fault == 0:
        return "no motor fault"
    return f"MF {fault:X}h ({', '.join(motor_fault_names(fault))})"


def status_text(status: int) -> str:
    """SR in words: servo, unit mode, and what is amiss."""
    parts = ["servo on" if status & SERVO_ON else "servo off", f"UM {unit_mode(status)}"]
    amplifier = status & AMPLIFIER_MASK
    if amplifier:
        parts.append(AMPLIFIER_FAULTS.get(amplifier, f"amplifier code {amplifier:X}h"))
    if status & FAULT_LATCHED:
        parts.append("fault latched")
    if status & CURRENT_LIMITED:
        parts.append("current limited")
    return ", ".join(parts)


def unit_mode(status: int) -> int:
    """UM as SR shows it."""
    return status >> UNIT_MODE_SHIFT & UNIT_MODE_MASK


def motor_off_cause(status: int, fault: int) -> str:
    """Why a drive is off that should be on; the amplifier field of SR counts where MF says nothing."""
    amplifier = status & AMPLIFIER_MASK
    if fault == 0 and amplifier:
        return AMPLIFIER_FAULTS.get(amplifier, f"amplifier code {amplifier:X}h")
    return motor_fault_text(fault)


# --- A serial port as the driver needs it: bytes out, bytes in by a deadline, every failure a `BusError` ---

READ_MAX = 512


class BytePort(Protocol):
    """What a dialogue talks through; replaced in tests."""

    def write(self, data: bytes) -> None: ...

    def read(self, timeout_s: float) -> bytes:
        """Whatever has come; waits up to `timeout_s` for the first byte; empty after a time-out."""

    def discard(self) -> None:
        """Throw away what has come and not been read."""

    def close(self) -> None: ...


class SerialPort:
    """8N1, no flow control.  Locked against a second `jointctl`; the loop process opens the same port without lock.

    `exclusive` False: to switch the drive off although another program has the port.
    """

    def __init__(self, path: str, baud_rate_bitps: int, *, exclusive: bool = True) -> None:
        self.path = path
        try:
            self._serial: Any = serial.Serial(
                path, baud_rate_bitps, timeout=0, write_timeout=1.0, exclusive=True if exclusive else None
            )
        except (serial.SerialException, OSError, ValueError, termios.error) as error:
            raise _open_error(path, baud_rate_bitps, error) from None
        keep_from_forks(self._serial)

    def write(self, data: bytes) -> None:
        with self._failures():
            self._serial.write(data)

    def read(self, timeout_s: float) -> bytes:
        with self._failures():
            self._serial.timeout = max(timeout_s, 0.0)
            first: bytes = self._serial.read(1)
            if not first:
                return b""
            self._serial.timeout = 0
            return first + bytes(self._serial.read(READ_MAX))

    def discard(self) -> None:
        with self._failures():
            self._serial.reset_input_buffer()

    def close(self) -> None:
        with contextlib.suppress(Exception):
            self._serial.reset_output_buffer()  # closing would wait for bytes that no one takes any more
        with contextlib.suppress(Exception):
            self._serial.close()

    @contextlib.contextmanager
    def _failures(self) -> Any:
        try:
            yield
        except (serial.SerialException, OSError, termios.error, TypeError) as error:
            # pyserial raises TypeError where the descriptor has gone between two of its calls
            raise BusError(
                f"serial port {self.path} failed: {_reason(error)}", "unplugged, or the adapter lost its power"
            ) from None


def open_descriptor(path: str) -> int:
    """A second descriptor of a port that is open and configured already, for the compiled loop; the caller closes it.

    The line settings belong to the port, not to the descriptor: nothing is set here.
    """
    try:
        return os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise _open_error(path, 0, error) from None


def usb_serial_number(path: str) -> str | None:
    """Of the USB adapter behind a port; None where the system knows none: other ports, cheap adapters."""
    device = os.path.realpath(path)
    try:
        return next((found.serial_number or None for found in list_ports.comports() if found.device == device), None)
    except OSError:  # a device that vanishes while it is read
        return None


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)


def _open_error(path: str, baud_rate_bitps: int, error: Exception) -> BusError:
    number = getattr(error, "errno", None)
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return BusError(f"no such serial port: {path}", "plug in the adapter; -p names the port")
    if number in (errno.EACCES, errno.EPERM):
        return BusError(f"no permission to open {path}", "sudo usermod -aG dialout $USER; log in again")
    if number in (errno.EAGAIN, errno.EBUSY) or "lock" in str(error):
        users = users_text(path)
        return BusError(
            f"serial port {path} is in use by another program{f' ({users})' if users else ''}",
            "end that program first; `jointctl stop` switches the drive off all the same",
        )
    if number == errno.ENOTTY or "configure port" in str(error):
        return BusError(f"{path} is not a serial port")
    if isinstance(error, ValueError):
        return BusError(f"serial port {path} does not take {baud_rate_bitps} baud: {error}")
    return BusError(f"cannot open serial port {path}: {_reason(error)}")


END_OF_COMMAND = b"\r"
END_OF_REPLY = b";"
REPLY_MAX = 512
COMMAND_MAX = 64
ATTEMPTS = 3
SILENCE_S = 0.03  # no byte for so long: the line is quiet
LONGEST_NOISE_S = 0.5
RELATIVE_TOLERANCE = 2e-3  # drives keep their own resolution of a limit
ABSOLUTE_TOLERANCE = 2e-3
_NAME = re.compile(r"[A-Z]{2}", re.ASCII)


class ReplyKind(Enum):
    VALUE = "value"  # `text` is the value; empty for an assignment
    ERROR = "error"  # refused; `error_code` is the byte before `?`, or 0 where none came
    GARBLED = "garbled"  # bytes came that are no reply to this command
    TIMEOUT = "timeout"  # nothing, or no end of a reply, in time


@dataclass(frozen=True)
class Reply:
    kind: ReplyKind
    text: str = ""
    error_code: int = 0
    echoed: bool = False
    raw: bytes = b""


def encode(name: str, index: int | None = None, value: float | str | None = None) -> bytes:
    """`PX`, `CL[1]=2.5`, ended by CR.  Whole numbers are written without a point, others with six digits after it."""
    if not _NAME.fullmatch(name):
        raise ValueError(f"command (={name!r}) must be two capital letters")
    text = name if index is None else f"{name}[{int(index)}]"
    if isinstance(value, str):
        text += f"={value}"
    elif value is not None:
        if not math.isfinite(value):
            raise ValueError(f"{text} (={value}) must be finite")
        text += f"={int(value)}" if value == int(value) else f"={value:.6f}"
    line = text.encode("ascii")
    if b";" in line or b"\r" in line or len(line) >= COMMAND_MAX:
        raise ValueError(f"command (={text!r}) must be less than {COMMAND_MAX} characters without ; and CR")
    return line + END_OF_COMMAND


def parse_reply(command: bytes, frame: bytes, echo: bool | None = None) -> Reply:
    """What `frame` (bytes up to the `;`, without it) says about `command`.

    `echo` True: the echo is required; False: not expected, but taken if it is there; None: either.
    """
    echoed = frame.startswith(command)
    body = frame[len(command) :] if echoed else frame
    if (echo and not echoed) or len(frame) > REPLY_MAX:
        return Reply(ReplyKind.GARBLED, raw=frame)
    if body.endswith(b"?") and len(body) <= 2:
        return Reply(ReplyKind.ERROR, error_code=body[0] if len(body) == 2 else 0, echoed=echoed, raw=frame)
    if any(not (0x20 <= byte <= 0x7E or byte in b"\t\n") for byte in body):
        return Reply(ReplyKind.GARBLED, raw=frame)
    return Reply(ReplyKind.VALUE, text=body.decode("ascii").strip(), echoed=echoed, raw=frame)


class Interpreter:
    """One command at a time: `begin` gives the bytes to send, `feed` takes what came, `poll` reports a time-out."""

    def __init__(self, echo: bool | None = None) -> None:
        self.echo = echo
        self.garbage_bytes = 0  # received while no command was open, or in garbled replies
        self._command: bytes | None = None
        self._until_s = 0.0
        self._buffer = bytearray()
        self._overflow = False

    @property
    def busy(self) -> bool:
        return self._command is not None

    def begin(self, command: bytes, now_s: float, timeout_s: float) -> bytes:
        """Open a command; what was received before is not its reply and is thrown away."""
        if self._command is not None:
            raise RuntimeError(f"{self._command!r} has not ended yet")
        self.reset()
        self._command, self._until_s = command, now_s + timeout_s
        return command

    def feed(self, data: bytes, now_s: float) -> Reply | None:
        """Take received bytes; the reply once it is complete.  Bytes behind its end answer nothing: garbage."""
        for at, byte in enumerate(data):
            if self._command is None:
                self.garbage_bytes += len(data) - at
                return None
            if byte == END_OF_REPLY[0]:
                self.garbage_bytes += len(data) - at - 1
                return self._complete()
            if len(self._buffer) < REPLY_MAX:
                self._buffer.append(byte)
            else:
                self._overflow = True
        return self.poll(now_s)

    def poll(self, now_s: float) -> Reply | None:
        """A TIMEOUT reply once the command's time is over."""
        if self._command is None or now_s < self._until_s:
            return None
        raw = bytes(self._buffer)
        self.garbage_bytes += len(raw)
        self.reset()
        return Reply(ReplyKind.TIMEOUT, raw=raw)

    def reset(self) -> None:
        """Forget the open command and every byte that was received."""
        self._command = None
        self._buffer.clear()
        self._overflow = False

    def _complete(self) -> Reply:
        assert self._command is not None
        frame = bytes(self._buffer)
        if self._overflow:
            reply = Reply(ReplyKind.GARBLED, raw=frame)
        else:
            reply = parse_reply(self._command, frame, self.echo)
        if reply.kind is ReplyKind.GARBLED:
            self.garbage_bytes += len(frame)
        self.reset()
        return reply


class RefusedError(DeviceError):
    def __init__(self, command: str, code: int) -> None:
        super().__init__(f"the drive refused {command}: {error_text(code)}")
        self.code = code


class Dialogue:
    """`clock` is a monotonic clock in seconds."""

    def __init__(self, port: BytePort, timeout_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._port = port
        self._timeout_s = timeout_s
        self._clock = clock
        self.interpreter = Interpreter()
        self.gate: Callable[[], None] = lambda: None  # raises where no more is to be sent to the drive
        self._verified: dict[tuple[str, int | None], float] = {}  # what `assign_verified` read back last

    def resynchronise(self) -> None:
        """End whatever half command the drive may have, and wait until the line is quiet."""
        self.interpreter.reset()
        self._port.write(b"\r")
        noisy_until_s = self._clock() + LONGEST_NOISE_S
        while self._clock() < noisy_until_s:
            data = self._port.read(SILENCE_S)
            if not data:
                break
            self.interpreter.feed(data, self._clock())
        self._port.discard()

    def once(self, command: bytes, behind: bytes = b"") -> Reply:
        """Send and wait for the end of the command, whatever it is; what is `behind` it follows unheard."""
        self._port.discard()
        now_s = self._clock()
        until_s = now_s + self._timeout_s
        self._port.write(self.interpreter.begin(command, now_s, self._timeout_s) + behind)
        while True:
            data = self._port.read(max(0.0, until_s - self._clock()))
            reply = self.interpreter.feed(data, self._clock()) if data else self.interpreter.poll(self._clock())
            if reply is not None:
                return reply

    def ask(self, command: bytes, attempts: int = ATTEMPTS, behind: bytes = b"") -> str:
        """The value.  `RefusedError` if the drive says no, `BusError` for garbage, `NoDeviceError` for silence."""
        shown = command.decode("ascii").strip()
        reply = Reply(ReplyKind.TIMEOUT)
        for attempt in range(attempts):
            self.gate()
            if attempt:
                self.resynchronise()
            reply = self.once(command, behind)
            if reply.kind is ReplyKind.VALUE:
                return reply.text
            if reply.kind is ReplyKind.ERROR:
                raise RefusedError(shown, reply.error_code or self._error_code())
        if reply.kind is ReplyKind.GARBLED or reply.raw:
            raise BusError(
                f"the line is garbled: {shown} was answered by {reply.raw[:24]!r}",
                "baud rate of drive and configuration, cable, ground",
            )
        raise NoDeviceError(f"the drive does not answer {shown} within {self._timeout_s:g} s")

    def _error_code(self) -> int:
        reply = self.once(encode("EC"))
        return int(reply.text) if reply.kind is ReplyKind.VALUE and reply.text.isdigit() else 0

    def query(self, name: str, index: int | None = None) -> str:
        return self.ask(encode(name, index))

    def number(self, name: str, index: int | None = None) -> float:
        return finite_number(_shown(name, index), self.query(name, index))

    def integer(self, name: str, index: int | None = None) -> int:
        """The value as a whole number."""
        return round(self.number(name, index))

    def assign(self, name: str, value: float, index: int | None = None) -> None:
        """Set a value; the drive says that it took it."""
        self.ask(encode(name, index, value))

    def assign_verified(self, name: str, value: float, index: int | None = None) -> float:
        """Set, read back and compare; returns what the drive keeps."""
        self.assign(name, value, index)
        kept = self.number(name, index)
        if _differ(kept, value):
            raise DeviceError(f"{_shown(name, index)} (={value:g}) does not read back: the drive has {kept:g}")
        self._verified[name, index] = kept
        return kept

    def forget_verified(self) -> None:
        """Commissioning begins anew, or in another unit mode."""
        self._verified.clear()

    def verify_again(self) -> None:
        """Read everything that was verified once more; `DeviceError` if the drive has changed in the meantime."""
        for (name, index), kept in self._verified.items():
            found = self.number(name, index)
            if _differ(found, kept):
                raise changed(_shown(name, index), f"{found:g}", f"{kept:g}")

    def command(self, name: str) -> None:
        """A command without value, such as BG; sent once, because it may act twice."""
        self.ask(encode(name), 1)


def finite_number(shown: str, text: str) -> float:
    """`DeviceError` for what is none, such as the nan that noise may make of a reply."""
    with contextlib.suppress(ValueError):
        if math.isfinite(number := float(text)):
            return number
    raise DeviceError(f"{shown} (={text!r}) of the drive is not a number")


def _differ(found: float, wanted: float) -> bool:
    return not abs(found - wanted) <= ABSOLUTE_TOLERANCE + RELATIVE_TOLERANCE * abs(wanted)


def changed(shown: str, found: str, wanted: str) -> DeviceError:
    """The error for a drive that is not as commissioning left it."""
    return DeviceError(
        f"the drive has changed since it was commissioned: {shown} is {found}, {wanted} was set",
        "it was restarted, or another program has used it; start the run again",
    )


def _shown(name: str, index: int | None) -> str:
    return name if index is None else f"{name}[{index}]"


# --- Torque and speed zero, motor off on a serial line: sent by drive, loop, guard and `jointctl stop` ---


SAFE_ATTEMPTS = 5
# TC and ST before MO: where the drive takes no MO=0 it is without torque, or its jog has ended, all the same.  JV=0, so
# that no later BG jogs on; without a BG, which in a unit mode that another program has chosen would begin a motion.
# The first CR ends a half command.
COMMANDS = (b"TC=0", b"JV=0", b"ST", b"MO=0")
SWITCH_OFF = b"\r" + b"".join(command + b"\r" for command in COMMANDS)


def switch_off(port: BytePort, line: Dialogue, attempts: int = SAFE_ATTEMPTS) -> str:
    """TC=0, JV=0, ST, MO=0 until MO reads 0; returns `off`, or `off, fault: ...`.

    Raises the last error where the drive did not confirm; all commands were sent, as far as the port took them.
    """
    line.interpreter.echo = None  # a drive that restarted has its own setting again
    error: JointctlError | None = None
    # at once and unheard, before any time is spent on a line that may be in disorder
    port.write(SWITCH_OFF)
    for _ in range(attempts):
        try:
            line.resynchronise()
            for command in COMMANDS:
                try:
                    line.ask(command + b"\r", 1)
                except RefusedError as refusal:
                    if command == b"MO=0" and refusal.code != MOTOR_MUST_BE_ON:
                        raise
            if line.integer("MO") == 0:
                status = line.integer("SR")
                cause = motor_off_cause(status, line.integer("MF"))
                return "off" if not status & (FAULT_LATCHED | AMPLIFIER_MASK) else f"off, fault: {cause}"
        except JointctlError as failure:
            error = failure
    raise error or DeviceError("MO of the drive does not become 0")
