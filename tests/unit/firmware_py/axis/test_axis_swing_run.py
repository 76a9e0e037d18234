"""The limit-cycle monitor in a run: the reading at rest, noise, notices, and the phases in which it watches."""

from __future__ import annotations

import math
from typing import Any

import pytest

from jointctl.firmware_py.observers import note_rest, reset_swing, torque_noise
from jointctl.firmware_py.records import AxisState, Sample, Swing, SwingConstants, SwingState
from jointctl.firmware_py.safety import ERROR_SWINGS, TORQUE_SWINGS, check_swing, take_notice, watch_rest
from jointctl.firmware_py.schema import dtype_of, new
from jointctl.firmware_py.sequence import reset_axis
from jointctl.firmware_py.states import AxisPhase, CommandKind, Fault, Notice, Reaction
from tests.axis_on_stub_joint import NewRig, assert_fault, assert_well

SLOWEST = 300


# --- rest and noise ---
def test_the_greatest_step_at_rest_is_kept_until_the_joint_moves() -> None:
    state = new(SwingState)[0]
    note_rest(state, 1.0, True)
    assert (state.rest_rad, state.rest_position_rad) == (0.0, 1.0)
    for position in (1.0, 1.25, 1.125, 1.0):
        note_rest(state, position, False)
    assert (state.rest_rad, state.rest_position_rad) == (0.25, 1.0)
    note_rest(state, 2.0, True)
    assert (state.rest_rad, state.rest_position_rad) == (0.0, 2.0)


@pytest.mark.parametrize(("past", "noisy"), [(0.0, False), (1e-9, True)])
def test_the_mean_change_of_the_command(past: float, noisy: bool) -> None:
    constants, state = new(SwingConstants)[0], new(SwingState)[0]
    constants.noise_gain, constants.noise_Nm = 0.25, 4.375 - past
    assert not torque_noise(constants, state, 10.0)
    assert state.noise_Nm == 2.5
    assert torque_noise(constants, state, -10.0) == noisy
    assert state.noise_Nm == 4.375
    constants.noise_Nm = 0.5
    assert torque_noise(constants, state, 0.0)  # that of a small joint
    constants.noise_Nm = 0.0
    assert not torque_noise(constants, state, 100.0)  # not watched


def test_a_run_begins_without_a_swing() -> None:
    state = new(SwingState)
    state.view(dtype="u1")[:] = 1
    reset_swing(state[0])
    for name in dtype_of(SwingState).names or ():
        if name in ("torque", "error", "faint_error", "rest_error"):
            assert all(state[0][name][field] == 0 for field in dtype_of(Swing).names or ())
        else:
            assert state[0][name] == 0


def test_a_run_begins_without_a_notice(axis: Any) -> None:
    state = new(AxisState)[0]
    state.notices, state.swing.torque.count, state.law.learning.stopped = 3, 3, 1
    reset_axis(axis, state)
    assert (state.notices, state.swing.torque.count, state.law.learning.stopped) == (0, 0, 0)


# --- in the axis ---
@pytest.mark.parametrize("phase", list(AxisPhase))
def test_a_swing_counts_while_the_law_is_active(axis: Any, state: Any, phase: AxisPhase) -> None:
    axis.limits.swing.torque_Nm, axis.limits.swing.slowest_cycles = 60.0, SLOWEST
    active = AxisPhase.APPROACH <= phase <= AxisPhase.RAMPING
    state.phase, state.reference.acceleration_radps2 = phase, 10.0  # 21 Nm of inertia torque
    for i in range(TORQUE_SWINGS):
        assert (state.fault, state.phase) == (Fault.NONE, phase)
        state.cycle += 25
        check_swing(axis, state, 21.0 + 60.5 * (i % 2 == 0))
    if active:
        assert (state.fault, state.fault_value, state.fault_drive_error) == (Fault.LIMIT_CYCLE, 20.0, 0)
        assert (state.phase, state.reaction) == (AxisPhase.QUICK_STOPPING, Reaction.QUICK_STOP)
    else:
        assert (state.fault, state.phase, state.swing.torque.count) == (Fault.NONE, phase, 0)


def test_what_the_desired_acceleration_asks_for_is_no_swing(axis: Any, state: Any) -> None:
    axis.limits.swing.torque_Nm, axis.limits.swing.slowest_cycles = 60.0, SLOWEST
    state.phase = AxisPhase.TRACKING
    for i in range(20):
        state.cycle += 25
        state.reference.acceleration_radps2 = 50.0 * (-1.0) ** i
        state.stream.torque_Nm = 70.0 * (-1.0) ** i  # a set-point's, on top of the law's
        check_swing(axis, state, 175.0 * (-1.0) ** i)
    assert state.fault == Fault.NONE
    assert state.swing.torque.count == 0


def test_the_error_is_measured_minus_desired(axis: Any, state: Any) -> None:
    axis.limits.swing.error_rad, axis.limits.swing.slowest_cycles = 0.002, SLOWEST
    state.phase = AxisPhase.TRACKING
    for i in range(ERROR_SWINGS):
        assert state.fault == Fault.NONE
        state.cycle += 25
        state.reference.position_rad = 0.1 * i
        state.measured_position_rad = 0.1 * i + 0.0021 * (-1.0) ** i
        check_swing(axis, state, 0.0)
    assert state.fault == Fault.LIMIT_CYCLE
    twin = new(AxisState)[0]
    reset_axis(axis, twin)
    twin.phase = AxisPhase.TRACKING
    for i in range(30):  # the joint swings as the reference does
        twin.cycle += 25
        twin.reference.position_rad = twin.measured_position_rad = 0.1 * (-1.0) ** i
        check_swing(axis, twin, 0.0)
    assert twin.fault == Fault.NONE


@pytest.mark.parametrize("phase", [AxisPhase.WAITING, AxisPhase.ENABLING])
@pytest.mark.parametrize(("speed_radps", "stands"), [(0.02, True), (-0.0201, False), (math.nan, False)])
def test_rest_is_watched_while_the_power_is_off(
    axis: Any, state: Any, phase: AxisPhase, speed_radps: float, stands: bool
) -> None:
    sample = new(Sample)[0]
    state.phase, state.velocity.velocity_radps = phase, speed_radps
    sample.position_rad = 0.5
    watch_rest(axis, state, sample)
    assert state.swing.rest_rad == 0.0  # the first sample
    state.velocity.primed, sample.position_rad = 1, 0.5625
    watch_rest(axis, state, sample)
    waiting = phase is AxisPhase.WAITING
    assert state.swing.rest_rad == (0.0625 if stands and waiting else 0.0)
    assert state.swing.rest_position_rad == (0.5625 if waiting else 0.0)


@pytest.mark.parametrize("phase", list(AxisPhase))
def test_notices_are_taken_while_there_is_torque_and_once(axis: Any, state: Any, phase: AxisPhase) -> None:
    swing = axis.limits.swing
    swing.noise_Nm, swing.noise_gain = 3.0, 0.5
    state.phase, state.command_torque_Nm = phase, 10.0
    take_notice(axis, state, 3.0)
    powered = AxisPhase.APPROACH <= phase <= AxisPhase.RELEASING
    assert state.notices == (Notice.TORQUE_NOISE if powered else 0)
    take_notice(axis, state, 20.0)
    assert state.swing.noise_told_Nm == (3.5 if powered else 0.0)
    assert state.swing.noise_Nm == (6.75 if powered else 0.0)
    state.law.learning.stopped = 1
    take_notice(axis, state, 10.0)
    assert state.notices == (Notice.TORQUE_NOISE | Notice.LEARNING_OFF if powered else 0)
    state.notices = 0
    state.swing.noise_Nm = 0.0
    take_notice(axis, state, 10.0)
    assert state.notices == (Notice.LEARNING_OFF if powered else 0)


def shaken(rig: NewRig, torque_Nm: float, *, kind: CommandKind = CommandKind.TORQUE) -> Any:
    """A run whose torque changes its sign each 25 cycles."""
    run = rig(0.0)
    run.axis.limits.torque_rate_max_Nmps, run.axis.command_kind = 1e9, kind
    run.axis.trajectory.amplitude_rad = 0.0
    run.axis.limits.swing.torque_Nm, run.axis.limits.swing.slowest_cycles = 60.0, SLOWEST
    run.axis.limits.saturation_max_cycles = 1 << 40
    run.until(AxisPhase.TRACKING).run(20)
    for cycle in range(200):
        if run.phase != AxisPhase.TRACKING:
            break
        side = torque_Nm * (-1.0) ** (cycle // 25)
        run.axis.law.kind = run.axis.law.kp = run.axis.law.kv = 0.0
        run.axis.law.gravity_Nm, run.axis.law.gravity_zero_rad = side, -math.pi / 2.0
        run.sample.torque_Nm = side
        run.joint.load_Nm = -run.command.torque_Nm
        run.tick()
    return run


@pytest.mark.parametrize("kind", list(CommandKind))
@pytest.mark.parametrize(("torque_Nm", "trips"), [(30.5, True), (29.5, False)])
def test_a_run_whose_torque_swings_ends_with_the_quick_stop(
    rig: NewRig, torque_Nm: float, trips: bool, kind: CommandKind
) -> None:
    """The command, or in velocity mode the torque that the drive measures."""
    run = shaken(rig, torque_Nm, kind=kind)
    if trips:
        assert run.state.fault_value == 20.0
        assert_fault(run, Fault.LIMIT_CYCLE, Reaction.QUICK_STOP)
    else:
        assert_well(run)


def test_a_limit_cycle_at_the_limit_is_told_as_that_and_not_as_saturation(rig: NewRig) -> None:
    run = shaken(rig, 1000.0)
    assert_fault(run, Fault.LIMIT_CYCLE, Reaction.QUICK_STOP)


@pytest.mark.parametrize(
    ("size_rad", "half_cycles", "speed_radps", "hunts"),
    [(0.002, 100, 0.0, True), (0.002, 100, 1e-3, False), (0.0009, 100, 0.0, False), (0.002, 321, 0.0, False)],
)
def test_an_error_that_swings_at_rest_is_noticed_however_slow(
    axis: Any, state: Any, size_rad: float, half_cycles: int, speed_radps: float, hunts: bool
) -> None:
    axis.limits.swing.hunting_rad, axis.limits.swing.slowest_cycles = 0.001, 20
    state.phase, state.reference.velocity_radps = AxisPhase.TRACKING, speed_radps
    for half in range(8):
        for _ in range(half_cycles):
            state.measured_position_rad = state.reference.position_rad + (half % 2) * size_rad
            take_notice(axis, state, 0.0)
            state.cycle += 1
        if half < 6:  # two halves tell where it turns
            assert state.notices == 0
    assert state.notices == (Notice.HUNTS if hunts else 0)
