"""Every error that a user can meet, as one tree; the class decides the exit code of the command line.

The message is one printable line that names the thing, its value and what is allowed.  The hint is one line that states
what to do about it (often a command to type), or empty.
"""

from __future__ import annotations

from typing import ClassVar

from jointctl.drivers.printable import one_line

INTERRUPTED = 130  # exit code after Ctrl-C and its like, which are no error
DECLINED = 12  # exit code where the user did not agree to what was asked: nothing was done


class JointctlError(Exception):
    """Anything that `jointctl` reports as one line instead of a traceback."""

    exit_code: ClassVar[int] = 1

    def __init__(self, message: str, hint: str = "") -> None:
        super().__init__(message, hint)
        self.message = one_line(message)
        self.hint = one_line(hint)

    def __str__(self) -> str:
        return f"{self.message} ({self.hint})" if self.hint else self.message


class UsageError(JointctlError):
    """The command line asks for something that cannot be done as it stands."""

    exit_code = 2


class ConfigurationError(JointctlError):
    """A configuration key is missing, unknown, out of range or in the wrong unit."""

    exit_code = 3


class BusError(JointctlError):
    """The CAN interface or serial port cannot be opened, or failed while in use."""

    exit_code = 4


class NoDeviceError(JointctlError):
    """The bus works, but no device answers at the node or port that was asked for."""

    exit_code = 5


class DeviceError(JointctlError):
    """The device refused a request, is not the one expected, or does not support what is needed."""

    exit_code = 6


class MotionFault(JointctlError):
    """The motion was stopped by a limit, by the drive or by the supervision; the joint is disabled."""

    exit_code = 7


class DataError(JointctlError):
    """A data file cannot be read, or its content does not allow the asked computation."""

    exit_code = 8


class MarginError(JointctlError):
    """The control loop would have too little stability margin with the measured delay: refused before enabling."""

    exit_code = 9
