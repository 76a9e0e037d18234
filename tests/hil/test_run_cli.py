"""`jointctl run` against `jointctl hil` in another process: runs, stops, and what a user is asked."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import time
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.states import AxisPhase, DriveRequest, DriveState
from tests.eds_styles import EPOS4, EPOS4_KEYS, eds_text
from tests.hil.terminal import Terminal

LARGEST_STEP_radps = 0.02  # of the desired velocity in one cycle; braking at 2 rad/s2 is a tenth of it


def largest_velocity_step(records: Any) -> float:
    """Of the desired velocity [rad/s] between neighbouring cycles without a skipped slot."""
    steps = np.abs(np.diff(records.desired_velocity_radps))
    return float(np.max(steps[records.skipped[1:] == 0]))


def entered(records: Any) -> list[AxisPhase]:
    return [AxisPhase(p) for i, p in enumerate(records.phase) if i == 0 or p != records.phase[i - 1]]


@pytest.mark.stays("supervisor: the user")
def test_two_runs_on_one_joint_and_it_is_disabled_after_each(bench: Any) -> None:
    config = bench.with_joint(trajectory__amplitude_rad=0.1)
    for number in (1, 2):
        done = bench.run("run", config, "-y", "--json", env={**os.environ, "TERM": "xterm-256color"})
        assert done.code == 0, done.err
        assert "\x1b" not in done.err  # a file gets lines only
        assert "\n  tracking\n" in done.err
        assert json.loads(done.out)["fault"] is None
        assert bench.disabled()
        assert len(list(bench.folder.glob("runs/*.mcap"))) == number  # and no *.tail.mcap of what a crash left
        assert "now at" in done.err
        assert "trajectory sine" in done.err
        assert "limits" in done.err


def test_a_motor_that_warms_up_is_seen_in_summary_log_and_export(bench: Any) -> None:
    heat = {"virtual__thermal": True, "virtual__heating_KpA2": 20.0, "virtual__thermal_time_s": 10.0}
    config = bench.with_joint(trajectory__duration_s=4.0, **heat)
    done = bench.run("run", config, "-y", "--json")
    assert done.code == 0, done.err
    told = json.loads(done.out)["temperature_degC"]
    assert 25.0 <= told["least"] < told["greatest"] - 2.0
    read = bench.log().temperatures
    assert read["temperature_degC"][[0, -1]].tolist() == [told["least"], told["greatest"]]
    assert 3 <= len(read) <= 10
    assert np.all(np.diff(read["time_ns"]) > 0.5e9)  # a busy computer answers late


def test_a_drive_without_6072_runs_within_its_makers_limit_and_has_it_back(bench: Any) -> None:
    (bench.folder / "maker.eds").write_text(eds_text(EPOS4), encoding="latin-1")
    config = bench.with_joint(**{f"drive__{key}": value for key, value in EPOS4_KEYS.items()})
    done = bench.run("run", config, "-y")
    assert done.code == 0, done.err
    assert "no object 6072: the drive limits its torque by 3001:2 = 4958 (was 5000) = 60.0 Nm" in done.err
    network = bench.network()
    try:
        assert int.from_bytes(network.add_node(1).sdo.upload(0x3001, 2), "little") == 5000
    finally:
        network.disconnect()


@pytest.mark.trips("supervisor: the user")
@pytest.mark.parametrize(("number", "name"), [(signal.SIGINT, "SIGINT"), (signal.SIGTERM, "SIGTERM")])
def test_one_stop_signal_while_tracking_ramps_down(bench: Any, number: int, name: str) -> None:
    config = bench.with_joint(trajectory__duration_s=30.0)
    started = bench.start("run", config, "-y").saw("  tracking")
    time.sleep(0.3)
    started.signal(number, group=True)
    done = started.finished(20.0)
    assert done.code == 130, done.err
    assert "Traceback" not in done.err
    assert f"stopped by {name}" in done.err
    assert bench.disabled()
    records = bench.log().records
    assert entered(records)[-4:] == [
        AxisPhase.RAMPING, AxisPhase.RELEASING, AxisPhase.DISABLING, AxisPhase.FINISHED,
    ]  # fmt: skip
    assert DriveRequest.QUICK_STOP not in records.request
    assert largest_velocity_step(records) < LARGEST_STEP_radps
    ramping = records[records.phase == AxisPhase.RAMPING]
    assert abs(records[records.phase == AxisPhase.TRACKING].desired_velocity_radps[-1]) > 0.1  # it was moving
    assert abs(ramping.desired_velocity_radps[-1]) < LARGEST_STEP_radps
    assert np.all(records[records.phase >= AxisPhase.RELEASING].desired_velocity_radps == 0.0)


def test_a_second_ctrl_c_is_a_quick_stop(bench: Any) -> None:
    # braking so gently that the second signal surely comes while the joint moves
    config = bench.with_joint(
        trajectory__duration_s=30.0, sequence__approach_s=1.5,
        sequence__brake_radps2=0.05, sequence__stop_timeout_s=30.0,
        limits__position_min_rad=-1.5, limits__position_max_rad=1.5,
    )  # fmt: skip
    started = bench.start("run", config, "-y").saw("  tracking")
    started.signal(signal.SIGINT, group=True)
    started.saw("  ramping").signal(signal.SIGINT, group=True)
    done = started.finished(20.0)
    assert done.code == 130, done.err
    assert bench.disabled()
    records = bench.log().records
    assert entered(records)[-3:] == [AxisPhase.QUICK_STOPPING, AxisPhase.DISABLING, AxisPhase.FINISHED]
    assert np.all(records.command_torque_Nm[records.phase >= AxisPhase.QUICK_STOPPING] == 0.0)


@pytest.mark.parametrize("delay_s", [0.1, 0.7, 1.5])
def test_ctrl_c_before_motion_moves_nothing(bench: Any, delay_s: float) -> None:
    config = bench.with_joint(trajectory__duration_s=30.0, sequence__settle_s=5.0, sequence__wait_timeout_s=60.0)
    started = bench.start("run", config, "-y")
    time.sleep(delay_s)
    started.signal(signal.SIGINT, group=True)
    done = started.finished(20.0)
    python_itself = done.err.startswith("Fatal Python error: init_")  # met before the first line of ours
    assert done.code in ((1,) if python_itself else (130, -signal.SIGINT)), done.err
    assert not python_itself or delay_s < 0.7
    assert "tracking" not in done.err
    if delay_s >= 0.7:
        assert "Traceback" not in done.err
    assert bench.disabled()
    if logs := list(bench.folder.glob("runs/*.mcap")):
        assert logs
        assert DriveState.ENABLED not in bench.log().records.drive_state


def test_answering_no_moves_nothing(bench: Any) -> None:
    config = bench.with_joint()
    terminal = Terminal(bench, "run", config).saw("[y/N]")
    os.write(terminal.master, b"\n")
    terminal.saw("nothing moved")
    assert terminal.started.finished(20.0).code == 12
    assert bench.disabled()
    assert not (bench.folder / "runs").exists()


def test_ctrl_c_at_the_question_ends_it(bench: Any) -> None:
    config = bench.with_joint()
    terminal = Terminal(bench, "run", config).saw("[y/N]")
    terminal.started.signal(signal.SIGINT, group=True)
    terminal.saw("interrupted; nothing moved", 10.0)
    assert terminal.started.finished(20.0).code == 130
    assert bench.disabled()


def test_a_terminal_that_is_closed_while_tracking_ramps_down(bench: Any) -> None:
    config = bench.with_joint(trajectory__duration_s=30.0)
    terminal = Terminal(bench, "run", config, "-y").saw(" tracking")
    os.close(terminal.master)  # from now on writing to it is an error
    terminal.started.signal(signal.SIGHUP)
    terminal.started.finished(20.0)
    assert bench.disabled()
    records = bench.log().records
    assert AxisPhase.RELEASING in entered(records)
    assert DriveRequest.QUICK_STOP not in records.request
    assert largest_velocity_step(records) < LARGEST_STEP_radps


def test_a_run_whose_output_nobody_reads_any_more_goes_on_to_its_end(bench: Any) -> None:
    config = bench.with_joint()
    reading, writing = os.pipe()
    with os.fdopen(reading) as reader:
        started = bench.start("run", config, "-y", stderr=writing)
        os.close(writing)
        while "tracking" not in reader.readline():
            pass
    assert started.finished(60.0).code == 0
    assert bench.disabled()
    assert entered(bench.log().records)[-1] is AxisPhase.FINISHED


def test_a_log_that_is_removed_in_the_motion_is_told_at_its_end(bench: Any) -> None:
    config = bench.config()
    bench.joint(config)
    started = bench.start("run", config, "-y").saw("  tracking")
    shutil.rmtree(bench.folder / "runs")
    done = started.finished(60.0)
    assert (done.code, bench.disabled()) == (8, True)
    (line,) = [line for line in done.err.splitlines() if line.startswith("warning: runs/")]
    assert line.endswith(".mcap: was removed or renamed during the run: this log is lost")
    assert "tracking error" in done.out


def test_dry_run_commissions_and_moves_nothing(bench: Any) -> None:
    config = bench.with_joint(virtual__initial_position_rad=0.1)
    done = bench.run("run", config, "--dry-run")
    assert done.code == 0, done.err
    assert "now at     +0.1000 rad" in done.err
    assert "dry run" in done.err
    assert bench.disabled()
    assert not (bench.folder / "runs").exists()


def test_a_disk_that_fills_while_tracking_ramps_down(bench: Any) -> None:
    config = bench.with_joint(trajectory__duration_s=30.0)
    started = bench.start("run", config, "-y").saw("  tracking")
    resource.prlimit(started.process.pid, resource.RLIMIT_FSIZE, (1024, 1024))
    started.finished(20.0).refused(8, "runs/", "cannot be written", "; the motion was ended for it")
    assert bench.disabled()


def test_a_disk_that_is_full_before_motion_moves_nothing(bench: Any) -> None:
    config = bench.with_joint()
    terminal = Terminal(bench, "run", config).saw("[y/N]")
    resource.prlimit(terminal.started.process.pid, resource.RLIMIT_FSIZE, (16, 16))
    os.write(terminal.master, b"y\n")
    terminal.saw("cannot be written")
    assert terminal.started.finished(20.0).code == 8
    assert "Traceback" not in terminal.text
    assert bench.disabled()
