"""`jointctl stop` and `clear-fault` from a second terminal."""

from __future__ import annotations

from typing import Any

import pytest

from tests.python_process import eventually

FAULT = 0x08


def _inject_heartbeat_loss(bench: Any, node: int = 1) -> None:
    """Arm the watchdog with a fault as its reaction, enable, and stay silent: the drive ends in fault."""
    network = bench.network()
    try:
        drive = network.add_node(node)
        network.send_message(0, [128, node])
        drive.sdo.download(0x6007, 0, (1).to_bytes(2, "little"))
        drive.sdo.download(0x1016, 1, (0x7E0064).to_bytes(4, "little"))
        drive.sdo.download(0x6060, 0, b"\x0a")
        for word in (0x06, 0x07, 0x0F):
            drive.sdo.download(0x6040, 0, word.to_bytes(2, "little"))
        network.send_message(0x700 + 126, [5])
        eventually(lambda: int.from_bytes(drive.sdo.upload(0x6041, 0), "little") & 0x4F == FAULT, 5.0)
    finally:
        network.disconnect()


@pytest.mark.trips("user: everything")
def test_stop_ends_a_run_of_another_terminal(bench: Any) -> None:
    config = bench.with_joint(trajectory__duration_s=30.0)
    run = bench.start("run", config, "-y").saw("tracking")
    stopped = bench.run("stop", config)
    assert (stopped.code, "switch on disabled" in stopped.out) == (0, True), stopped
    ended = run.finished(20.0)
    assert ended.code == 130, ended.err
    assert "stopped by jointctl stop" in ended.err
    assert "quick stop asked for by jointctl stop" in [event.text for event in bench.log().events]
    assert bench.disabled()


def test_stop_is_not_lost_to_a_file_that_is_being_edited(bench: Any) -> None:
    config = bench.with_joint(trajectory__duration_s=30.0)
    run = bench.start("run", config, "-y").saw("tracking")
    path = bench.folder / config
    path.write_text(path.read_text().replace("[control]", "[control]\nkp = -3\nki =", 1))
    bench.run("check", config).refused(3)  # no TOML any more
    stopped = bench.run("stop", config)
    assert (stopped.code, "switch on disabled" in stopped.out) == (0, True), stopped
    assert "the configuration does not hold" in stopped.err
    assert run.finished(20.0).code == 130
    assert bench.disabled()


@pytest.mark.stays("user: everything")
def test_stop_of_a_resting_joint_is_harmless(bench: Any) -> None:
    config = bench.with_joint()
    assert bench.run("stop", config).code == 0
    assert bench.run("run", config, "-y").code == 0  # the twin: it can be run as before


def test_clear_fault_resets_and_leaves_the_drive_off(bench: Any) -> None:
    config = bench.with_joint()
    _inject_heartbeat_loss(bench)
    bench.run("run", config, "-y").refused(6, "fault")
    cleared = bench.run("clear-fault", config)
    assert cleared.code == 0, cleared
    assert "was reset" in cleared.out
    assert bench.status_word() & 0x6F == 0x40
    again = bench.run("clear-fault", config)
    assert (again.code, "no fault" in again.out) == (0, True)
