"""The guard of a serial line, and `jointctl stop` from a second terminal: real processes, some of them killed or hung.

The virtual drive is a thread of this process, as in test_elmo_run.py.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from typing import Any

import pytest

from jointctl.tools.session.elmo_guard import guard_address, running_supervisor
from tests.hil.moving_run import gone
from tests.hil.serial_bench import GUARD, LOOP, guard_order
from tests.python_process import eventually


def tracking(serial_bench: Any, **changes: Any) -> Any:
    run = serial_bench.bench.start("run", serial_bench.config(**changes), "-y").saw("  tracking")
    assert serial_bench.device.interpreter.m.motor_on
    return run


def test_its_twin_without_a_guard_keeps_its_torque(serial_bench: Any) -> None:
    run = tracking(serial_bench)
    loop = run.child(LOOP)
    os.kill(run.child(GUARD), signal.SIGKILL)
    run.saw("the guard of the line has ended")
    os.kill(loop, signal.SIGSTOP)
    run.signal(signal.SIGKILL)
    os.kill(loop, signal.SIGKILL)
    run.process.wait()
    time.sleep(0.5)
    assert serial_bench.device.interpreter.m.motor_on  # what the guard is there for
    assert serial_bench.bench.run("stop", "serial.toml").code == 0
    eventually(serial_bench.standing, 20.0)


@pytest.mark.stays("serial guard: loop and supervisor")
@pytest.mark.stays("serial guard: a drive that was not reached at the end of a run")
def test_a_run_that_ends_well_leaves_no_guard_behind(serial_bench: Any) -> None:
    run = tracking(serial_bench, trajectory__duration_s=1.0)
    guard = run.child(GUARD)
    assert run.finished().code == 0
    assert gone(guard)
    assert "line guard" not in run.err
    assert serial_bench.device.last_command == b"MF"  # the supervisor's last question


@pytest.mark.trips("serial guard: a drive that was not reached at the end of a run")
def test_a_port_that_comes_back_is_told_to_switch_off(serial_bench: Any) -> None:
    link = serial_bench.bench.folder / "ttyUSB0"
    link.symlink_to(serial_bench.device.path)
    run = tracking(serial_bench, drive__port=str(link))
    serial_bench.device.vanish()
    run.finished().refused(7, "BUS_ERROR")
    assert serial_bench.device.interpreter.m.motor_on
    serial_bench.device.plug_in()
    link.unlink()
    link.symlink_to(serial_bench.device.path)
    eventually(serial_bench.standing, 20.0)


def test_stop_ends_a_run_that_has_the_port(serial_bench: Any) -> None:
    run = tracking(serial_bench)
    stopped = serial_bench.bench.run("stop", "serial.toml")
    assert (stopped.code, "the drive is off" in stopped.out) == (0, True), stopped
    assert f"pid {run.process.pid}" in stopped.err
    assert serial_bench.standing()
    ended = run.finished(20.0)
    assert ended.code == 130
    assert "stopped by jointctl stop" in ended.err


def test_stop_while_the_user_is_asked(serial_bench: Any) -> None:
    leader, follower = os.openpty()
    run = serial_bench.bench.start("run", serial_bench.config(), stdin=follower).saw("Move the joint?")
    eventually(lambda: running_supervisor(serial_bench.device.path) == run.process.pid, 20.0)
    assert serial_bench.bench.run("stop", "serial.toml").code == 0
    assert run.finished(20.0).code == 130
    assert serial_bench.standing()
    os.close(leader)
    os.close(follower)


@pytest.mark.parametrize("hung", [LOOP, "supervisor", "both"])
def test_stop_of_a_run_that_hangs(serial_bench: Any, hung: str) -> None:
    run = tracking(serial_bench)
    loop = run.child(LOOP)
    if hung != LOOP:
        run.signal(signal.SIGSTOP)
    if hung != "supervisor":
        os.kill(loop, signal.SIGSTOP)
    stopped = serial_bench.bench.run("stop", "serial.toml")
    assert (stopped.code, "the drive is off" in stopped.out) == (0, True), stopped
    assert serial_bench.standing()
    run.process.wait(20.0)
    eventually(lambda: gone(loop), 20.0)


def test_stop_without_an_answer_of_the_guard(serial_bench: Any) -> None:
    run = tracking(serial_bench)
    guard, loop = run.child(GUARD), run.child(LOOP)
    for pid in (guard, loop, run.process.pid):
        os.kill(pid, signal.SIGSTOP)
    stopped = serial_bench.bench.run("stop", "serial.toml")
    assert (stopped.code, "the drive is off" in stopped.out) == (0, True), stopped
    assert "telling the drive on the same line" in stopped.err
    assert serial_bench.standing()
    assert "ending process" in stopped.err
    for pid in (run.process.pid, loop, guard):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def test_another_program_on_the_port_is_named_and_left_alone(serial_bench: Any) -> None:
    serial_bench.config()
    serial_bench.device.interpreter.execute(b"MO=1")
    program = (
        "import serial, sys, time; p = serial.Serial(sys.argv[1], exclusive=True); print(flush=True); time.sleep(60)"
    )
    other = subprocess.Popen([sys.executable, "-c", program, serial_bench.device.path], stdout=subprocess.PIPE)
    try:
        other.stdout.readline()
        stopped = serial_bench.bench.run("stop", "serial.toml")
        assert (stopped.code, "the drive is off" in stopped.out) == (0, True), stopped
        assert f"pid {other.pid}" in stopped.err
        assert other.poll() is None
        serial_bench.bench.run("clear-fault", "serial.toml").refused(4, "in use by another program", str(other.pid))
    finally:
        other.kill()
        other.communicate()


def test_stop_of_a_resting_joint_is_harmless(serial_bench: Any) -> None:
    config = serial_bench.config(trajectory__duration_s=0.5)
    assert serial_bench.bench.run("stop", config).code == 0
    assert serial_bench.bench.run("run", config, "-y").code == 0  # the twin: it can be run as before


def test_clear_fault_is_refused_while_a_run_is_active(serial_bench: Any) -> None:
    run = tracking(serial_bench)
    pid = run.process.pid
    serial_bench.bench.run("clear-fault", "serial.toml").refused(4, "a run is active on")
    assert f"pid {pid}" in serial_bench.bench.run("clear-fault", "serial.toml").err
    assert serial_bench.device.interpreter.m.motor_on  # the run goes on
    run.signal(signal.SIGINT)
    assert run.finished().code == 130
    assert serial_bench.bench.run("clear-fault", "serial.toml").out == "no fault\n"


def test_a_dry_run_that_is_over_before_its_guard_is_up_says_nothing_of_it(serial_bench: Any) -> None:
    ours, theirs = socket.socketpair()
    ours.sendall(b'{"state": "off"}\n')
    ours.close()
    alive = os.pidfd_open(os.getpid())
    with theirs, tempfile.TemporaryFile() as block:
        block.truncate(8 * 8)
        order = guard_order(serial_bench.device.path, theirs.fileno(), block.fileno(), alive)
        guard = subprocess.run(
            [sys.executable, "-P", "-m", GUARD, order.argument()],
            pass_fds=(theirs.fileno(), block.fileno(), alive), capture_output=True, timeout=60.0,
        )  # fmt: skip
    os.close(alive)
    assert (guard.returncode, guard.stderr) == (0, b"")


def test_whoever_says_nothing_or_nonsense_does_not_hold_up_the_guard(serial_bench: Any) -> None:
    run = tracking(serial_bench)
    address = guard_address(serial_bench.device.path)
    callers = []
    for said in (b"", b"nonsense\n", b"[1]\n", json.dumps({"ask": "dance"}).encode() + b"\n"):
        caller = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        caller.connect(address)
        caller.sendall(said)
        callers.append(caller)
    assert running_supervisor(serial_bench.device.path) == run.process.pid
    for caller in callers:
        caller.close()
    assert serial_bench.device.interpreter.m.motor_on
    assert serial_bench.bench.run("stop", "serial.toml").code == 0
    assert run.finished().code == 130
