"""The serial port of a CAN adapter (slcan), which serves one program at a time: who comes second is told who has it."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator

from jointctl.drivers.can.channel import split_channel
from jointctl.drivers.errors import BusError
from jointctl.drivers.port_users import users_text


def port_path(channel: str) -> str:
    """The device file of `/dev/ttyACM0@115200`, as python-can writes port and baud rate."""
    return split_channel(channel)[0].partition("@")[0]


@contextlib.contextmanager
def reserved(channel: str, *, exclusive: bool) -> Iterator[None]:
    """`OSError` if the port cannot be opened, `BusError` if `exclusive` and a program of ours has it.

    Opening it would close the CAN channel under that program's feet.  The port stays open meanwhile, so that its
    control lines, which restart some adapters, do not move in between.
    """
    if "://" in channel:  # pyserial's URLs: no device file
        yield
        return
    path = port_path(channel)
    descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        if exclusive:
            lock(descriptor, path)
        yield
    finally:
        os.close(descriptor)


def lock(descriptor: int, path: str) -> None:
    """Keep others off as long as the descriptor is open; `BusError` names the program that has the port."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        users = users_text(path)
        raise BusError(
            f"the adapter on {path} is in use by another program{f' ({users})' if users else ''}",
            "it serves one at a time: end that program; `jointctl stop` switches the drive off all the same",
        ) from None
