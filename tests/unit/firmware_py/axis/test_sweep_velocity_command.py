"""The velocity command of the axis and 60FF on the wire."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.can.frames import Frame
from jointctl.drivers.canopen.cia import State
from jointctl.drivers.canopen.cyclic import FRAME_SLOTS, SLOT_RPDO, end_cycle, get_i32, velocity_units
from jointctl.drivers.canopen.pdo import new_port
from jointctl.firmware_py.axis import limited_velocity_radps
from jointctl.firmware_py.records import Command, LimitConstants, Sample
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import (
    AxisPhase,
    CommandKind,
    DriveRequest,
    Fault,
    StopRequest,
)
from tests.axis_on_stub_joint import OwnLoopRig

PERIOD_s = 1e-3


@pytest.fixture
def limits() -> Any:
    record = new(LimitConstants)[0]
    record.velocity_max_radps = 2.0
    return record


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("wanted", "sent"), [(1.999999, 1.999999), (2.0, 2.0), (math.nextafter(2.0, 3.0), 2.0), (5.0, 2.0), (1e300, 2.0)]
)
def test_the_velocity_limit_is_inclusive(limits: Any, sign: float, wanted: float, sent: float) -> None:
    assert limited_velocity_radps(limits, 1e9, sign * wanted, 0.0, PERIOD_s) == (sign * sent, True)


@pytest.mark.parametrize(
    ("wanted", "sent"), [(1.009, 1.009), (1.01, 1.01), (1.0100001, 1.01), (0.5, 0.99), (9.0, 1.01)]
)
def test_the_acceleration_limit_holds_from_the_last_command(limits: Any, wanted: float, sent: float) -> None:
    found, finite = limited_velocity_radps(limits, 10.0, wanted, 1.0, PERIOD_s)
    assert finite
    assert found == pytest.approx(sent, abs=1e-12)


def test_after_an_overrun_the_step_may_be_as_much_longer(limits: Any) -> None:
    assert limited_velocity_radps(limits, 10.0, 2.0, 1.0, 3.0 * PERIOD_s)[0] == pytest.approx(1.03)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_zero_at_once(limits: Any, bad: float) -> None:
    assert limited_velocity_radps(limits, 10.0, bad, 1.0, PERIOD_s) == (0.0, False)


@pytest.fixture
def velocity(rig: Callable[..., Any]) -> OwnLoopRig:
    return OwnLoopRig(rig(0.05), CommandKind.VELOCITY, position_gain_ps=5.0, acceleration_max_radps2=60.0)


def test_a_joint_is_tracked_stopped_and_disabled_by_velocity_alone(velocity: OwnLoopRig) -> None:
    velocity.until(AxisPhase.TRACKING)
    velocity.tick(500)
    error_rad = velocity.rig.state.measured_position_rad - velocity.rig.state.reference.position_rad
    assert abs(error_rad) < 2e-3
    assert velocity.commands[-1] == pytest.approx(velocity.rig.state.reference.velocity_radps, abs=0.01)
    velocity.rig.stop = StopRequest.RAMP
    velocity.until(AxisPhase.FINISHED)
    assert velocity.rig.state.fault == Fault.NONE
    assert set(velocity.rig.torques_Nm) == {0.0}
    assert np.max(np.abs(np.diff(velocity.commands))) <= 60.0 * PERIOD_s + 1e-12


def test_nothing_is_commanded_before_the_drive_is_enabled_and_after_release(velocity: OwnLoopRig) -> None:
    velocity.until(AxisPhase.APPROACH)
    assert set(velocity.commands[:-1]) == {0.0}
    velocity.tick(50)
    velocity.rig.stop = StopRequest.QUICK_STOP
    velocity.tick(1)
    assert velocity.rig.phase == AxisPhase.QUICK_STOPPING
    assert velocity.commands[-1] == 0.0
    assert velocity.rig.command.request == DriveRequest.QUICK_STOP


def test_a_velocity_that_is_not_finite_stops_the_joint(velocity: OwnLoopRig) -> None:
    velocity.until(AxisPhase.TRACKING)
    velocity.rig.axis.velocity_command.position_gain_ps = math.nan
    velocity.tick(1)
    assert velocity.rig.state.fault == Fault.NOT_FINITE
    assert velocity.commands[-1] == 0.0


def test_its_twin_a_velocity_of_an_enormous_but_finite_gain_is_limited(velocity: OwnLoopRig) -> None:
    velocity.until(AxisPhase.TRACKING)
    before_radps = velocity.commands[-1]
    velocity.rig.axis.velocity_command.position_gain_ps = 1e300
    velocity.tick(1)
    assert velocity.rig.state.fault == Fault.NONE
    assert abs(velocity.commands[-1] - before_radps) <= 60.0 * PERIOD_s + 1e-12


@pytest.mark.parametrize(("torque_Nm", "trips"), [(59.9, False), (-59.9, False), (60.0, True), (-60.0, True)])
def test_a_drive_at_the_torque_limit_for_too_long_trips(velocity: OwnLoopRig, torque_Nm: float, trips: bool) -> None:
    velocity.until(AxisPhase.TRACKING)
    velocity.rig.sample.torque_Nm = torque_Nm
    velocity.tick(20)
    assert velocity.rig.state.fault == Fault.NONE
    velocity.tick(1)
    assert velocity.rig.state.fault == (Fault.TORQUE_SATURATED if trips else Fault.NONE)


@pytest.mark.parametrize(("limit_share", "trips"), [(1.0 - 1e-9, True), (1.0, False)])
def test_a_joint_that_does_not_follow_trips(velocity: OwnLoopRig, limit_share: float, trips: bool) -> None:
    """It stands still while the reference moves on evenly: the error of each cycle is known before."""
    velocity.until(AxisPhase.TRACKING)
    rig = velocity.rig
    for _ in range(100):
        rig.tick()
    assert rig.state.fault == Fault.NONE
    at_rad = float(rig.sample.position_rad)
    reference = rig.axis.trajectory
    next_rad = reference.amplitude_rad * math.sin(reference.omega_radps * (rig.state.trajectory_s + PERIOD_s))
    rig.axis.limits.following_error_max_rad = abs(at_rad - next_rad) * limit_share
    rig.tick()
    assert rig.state.fault == (Fault.FOLLOWING_ERROR if trips else Fault.NONE)
    rig.axis.limits.following_error_max_rad = 0.2
    for _ in range(2000):
        if rig.state.fault:
            break
        rig.tick()
    assert rig.state.fault == Fault.FOLLOWING_ERROR


# --- 60FF ---
@pytest.fixture
def port(settings_of_virtual_joint: Any) -> Any:
    ports = new_port(settings_of_virtual_joint, 0.0605, 1000, velocity=True)
    ports[0].state = State.OPERATION_ENABLED
    return ports[0]


def rpdo(port: Any, velocity_radps: float, request: int = DriveRequest.ENABLE) -> Any:
    frames = new(Frame, FRAME_SLOTS)
    command = new(Command)[0]
    command.velocity_radps, command.torque_Nm, command.request = velocity_radps, 30.0, request
    end_cycle(port, frames, new(Sample)[0], command)
    return frames[SLOT_RPDO]


@pytest.mark.parametrize("turns_per_s", [0.25, -0.25, 1.0, -0.0001, 0.0])
def test_a_velocity_goes_out_in_counts_per_second(port: Any, turns_per_s: float) -> None:
    frame = rpdo(port, math.tau * turns_per_s)
    assert frame.length == 6
    assert get_i32(frame.payload, 2) == round(524288 * turns_per_s)


def test_the_target_is_zero_unless_enabled_and_asked_for(port: Any) -> None:
    assert get_i32(rpdo(port, 1.0).payload, 2) != 0
    for request in (DriveRequest.OFF, DriveRequest.QUICK_STOP):
        assert get_i32(rpdo(port, 1.0, request).payload, 2) == 0
    port.state = State.SWITCHED_ON
    assert get_i32(rpdo(port, 1.0).payload, 2) == 0


@pytest.mark.parametrize(
    ("velocity", "units"), [(1e9, 2147483647), (-1e9, -2147483647), (math.nan, 0), (math.inf, 0), (-math.inf, 0)]
)
def test_saturation_comes_before_the_cast(port: Any, velocity: float, units: int) -> None:
    assert velocity_units(port, velocity) == units


@pytest.mark.parametrize(
    ("unit", "per_radps"), [("r/min", 60.0 / math.tau * 121.0), ("0.1 r/min", 600.0 / math.tau * 121.0)]
)
def test_motor_speed_units_and_the_direction_of_the_encoder(
    settings_of_virtual_joint: Any, unit: str, per_radps: float
) -> None:
    import dataclasses

    settings = dataclasses.replace(settings_of_virtual_joint, velocity_unit=unit, encoder_direction=-1)
    port = new_port(settings, 0.0605, 1000, velocity=True)[0]
    assert velocity_units(port, 2.0) == round(-2.0 * per_radps)


def test_a_torque_port_sends_no_velocity(settings_of_virtual_joint: Any) -> None:
    port = new_port(settings_of_virtual_joint, 0.0605, 1000)[0]
    port.state = State.OPERATION_ENABLED
    frame = rpdo(port, 1.0)
    assert frame.length == 4
    assert get_i32(frame.payload, 2) == round(30.0 / 0.0605)
