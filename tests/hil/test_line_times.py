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

from tests.hil.moving_run import gone
from tests.hil.serial_bench import GUARD, LOOP
from tests.python_process import eventually

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
    eventually(lambda: abs(serial_bench.device.interpreter.m.torque_A) > 0.5, 20.0)
    return run


@pytest.mark.trips("serial loop: its own end, however it comes about", "supervisor killed")
@pytest.mark.trips("serial supervisor: the loop process", "loop killed")
@pytest.mark.trips("serial guard: loop and supervisor", "both killed")
@pytest.mark.parametrize(
    ("loop_signal", "supervisor_signal", "at_most_s", "words"),  # the time until the motor is off: docs/safety.md
    [
        pytest.param(signal.SIGKILL, None, 1.0, ("killed by signal 9", "drive state now: off"), id="loop killed"),
        pytest.param(signal.SIGKILL, signal.SIGKILL, 1.0, (), id="both killed"),
        pytest.param(None, signal.SIGKILL, 4.5, (), id="supervisor killed"),
        pytest.param(signal.SIGSTOP, None, 4.0, (), id="loop stopped"),
        pytest.param(None, signal.SIGSTOP, 4.5, (), id="supervisor stopped"),
        pytest.param(signal.SIGSTOP, signal.SIGSTOP, 5.0, (), id="both stopped"),
    ],
)
def test_torque_ends_in_time_whoever_is_killed_or_stopped(
    serial_bench: Any, loop_signal: int | None, supervisor_signal: int | None, at_most_s: float, words: tuple[str, ...]
) -> None:
    run = pushing(serial_bench)
    loop, guard = run.child(LOOP), run.child(GUARD)
    motor = serial_bench.device.interpreter.m
    if supervisor_signal is not None and loop_signal is not None:
        os.kill(loop, signal.SIGSTOP)  # it shall not see the supervisor's end
    for pid, number in ((run.process.pid, supervisor_signal), (loop, loop_signal)):
        if number is not None:
            os.kill(pid, number)
    assert motor.motor_on
    taken_s = waited_s(lambda: not motor.motor_on)
    print(f"{taken_s:.3f} s")
    assert taken_s < at_most_s
    assert motor.torque_A == 0.0
    eventually(serial_bench.standing, 20.0)
    for pid in (run.process.pid, loop):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)
    if supervisor_signal != signal.SIGKILL:
        done = run.finished()
        done.refused(7, *words)
        assert "heartbeat" not in done.err.split("error: ")[1]
    elif loop_signal == signal.SIGKILL:
        run.process.wait()
        assert gone(guard)
        assert "line guard: the drive on" in run.err
    assert not motor.motor_on
    eventually(serial_bench.standing, 20.0)  # friction's bristles swing it back for a moment


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
