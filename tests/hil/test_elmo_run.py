"""`jointctl` on a serial drive, end to end: the virtual drive on a pseudo-terminal, the run as processes of its own.

The virtual drive is a thread of this process, so that a test can break its line or look at its motor.
"""

from __future__ import annotations

import functools
import os
import signal
import time
from collections.abc import Callable
from typing import Any

import pytest

from jointctl.firmware_py.states import AxisPhase
from jointctl.hil.elmo_line import ElmoDevice
from tests.hil.serial_bench import stick_position
from tests.python_process import eventually


@pytest.mark.stays("serial loop: its own end, however it comes about")
def test_a_run_tracks_the_sine_and_ends_with_the_motor_off(serial_bench: Any) -> None:
    config = serial_bench.config(trajectory__duration_s=3.0)
    finished = serial_bench.bench.run("run", config, "-y")
    assert finished.code == 0, finished.err
    assert serial_bench.standing()
    log = serial_bench.bench.log().records
    tracking = log[log["phase"] == AxisPhase.TRACKING]
    assert len(tracking) > 200
    # 3 mrad on a quiet computer; the line loses a few samples on a busy one
    assert abs(tracking["error_rad"]).max() < 0.05
    assert abs(tracking["measured_torque_Nm"]).max() > 10.0
    assert "loop delay" in finished.err


def test_gains_that_the_line_cannot_carry_are_refused_before_anything_moves(serial_bench: Any) -> None:
    config = serial_bench.config(control__kp=784.0, control__kv=56.0, control__lyapunov_q=1800.0)
    finished = serial_bench.bench.run("run", config, "-y")
    finished.refused(9, "a slower loop: control.kp", "loop delay")
    assert serial_bench.standing()
    assert "approach\n" not in finished.err


def test_a_wrong_baud_rate_is_no_device_and_says_so(serial_bench: Any) -> None:
    config = serial_bench.config(drive__baud_rate_bitps=230_400)
    serial_bench.bench.run("run", config, "-y").refused(5, "baud rate")


def test_a_drive_that_restarts_while_the_question_is_open_is_not_started(serial_bench: Any) -> None:
    leader, follower = os.openpty()
    run = serial_bench.bench.start("run", serial_bench.config(), stdin=follower).saw("Move the joint?")
    serial_bench.device.restart_drive()
    os.write(leader, b"y\n")
    finished = run.finished()
    finished.refused(6, "the drive has changed since it was commissioned: UM is 5, 1 was set", "start the run again")
    assert not serial_bench.device.interpreter.m.motor_on
    os.close(leader)
    os.close(follower)


def test_a_missing_port_is_a_bus_error(serial_bench: Any) -> None:
    config = serial_bench.config(drive__port=str(serial_bench.bench.folder / "none"))
    serial_bench.bench.run("run", config, "-y").refused(4, "no such serial port")


def test_a_second_controller_is_kept_out(serial_bench: Any) -> None:
    first = serial_bench.bench.start("run", serial_bench.config(), "-y").saw("  tracking")
    serial_bench.bench.run("run", serial_bench.config(), "-y").refused(
        4, "another program controls", f"pid {first.process.pid}"
    )
    first.signal(signal.SIGINT)
    assert first.finished().code == 130
    assert serial_bench.standing()


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda device: device.restart_drive(), ("DRIVE_RESTARTED", "restarted while the loop was running")),
        (lambda device: device.interpreter.execute(b"MO=0"), ("DRIVE_NOT_ENABLED", "switched off without being asked")),
        (lambda device: setattr(device.faults, "garbage_every", 1), ("STALE_SAMPLE", "noise garbles the replies")),
        (lambda device: setattr(device.faults, "half_every", 1), ("STALE_SAMPLE", "no usable position reply")),
        (lambda device: setattr(device.faults, "mute", True), ("STALE_SAMPLE", "went silent", "did not confirm")),
        (lambda device: setattr(device.faults, "stuck_reply", b"8344;"), ("error: ", "did not confirm that it is off")),
        (lambda device: stick_position(device), ("POSITION_FROZEN",)),
    ],
    ids=["restart", "switched off", "garbage", "half replies", "silent", "stuck reply", "stuck position"],
)
def test_faults_of_drive_and_line_end_with_the_joint_stopped(
    serial_bench: Any, spoil: Callable[[ElmoDevice], None], words: tuple[str, ...]
) -> None:
    run = serial_bench.bench.start("run", serial_bench.config(limits__sample_age_max_s=0.5), "-y").saw("  tracking")
    spoil(serial_bench.device)
    finished = run.finished()
    finished.refused(7, *words)
    eventually(serial_bench.standing, 20.0)


def test_an_unplugged_port_ends_the_run_and_the_drives_own_limits_end_the_motion(serial_bench: Any) -> None:
    run = serial_bench.bench.start("run", serial_bench.config(), "-y").saw("  tracking")
    serial_bench.device.vanish()
    run.finished().refused(7, "BUS_ERROR", "the serial port is gone")
    # the last torque stays applied: a push that friction does not hold ends at the drive's own limits
    device = serial_bench.device.interpreter
    device.state[0].added_load_torque_Nm = -60.0
    eventually(lambda: not device.m.motor_on, 20.0)
    assert device.m.motor_fault in (0x20000, 0x400000)


def test_a_drive_that_comes_back_with_another_baud_rate(serial_bench: Any) -> None:
    run = serial_bench.bench.start("run", serial_bench.config(), "-y").saw("  tracking")
    serial_bench.device.baud_rate_bitps = 57_600
    finished = run.finished()
    finished.refused(7, "STALE_SAMPLE", "garbles the replies")
    assert "did not confirm that it is off" in finished.err
    # it has not understood a word: its own limits have stopped it by now, or the guard that goes on trying does
    serial_bench.device.baud_rate_bitps = 115_200
    eventually(serial_bench.standing, 20.0)


def test_their_twins_just_inside_the_limits_do_not_end_a_run(serial_bench: Any) -> None:
    """Every fault of the line for less than `limits.sample_age_max_s`, one after the other, and the run goes on.

    Stuck is the position alone: a status that sticks says sooner or later that the motor is off.
    """
    device, faults = serial_bench.device, serial_bench.device.faults
    limits = {"limits__sample_age_max_s": 1.0, "limits__position_jump_max_rad": 0.2}
    run = serial_bench.bench.start("run", serial_bench.config(**limits), "-y").saw("  tracking")

    def for_a_while(change: Callable[[], None], back: Callable[[], None], time_s: float = 0.3) -> None:
        change()
        time.sleep(time_s)
        back()
        time.sleep(0.6)
        assert run.process.poll() is None
        assert device.interpreter.m.motor_on

    def set_rate(baud_rate_bitps: int) -> None:
        device.baud_rate_bitps = baud_rate_bitps

    for name, bad, good in (("garbage_every", 1, 0), ("half_every", 1, 0), ("mute", True, False)):
        for_a_while(functools.partial(setattr, faults, name, bad), functools.partial(setattr, faults, name, good))
    for_a_while(lambda: stick_position(device), lambda: delattr(device.interpreter, "execute"), 0.1)
    for_a_while(lambda: set_rate(57_600), lambda: set_rate(115_200))
    faults.garbage_every, faults.half_every = 17, 23  # and now and then for the rest of it
    time.sleep(2.0)
    assert device.interpreter.m.motor_on
    run.signal(signal.SIGINT)
    finished = run.finished()
    assert finished.code == 130, finished.err
    assert "error:" not in finished.err
    assert serial_bench.standing()
