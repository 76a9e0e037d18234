"""How long a serial drive keeps its torque after a program or the port has gone: the times in docs/safety.md.

Real processes, killed or stopped while the joint is tracking; the virtual drive is a thread of this process and is
looked at every millisecond.  The bounds are those of the document; on a quiet computer it takes far less.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import time
from collections.abc import Callable
from typing import Any

import pytest

LOOP = "jointctl.tools.session.loop_process"
POLL_S = 0.001


def waited_s(condition: Callable[[], bool], timeout_s: float = 30.0) -> float:
    """Time until the condition holds."""
    begin_s = time.monotonic()
    while not condition():
        assert time.monotonic() - begin_s < timeout_s
        time.sleep(POLL_S)
    return time.monotonic() - begin_s


def pushing(serial_bench: Any, **changes: Any) -> Any:
    """A run whose drive applies torque against friction now."""
    run = serial_bench.bench.start("run", serial_bench.config(**changes), "-y").saw("  tracking")
    serial_bench.until(lambda: abs(serial_bench.device.interpreter.m.torque_A) > 0.5)
    return run


# what becomes of loop and supervisor, and the time until the motor is off: as docs/safety.md has them
CASES = {
    "loop killed": ((signal.SIGKILL, None), 1.0),
    "both killed": ((signal.SIGKILL, signal.SIGKILL), 1.0),
    "supervisor killed": ((None, signal.SIGKILL), 4.5),
    "loop stopped": ((signal.SIGSTOP, None), 4.0),
    "supervisor stopped": ((None, signal.SIGSTOP), 4.5),
    "both stopped": ((signal.SIGSTOP, signal.SIGSTOP), 5.0),
}


@pytest.mark.parametrize("case", CASES)
def test_torque_ends_in_time_whoever_is_killed_or_stopped(serial_bench: Any, case: str) -> None:
    (loop_signal, supervisor_signal), at_most_s = CASES[case]
    run = pushing(serial_bench)
    loop = run.child(LOOP)
    motor = serial_bench.device.interpreter.m
    if supervisor_signal is not None and loop_signal is not None:
        os.kill(loop, signal.SIGSTOP)  # it shall not see the supervisor's end
    for pid, number in ((run.process.pid, supervisor_signal), (loop, loop_signal)):
        if number is not None:
            os.kill(pid, number)
    assert motor.motor_on
    taken_s = waited_s(lambda: not motor.motor_on)
    print(f"{case}: {taken_s:.3f} s")
    assert taken_s < at_most_s
    assert motor.torque_A == 0.0
    serial_bench.until(serial_bench.standing)
    for pid in (run.process.pid, loop):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)


def test_a_port_that_vanishes_is_told_at_once_and_a_port_that_comes_back_is_used_at_once(serial_bench: Any) -> None:
    link = serial_bench.bench.folder / "ttyUSB0"
    link.symlink_to(serial_bench.device.path)
    run = pushing(serial_bench, drive__port=str(link))
    device = serial_bench.device.interpreter
    motor = device.m
    # the torque that stays applied shall not reach the drive's own limits: friction has to hold it
    device.state[0].added_load_torque_Nm = math.copysign(10.0, motor.torque_A)
    link.unlink()
    begin_s = time.monotonic()
    serial_bench.device.vanish()
    run.saw("did not confirm that it is off")
    told_s = time.monotonic() - begin_s
    torque_A = motor.torque_A
    time.sleep(1.0)
    assert motor.motor_on  # nobody can tell it anything
    assert motor.torque_A == torque_A != 0.0
    serial_bench.device.plug_in()
    link.symlink_to(serial_bench.device.path)
    off_s = waited_s(lambda: not motor.motor_on)
    run.finished().refused(7, "BUS_ERROR", "the serial port is gone", "use the emergency stop")
    print(f"told {told_s:.3f} off after plug-in {off_s:.3f}")
    assert told_s < 1.0
    assert off_s < 2.0
