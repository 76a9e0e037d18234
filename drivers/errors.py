"""Every error that a user can meet, as one tree, and text of others as it may be shown.

The class of an error decides the exit code of the command line.  The message is one printable line that names the
thing, its value and what is allowed.  The hint is one line that states what to do about it (often a command to type),
or empty.
"""

from __future__ import annotations

import errno
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar

# --- Text of others (names of files, values, what a library says) as it may be shown: one line, no control ---
# What a terminal or a browser would obey instead of show is escaped as JSON and TOML write it: ESC is `\u001b`.  Both
# are applied where text leaves the program (`JointctlError`, `tools.output`, pages), not where a message is made;
# applied twice, they change nothing more.


LONGEST_VALUE = 120  # characters of a value in a message
LONGEST_MESSAGE = 2000
_TAIL = 40  # of a value that is cut: a file's name stands at the end of its path
# C0, C1; what is invisible or turns the direction of writing; line separators; lone surrogates (names that are no
# UTF-8); tags
_CONTROL = re.compile(
    "[\x00-\x1f\x7f-\x9f\xad\u061c\u180e\u200b-\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb"
    "\ud800-\udfff\U000e0000-\U000e0fff]"
)
_SHORT = {"\n": "\\n", "\r": "\\r", "\t": "\\t"}
_INDENTED_BREAK = re.compile(r"[ \t]*\n[ \t]+|[ \t]+\n")
_WORD = re.compile(rf"([(=\"']{{0,3}})(\S{{{LONGEST_VALUE - 5},}}?)([)\"':;,.]{{0,3}})(?!\S)")
# a value in brackets, or in quotes that are no apostrophe; what begins a line up to a colon is the name of a file, or
# a sentence where a value stands in it
_VALUES = (
    re.compile(r"(?<=\(=).*?(?=\)(?:[ :,;.]|$))"),
    re.compile(r"(?<!\w)'.*?'(?!\w)"),
    re.compile(r'(?<!\w)".*?"(?!\w)'),
    re.compile(r"^(?![^:]* \(=)[^:]*(?=: )"),
)


def printable(text: str, keep: str = "") -> str:
    """Every control character, line break, direction mark and lone surrogate as its escape; but those of `keep`."""
    return _CONTROL.sub(lambda found: found[0] if found[0] in keep else _escaped(found[0]), text)


def _escaped(character: str) -> str:
    code = ord(character)
    return _SHORT.get(character) or (f"\\u{code:04x}" if code <= 0xFFFF else f"\\U{code:08x}")


def shortened(value: str) -> str:
    """At most `LONGEST_VALUE` characters: beginning and end."""
    if len(value) <= LONGEST_VALUE:
        return value
    return f"{value[: LONGEST_VALUE - _TAIL - 3]}...{value[-_TAIL:]}"


def decimals_of(value: float, least: int) -> int:
    """Of a torque or a speed, or of a row with this greatest one: so many at least, two digits that count below 1."""
    size = abs(value)
    return max(least, 1 - math.floor(math.log10(size))) if 1e-6 < size < 1.0 else least


def text_Nm(torque_Nm: float, decimals: int = 1) -> str:
    """A torque with its unit."""
    return f"{torque_Nm:.{decimals_of(torque_Nm, decimals)}f} Nm"


def text_radps(speed_radps: float, decimals: int = 2) -> str:
    """A speed with its unit."""
    return f"{speed_radps:.{decimals_of(speed_radps, decimals)}f} rad/s"


def message_line(text: str) -> str:
    """A message as one printable line whose values are cut.

    What a value is shows in how messages are written: `(=value)`, `'value'`, `file: ...`, and any word of that length.
    """
    line = printable(text)
    if len(line) <= LONGEST_VALUE:
        return line
    for value in _VALUES:
        line = value.sub(lambda found: shortened(found[0]), line)
    line = _WORD.sub(lambda found: found[1] + shortened(found[2]) + found[3], line)
    return line if len(line) <= LONGEST_MESSAGE else f"{line[: LONGEST_MESSAGE - 3]}..."


def one_line(text: str) -> str:
    """As `message_line`; a text that was broken and indented is put together again."""
    return message_line(re.sub(r" {2,}", " ", _INDENTED_BREAK.sub(" ", text)).strip())


# --- Errors ---


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


def refused_by_system(error: OSError) -> JointctlError:
    """What no file, bus or device is to blame for, in one line."""
    if error.errno in (errno.EMFILE, errno.ENFILE):
        return JointctlError(f"open files: {error.strerror}", "raise the limit, such as `ulimit -n 1024`")
    return JointctlError(f"{error.filename or 'the operating system'}: {error.strerror or error}")


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


class LimitCycle(MotionFault):
    """The motion was stopped because torque or error swung back and forth instead of settling."""


class StoodStill(MotionFault):
    """The motion was stopped because the reading stood still although the joint was driven."""


class DataError(JointctlError):
    """A data file cannot be read, or its content does not allow the asked computation."""

    exit_code = 8


class TooFewPoints(DataError):
    """Too few plateaus with a steady speed are left for an identification."""


class MarginError(JointctlError):
    """The control loop would have too little stability margin with the measured delay: refused before enabling."""

    exit_code = 9


@contextmanager
def blamed(name: str) -> Iterator[None]:
    """An error, with the name of the joint in front where it is one of several."""
    try:
        yield
    except BusError:  # it names the node, which need not be the joint's that has come across it
        raise
    except JointctlError as error:
        error.message = f"{name}: {error.message}" if name else error.message
        raise
