"""A virtual serial drive in the process of a test, and configurations with its port."""

from __future__ import annotations

import contextlib
import json
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jointctl.hil.elmo_line import ElmoDevice
from jointctl.tools.session.elmo_guard import GuardOrder
from tests.configurations import written

GUARD, LOOP = "jointctl.tools.session.elmo_guard", "jointctl.tools.session.loop_process"
# a busy computer may stop this process, and with it the virtual drive, for tens of milliseconds
# and 100 Hz leaves room for what it adds to the measured delay
PATIENT: dict[str, Any] = {
    "loop__rate_Hz": 100.0, "control__kp": 64.0, "control__kv": 16.0, "control__lyapunov_q": 20.0,
    "control__velocity_cutoff_Hz": 40.0, "limits__sample_age_max_s": 0.5, "limits__skipped_max_s": 0.5,
    "limits__following_error_max_rad": 0.3, "drive__dead_man_s": 0.3, "log__folder": "runs", "log__picture": False,
}  # fmt: skip


class SerialBench:
    """A configuration with the port of a running virtual drive in it; the drive is a thread of this process."""

    def __init__(self, bench: Any) -> None:
        self.bench = bench
        self.device: ElmoDevice

    def config(self, name: str = "serial.toml", **changes: Any) -> str:
        values = {**PATIENT, "trajectory__duration_s": 20.0, "drive__port": self.device.path, **changes}
        return serial_config(self.bench.folder, name, values)

    def standing(self) -> bool:
        """Motor off and the joint at rest."""
        device = self.device.interpreter
        return not device.m.motor_on and abs(float(device.state[0].joint_velocity_radps)) < 1e-3


def serial_config(folder: Path, name: str, values: dict[str, Any]) -> str:
    return written(folder / name, "elmo_serial", **values).name


def stick_position(device: ElmoDevice) -> None:
    """PX does not change any more; everything else is answered as before."""
    execute, stuck = device.interpreter.execute, device.interpreter.execute(b"PX")
    device.interpreter.execute = (  # type: ignore[method-assign]
        lambda line: stuck if line == b"PX" else execute(line)
    )


def guard_order(port: str, control_fd: int, block_fd: int, alive_fd: int, **changes: Any) -> GuardOrder:
    """Of a guard for a supervisor and a loop that are both this process; `block_fd` is of 8 words."""
    return GuardOrder(
        port=port, baud_rate_bitps=115_200, reply_timeout_s=0.2, silent_s=3.0, control_fd=control_fd,
        block_fd=block_fd, supervisor_pidfd=alive_fd, loop_pidfd=alive_fd, supervisor_pid=os.getpid(), go_word=0,
        stop_word=1, loop_word=2, ended_word=3, held_up_word=4, words=8, stop_value=3, **changes,
    )  # fmt: skip


@contextmanager
def name_kept(port: str) -> Iterator[None]:
    """No other pseudo-terminal gets this name meanwhile, also when the port has vanished."""
    descriptor = os.open(port, os.O_RDWR | os.O_NOCTTY)
    try:
        yield
    finally:
        os.close(descriptor)


def end_line_guards(port: str) -> None:
    """A guard tries for a minute to reach a drive on a port that vanished; another test's line may get its name."""
    for process in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError, ValueError):
            arguments = process.read_text().split("\0")
            if GUARD in arguments:
                guarded = json.loads(next(text for text in arguments if text.startswith("{")))["port"]
                if os.path.realpath(guarded) == os.path.realpath(port):  # it may be a link to it
                    os.kill(int(process.parent.name), signal.SIGKILL)
