"""`jointctl.Arm` in real time: three joints on one bus; however the program ends, all are stopped and off."""

from __future__ import annotations

import signal
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.states import AxisPhase, Fault, Notice
from jointctl.tools.recording.run_log_reader import read_run_log
from tests.hil.bench import processes_in
from tests.hil.test_arm_run import NAMES, ArmBench
from tests.hil.test_python_joint import KERNELS, RAMPED
from tests.python_process import eventually

PROGRAM = """
import math, sys, time
import numpy as np
import jointctl

def say(text):
    print(text, file=sys.stderr, flush=True)

with jointctl.Arm("arm/arm.toml") as arm:
    say(arm.state.phase)
    arm.enable()
    say("enabled")
    {body}
say("left")
"""
STREAM = """
    start = arm.state.desired_position_rad
    begun = time.monotonic()
    while True:
        t = time.monotonic() - begun
        arm.command(start + 0.05 * min(t, 1.0) ** 2 * np.sin(t + np.arange(3)), time_s=t)
        if t > 2.0: say("streaming")
        time.sleep(0.01)
"""
# a busy computer must not be the fault that is seen
PATIENT = "\n[stream]\ndelay_s = 0.3\ntimeout_s = 1.0\nclient_timeout_s = 3.0\n"


@pytest.fixture
def arm(bench: Any) -> ArmBench:
    return ArmBench(bench, PATIENT)


def ramped(log: Any) -> bool:
    """Braked along its ramp; a joint that sank while its torque was released has been stopped by its drive besides."""
    phases = [int(phase) for phase in dict.fromkeys(log.records.phase.tolist())]
    if int(log.records.notices[-1]) & Notice.SANK:
        phases.remove(AxisPhase.QUICK_STOPPING)
    return phases[-5:] == RAMPED


def started(arm: ArmBench, body: str) -> Any:
    return arm.bench.program(PROGRAM.format(body=body.strip()))


def test_motions_and_set_points_then_all_off(arm: ArmBench) -> None:
    body = (
        KERNELS
        + """
    arm.move_to([0.3, -0.2, 0.1], duration_s=1.0)
    arm.follow([0.0, 0.5, 1.0], [[0.2, -0.1, 0.1], [0.25, -0.1, 0.2], [0.2, -0.1, 0.1]])
    begun = time.monotonic()
    for k in range(1, 200):
        arm.command(np.array([0.2, -0.1, 0.1]) + 1e-6 * k * k * np.array([1, 2, -1]), time_s=0.005 * k)
        time.sleep(max(0.0, begun + 0.005 * k - time.monotonic()))
    arm.wait(0.8)
    say("at " + " ".join(f"{at:.6f}" for at in arm.state.desired_position_rad))
    say(f"kernels compiled or loaded meanwhile: {sorted(kernels() - at_first)}")
    """
    )
    ended = started(arm, body).finished()
    assert ended.code == 0, ended.err
    assert "meanwhile: []" in ended.err  # the loop watches its client, and compiling takes seconds
    (line,) = (line for line in ended.err.splitlines() if line.startswith("at "))
    at_rad = np.array([float(word) for word in line.split()[1:]])
    ways = np.array([1.0, 2.0, -1.0])
    brake_rad = (397e-6 / 0.005) ** 2 * ways**2 * np.sign(ways) / (2.0 * np.array([15.0, 20.0, 30.0]))
    assert at_rad == pytest.approx([0.2, -0.1, 0.1] + 1e-6 * 199**2 * ways + brake_rad, abs=1e-3)
    logs = arm.logs()
    assert len({len(log.records) for log in logs}) == 1
    desired = np.stack([log.records.desired_velocity_radps for log in logs])
    first = {int(np.flatnonzero(row)[0]) for row in desired}
    assert len(first) == 1  # all begin in the same cycle
    for log in logs:
        assert ramped(log)
        tracking = log.records[log.records.phase == AxisPhase.TRACKING]
        assert abs(tracking.error_rad).max() < 0.02
        assert any("by the program" in event.text for event in log.events)
    assert arm.all_off()


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("arm.move_to([0.2, 0.1, 0.1]); raise ValueError('mine')", "ValueError: mine"),
        ("arm.stop(); arm.move_to([0.2, 0.1, 0.1])", "the run has ended, by the program"),
        ("time.sleep(5.0)", "CLIENT_SILENT"),
        ("arm.command([0.1, 5.0, 0.1])", "elbow: position_rad (=5) must be in ["),
    ],
)
def test_an_exception_ramps_all_down_and_disables_them(arm: ArmBench, body: str, words: str) -> None:
    ended = started(arm, body).finished()
    assert ended.code == 1
    assert words in ended.err
    for log in arm.logs():
        assert ramped(log)
    assert arm.all_off()


def test_ctrl_c_ramps_all_down(arm: ArmBench) -> None:
    program = started(arm, STREAM).saw("streaming")
    program.signal(signal.SIGINT)
    assert "KeyboardInterrupt" in program.finished(30.0).err
    for log in arm.logs():
        assert ramped(log)
    assert arm.all_off()


def test_the_death_of_the_interpreter_ramps_all_down(arm: ArmBench) -> None:
    program = started(arm, STREAM).saw("streaming")
    program.signal(signal.SIGKILL)
    program.finished(30.0)
    eventually(lambda: len(list(arm.bench.folder.glob("runs/*.tail.mcap"))) >= len(NAMES), 20.0)
    eventually(lambda: not processes_in(arm.bench.folder), 20.0)  # the loop, which writes them
    tails = list(arm.bench.folder.glob("runs/*.tail.mcap"))
    assert {path.name.split(".", 1)[1] for path in tails} == {f"{name}.tail.mcap" for name in NAMES}
    for path in tails:
        records = read_run_log(path).records
        assert (records.fault[-1], records.phase[-1]) == (Fault.SUPERVISOR_LOST, AxisPhase.FINISHED)
    assert arm.all_off()


def test_a_fault_of_one_joint_is_raised_with_its_name(arm: ArmBench) -> None:
    path = arm.folder / "elbow.toml"
    lines = path.read_text().splitlines()
    lines = [
        "following_error_max_rad = 0.00002" if line.startswith("following_error_max_rad") else line for line in lines
    ]
    path.write_text("\n".join(lines))
    ended = started(arm, "arm.move_to([0.4, -0.4, 0.3], duration_s=1.0)").finished()
    assert ended.code == 1
    assert "elbow: FOLLOWING_ERROR" in ended.err
    assert [int(log.records.fault[-1]) for log in arm.logs()] == [Fault.NONE, Fault.FOLLOWING_ERROR, Fault.NONE]
    assert arm.all_off()


def test_jointctl_stop_on_one_joints_file_ends_the_program(arm: ArmBench) -> None:
    program = started(arm, "arm.wait(60.0)").saw("enabled")
    stopped = arm.bench.run("stop", str(arm.folder / "wrist.toml"))
    assert stopped.code == 0, stopped.err
    ended = program.finished(30.0)
    assert ended.code == 1
    assert "by jointctl stop" in ended.err
    assert arm.all_off()
