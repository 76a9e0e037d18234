"""Keeps the cores out of their deep idle states while a loop runs: waking up from one takes up to 100 us or more.

The kernel's interface is /dev/cpu_dma_latency (Documentation/power/pm_qos_interface): as long as it is held open, no
core enters an idle state with a longer exit latency than was written.  cyclictest does the same.
"""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Iterator
from pathlib import Path

LATENCY_DEVICE = Path("/dev/cpu_dma_latency")
_NO_LATENCY = struct.pack("=i", 0)


@contextlib.contextmanager
def cores_awake(device: Path = LATENCY_DEVICE) -> Iterator[str]:
    """Inside the block no core sleeps deeply; gives the refusal in words, or an empty text."""
    try:
        fd = os.open(device, os.O_WRONLY | os.O_CLOEXEC)
    except OSError as error:
        yield f"{device}: {error.strerror or error}"
        return
    try:
        try:
            os.write(fd, _NO_LATENCY)
            refused = ""
        except OSError as error:
            refused = f"{device}: {error.strerror or error}"
        yield refused
    finally:
        os.close(fd)
