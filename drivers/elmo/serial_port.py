"""A serial port as the driver needs it: bytes out, bytes in by a deadline, every failure a `BusError`."""

from __future__ import annotations

import contextlib
import errno
import os
import termios
from typing import Any, Protocol

import serial
from serial.tools import list_ports

from jointctl.drivers.errors import BusError
from jointctl.drivers.port_users import users_text

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
