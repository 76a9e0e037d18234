"""Ways in which a loop could have gone on with old values or unheard, each closed; every one with its twin."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from unittest.mock import Mock

import pytest

from jointctl.firmware_py.cycle import Histogram
from jointctl.firmware_py.states import AxisPhase, DriveRequest, DriveState, Fault, StopRequest
from jointctl.tools.configuration.config import Config
from jointctl.tools.session.run_watch import RunWatch
from jointctl.tools.session.session import Session
from tests.unit.drivers.elmo.virtual_line import Talk
from tests.unit.firmware_py.stub_loop import ANSWER_ns, Loop


# --- serial drive: a status that is old ---
@pytest.mark.parametrize("echo", [True, False])
def test_a_stop_right_after_motor_on_is_said_although_the_status_is_still_off(echo: bool) -> None:
    talk = Talk(echo)
    talk.cycle(DriveRequest.OFF, count=4)
    assert b"MO=0" not in talk.said  # twin: off and never asked for more
    talk.command.request = DriveRequest.ENABLE
    while b"MO=1" not in talk.cycle(DriveRequest.ENABLE):
        pass
    talk.sample.drive_state, talk.port.status = DriveState.OFF, 0  # what was read before the motor was on
    assert b"MO=0" in talk.cycle(DriveRequest.OFF)
    talk.cycle(DriveRequest.OFF)
    assert talk.device.m.motor_on == 0


@pytest.mark.parametrize("answers", [True, False])
def test_a_drive_that_tells_positions_but_no_status_is_not_taken_for_enabled(answers: bool) -> None:
    talk = Talk().enabled()
    talk.spoil = lambda reply: reply if answers or not reply.startswith(b"SR") else b""
    count = int(talk.sample.count)
    talk.cycle(torque_Nm=12.1, count=40)
    assert talk.sample.count > count + 20  # positions keep coming
    assert talk.sample.drive_state == (DriveState.ENABLED if answers else DriveState.UNKNOWN)


# --- the measured delay, where every sample answers the SYNC before ---
@pytest.mark.parametrize(("after_wake_ns", "bin_us"), [(-1, 1001), (1, 1)])
def test_a_sample_that_came_between_the_cycles_is_a_period_old(
    axis_constants: Any, after_wake_ns: int, bin_us: int
) -> None:
    loop = Loop(axis_constants)
    loop.stub[ANSWER_ns] = after_wake_ns
    loop.run(20)
    row = loop.histograms[Histogram.ROUND_TRIP]
    assert row.sum() == 20
    assert row[:bin_us].sum() == 0
    assert bin_us > 1000 or row[bin_us] == 20


# --- the supervisor brakes, the user asks for more ---
class _BrakingLoop:
    def __init__(self) -> None:
        self.asked: list[StopRequest] = []
        self.polls = 3

    def request_stop(self, request: StopRequest) -> None:
        self.asked.append(request)

    def beat(self) -> None:
        pass

    def running(self) -> bool:
        self.polls -= 1
        return self.polls > 0


def braked(configs: Sequence[Config], signal: StopRequest = StopRequest.NONE, **viewer: Any) -> _BrakingLoop:
    """What has become of the loop when its supervisor, which cannot go on, has braked the joints."""
    session = Session.__new__(Session)
    session.plan = Mock(configs=tuple(configs))
    loop: Any = _BrakingLoop()
    watch = RunWatch.__new__(RunWatch)
    watch.around = Mock(signals=Mock(request=signal))
    watch.display = Mock(stop_request=Mock(**{"return_value": StopRequest.NONE, **viewer}))
    session._brake(loop, watch)
    return loop


@pytest.mark.parametrize("by", ["a signal", "a signal, behind a broken display", "a viewer"])
@pytest.mark.parametrize("request_", [StopRequest.NONE, StopRequest.QUICK_STOP, StopRequest.OFF])
def test_a_stop_is_heard_while_a_failed_supervisor_brakes(virtual_config: Any, request_: StopRequest, by: str) -> None:
    """By a signal, or the second press of STOP at the page."""
    by_signal, by_page = (StopRequest.NONE, request_) if by == "a viewer" else (request_, StopRequest.NONE)
    broken = OSError("no page") if "broken" in by else None
    loop = braked([virtual_config], by_signal, return_value=by_page, side_effect=broken)
    assert loop.polls == 0, "it is braked to the end"
    assert max(loop.asked) == max(StopRequest.RAMP, request_)


@pytest.mark.parametrize("slow", [True, False])
def test_a_failed_supervisor_of_an_arm_waits_for_its_slowest_joint(virtual_config: Any, slow: bool) -> None:
    """Not for the first one's time: that took the others out of their ramps.  The twin has no slow one."""
    at_once = dict.fromkeys(("stop_timeout_s", "release_s", "off_timeout_s"), 0.0)
    quick = virtual_config.changed(sequence=at_once)
    assert (braked([quick, virtual_config if slow else quick]).polls == 0) is slow


# --- the loop stood still (SIGSTOP, a suspended machine) and goes on ---
@pytest.mark.parametrize("elapsed_cycles", [9, 150, 1_500])
def test_a_loop_that_stood_still_gives_no_torque_to_a_drive_that_was_stopped_meanwhile(
    rig: Any, elapsed_cycles: int
) -> None:
    run = rig(0.1).until(AxisPhase.TRACKING).run(20)
    run.command.request = DriveRequest.OFF  # the watchdog in the drive: power off, whatever the last command was
    run.joint.drive_state, run.joint.velocity_radps = DriveState.OFF, 0.0
    before = len(run.requests)
    run.tick(elapsed_cycles)
    for _ in range(40):
        if run.phase == AxisPhase.FINISHED:
            break
        run.joint.drive_state = DriveState.ENABLED  # somebody switches it on again
        run.tick()
    assert run.phase == AxisPhase.FINISHED
    assert run.state.fault == Fault.DRIVE_NOT_ENABLED
    assert set(run.requests[before:]) == {DriveRequest.OFF}
    assert set(run.torques_Nm[before:]) == {0.0}


def test_a_loop_that_missed_a_few_cycles_goes_on(rig: Any) -> None:
    run = rig(0.1).until(AxisPhase.TRACKING).run(20)
    run.tick(int(run.axis.limits.skipped_max_cycles) + 1)
    run.run(50)
    assert (run.phase, run.state.fault) == (AxisPhase.TRACKING, Fault.NONE)
