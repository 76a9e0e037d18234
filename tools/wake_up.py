"""How late this computer wakes up, and what makes it wake up in time: no deep idle states, real-time priority.

Waking up from a deep idle state takes up to 100 us or more.  The kernel's interface against them is
/dev/cpu_dma_latency (Documentation/power/pm_qos_interface): as long as it is held open, no core enters an idle state
with a longer exit latency than was written.  cyclictest does the same.

Measured is a compiled sleep loop that does nothing else, with the same absolute deadlines and the same sleep as the
control loop, so that the figures are a lower bound of what the loop will see.  Not measured: the latency of the CAN
adapter, and page faults of a process that is not locked in memory.
"""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.libc import monotonic_ns, sleep_until_ns

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


@kernel
def sleep_cycles(period_ns: int, late_ns: np.ndarray, timespec: np.ndarray) -> None:
    """Sleep to the end of len(late_ns) periods; `late_ns` int64[N] gets each wake-up minus its deadline [ns].

    `timespec` int64[2] is scratch.  After an overrun slots are skipped and the phase is kept, as the loop does.
    """
    deadline_ns = monotonic_ns(timespec) + period_ns
    for i in range(len(late_ns)):
        sleep_until_ns(deadline_ns, timespec)
        late = monotonic_ns(timespec) - deadline_ns
        late_ns[i] = late
        if late >= period_ns:
            deadline_ns += late // period_ns * period_ns
        deadline_ns += period_ns


def wake_up_lateness_ns(rate_Hz: float, cycles: int) -> np.ndarray[Any, Any]:
    """Lateness [ns] of `cycles` wake-ups at `rate_Hz`, shape (cycles,), under the scheduling of the calling thread."""
    if cycles < 1:
        raise ValueError(f"cycles (={cycles}) must be at least 1")
    if not rate_Hz > 0.0:
        raise ValueError(f"rate_Hz (={rate_Hz:g}) must be above 0")
    late_ns = np.zeros(cycles, np.int64)
    timespec = np.zeros(2, np.int64)
    sleep_cycles(1_000, late_ns[:1], timespec)  # compiles, or loads from the cache
    sleep_cycles(round(1e9 / rate_Hz), late_ns, timespec)
    return late_ns


@contextlib.contextmanager
def fifo(priority: int) -> Iterator[str]:
    """SCHED_FIFO for the calling thread inside the block; gives the refusal in words, or an empty text."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        yield str(error.strerror or error)
        return
    try:
        yield ""
    finally:
        os.sched_setscheduler(0, *before)
