"""The ASCII interpreter without a port: bytes of commands, and what the bytes that come back mean.

    PX\\r      -> PX\\r12345;         value, with echo
    MO=1\\r    -> MO=1\\r;            done
    UM=9\\r    -> UM=9\\r<byte>?;     refused; EC tells why, and the byte is that code

A command is two letters, optional [index], optional =value, ended by CR here: the drive takes ; as well, but then
the echo would end with the character that ends a reply.  A reply ends with `;`.  With echo off only the part after CR
comes.  The echo is also the only proof that a reply belongs to a command: there is no checksum and no number.

Sans-I/O: the caller moves the bytes and tells the time.  Memory is bounded: a reply longer than `REPLY_MAX` is
garbage.  An error byte of 59 (`;`) would end the reply early; no error code of that value is known.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import Enum

END_OF_COMMAND = b"\r"
END_OF_REPLY = b";"
REPLY_MAX = 512
COMMAND_MAX = 64
_NAME = re.compile(r"[A-Z]{2}", re.ASCII)


class ReplyKind(Enum):
    """How one command ended."""

    VALUE = "value"  # `text` is the value; empty for an assignment
    ERROR = "error"  # refused; `error_code` is the byte before `?`, or 0 where none came
    GARBLED = "garbled"  # bytes came that are no reply to this command
    TIMEOUT = "timeout"  # nothing, or no end of a reply, in time


@dataclass(frozen=True)
class Reply:
    """The end of one command."""

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
    """One command at a time: `begin` gives the bytes to send, `feed` takes what came, `poll` tells a time-out."""

    def __init__(self, echo: bool | None = None) -> None:
        self.echo = echo
        self.garbage_bytes = 0  # received while no command was open, or in garbled replies
        self._command: bytes | None = None
        self._until_s = 0.0
        self._buffer = bytearray()
        self._overflow = False

    @property
    def busy(self) -> bool:
        """Whether a command is open."""
        return self._command is not None

    def begin(self, command: bytes, now_s: float, timeout_s: float) -> bytes:
        """Open a command; what was received before is not its reply and is thrown away."""
        if self._command is not None:
            raise RuntimeError(f"{self._command!r} has not ended yet")
        self.reset()
        self._command, self._until_s = command, now_s + timeout_s
        return command

    def feed(self, data: bytes, now_s: float) -> Reply | None:
        """Take received bytes; the reply once it is complete.  Bytes behind its end are garbage: nobody asked."""
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
