"""`jointctl sweep` on a serial drive in speed mode (UM=2): what it measures, and how a jog ends that nobody attends to.

Real processes; the virtual drive is a thread of this process, as in test_elmo_run.py.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.friction import friction_curve_Nm
from jointctl.hil.elmo_drive import MF_POSITION_LIMIT
from jointctl.hil.elmo_line import ElmoDevice
from jointctl.tools.configuration.conversions import friction_constants
from jointctl.tools.configuration.load import load_config
from tests.hil.serial_bench import GUARD, LOOP, stick_position
from tests.python_process import eventually

SHORT = ("--points", "2", "--grid", "log", "--max-speed", "0.3", "--min-speed", "0.29", "--warm-up", "0", "-y")


def jogging(serial_bench: Any) -> Any:
    """A sweep whose drive jogs at a speed that takes it out of its range if nobody ends it."""
    run = serial_bench.bench.start("sweep", serial_bench.config(), "-o", "data.csv", *SHORT)
    run.saw("  tracking")
    eventually(lambda: abs(serial_bench.device.interpreter.speed_cps()) > 15_000, 20.0)
    return run


def test_the_curve_is_that_of_the_joint_and_the_drive_ends_off(serial_bench: Any) -> None:
    name = serial_bench.config()
    finished = serial_bench.bench.run("sweep", name, "-o", "data.csv", *SHORT)
    assert finished.code == 0, finished.err
    assert "speed (UM=2)" in finished.err
    assert serial_bench.standing()
    device = serial_bench.device.interpreter
    assert (device.m.unit_mode, device.jog_cps) == (2, 0.0)
    sidecar = json.loads((serial_bench.bench.folder / "data.json").read_text())
    assert sidecar["drive"]["mode"] == "speed (UM=2)"
    found = np.genfromtxt(serial_bench.bench.folder / "data.csv", delimiter=",", names=True)
    config = load_config(serial_bench.bench.folder / name)
    assert config.friction is not None
    wanted = 1.1 * friction_curve_Nm(friction_constants(config.friction, 121.0), found["velocity_radps"])
    # a busy computer loses samples here: the exact comparison is that of the lockstep sweeps
    assert np.abs(found["motor_torque_Nm"]) == pytest.approx(np.abs(wanted), rel=0.05)


def test_ctrl_c_ramps_down(serial_bench: Any) -> None:
    run = jogging(serial_bench)
    run.signal(signal.SIGINT)
    assert run.finished().code == 130
    assert "  ramping" in run.err
    assert serial_bench.standing()


def test_loop_and_supervisor_killed_the_guard_ends_the_jog(serial_bench: Any) -> None:
    run = jogging(serial_bench)
    loop = run.child(LOOP)
    os.kill(loop, signal.SIGSTOP)  # it shall not see the supervisor's end
    run.signal(signal.SIGKILL)
    os.kill(loop, signal.SIGKILL)
    began_s = time.monotonic()
    eventually(lambda: not serial_bench.device.interpreter.m.motor_on, 20.0)
    assert time.monotonic() - began_s < 1.0
    eventually(serial_bench.standing, 20.0)
    device = serial_bench.device.interpreter
    assert (device.m.motor_fault, device.jog_cps) == (0, 0.0)


def test_its_twin_without_a_guard_jogs_on_to_the_drives_own_position_limit(serial_bench: Any) -> None:
    run = jogging(serial_bench)
    loop = run.child(LOOP)
    os.kill(run.child(GUARD), signal.SIGKILL)
    run.saw("the guard of the line has ended")
    device = serial_bench.device.interpreter
    eventually(lambda: abs(device.m.jog_cps) > 15_000, 20.0)
    os.kill(loop, signal.SIGSTOP)
    run.signal(signal.SIGKILL)
    os.kill(loop, signal.SIGKILL)
    time.sleep(0.5)
    assert device.m.motor_on
    assert abs(device.speed_cps()) > 10_000
    eventually(serial_bench.standing, 20.0)
    assert device.m.motor_fault == MF_POSITION_LIMIT


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda device: device.restart_drive(), "DRIVE_RESTARTED"),
        (lambda device: setattr(device.faults, "mute", True), "STALE_SAMPLE"),
        (stick_position, "POSITION_FROZEN"),
        (lambda device: setattr(device.interpreter.m, "speed_error_cps", 0.0), "speed tracking error (ER[2])"),
    ],
    ids=["restart", "silent", "stuck position", "speed error"],
)
def test_faults_end_with_the_joint_stopped(serial_bench: Any, spoil: Callable[[ElmoDevice], None], words: str) -> None:
    run = jogging(serial_bench)
    spoil(serial_bench.device)
    run.finished().refused(7, words)
    eventually(serial_bench.standing, 20.0)
    assert serial_bench.device.interpreter.m.motor_fault != MF_POSITION_LIMIT


def test_an_unplugged_port_is_told_and_the_drives_own_position_limit_ends_the_jog(serial_bench: Any) -> None:
    run = jogging(serial_bench)
    serial_bench.device.vanish()
    run.saw("the serial port is gone")
    device = serial_bench.device.interpreter
    assert device.m.motor_on  # told while it still moves
    run.finished().refused(7, "BUS_ERROR")
    eventually(serial_bench.standing, 20.0)
    assert device.m.motor_fault == MF_POSITION_LIMIT


def test_an_unplugged_port_keeps_the_measured_rows(serial_bench: Any) -> None:
    points = ("--points", "4", "--grid", "log", "--max-speed", "0.3", "--min-speed", "0.27", "--warm-up", "0", "-y")
    data = serial_bench.bench.folder / "data.csv"
    run = serial_bench.bench.start("sweep", serial_bench.config(), "-o", data.name, *points).saw("  tracking")
    eventually(lambda: data.read_text().count("\n") > 1, 60.0)
    serial_bench.device.vanish()
    ended = run.finished()
    kept = data.read_text().splitlines()
    rows = "1 point is" if len(kept) == 2 else f"{len(kept) - 1} points are"
    ended.refused(7, "BUS_ERROR", f"{rows} in data.csv", "then --resume")
    assert 2 <= len(kept) <= 4
    assert len(json.loads(data.with_suffix(".json").read_text())["measured"]) == len(kept) - 1
