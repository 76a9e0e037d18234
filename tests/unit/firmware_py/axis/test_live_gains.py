"""Gains and requests while the joint moves: taken whole and checked, without a jump, never while stopping."""

from __future__ import annotations

import math

import numpy as np
import pytest

from jointctl.firmware_py.law import solve_lyapunov_p
from jointctl.firmware_py.live_change import gains_allowed, gains_of, set_gains
from jointctl.firmware_py.motion_records import ChangeAnswer, ChangeKind, Gains
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, ControllerKind, Fault, StopRequest
from tests.axis_on_stub_joint import NewRig
from tests.unit.firmware_py.axis.live_axis import GAINS, RAMP_s, answered, hold, live, post


def test_gains_change_along_a_line_and_nothing_jumps(rig: NewRig) -> None:
    run = live(rig(0.0)).until(AxisPhase.TRACKING).run(100)
    number = post(run, ChangeKind.GAINS, kp=1200.0, kv=70.0, learning_rate=40.0)
    assert answered(run, number) is ChangeAnswer.TAKEN
    seen = [float(run.axis.law.kp)]
    while run.state.change.ramping:
        run.tick()
        seen.append(float(run.axis.law.kp))
        _, p12, p22 = solve_lyapunov_p(seen[-1], float(run.axis.law.kv), 1800.0, 1800.0)
        np.testing.assert_allclose(run.axis.law.network.p_b, [p12 / 2.1, p22 / 2.1], rtol=1e-12)
    assert len(seen) == pytest.approx(RAMP_s / 1e-3, abs=2)
    np.testing.assert_allclose(np.diff(seen), (1200.0 - 784.0) / 50.0, rtol=1e-6)
    assert (run.axis.law.kp, run.axis.law.kv, run.axis.law.network.learning_rate) == (1200.0, 70.0, 40.0)
    assert np.max(np.abs(np.diff(run.torques_Nm[-60:]))) < 0.2
    run.run(200)
    assert run.phase is AxisPhase.TRACKING
    assert run.state.fault == Fault.NONE


@pytest.mark.parametrize("name", GAINS)
def test_gain_limits_are_dense_at_their_boundary(name: str) -> None:
    low, high, gains = new(Gains)[0], new(Gains)[0], new(Gains)[0]
    for field in GAINS:
        setattr(low, field, 1.0)
        setattr(high, field, 3.0)
        setattr(gains, field, 2.0)
    for value, allowed in (
        (1.0, True), (3.0, True), (math.nextafter(1.0, 0.0), False), (math.nextafter(3.0, 4.0), False),
        (math.nan, False), (math.inf, False), (-math.inf, False), (0.0, False),
    ):  # fmt: skip
        setattr(gains, name, value)
        assert bool(gains_allowed(low, high, gains)) is allowed


@pytest.mark.parametrize("value", [784.0 * 2.0001, 784.0 * 0.4999, math.nan, math.inf, -784.0, 0.0])
def test_gains_outside_of_the_limits_change_nothing(rig: NewRig, value: float) -> None:
    run = live(rig(0.0)).until(AxisPhase.TRACKING)
    before = run.axis.law.copy()
    assert answered(run, post(run, ChangeKind.GAINS, kp=value, kv=60.0)) is ChangeAnswer.GAIN_LIMIT
    run.run(60)
    assert (run.axis.law.kp, run.axis.law.kv) == (before.kp, before.kv)
    assert run.phase is AxisPhase.TRACKING


def test_a_change_is_taken_whole_or_not_yet(rig: NewRig) -> None:
    run = live(rig(0.0)).until(AxisPhase.TRACKING)
    number = post(run, ChangeKind.GAINS, kp=900.0)
    for first, last in ((number - 1, number), (number, number - 1), (number + 1, number + 1)):
        run.axis.change.request.first, run.axis.change.request.last = first, last
        run.run(5)
        assert run.state.change.answered == number - 1
        assert run.axis.law.kp == 784.0
    run.axis.change.request.first = run.axis.change.request.last = number
    assert answered(run, number) is ChangeAnswer.TAKEN


def test_one_request_is_carried_out_once(rig: NewRig) -> None:
    run = live(rig(0.0)).until(AxisPhase.TRACKING)
    answered(run, post(run, ChangeKind.GAINS, kp=900.0))
    run.run(100)
    run.axis.change.request.gains.kp = 1500.0  # without a new number: nobody looks
    run.run(100)
    assert run.axis.law.kp == 900.0


@pytest.mark.parametrize("kind", [0, 3, -1])
def test_a_kind_that_is_not_known_is_refused(rig: NewRig, kind: int) -> None:
    run = live(rig(0.0)).until(AxisPhase.TRACKING)
    assert answered(run, post(run, kind)) is ChangeAnswer.WRONG_KIND


@pytest.mark.parametrize("phase", [AxisPhase.WAITING, AxisPhase.ENABLING, AxisPhase.APPROACH, AxisPhase.TRACKING])
def test_gains_change_while_the_law_follows_and_motions_while_it_tracks(rig: NewRig, phase: AxisPhase) -> None:
    run = live(rig(0.1))
    if phase is not AxisPhase.WAITING:
        run.until(phase)
    gains = answered(run, post(run, ChangeKind.GAINS, kp=900.0))
    motion = answered(run, hold(run, 0.1))
    assert run.phase is phase
    assert (gains is ChangeAnswer.TAKEN) is (phase >= AxisPhase.APPROACH)
    assert (motion is ChangeAnswer.TAKEN) is (phase is AxisPhase.TRACKING)


@pytest.mark.parametrize("stop", [StopRequest.RAMP, StopRequest.QUICK_STOP, StopRequest.OFF])
def test_nothing_changes_any_more_once_the_joint_is_being_stopped(rig: NewRig, stop: StopRequest) -> None:
    run = live(rig(0.0)).until(AxisPhase.TRACKING).run(50)
    post(run, ChangeKind.GAINS, kp=1200.0)
    run.run(20)
    halfway = float(run.axis.law.kp)
    assert 784.0 < halfway < 1200.0
    run.stop = stop
    number = post(run, ChangeKind.GAINS, kp=1000.0)
    assert answered(run, number) is ChangeAnswer.WRONG_PHASE
    assert answered(run, hold(run, 0.0)) is ChangeAnswer.WRONG_PHASE
    run.until(AxisPhase.FINISHED)
    assert run.axis.law.kp == pytest.approx(halfway, rel=1e-12)


def test_what_was_integrated_keeps_its_torque(rig: NewRig) -> None:
    run = live(rig(0.0))
    law, state, gains = run.axis.law, run.state.law, new(Gains)[0]
    law.kind, law.ki, law.observer.bandwidth_radps = ControllerKind.PID, 1000.0, 50.0
    state.integral_rads, state.observer.disturbance_Nm, state.observer.integral_Nms = 0.01, 7.0, 7.0 / 50.0 + 0.3
    gains_of(law, gains)
    gains.ki, gains.observer_radps = 2000.0, 80.0
    set_gains(run.axis.change, law, state, gains)
    assert law.ki * state.integral_rads == pytest.approx(10.0)
    assert law.observer.bandwidth_radps * (state.observer.integral_Nms - 0.3) == pytest.approx(7.0)
