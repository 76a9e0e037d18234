"""The virtual drive with objects, maps and answers that it does not have of itself."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from jointctl.drivers.canopen.drive import CanopenDrive
from jointctl.drivers.canopen.settings import CanopenSettings

NO_ACCESS, READ_ONLY, OUT_OF_RANGE, DEVICE_STATE = 0x06010000, 0x06010002, 0x06090030, 0x08000022


@contextmanager
def opened(bus: Any, settings: CanopenSettings) -> Iterator[CanopenDrive]:
    drive = bus.drive(settings)
    try:
        yield drive
    finally:
        drive.close()


def value(bus: Any, index: int, sub: int = 0) -> int:
    return int(bus.device.objects.value(index, sub))


def store(bus: Any, index: int, sub: int, number: int) -> None:
    """A default of the drive that is not the virtual one's."""
    bus.device.objects.store(index, sub, struct.pack("<q", number)[: bus.device.objects.entry(index, sub).size])
