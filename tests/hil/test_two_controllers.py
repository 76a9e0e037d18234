"""Two programs that want the same joint: the second is told who has it, and the first goes on undisturbed."""

from __future__ import annotations

import os
import signal
import struct
import time
from pathlib import Path
from typing import Any

import can
import pytest

from jointctl.drivers import stop_note
from jointctl.drivers.bus_lock import lock_name
from jointctl.drivers.canopen.cia import SYNC_ID, ControlWord
from jointctl.firmware_py.states import Fault
from tests.device_on_bus import sent_every_10_ms
from tests.hil.terminal import Terminal

SDO_REQUEST = 0x601  # to node 1
OTHERS = (("run", "-y"), ("clear-fault",), ("doctor", "--motion", "-y"))


def test_whoever_comes_while_the_joint_moves_is_refused(bench: Any) -> None:
    config = bench.with_joint(trajectory__duration_s=60.0)
    first = bench.start("run", config, "-y").saw("  tracking")
    for verb in OTHERS:
        bench.run(*verb, config).refused(4, "another program controls", f"pid {first.process.pid}")
    first.signal(signal.SIGINT)
    done = first.finished(30.0)
    assert done.code == 130, done.err
    assert bench.log().records.fault[-1] == Fault.NONE
    assert bench.disabled()


def test_whoever_comes_while_the_first_is_asked_is_refused(bench: Any) -> None:
    config = bench.with_joint(drive__heartbeat_s=0.5)
    assert bench.run("params", "dump", config, "-o", "kept.dcf").code == 0
    first = Terminal(bench, "run", config).saw("[y/N]")
    with can.Bus(interface="jointctl", channel=bench.channel) as ear:
        for arguments in (*((*verb, config) for verb in OTHERS), ("params", "restore", "kept.dcf", config, "-y")):
            assert first.started.process.poll() is None, f"the first ended before {arguments}: {first.finished()}"
            bench.run(*arguments).refused(4, "another program controls", f"pid {first.started.process.pid}")
        requests = [message for message in iter(lambda: ear.recv(0.0), None) if message.arbitration_id == SDO_REQUEST]
    assert not requests
    os.write(first.master, b"y\n")
    assert first.finished().code == 0, first.text
    assert bench.disabled()


@pytest.mark.parametrize("noted", [True, False])
def test_frames_of_a_stop_that_was_not_heard_yet_are_its_own(
    bench: Any, monkeypatch: pytest.MonkeyPatch, noted: bool
) -> None:
    """On a busy computer it had ended as code 7, "another program controls this bus"; its twin does."""
    config = bench.with_joint(trajectory__duration_s=60.0)
    run = bench.start("run", config, "-y").saw("  tracking")
    monkeypatch.setattr(stop_note, "FOLDER", Path("/dev/shm"))
    lock = lock_name("jointctl", bench.channel)
    try:
        if noted:
            stop_note.write_note(lock)
        network = bench.network()
        network.add_node(1).sdo.download(0x6040, 0, struct.pack("<H", ControlWord.DISABLE_VOLTAGE))
        network.disconnect()
        ended = run.finished(30.0)
    finally:
        for note in stop_note.FOLDER.glob(f"{lock}-stop-*"):
            note.unlink()
    if noted:
        assert ended.code == 130, ended.err
        assert "stopped by jointctl stop" in ended.out + ended.err
    else:
        ended.refused(7, "SDO request to node 1 that writes object 6040")
    assert bench.disabled()


def test_of_two_that_start_at_once_one_runs(bench: Any) -> None:
    config = bench.with_joint()
    started = [bench.start("run", config, "-y") for _ in range(2)]
    finished = sorted((one.finished() for one in started), key=lambda done: done.code)
    assert finished[0].code == 0, finished[0].err
    finished[1].refused(4, "another program controls", "pid ")
    assert bench.disabled()


def test_stop_ends_a_program_that_waits_for_its_user(bench: Any) -> None:
    config = bench.with_joint()
    first = Terminal(bench, "run", config).saw("[y/N]")
    assert bench.run("stop", config).code == 0
    ended = first.finished()
    assert ended.code == 130, first.text
    assert "interrupted by jointctl stop; nothing moved" in first.text
    assert bench.disabled()


def test_stop_ends_a_tune_that_waits_for_its_user(bench: Any) -> None:
    config = bench.with_joint()
    first = Terminal(bench, "tune", config).saw("[y/N]")
    bench.run("run", config, "-y").refused(4, "another program controls")
    assert bench.run("stop", config).code == 0
    assert first.finished().code == 130, first.text
    assert "by jointctl stop; nothing moves" in first.text


@pytest.mark.parametrize("delay_s", [0.0, 0.5, 1.0, 1.5, 2.2])
def test_a_stop_latches_wherever_the_run_is(bench: Any, delay_s: float) -> None:
    """From the first moment of its process on: it ends with the code of an interruption, and the drive is off.

    After each frame of it, at simulated time: tests/faults/test_every_frame.py.
    """
    config = bench.with_joint()
    run = bench.start("run", config, "-y")
    time.sleep(delay_s)
    stopped = bench.run("stop", config)
    assert (stopped.code, "switch on disabled" in stopped.out) == (0, True), stopped
    ended = run.finished(20.0)
    assert ended.code == 130, ended.err
    assert bench.disabled()


@pytest.mark.parametrize(
    "verb",
    [
        ("sweep", "-y", "-o", "data.csv"), ("doctor", "--motion", "-y"), ("clear-fault",), ("tune", "-y"),
        ("response", "-y"), ("excite", "-y"), ("map", "-y"),
    ],
)  # fmt: skip
def test_whatever_is_stopped_says_that_a_stop_has_ended_it(bench: Any, verb: tuple[str, ...]) -> None:
    """And it takes the frames of that stop for no other controller's."""
    config = bench.with_joint()
    started = bench.start(*verb, config)
    assert bench.run("stop", config).code == 0
    ended = started.finished(20.0)
    assert ended.code == 130, ended.err
    assert "by jointctl stop; " in ended.err
    assert "another controller" not in ended.err
    assert "Traceback" not in ended.err
    assert bench.disabled()


def test_a_run_that_hangs_is_ended_with_its_loop(bench: Any) -> None:
    config = bench.with_joint(trajectory__duration_s=30.0, sequence__supervisor_timeout_s=30.0)
    run = bench.start("run", config, "-y").saw("  tracking")
    run.process.send_signal(signal.SIGSTOP)
    stopped = bench.run("stop", config)
    assert (stopped.code, "ending process" in stopped.err) == (0, True), stopped
    assert run.process.wait(5.0) == -signal.SIGKILL
    assert bench.disabled()
    again = bench.run("run", bench.config(), "-y", "--allow-low-margin")  # takes the armed watchdog over
    assert again.code == 0, again.err


@pytest.mark.parametrize("data", [b"\x0f\0\x2c\x01", b"\x06\0\0\0"], ids=["torque", "shutdown"])
def test_set_points_of_another_controller_end_a_run_and_are_named(bench: Any, data: bytes) -> None:
    config = bench.with_joint(trajectory__duration_s=30.0)
    run = bench.start("run", config, "-y").saw("  tracking")
    with can.Bus(interface="jointctl", channel=bench.channel) as foreign:
        foreign.send(can.Message(arbitration_id=0x201, data=data, is_extended_id=False))
        done = run.finished(20.0)
    done.refused(7, "another controller is active on this bus: 1 x RPDO to node 1 (201h) with other commands")
    assert bench.disabled()


def test_sync_of_another_controller_ends_a_run_and_is_named(bench: Any) -> None:
    """The drive takes its torque and samples at every SYNC, whoever sends it."""
    config = bench.with_joint(trajectory__duration_s=30.0)
    run = bench.start("run", config, "-y").saw("  tracking")
    with sent_every_10_ms("jointctl", bench.channel, SYNC_ID):
        done = run.finished(20.0)
    done.refused(7, "another controller is active on this bus: ", "x SYNC")
    assert bench.disabled()


def test_heartbeats_that_would_feed_the_drives_watchdog_for_us_end_a_run_and_are_named(bench: Any) -> None:
    """With them a drive without 1400:5 kept its torque when both programs had died."""
    config = bench.with_joint(trajectory__duration_s=30.0)
    run = bench.start("run", config, "-y").saw("  tracking")
    with sent_every_10_ms("jointctl", bench.channel, 0x77E, b"\5"):
        done = run.finished(20.0)
    done.refused(7, "another controller is active on this bus: ", "x heartbeat of node 126, which is our own")
    assert bench.disabled()


def test_a_foreign_controller_is_known_by_its_sync(bench: Any) -> None:
    config = bench.with_joint()
    with sent_every_10_ms("jointctl", bench.channel, SYNC_ID):
        for verb in (("run", "-y"), ("clear-fault",)):
            bench.run(*verb, config).refused(4, "another controller", "SYNC")
    assert bench.disabled()
