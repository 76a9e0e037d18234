"""Question and answer with the drive, one command at a time, with retries where a repetition does no harm."""

from __future__ import annotations

import time
from collections.abc import Callable

from jointctl.drivers.elmo.codes import error_text
from jointctl.drivers.elmo.interpreter import Interpreter, Reply, ReplyKind, encode
from jointctl.drivers.elmo.serial_port import BytePort
from jointctl.drivers.errors import BusError, DeviceError, NoDeviceError

ATTEMPTS = 3
SILENCE_S = 0.03  # no byte for so long: the line is quiet
LONGEST_NOISE_S = 0.5
RELATIVE_TOLERANCE = 2e-3  # drives keep their own resolution of a limit
ABSOLUTE_TOLERANCE = 2e-3


class RefusedError(DeviceError):
    """The drive answered with an error code."""

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
        self.retries = 0
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

    def once(self, command: bytes) -> Reply:
        """Send and wait for the end of the command, whatever it is."""
        self._port.discard()
        now_s = self._clock()
        until_s = now_s + self._timeout_s
        self._port.write(self.interpreter.begin(command, now_s, self._timeout_s))
        while True:
            data = self._port.read(max(0.0, until_s - self._clock()))
            reply = self.interpreter.feed(data, self._clock()) if data else self.interpreter.poll(self._clock())
            if reply is not None:
                return reply

    def ask(self, command: bytes, attempts: int = ATTEMPTS) -> str:
        """The value.  `RefusedError` if the drive says no, `BusError` for garbage, `NoDeviceError` for silence."""
        shown = command.decode("ascii").strip()
        reply = Reply(ReplyKind.TIMEOUT)
        for attempt in range(attempts):
            self.gate()
            if attempt:
                self.retries += 1
                self.resynchronise()
            reply = self.once(command)
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
        """The value as text."""
        return self.ask(encode(name, index))

    def number(self, name: str, index: int | None = None) -> float:
        """The value as a number."""
        text = self.query(name, index)
        try:
            return float(text)
        except ValueError:
            raise DeviceError(f"{_shown(name, index)} (={text!r}) of the drive is not a number") from None

    def integer(self, name: str, index: int | None = None) -> int:
        """The value as a whole number."""
        return round(self.number(name, index))

    def assign(self, name: str, value: float, index: int | None = None, *, attempts: int = ATTEMPTS) -> None:
        """Set a value; the drive says that it took it."""
        self.ask(encode(name, index, value), attempts)

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
