"""Reading files that a user names: regular files up to a size, numbers as CSV means them, TOML and JSON of any depth.

A device or a FIFO would be read for ever, a file of gigabytes would fill the memory.  All of it comes as `OSError` with
a `strerror` that can be shown, or as `ValueError` of the format, so that a reader needs to catch nothing else.
"""

from __future__ import annotations

import errno
import json
import os
import re
import stat
import tomllib
from pathlib import Path
from typing import IO, Any

MIB = 1 << 20
LARGEST_TEXT_BYTES = 16 * MIB  # of a configuration, an EDS or DCF file, a list of speeds, a sidecar
LARGEST_TABLE_BYTES = 64 * MIB  # of a CSV table
LARGEST_SERIES_BYTES = 512 * MIB  # of one that is only read for an identification: some million lines
LARGEST_LOG_BYTES = 64 << 30  # of a run log, which is read piece by piece: a month at 1 kHz
DEEPEST = 64  # sections, tables and lists in each other
LONGEST_BITS = 1000  # of a whole number; beyond it is no float either
_TOO_DEEP, _TOO_LONG = "is nested too deeply", "has a number with too many digits"
_PIECE_BYTES = 1 << 20
_KINDS = (
    (stat.S_ISFIFO, "a FIFO"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)
# not blocking: it may have become a FIFO in the meantime; where there are texts and bytes, bytes
_FLAGS = sum(getattr(os, name, 0) for name in ("O_NONBLOCK", "O_NOCTTY", "O_BINARY"))
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def open_input(path: str | Path, largest_bytes: int) -> IO[bytes]:
    """A regular file, open for reading; nothing else is opened, since that alone can do something to a device."""
    try:
        _check(os.stat(path), path, largest_bytes)
        descriptor = os.open(path, os.O_RDONLY | _FLAGS)
    except ValueError:  # a zero or half a character in it
        raise OSError(errno.EINVAL, "is no name of a file", str(path)) from None
    try:
        _check(os.fstat(descriptor), path, largest_bytes)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def _check(found: os.stat_result, path: str | Path, largest_bytes: int) -> None:
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, "is a folder, not a file", str(path))
    if not stat.S_ISREG(found.st_mode):
        kind = next((words for is_it, words in _KINDS if is_it(found.st_mode)), "something else")
        raise OSError(errno.EINVAL, f"is {kind}, not a regular file", str(path))
    if found.st_size > largest_bytes:
        raise _too_large(f"{found.st_size} bytes", path, largest_bytes)


def _too_large(size: str, path: str | Path, largest_bytes: int) -> OSError:
    return OSError(errno.EFBIG, f"has {size}, at most {largest_bytes} are read", str(path))


def require_input(path: str | Path, largest_bytes: int = LARGEST_TEXT_BYTES) -> None:
    """For what a library will read by itself; `OSError` as of `read_input`."""
    open_input(path, largest_bytes).close()


def read_input(path: str | Path, largest_bytes: int = LARGEST_TEXT_BYTES) -> bytes:
    """The content of a regular file; `OSError` for anything else, and for one that turns out to be larger."""
    pieces, left = [], largest_bytes + 1
    with open_input(path, largest_bytes) as file:
        while left and (piece := file.read(min(left, _PIECE_BYTES))):
            pieces.append(piece)
            left -= len(piece)
    if not left:  # files of /proc have no size
        raise _too_large(f"more than {largest_bytes} bytes", path, largest_bytes)
    return b"".join(pieces)


def number_from(text: str) -> float:
    """A number as a CSV file has it; `ValueError` for all else that Python takes: 1_0, digits of other scripts, nan."""
    word = text.strip(" \t")
    if not _NUMBER.fullmatch(word):
        raise ValueError(f"{text!r} is not a number")
    return float(word)


def parse_toml(text: str) -> dict[str, Any]:
    """`tomllib.loads`; `TOMLDecodeError` also for what the parser, or code that shows a value, would stumble over."""
    try:
        found = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError:
        raise tomllib.TOMLDecodeError(_TOO_DEEP) from None
    except ValueError:  # of Python's int(): thousands of digits
        raise tomllib.TOMLDecodeError(_TOO_LONG) from None
    if (problem := _problem(found)) is not None:
        raise tomllib.TOMLDecodeError(problem)
    return found


def parse_json(text: str | bytes) -> Any:
    """`json.loads`; `ValueError` with the same limits."""
    try:
        found = json.loads(text)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    if (problem := _problem(found)) is not None:
        raise ValueError(problem)
    return found


def _problem(found: object) -> str | None:
    """What is wrong with a document that was read; without recursion."""
    level = [found]
    for _ in range(DEEPEST):
        below: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                below += value.values()
            elif isinstance(value, list):
                below += value
            elif isinstance(value, int) and value.bit_length() > LONGEST_BITS:
                return _TOO_LONG
        if not below:
            return None
        level = below
    return _TOO_DEEP
