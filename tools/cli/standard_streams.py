"""Standard input, output and error are there, whatever the caller closed.

Behind a closed one the next file or socket that is opened gets its number, and what is printed, by a child as well,
lands in it: in a CAN socket or a log.
"""

from __future__ import annotations

import io
import os
import sys


def never_refuse_a_character() -> None:
    """What the encoding of a terminal lacks (`LANG=C`) is escaped instead of ending the program."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def occupy_standard_streams() -> None:
    """Put the null device in the place of each that is closed, for this process and its children."""
    while (fd := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(fd, True)
    os.close(fd)
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w", encoding="utf-8"))  # noqa: SIM115
