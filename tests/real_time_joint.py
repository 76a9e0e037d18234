"""The virtual joint in real time in the process of a test, on time however busy the computer is."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from tools.configuration.config import Config
from tools.simulation.virtual_joint import serve_virtual_joint

PRIORITY = 60
COMPILED = ("device", "virtual bus")  # the threads that never hold the interpreter's lock for long


@contextmanager
def real_time_joint(config: Config) -> Iterator[None]:
    """Bus and drive of `config`; their compiled threads get SCHED_FIFO where they may, as in `jointctl hil`."""
    before = set(threading.enumerate())
    with serve_virtual_joint(config):
        for thread in set(threading.enumerate()) - before:
            if thread.name != "device-sdo" and thread.name.startswith(COMPILED) and thread.native_id is not None:
                with contextlib.suppress(OSError):
                    os.sched_setscheduler(thread.native_id, os.SCHED_FIFO, os.sched_param(PRIORITY))
        yield
