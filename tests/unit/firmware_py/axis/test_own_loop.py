"""CSP and CSV: target position and velocity with the law's feed-forward, and 607A, 60B1, 60B2 on the wire."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.can.frames import Frame
from jointctl.drivers.canopen.cia import State
from jointctl.drivers.canopen.cyclic import FRAME_SLOTS, SLOT_OFFSET, SLOT_RPDO, end_cycle, get_i16, get_i32
from jointctl.drivers.canopen.pdo import PdoLayout, new_port, own_layout
from jointctl.firmware_py.axis import command_axis, limited_target_radps, look_ahead, velocity_command_radps
from jointctl.firmware_py.motion_records import Reference
from jointctl.firmware_py.records import Command, LimitConstants, Sample, VelocityCommandConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import (
    AxisPhase,
    CommandKind,
    ControllerKind,
    DriveRequest,
    DriveState,
    Encoders,
    Fault,
    FeedForward,
    StopRequest,
)
from tests.axis_on_stub_joint import OwnLoopRig

PERIOD_s = 1e-3
ACCELERATION_radps2 = 20.0
COUNT_rad = math.tau / 524288


# --- the limits of a target position ---
@pytest.fixture
def limits() -> Any:
    record = new(LimitConstants)[0]
    record.position_min_rad, record.position_max_rad, record.velocity_max_radps = -1.0, 1.0, 2.0
    return record


def target(position_rad: float, velocity_radps: float = 0.0) -> Any:
    record = new(Reference)[0]
    record.position_rad, record.velocity_radps = position_rad, velocity_radps
    return record


def stepped(limits: Any, to: Any, position_rad: float, velocity_radps: float) -> tuple[float, bool]:
    return limited_target_radps(limits, ACCELERATION_radps2, PERIOD_s, to, position_rad, velocity_radps)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("share", "reached"), [(0.999, True), (1.0, True), (1.001, False)])
def test_a_target_within_the_acceleration_limit_is_reached_at_once(
    limits: Any, sign: float, share: float, reached: bool
) -> None:
    velocity = 0.5 + share * ACCELERATION_radps2 * PERIOD_s
    found, finite = stepped(limits, target(sign * velocity * PERIOD_s, sign * velocity), 0.0, sign * 0.5)
    assert finite
    assert (found == pytest.approx(sign * velocity, abs=1e-9)) is reached


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_counts_is_the_change_of_velocity_not_the_velocity(limits: Any, sign: float) -> None:
    """A target that is reached without any change is, though it will stand still; so is one at exactly the limit."""
    assert stepped(limits, target(sign * 0.5 * PERIOD_s), 0.0, sign * 0.5) == (pytest.approx(sign * 0.5), True)
    backwards = target(sign * 0.5, sign * -0.5)  # in binary fractions: the limit is met to the bit
    assert limited_target_radps(limits, 2.0, 0.5, backwards, 0.0, 0.0) == (sign, True)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_target_that_is_not_finite_stays_where_it_was(limits: Any, bad: float) -> None:
    assert stepped(limits, target(bad), 0.3, 1.0) == (0.0, False)
    assert stepped(limits, target(0.3, bad), 0.3, 1.0) == (0.0, False)


@pytest.mark.parametrize("speed_radps", [0.0, 0.4, -0.4])
@pytest.mark.parametrize("ahead_rad", [1e-5, 1e-3, 0.05, -0.05])
def test_a_target_out_of_reach_is_caught_up_with_like_a_joint_would(
    limits: Any, ahead_rad: float, speed_radps: float
) -> None:
    """Within velocity and acceleration limit, not beyond it but for the way of coming up to its speed, then exactly."""
    position = velocity = 0.0
    beyond = steps = 0.0
    aims = [ahead_rad + speed_radps * PERIOD_s * k for k in range(1, 1500)]
    for aim in aims:
        found, _ = stepped(limits, target(aim, speed_radps), position, velocity)
        steps, velocity = max(steps, abs(found - velocity)), found
        position += velocity * PERIOD_s
        beyond = max(beyond, math.copysign(1.0, ahead_rad) * (position - aim))
    assert abs(velocity) <= 2.0
    assert steps <= ACCELERATION_radps2 * PERIOD_s * (1.0 + 1e-9)
    assert position == pytest.approx(aims[-1], abs=1e-9)
    coming_up_rad = 0.5 * speed_radps**2 / ACCELERATION_radps2 + abs(speed_radps) * PERIOD_s
    assert beyond <= 0.05 * abs(ahead_rad) + ACCELERATION_radps2 * PERIOD_s**2 + coming_up_rad


def test_a_target_beyond_the_position_limits_is_not_gone_to(limits: Any) -> None:
    position = velocity = fastest = 0.0
    for _ in range(3000):
        velocity, _ = stepped(limits, target(5.0), position, velocity)
        position += velocity * PERIOD_s
        fastest = max(fastest, velocity)
    assert position == pytest.approx(1.0, abs=1e-6)
    assert fastest == 2.0  # its limit: the acceleration would allow more


def test_the_motion_ahead_is_that_of_its_derivatives() -> None:
    ahead, now = new(Reference)[0], target(0.3, 0.2)
    now.acceleration_radps2, now.snap_radps4 = -4.0, 7.0
    look_ahead(now, 0.01, ahead)
    assert (ahead.position_rad, ahead.velocity_radps) == pytest.approx((0.3 + 0.002 - 0.0002, 0.16))
    assert (ahead.acceleration_radps2, ahead.snap_radps4) == (-4.0, 7.0)


@pytest.mark.parametrize(("position_rad", "expected_radps"), [(0.3, 0.2), (0.31, 0.2 - 0.05), (0.28, 0.2 + 0.1)])
def test_the_velocity_command_leads_back_to_the_planned_motion(position_rad: float, expected_radps: float) -> None:
    constants = new(VelocityCommandConstants)[0]
    constants.position_gain_ps = 5.0
    assert velocity_command_radps(constants, target(0.3, 0.2), position_rad) == pytest.approx(expected_radps)


# --- a whole run of the axis ---
def own_loop(rig: Any, kind: CommandKind) -> OwnLoopRig:
    values = {"position_gain_ps": 20.0, "acceleration_max_radps2": ACCELERATION_radps2, "lead_s": 2.0 * PERIOD_s}
    return OwnLoopRig(rig, kind, **values, feeds_torque=1)


@pytest.fixture(params=[CommandKind.POSITION, CommandKind.VELOCITY], ids=["csp", "csv"])
def own(rig: Callable[..., Any], request: pytest.FixtureRequest) -> OwnLoopRig:
    return own_loop(rig(0.05), request.param)


@pytest.fixture
def csp(rig: Callable[..., Any]) -> OwnLoopRig:
    return own_loop(rig(0.05), CommandKind.POSITION)


def test_a_joint_is_tracked_without_lag_stopped_and_disabled(own: OwnLoopRig) -> None:
    own.until(AxisPhase.TRACKING)
    own.tick(500)
    state = own.rig.state
    assert abs(state.measured_position_rad - state.reference.position_rad) < 2e-5
    own.rig.stop = StopRequest.RAMP
    own.until(AxisPhase.FINISHED)
    assert state.fault == Fault.NONE


def test_the_torque_offset_is_the_feed_forward_and_no_feedback(own: OwnLoopRig) -> None:
    own.until(AxisPhase.TRACKING)
    own.tick(100)
    law, state = own.rig.state.law, own.rig.state
    assert law.feedback_torque_Nm == law.observer_torque_Nm == 0.0
    assert law.inertia_torque_Nm != 0.0
    parts = law.inertia_torque_Nm + law.gravity_torque_Nm + law.friction_torque_Nm
    assert state.command_torque_Nm == pytest.approx(parts)
    own.rig.axis.velocity_command.feeds_torque = 0
    own.tick(50)
    assert state.command_torque_Nm == 0.0


def test_the_target_follows_the_joint_until_the_drive_is_enabled(csp: OwnLoopRig) -> None:
    csp.tick(2)
    assert csp.rig.phase == AxisPhase.WAITING
    assert csp.targets[-1] == csp.rig.joint.position_rad
    csp.rig.joint.position_rad += 1e-4  # turned by hand
    csp.tick()
    assert csp.targets[-1] == csp.rig.joint.position_rad
    here = csp.rig.joint.position_rad
    csp.until(AxisPhase.APPROACH)
    csp.tick(20)
    first = csp.enabled.index(True)
    assert csp.targets[first] == pytest.approx(here, abs=COUNT_rad)
    jerks = np.abs(np.diff(csp.targets[first:], n=2))
    assert jerks.max() <= ACCELERATION_radps2 * PERIOD_s**2 * (1.0 + 1e-6)


def test_an_enabled_joint_that_sinks_before_the_motion_begins_is_held(csp: OwnLoopRig) -> None:
    """Of an arm: its drive is on, another one is not yet; a target that followed would let it go."""
    csp.rig.axis.sequence.moved_max_rad = 0.0
    csp.tick(2)
    state = csp.rig.state
    state.phase, csp.rig.joint.drive_state = AxisPhase.ENABLING, DriveState.ENABLED
    csp.rig.sample.drive_state = DriveState.ENABLED
    before = float(state.command_position_rad)
    state.measured_position_rad += 0.01
    command_axis(csp.rig.axis, state, np.zeros((1, 5)), csp.rig.sample, csp.rig.command, 1)
    assert csp.rig.command.position_rad == before
    csp.rig.sample.drive_state = DriveState.STARTING  # the twin: not yet on
    command_axis(csp.rig.axis, state, np.zeros((1, 5)), csp.rig.sample, csp.rig.command, 1)
    assert csp.rig.command.position_rad == pytest.approx(before + 0.01)


@pytest.mark.parametrize("record", ["velocity_command.lead_s", "law.inertia_kgm2"])
def test_a_target_or_an_offset_that_is_not_finite_never_reaches_the_drive(csp: OwnLoopRig, record: str) -> None:
    csp.until(AxisPhase.TRACKING)
    csp.tick(20)
    part, field = record.split(".")
    setattr(getattr(csp.rig.axis, part), field, math.nan)
    csp.tick()
    assert csp.rig.state.fault == Fault.NOT_FINITE
    assert csp.rig.phase == AxisPhase.QUICK_STOPPING
    assert all(math.isfinite(x) for x in csp.targets)
    assert (csp.rig.command.velocity_radps, csp.rig.command.torque_Nm) == (0.0, 0.0)


@pytest.mark.parametrize(("torque_Nm", "trips"), [(59.9, False), (60.0, True), (-60.0, True)])
def test_a_drive_at_its_torque_limit_for_too_long_trips(own: OwnLoopRig, torque_Nm: float, trips: bool) -> None:
    own.until(AxisPhase.TRACKING)
    own.rig.sample.torque_Nm = torque_Nm
    own.tick(21)
    assert own.rig.state.fault == (Fault.TORQUE_SATURATED if trips else Fault.NONE)


def test_after_an_overrun_the_target_goes_on_from_where_the_drive_stands(csp: OwnLoopRig) -> None:
    csp.until(AxisPhase.TRACKING)
    csp.tick(300)
    moving = float(csp.rig.state.command_velocity_radps)
    assert abs(moving) > 3.0 * ACCELERATION_radps2 * PERIOD_s
    csp.rig.tick(elapsed_cycles=5)
    assert abs(csp.rig.state.command_velocity_radps) <= ACCELERATION_radps2 * PERIOD_s * (1.0 + 1e-9)


# --- on the wire ---
def csp_layout(node: int) -> PdoLayout:
    return dataclasses.replace(
        own_layout(node, velocity=True), rpdo_length=8, torque_offset_at=6, offset_rpdo_id=0x300 + node
    )


@pytest.fixture
def port(settings_of_virtual_joint: Any) -> Any:
    settings = dataclasses.replace(settings_of_virtual_joint, encoder_direction=-1, velocity_share=0.5)
    port = new_port(settings, 0.0605, 1000, position=True, layout=csp_layout(settings.node))[0]
    port.state, port.last_counts = State.OPERATION_ENABLED, 777
    return port


def sent(port: Any, request: int = DriveRequest.ENABLE, position_rad: float = 0.25 * math.tau) -> tuple[int, int, int]:
    """(607A, 60B2, 60B1)"""
    frames = new(Frame, FRAME_SLOTS)
    command = new(Command)[0]
    command.position_rad, command.velocity_radps, command.torque_Nm = position_rad, 0.5 * math.tau, 30.0
    command.request = request
    end_cycle(port, frames, new(Sample)[0], command)
    main, offset = frames[SLOT_RPDO], frames[SLOT_OFFSET]
    assert (main.length, offset.length, offset.can_id) == (8, 4, 0x300 + port.node)
    return get_i32(main.payload, 2), get_i16(main.payload, 6), get_i32(offset.payload, 0)


def test_position_torque_offset_and_the_share_of_the_speed(port: Any) -> None:
    assert sent(port) == (-524288 // 4, round(30.0 / 0.0605), -524288 // 4)


@pytest.mark.parametrize("request_", [DriveRequest.OFF, DriveRequest.QUICK_STOP])
def test_unless_enabled_and_asked_for_the_target_is_where_the_joint_stands(port: Any, request_: DriveRequest) -> None:
    assert sent(port, request_) == (777, 0, 0)
    port.state = State.SWITCHED_ON
    assert sent(port) == (777, 0, 0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e300])
def test_a_position_that_is_no_number_is_where_the_joint_stands(port: Any, bad: float) -> None:
    assert sent(port, position_rad=bad)[0] == 777


def test_counts_that_run_over_go_on_where_the_drive_counts(port: Any) -> None:
    turns = 2**31 / 524288 + 1.0
    assert sent(port, position_rad=-turns * math.tau)[0] == -(2**31) + 524288


def test_without_offsets_there_is_one_frame(settings_of_virtual_joint: Any) -> None:
    port = new_port(settings_of_virtual_joint, 0.0605, 1000, velocity=True)[0]
    port.state = State.OPERATION_ENABLED
    frames, command = new(Frame, FRAME_SLOTS), new(Command)[0]
    command.request, command.velocity_radps = DriveRequest.ENABLE, 1.0
    end_cycle(port, frames, new(Sample)[0], command)
    assert (frames[SLOT_RPDO].length, frames[SLOT_OFFSET].can_id) == (6, 0)


# --- a joint that is not rigid ---
@pytest.mark.parametrize(("encoders", "twisted"), [(Encoders.MOTOR, True), (Encoders.LINK, False)])
def test_of_a_flexible_joint_the_target_of_the_motors_encoder_is_ahead_by_the_twist(
    csp: OwnLoopRig, encoders: Encoders, twisted: bool
) -> None:
    law = csp.rig.axis.law
    law.kind, law.feed_forward = ControllerKind.FLEXIBLE_JOINT, FeedForward.NONE
    law.flexible.encoders = encoders
    law.flexible.motor_inertia_kgm2, law.flexible.link_inertia_kgm2 = 1.0, law.inertia_kgm2 - 1.0
    law.flexible.compliance_radpNm = 1e-4
    law.flexible.motor_velocity = law.flexible.link_velocity = csp.rig.axis.velocity
    csp.until(AxisPhase.TRACKING)
    csp.tick(200)
    state = csp.rig.state
    twist_rad = 1e-4 * (law.inertia_kgm2 - 1.0) * state.reference.acceleration_radps2
    assert abs(twist_rad) > 1e-6
    ahead_rad = state.reference.position_rad + 2e-3 * (
        state.reference.velocity_radps + 1e-3 * state.reference.acceleration_radps2
    )
    expected_rad = ahead_rad + (twist_rad if twisted else 0.0)
    assert csp.targets[-1] == pytest.approx(expected_rad, abs=2e-7)
