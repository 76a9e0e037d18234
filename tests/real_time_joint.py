"""The virtual joints in real time in the process of a test, on time however busy the computer is.

A real drive answers in time whatever a computer is busy with.  So threads of the virtual ones come before ordinary
programs (SCHED_FIFO), where the system allows it: as in `jointctl hil`.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from jointctl.hil.elmo_line import ElmoDevice
from jointctl.tools.configuration.arm import ArmConfig
from jointctl.tools.configuration.config import Config
from jointctl.tools.virtual_joint import serve_virtual_elmo, serve_virtual_joint

BEFORE_A_LOOP, BELOW_A_LOOP = 60, 20  # priorities
COMPILED = ("device", "virtual bus")  # the threads that never hold the interpreter's lock for long


def schedule(thread: int, policy: int, priority: int) -> None:
    """Schedule a thread of this process, by its native id; nothing happens without the right, or if it has ended."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(thread, policy, os.sched_param(priority))


@contextmanager
def real_time_joint(config: Config | ArmConfig) -> Iterator[Any]:
    """Bus and CANopen drives of `config`; only their compiled threads come first."""
    with serve_virtual_joint(config) as joint:
        schedule_compiled()
        yield joint


def schedule_compiled() -> None:
    """The compiled threads of this process come first."""
    for thread in threading.enumerate():
        if thread.name != "device-sdo" and thread.name.startswith(COMPILED) and thread.native_id is not None:
            schedule(thread.native_id, os.SCHED_FIFO, BEFORE_A_LOOP)


@contextmanager
def real_time_serial_joint(config: Config) -> Iterator[ElmoDevice]:
    """The serial drive of `config`, a Python thread, which waits for the interpreter's lock.

    So all threads of this process come before ordinary programs, and below a loop; what they start does not.
    """

    def schedule_all(policy: int, priority: int) -> None:
        for thread in os.listdir("/proc/self/task"):
            schedule(int(thread), policy, priority)

    with serve_virtual_elmo(config) as device:
        schedule_all(os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, BELOW_A_LOOP)
        try:
            yield device
        finally:
            schedule_all(os.SCHED_OTHER, 0)
