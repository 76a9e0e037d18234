"""The limits of the loop: dense at every boundary, and properties that hold for any number whatever."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointctl.firmware_py.motion_records import Reference, TrajectoryConstants
from jointctl.firmware_py.records import LimitConstants
from jointctl.firmware_py.safety import (
    ROUNDING_rad,
    ROUNDING_radps,
    drive_fault,
    encoders_disagree,
    limit_position_rad,
    limited_torque_Nm,
    motion_fault,
    reaction_to,
    reference_fault,
    within,
)
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, DriveState, Fault, LimitSource, Reaction, TrajectoryKind
from jointctl.firmware_py.trajectory import NO_TABLE, reference_at, trapezoid_times_s

NOT_FINITE = (math.nan, math.inf, -math.inf)


def limit_constants() -> Any:
    limits = new(LimitConstants)[0]
    limits.position_min_rad, limits.position_max_rad, limits.velocity_max_radps = -0.5, 0.7, 1.5
    limits.torque_max_Nm, limits.torque_rate_max_Nmps, limits.following_error_max_rad = 60.0, 20000.0, 0.05
    return limits


LIMITS = limit_constants()
# fault, lower and upper limit, and the function of one value that reports it
Check = Callable[[float], int]
LIMITED: list[tuple[str, Fault, float, float, Check]] = [
    ("position", Fault.POSITION_LIMIT, -0.5, 0.7, lambda v: motion_fault(LIMITS, v, 0.0, 0.0)),
    ("velocity", Fault.VELOCITY_LIMIT, -1.5, 1.5, lambda v: motion_fault(LIMITS, 0.0, v, 0.0)),
    ("error", Fault.FOLLOWING_ERROR, -0.05, 0.05, lambda v: motion_fault(LIMITS, 0.0, 0.0, v)),
    (
        "reference position",
        Fault.REFERENCE_LIMIT,
        -0.5 - ROUNDING_rad,
        0.7 + ROUNDING_rad,
        lambda v: reference_fault(LIMITS, v, 0.0, 0.0, 0.0, 2.0, 0.1),
    ),
    (
        "reference velocity",
        Fault.REFERENCE_LIMIT,
        -1.5 - ROUNDING_radps,
        1.5 + ROUNDING_radps,
        lambda v: reference_fault(LIMITS, 0.0, v, 0.0, 0.0, 1e9, 0.0),
    ),
]


@pytest.mark.parametrize(("name", "fault", "low", "high", "check"), LIMITED, ids=[c[0] for c in LIMITED])
def test_each_limit_is_dense_at_its_boundary(name: str, fault: Fault, low: float, high: float, check: Check) -> None:
    for limit, outward in ((low, -math.inf), (high, math.inf)):
        outside = inside = limit
        assert check(limit) == Fault.NONE, f"{name} exactly at {limit}"
        for _ in range(20):
            outside, inside = math.nextafter(outside, outward), math.nextafter(inside, 0.0)
            assert check(outside) == fault
            assert check(inside) == Fault.NONE
        for k in range(1, 200):
            assert check(limit + math.copysign(k * 1e-4, outward)) == fault
            assert check(limit - math.copysign(k * 1e-4, outward)) == Fault.NONE
    for k in range(101):
        assert check(min(low + (high - low) * k / 100.0, high)) == Fault.NONE


@pytest.mark.parametrize(("name", "fault", "low", "high", "check"), LIMITED, ids=[c[0] for c in LIMITED])
@pytest.mark.parametrize("value", NOT_FINITE)
def test_what_is_not_finite_is_outside_every_limit(
    name: str, fault: Fault, low: float, high: float, check: Check, value: float
) -> None:
    assert check(value) == fault


def test_position_is_reported_before_velocity_before_error() -> None:
    assert motion_fault(LIMITS, 9.0, 9.0, 9.0) == Fault.POSITION_LIMIT
    assert motion_fault(LIMITS, 0.0, 9.0, 9.0) == Fault.VELOCITY_LIMIT
    assert motion_fault(LIMITS, 0.0, 0.0, 9.0) == Fault.FOLLOWING_ERROR


def test_a_limit_that_is_not_a_number_allows_nothing() -> None:
    assert not within(0.0, math.nan, 1.0)
    assert not within(0.0, -1.0, math.nan)


@pytest.mark.parametrize("state", DriveState)
@pytest.mark.parametrize("expected", [True, False])
def test_drive_state(state: DriveState, expected: bool) -> None:
    if state in (DriveState.FAULT, DriveState.FAULT_BRAKING):
        fault = Fault.DRIVE_FAULT
    elif expected and state is not DriveState.ENABLED:
        fault = Fault.DRIVE_NOT_ENABLED
    else:
        fault = Fault.NONE
    assert drive_fault(int(state), expected, 0) == fault
    for restarts in (1, 2, -1):
        assert drive_fault(int(state), expected, restarts) == Fault.DRIVE_RESTARTED


POWERED = (AxisPhase.APPROACH, AxisPhase.TRACKING, AxisPhase.RAMPING, AxisPhase.RELEASING)
BY_RAMP = (Fault.REFERENCE_LIMIT, Fault.SUPERVISOR_LOST, Fault.OVERRUN, Fault.CLIENT_SILENT)
BY_POWER_OFF = (Fault.DRIVE_FAULT, Fault.DRIVE_NOT_ENABLED, Fault.DRIVE_RESTARTED)


@pytest.mark.parametrize("fault", Fault)
def test_reaction_for_every_fault_in_every_phase(fault: Fault) -> None:
    for phase in AxisPhase:
        if fault is Fault.NONE:
            expected = Reaction.NONE
        elif phase not in POWERED or fault in BY_POWER_OFF:
            expected = Reaction.OFF
        elif fault in BY_RAMP:
            expected = Reaction.RAMP
        else:
            expected = Reaction.QUICK_STOP
        assert reaction_to(int(fault), int(phase)) == expected, phase


STEP_Nm = 20.0  # 20000 Nm/s in 1 ms


@pytest.mark.parametrize(("limit", "last", "sign"), [(60.0, 50.0, 1.0), (60.0, -50.0, -1.0)])
def test_torque_limit_is_dense_at_its_boundary(limit: float, last: float, sign: float) -> None:
    for k in range(-100, 101):
        asked = sign * (limit + k * 0.01)
        sent, finite = limited_torque_Nm(LIMITS, asked, last, 1e-3)
        assert finite
        assert sent == (asked if k <= 0 else sign * limit)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("last", [0.0, 13.0, -13.0])
def test_rate_limit_is_dense_at_its_boundary(sign: float, last: float) -> None:
    for k in range(-100, 101):
        asked = last + sign * (STEP_Nm + k * 0.01)
        sent, _ = limited_torque_Nm(LIMITS, asked, last, 1e-3)
        assert sent == (asked if k <= 0 else last + sign * STEP_Nm)


def test_the_limit_comes_before_the_rate() -> None:
    """The order shows where the last torque is above a limit that was lowered: the rate is kept on the way down."""
    assert limited_torque_Nm(LIMITS, 1000.0, 55.0, 1e-3) == (60.0, True)
    assert limited_torque_Nm(LIMITS, 1000.0, -60.0, 1e-3) == (-40.0, True)
    assert limited_torque_Nm(LIMITS, 0.0, 100.0, 1e-3) == (80.0, True)
    assert limited_torque_Nm(LIMITS, 1000.0, 100.0, 1e-3) == (80.0, True)


@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize("last", [0.0, 60.0, -60.0])
def test_not_finite_is_zero_at_once_and_said(value: float, last: float) -> None:
    assert limited_torque_Nm(LIMITS, value, last, 1e-3) == (0.0, False)
    # the twin: the greatest finite number is only limited
    greatest = math.copysign(1.7976931348623157e308, value)
    sent, finite = limited_torque_Nm(LIMITS, greatest, last, 1e-3)
    assert finite
    assert abs(sent - last) <= STEP_Nm


@settings(max_examples=300, deadline=None)
@given(
    asked=st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=1, max_size=40),
    limit=st.floats(0.1, 1e4),
    rate=st.floats(0.0, 1e6),
)
def test_whatever_is_asked_torque_and_step_stay_within(asked: list[float], limit: float, rate: float) -> None:
    limits = new(LimitConstants)[0]
    limits.torque_max_Nm, limits.torque_rate_max_Nmps = limit, rate
    last = 0.0
    for value in asked:
        sent, finite = limited_torque_Nm(limits, value, last, 1e-3)
        assert finite is math.isfinite(value)
        assert abs(sent) <= limit
        if finite:
            assert abs(sent - last) <= rate * 1e-3 * (1.0 + 1e-12) + 1e-12
        else:
            assert sent == 0.0
        last = sent


@settings(max_examples=300, deadline=None)
@given(value=st.floats(-59.0, 59.0), last=st.floats(-60.0, 60.0))
def test_what_is_within_all_limits_is_passed_unchanged(value: float, last: float) -> None:
    sent, finite = limited_torque_Nm(LIMITS, value, last, 1e-3)
    assert finite
    if abs(value - last) < STEP_Nm:
        assert sent == value


@settings(max_examples=200, deadline=None)
@given(value=st.floats(allow_nan=True, allow_infinity=True), low=st.floats(-5.0, 0.0), high=st.floats(0.0, 5.0))
def test_within_is_the_closed_interval(value: float, low: float, high: float) -> None:
    assert within(value, low, high) is (low <= value <= high)


@pytest.mark.trips(Fault.REFERENCE_LIMIT, "(1e-9, Fault.REFERENCE_LIMIT)")
@pytest.mark.stays(Fault.REFERENCE_LIMIT, "(-1e-9, Fault.NONE)")
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("past_rad", "fault"), [(-1e-9, Fault.NONE), (1e-9, Fault.REFERENCE_LIMIT)])
def test_a_reference_must_be_able_to_brake_inside_the_limits(sign: float, past_rad: float, fault: Fault) -> None:
    velocity, brake, ahead = 1.2, 4.0, 0.002
    edge = LIMITS.position_max_rad if sign > 0.0 else LIMITS.position_min_rad
    position = edge - sign * (velocity * ahead + velocity**2 / (2.0 * brake) - past_rad)
    for gaining in (0.0, 3.0):  # what it gains in speed until it is braked is the acceleration limit's business
        assert reference_fault(LIMITS, position, sign * velocity, sign * gaining, 0.0, brake, ahead) == fault
    # moving away from that limit, the same place is no danger
    assert reference_fault(LIMITS, position, -sign * 0.1, 0.0, 0.0, brake, ahead) == Fault.NONE


def test_no_jerk_takes_a_reference_far_beyond_a_limit() -> None:
    velocity, brake, ahead, limit = 1.2, 4.0, 0.002, LIMITS.position_max_rad
    way = velocity * ahead + velocity**2 / (2.0 * brake)
    for jerk, past_rad, fault in (
        (1e9, 1.01e-5, Fault.REFERENCE_LIMIT), (1e9, 0.99e-5, Fault.NONE), (-100.0, 0.99 * 8e-7, Fault.NONE),
        (-100.0, 1.01 * 8e-7, Fault.REFERENCE_LIMIT), (math.nan, 1.0, Fault.REFERENCE_LIMIT),
    ):  # fmt: skip
        assert reference_fault(LIMITS, limit - way + past_rad, velocity, 0.0, jerk, brake, ahead) == fault
    assert reference_fault(LIMITS, limit + 2.0 * ROUNDING_rad, 0.0, 0.0, 1e9, brake, ahead) == Fault.REFERENCE_LIMIT


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("past_rad", "fault"), [(-1e-9, Fault.NONE), (1e-9, Fault.REFERENCE_LIMIT)])
@pytest.mark.parametrize("velocity", [1.2, 0.02])  # 0.02: at rest before it would be braked
def test_a_reference_that_slows_down_is_braked_from_where_it_is_then(
    sign: float, past_rad: float, fault: Fault, velocity: float
) -> None:
    slowing, brake, ahead = 20.0, 4.0, 0.002
    later = max(velocity - slowing * ahead, 0.0)
    way = (velocity**2 - later**2) / (2.0 * slowing) + later**2 / (2.0 * brake)
    edge = LIMITS.position_max_rad if sign > 0.0 else LIMITS.position_min_rad
    position = edge - sign * (way - past_rad)
    assert reference_fault(LIMITS, position, sign * velocity, -sign * slowing, 0.0, brake, ahead) == fault


@pytest.mark.parametrize("beyond_rad", [0.0, 1e-9])
@pytest.mark.parametrize("kind", [TrajectoryKind.MIN_JERK, TrajectoryKind.TRAPEZOID, TrajectoryKind.SINE])
def test_a_motion_may_end_at_a_limit_and_no_farther(kind: TrajectoryKind, beyond_rad: float) -> None:
    """As the cycles see it: a trapezoid with half the deceleration of the brake at most, the others with all of it."""
    random = np.random.default_rng(230)
    limits, c, reference, brake = limit_constants(), new(TrajectoryConstants)[0], new(Reference)[0], 20.0
    for limit, distance, hard in zip(
        random.uniform(-3.0, 3.0, 30), random.uniform(0.01, 3.0, 30), random.uniform(0.1, 1.0, 30), strict=True
    ):
        limits.position_min_rad, limits.position_max_rad, limits.velocity_max_radps = limit - 10.0, limit, 100.0
        acceleration = hard * brake * (0.5 if kind is TrajectoryKind.TRAPEZOID else 1.0)
        c.kind, c.start_rad, c.target_rad = kind, limit - distance, limit + beyond_rad
        c.speed_radps, c.acceleration_radps2 = 0.3 * math.sqrt(distance * acceleration), acceleration
        c.amplitude_rad, c.offset_rad = 0.5 * distance, limit + beyond_rad - 0.5 * distance
        c.omega_radps = math.sqrt(2.0 * acceleration / distance)
        ramp_s, cruise_s = trapezoid_times_s(distance, c.speed_radps, acceleration)
        c.move_s = math.sqrt(5.7736 * distance / acceleration)
        trapezoid_s, crest_s = 2.0 * ramp_s + cruise_s, 0.5 * math.pi / c.omega_radps
        end_s = {TrajectoryKind.MIN_JERK: c.move_s, TrajectoryKind.TRAPEZOID: trapezoid_s}.get(kind, crest_s)
        found = set()
        for t_s in (*np.linspace(0.0, end_s, 100), *(end_s + random.uniform(0.0, 1e-3) + 1e-3 * np.arange(-30, 5))):
            reference_at(c, NO_TABLE, 0, float(t_s), reference)
            motion = reference.position_rad, reference.velocity_radps, reference.acceleration_radps2
            found.add(reference_fault(limits, *map(float, motion), float(reference.jerk_radps3), brake, 2e-3))
        if beyond_rad == 0.0:
            assert found == {Fault.NONE}, (limit, distance, hard)
        else:
            assert Fault.REFERENCE_LIMIT in found


# --- two encoders ---
def limits_of_two_encoders() -> Any:
    limits = new(LimitConstants)[0]
    limits.position_min_rad, limits.position_max_rad = -1.0, 3.0
    limits.disagreement_max_rad, limits.twist_radpNm = 0.01, 1e-4
    return limits


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(("torque_Nm", "allowed_rad"), [(0.0, 0.01), (50.0, 0.015), (-50.0, 0.015)])
def test_disagreement_is_dense_at_its_boundary(sign: float, torque_Nm: float, allowed_rad: float) -> None:
    limits = limits_of_two_encoders()
    for share in (0.0, 0.5, 0.99, 0.9999):
        assert not encoders_disagree(limits, 0.0, sign * share * allowed_rad, torque_Nm)
    for share in (1.0001, 1.01, 2.0, 1e6, float("inf"), float("nan")):
        assert encoders_disagree(limits, 0.0, sign * share * allowed_rad, torque_Nm)
    assert encoders_disagree(limits, float("nan"), 0.0, torque_Nm)


def test_at_exactly_the_limit_they_still_agree_and_of_two_equally_far_the_one_of_the_law_counts() -> None:
    limits = new(LimitConstants)[0]
    limits.disagreement_max_rad = 0.25
    assert not encoders_disagree(limits, 0.5, 0.25, 0.0)
    limits.limit_source = LimitSource.BOTH
    limits.position_min_rad, limits.position_max_rad = -1.0, 1.0
    assert limit_position_rad(limits, 0.5, -0.5) == 0.5


def test_one_encoder_never_disagrees() -> None:
    limits = limits_of_two_encoders()
    limits.disagreement_max_rad = 0.0
    assert not encoders_disagree(limits, 0.0, 1.0, 0.0)


@pytest.mark.parametrize(
    ("source", "law_rad", "other_rad", "seen_rad"),
    [
        (LimitSource.LAW, 0.5, 9.0, 0.5),
        (LimitSource.OTHER, 0.5, 9.0, 9.0),
        (LimitSource.BOTH, 1.2, 2.9, 2.9),  # the middle is 1
        (LimitSource.BOTH, -0.95, 2.9, -0.95),
        (LimitSource.BOTH, 3.1, 1.0, 3.1),
    ],
)
def test_which_position_the_limits_see(source: LimitSource, law_rad: float, other_rad: float, seen_rad: float) -> None:
    limits = limits_of_two_encoders()
    limits.limit_source = source
    assert limit_position_rad(limits, law_rad, other_rad) == seen_rad


def test_of_both_a_position_that_is_no_number_is_seen() -> None:
    limits = limits_of_two_encoders()
    limits.limit_source = LimitSource.BOTH
    assert math.isnan(limit_position_rad(limits, 0.0, float("nan")))
