"""`jointctl.Joint` in real time: however the program ends, the joint is stopped and off."""

from __future__ import annotations

import os
import re
import signal
from pathlib import Path
from typing import Any

import pytest

from jointctl.firmware_py.states import AxisPhase, Fault
from tests.hil.bench import processes_in
from tests.python_process import eventually

PROGRAM = """
import math, sys, time
import jointctl

def say(text):
    print(text, file=sys.stderr, flush=True)

with jointctl.Joint("joint.toml") as joint:
    say(joint.state.phase)
    joint.enable({approve})
    say("enabled")
    {body}
say("left")
"""
STREAM = """
    start = joint.state.desired_position_rad
    begun = time.monotonic()
    while True:
        t = time.monotonic() - begun
        share = min(t, 1.0) ** 2
        joint.command(start + 0.1 * share * math.sin(t), time_s=t)
        if t > 2.0: say("streaming")
        time.sleep(0.005)
"""


def started(bench: Any, body: str, approve: str = "", **changes: Any) -> Any:
    # a busy computer must not be the fault that is seen
    bench.with_joint(**{"stream__delay_s": 0.3, "stream__timeout_s": 1.0, "stream__client_timeout_s": 3.0, **changes})
    return bench.program(PROGRAM.format(body=body.strip(), approve=approve))


def phases(bench: Any) -> list[int]:
    return [int(phase) for phase in dict.fromkeys(bench.log().records.phase.tolist())]


RAMPED = [AxisPhase.TRACKING, AxisPhase.RAMPING, AxisPhase.RELEASING, AxisPhase.DISABLING, AxisPhase.FINISHED]


KERNELS = """
    import gc
    from jointctl.firmware_py.kernel import Kernel
    def kernels():
        return {k.py_func.__qualname__ for k in gc.get_objects() if issubclass(type(k), Kernel) and k.loaded}
    at_first = kernels()
"""


def test_motions_and_set_points_then_off(bench: Any) -> None:
    body = (
        KERNELS
        + """
    joint.move_to(0.2, duration_s=1.0)
    joint.follow([0.0, 0.5, 1.0], [0.2, 0.25, 0.2])
    for k in range(1, 200):
        joint.command(0.2 + 1e-6 * k * k, time_s=0.005 * k)
        time.sleep(0.005)
    joint.wait(0.5)
    say(f"at {joint.state.desired_position_rad:.6f}")
    say(f"kernels compiled or loaded meanwhile: {sorted(kernels() - at_first)}")
    """
    )
    ended = started(bench, body).finished()
    assert ended.code == 0, ended.err
    assert "meanwhile: []" in ended.err  # the loop watches its client, and compiling takes seconds
    brake_rad = (397e-6 / 0.005) ** 2 / (2.0 * 2.0)  # from the last set-point on, at 2 rad/s2
    (at_rad,) = (float(line.split()[1]) for line in ended.err.splitlines() if line.startswith("at "))
    assert at_rad == pytest.approx(0.2 + 1e-6 * 199**2 + brake_rad, abs=2e-6)
    log = bench.log()
    assert phases(bench)[-5:] == RAMPED
    tracking = log.records[log.records.phase == AxisPhase.TRACKING]
    assert abs(tracking.error_rad).max() < 0.01
    assert bench.disabled()


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("joint.move_to(0.2); raise ValueError('mine')", "ValueError: mine"),
        ("joint.stop(); joint.move_to(0.2)", "the run has ended, by the program; the joint is off"),
        ("time.sleep(5.0)", "CLIENT_SILENT"),
        ("joint.command(5.0)", "position_rad (=5) must be in [-0.7..0.7]"),
    ],
)
def test_an_exception_ramps_down_and_disables(bench: Any, body: str, words: str) -> None:
    ended = started(bench, body).finished()
    assert ended.code == 1
    assert words in ended.err
    assert phases(bench)[-5:] == RAMPED
    assert bench.disabled()


def test_set_points_that_are_refused_are_no_sign_of_life(bench: Any) -> None:
    body = """
    while True:
        try: joint.command(5.0)
        except jointctl.SetPointError: time.sleep(0.05)
    """
    ended = started(bench, body).finished()
    assert ended.code == 1
    assert "CLIENT_SILENT" in ended.err
    assert bench.log().records.fault[-1] == Fault.CLIENT_SILENT
    assert bench.disabled()


@pytest.mark.parametrize("body", ["joint.wait(30.0)", STREAM], ids=["at rest", "streaming"])
def test_ctrl_c_ramps_down(bench: Any, body: str) -> None:
    program = started(bench, body).saw("streaming" if body == STREAM else "enabled")
    program.signal(signal.SIGINT)
    ended = program.finished(30.0)
    assert "KeyboardInterrupt" in ended.err
    assert phases(bench)[-5:] == RAMPED
    assert bench.disabled()


def test_ctrl_c_while_it_stops_returns_when_the_drive_is_off(bench: Any) -> None:
    body = """
    joint.move_to(0.6, duration_s=4.0, wait=False)
    joint.wait(1.5)
    say("stopping")
    try: joint.stop()
    except KeyboardInterrupt: say(f"stopped: {joint.state.drive_state}")
    """
    program = started(bench, body, sequence__release_s=2.0).saw("stopping")
    program.signal(signal.SIGINT)
    ended = program.finished(30.0)
    assert "stopped: switch on disabled" in ended.err
    assert bench.disabled()


@pytest.mark.parametrize("error", ["SystemExit(3)", "TimeoutError('mine')"])
def test_what_a_signal_raises_while_the_block_is_left_comes_when_the_drive_is_off(bench: Any, error: str) -> None:
    """A handler of the program's own, as for SIGTERM or a time-out."""
    body = f"""
    import signal
    def ends(*_): raise {error}
    signal.signal(signal.SIGALRM, ends)
    joint.move_to(0.6, duration_s=4.0, wait=False)
    joint.wait(1.5)
    signal.setitimer(signal.ITIMER_REAL, 0.3)
    try: joint.stop()
    except BaseException as error: say(f"stopped: {{joint.state.drive_state}} ({{error!r}})")
    """
    ended = started(bench, body, sequence__release_s=2.0).finished(60.0)
    assert f"stopped: switch on disabled ({error})" in ended.err
    assert phases(bench)[-5:] == RAMPED
    assert bench.disabled()


def test_the_state_is_none_once_the_loop_has_died(bench: Any) -> None:
    program = started(bench, "while joint.state.phase == 'tracking': time.sleep(0.05)").saw("enabled")
    for process in processes_in(bench.folder):
        if "loop_process" in Path(f"/proc/{process}/cmdline").read_text():
            os.kill(process, signal.SIGKILL)
    ended = program.finished(30.0)
    assert ended.code == 1
    assert "MotionFault: the loop process was killed by signal 9" in ended.err


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_the_death_of_the_interpreter_ramps_down(bench: Any, number: int) -> None:
    program = started(bench, STREAM).saw("streaming")
    program.signal(number)
    program.finished(30.0)
    eventually(lambda: list(bench.folder.glob("runs/*.tail.mcap")), 20.0)
    eventually(lambda: not processes_in(bench.folder), 20.0)  # the loop, which writes it
    log = bench.log()
    assert log.records.fault[-1] == Fault.SUPERVISOR_LOST
    assert log.records.phase[-1] == AxisPhase.FINISHED
    assert bench.disabled()


@pytest.mark.parametrize("when", ["commissioned", "enabled"])
def test_jointctl_stop_ends_it_for_good(bench: Any, when: str) -> None:
    approve = "lambda lines: time.sleep(4.0) or True" if when == "commissioned" else ""
    program = started(bench, "joint.wait(60.0)", approve=approve).saw(when)
    stopped = bench.run("stop", "joint.toml")
    assert (stopped.code, "switch on disabled" in stopped.out) == (0, True), stopped
    ended = program.finished(30.0)
    assert ended.code == 1
    assert "by jointctl stop" in ended.err
    assert bench.disabled()


def test_a_program_that_goes_on_without_its_joint_is_not_ended(bench: Any) -> None:
    body = """
    try: joint.wait(60.0)
    except jointctl.JointctlError: say("over")
    time.sleep(30.0)
    """
    program = started(bench, body).saw("enabled")
    stopped = bench.run("stop", "joint.toml")
    assert (stopped.code, "ending process" in stopped.err) == (0, False), stopped
    program.saw("over")
    assert program.process.poll() is None
    assert bench.run("clear-fault", "joint.toml").code == 0  # and others may have the bus
    program.end()


def test_a_forked_process_neither_moves_nor_ends_it(bench: Any) -> None:
    body = """
    import os
    child = os.fork()
    if not child:
        for call in joint.stop, lambda: joint.state, lambda: joint.wait(1.0), lambda: joint.command(0.1):
            try:
                call()
            except jointctl.UsageError as error:
                say(error)
        sys.exit(3)  # through the block
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 3
    joint.move_to(0.15, duration_s=0.5)
    say("waiting")
    joint.wait(30.0)
    """
    program = started(bench, body).saw("waiting")
    stopped = bench.run("stop", "joint.toml")
    assert (stopped.code, "ending process" in stopped.err) == (0, False), stopped
    ended = program.finished(30.0)
    assert ended.err.count("was forked from the one that has the joint") == 4
    assert "by jointctl stop" in ended.err
    assert bench.disabled()


UNLEFT = """
import sys, threading
import jointctl

joint = jointctl.Joint("joint.toml").__enter__()
{body}
print("the end", file=sys.stderr, flush=True)
"""
DAEMON = """
joint.enable()
def back_and_forth():
    while True:
        joint.move_to(0.1, duration_s=1.0)
        joint.move_to(0.0, duration_s=1.0)
threading.Thread(target=back_and_forth, daemon=True).start()
joint.wait(1.5)
"""


@pytest.mark.parametrize("body", ["", DAEMON], ids=["commissioned", "moved by a daemon thread"])
def test_a_program_that_ends_without_leaving_the_block_leaves_nothing_running(bench: Any, body: str) -> None:
    bench.with_joint(stream__client_timeout_s=3.0)
    program = bench.program(UNLEFT.format(body=body)).saw("the end")
    assert program.finished(20.0).code == 0
    if body:
        assert any("asked for by the end of the program" in event.text for event in bench.log().events)
        assert phases(bench)[-5:] == RAMPED
    assert bench.disabled()


def test_a_program_that_goes_on_after_a_fault_learns_that_its_drive_may_be_on(bench: Any) -> None:
    drive = bench.joint_process(bench.config())
    body = """
    try: joint.wait(60.0)
    except jointctl.MotionFault: say("fault")
    try: joint.stop()
    except jointctl.DeviceError: say("not stopped")
    """
    program = bench.program(PROGRAM.format(body=body.strip(), approve="")).saw("enabled")
    drive.end()
    ended = program.saw("fault").finished(30.0)
    assert "not stopped" in ended.err
    assert "DeviceError: the drive did not confirm that it is off" in ended.err
    assert "left" not in ended.err.split()


ANOTHER = """
import os
another = "import sys, time; print('another', file=sys.stderr, flush=True); time.sleep(60.0)"
os.execv(sys.executable, [sys.executable, "-c", another])
"""


@pytest.mark.parametrize("body", ["", "joint.enable()\n"], ids=["commissioned", "enabled"])
def test_a_program_whose_process_becomes_another_one_leaves_the_joint_and_its_bus(bench: Any, body: str) -> None:
    """The loop took it for its supervisor, whose number it has: the bus stayed locked, the last records were lost."""
    config = bench.with_joint()
    program = bench.program(UNLEFT.format(body=body + ANOTHER)).saw("another")
    eventually(lambda: bench.run("run", config, "--dry-run", "-q").code == 0)
    assert bench.disabled()
    assert bool(list(bench.folder.glob("**/*.tail.mcap"))) == bool(body)
    program.end()


STANDS = """
from jointctl.tools.session import control

agreed, now_ns = control.StopSignals.agreed, control.now_ns

def standing(signals):
    agreed(signals)
    control.now_ns = lambda: now_ns() + {stood_s} * 10**9

control.StopSignals.agreed = standing
"""


@pytest.mark.parametrize(("stood_s", "refused"), [(31, True), (1, False)])
def test_a_yes_does_not_count_after_a_standstill(bench: Any, stood_s: float, refused: bool) -> None:
    """Stopped by Ctrl-Z, or with its computer asleep, a run that was agreed to moved the joint when it went on."""
    bench.with_joint(stream__client_timeout_s=3.0)
    program = STANDS.format(stood_s=stood_s) + PROGRAM.format(body="joint.stop()", approve="")
    ended = bench.program(program).finished(60.0)
    assert (
        bool(re.search(r"stood still, or was too slow, for \d+ s after the motion was agreed to", ended.err)) is refused
    )
    assert ("enabled" in ended.err.split()) is not refused
    assert bench.disabled()


INTERRUPTED = """
import _thread, sys, threading, time
import jointctl

def before_the_yes(lines):
    raise KeyboardInterrupt

def behind_the_yes(lines):
    threading.Timer(0.05, _thread.interrupt_main).start()
    return True

with jointctl.Joint("joint.toml") as joint:
    try:
        joint.enable({approve})
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr, flush=True)
    time.sleep(4.0)
    joint.wait(0.1)
"""


@pytest.mark.parametrize("approve", ["before_the_yes", "behind_the_yes"])
def test_an_enable_that_is_interrupted_ends_the_run_whatever_the_program_does_then(bench: Any, approve: str) -> None:
    bench.with_joint()
    ended = bench.program(INTERRUPTED.format(approve=approve)).finished(60.0)
    assert ended.code == 1
    assert "interrupted" in ended.err
    assert "the run has ended, by the program; the joint is off" in ended.err
    assert bench.disabled()


INTERRUPTED_AT_THE_END = """
import sys, time
from types import SimpleNamespace
import jointctl
from jointctl import live_joint

def interrupted():
    live_joint.time = time
    raise KeyboardInterrupt

live_joint.time = SimpleNamespace(**{**vars(time), "monotonic_ns": interrupted})
try:
    with jointctl.Joint("joint.toml"):
        print("entered", file=sys.stderr, flush=True)
except KeyboardInterrupt:
    print("interrupted", file=sys.stderr, flush=True)
with jointctl.Joint("joint.toml") as joint:
    print(joint.state.phase, file=sys.stderr, flush=True)
"""


def test_a_commissioning_that_is_interrupted_at_its_very_end_leaves_the_bus(bench: Any) -> None:
    """Its session had the bus until the program ended: no block was entered that could be left."""
    bench.with_joint()
    ended = bench.program(INTERRUPTED_AT_THE_END).finished(60.0)
    assert ended.code == 0, ended.err
    assert ended.err.split()[-2:] == ["interrupted", "commissioned"]
    assert bench.disabled()


def test_a_second_program_is_refused_by_name(bench: Any) -> None:
    program = started(bench, "joint.wait(60.0)").saw("enabled")
    second = bench.run("run", "joint.toml", "-y")
    second.refused(4, "program.py")
    program.signal(signal.SIGINT)
    program.finished(30.0)
    assert bench.disabled()


def test_approve_is_shown_the_envelope_and_may_say_no(bench: Any) -> None:
    ended = started(bench, "", approve="lambda lines: say('|'.join(lines)) or False").finished()
    assert ended.code == 1
    assert "limits     -0.700 .. +0.700 rad" in ended.err
    assert "not approved; nothing has moved" in ended.err
    assert bench.disabled()
