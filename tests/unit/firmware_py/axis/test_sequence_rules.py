"""The phases of a run as pure functions: forward only, the stronger reaction wins, nothing is left from before."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import pytest

from jointctl.firmware_py.records import AxisState, Command
from jointctl.firmware_py.safety import enter, powered, react, trip
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.sequence import request_stop, reset_axis, write_command
from jointctl.firmware_py.states import AxisPhase, DriveRequest, Fault, Reaction, StopRequest

GOAL = {
    Reaction.RAMP: AxisPhase.RAMPING,
    Reaction.QUICK_STOP: AxisPhase.QUICK_STOPPING,
    Reaction.OFF: AxisPhase.DISABLING,
}


# written in a cycle before they are read in it
WRITTEN_FIRST = {
    "frozen_way_rad",
    "frozen_reference_rad",
    "frozen_at_rad",
    "sample_late_s",
    "measured_position_rad",
    "measured_torque_Nm",
}


def test_reset_leaves_nothing_of_the_run_before_behind(axis: Any, state: Any) -> None:
    used = new(AxisState)[0]
    plain = [name for name in used.dtype.names if used.dtype[name].kind in "if"]
    for name in plain:
        used[name] = 3
    inside = {
        "change": ("answered", "answer", "ramping", "ramp_s", "motion"),
        "stream": ("taken", "refused", "following", "torque_Nm"),
    }
    for record, names in inside.items():
        for name in names:
            used[record][name] = 3
    used.velocity.primed, used.law.lugre_deflection_rad, used.law.network.weights[:] = 1, 0.1, 5.0
    reset_axis(axis, used)
    assert [name for name in plain if name not in WRITTEN_FIRST and used[name] != 0] == []
    left = [(record, name) for record, names in inside.items() for name in names if used[record][name] != 0]
    assert left == []
    assert (used.velocity.primed, used.law.lugre_deflection_rad) == (0, 0.0)
    assert list(used.law.network.weights) == [0.01] * 15


@pytest.mark.parametrize("phase", AxisPhase)
def test_torque_is_only_commanded_between_enabled_and_released(phase: AxisPhase) -> None:
    assert powered(int(phase)) is (phase.name in ("APPROACH", "TRACKING", "RAMPING", "RELEASING"))


@pytest.mark.parametrize("phase", AxisPhase)
def test_react_goes_forward_or_stays(state: Any, phase: AxisPhase) -> None:
    for in_force, reaction in itertools.product(Reaction, Reaction):
        state.phase, state.reaction, state.phase_cycle = phase, in_force, 7
        react(state, int(reaction))
        if reaction <= in_force or phase is AxisPhase.FINISHED:
            assert (state.phase, state.reaction, state.phase_cycle) == (phase, in_force, 7)
        else:
            assert state.reaction == reaction
            assert state.phase == max(phase, GOAL[reaction])
            assert state.phase_cycle == (7 if state.phase == phase else 0)


@pytest.mark.parametrize("phase", [AxisPhase.ENABLING, AxisPhase.TRACKING, AxisPhase.RELEASING])
def test_the_first_fault_is_latched_and_the_reaction_never_weakens(axis: Any, state: Any, phase: AxisPhase) -> None:
    for first, second in itertools.product(Fault, Fault):
        reset_axis(axis, state)
        state.phase = phase
        trip(state, int(first), 1.0, 11)
        reaction, after_first = int(state.reaction), int(state.phase)
        trip(state, int(second), 2.0, 22)
        latched = first if first is not Fault.NONE else second
        expected = (0.0, 0) if latched is Fault.NONE else (1.0, 11) if first is not Fault.NONE else (2.0, 22)
        assert (state.fault, state.fault_value, state.fault_drive_error) == (latched, *expected)
        assert state.reaction >= reaction
        assert state.phase >= after_first


@pytest.mark.parametrize("phase", AxisPhase)
@pytest.mark.parametrize("stop", StopRequest)
def test_stop_request_in_every_phase(state: Any, phase: AxisPhase, stop: StopRequest) -> None:
    state.phase = phase
    request_stop(state, int(stop))
    assert state.fault == Fault.NONE
    if stop is StopRequest.NONE:
        goal = phase
    elif phase <= AxisPhase.ENABLING or stop is StopRequest.OFF:
        goal = AxisPhase.DISABLING
    else:
        goal = GOAL[Reaction(int(stop))]
    assert state.phase == max(phase, goal)


@pytest.mark.parametrize("phase", AxisPhase)
def test_request_of_every_phase(state: Any, phase: AxisPhase) -> None:
    state.phase_cycle = state.good_samples = 7
    enter(state, int(phase))
    assert (state.phase, state.phase_cycle, state.good_samples) == (phase, 0, 0)
    command = new(Command)[0]
    command.request = -1  # each phase says what it wants
    state.command_torque_Nm, state.command_velocity_radps = 1.5, 0.25
    write_command(state, command)
    assert (command.torque_Nm, command.velocity_radps) == (1.5, 0.25)
    if phase is AxisPhase.QUICK_STOPPING:
        assert command.request == DriveRequest.QUICK_STOP
    elif AxisPhase.ENABLING <= phase <= AxisPhase.RELEASING:
        assert command.request == DriveRequest.ENABLE
    else:
        assert command.request == DriveRequest.OFF


def test_phases_follow_each_other_in_a_whole_run(rig: Callable[..., Any]) -> None:
    run = rig(0.1)
    run.until(AxisPhase.TRACKING).run(20)
    run.stop = StopRequest.RAMP
    run.until(AxisPhase.FINISHED)
    order = [phase for phase, _ in itertools.groupby(run.phases)]
    assert order == [p for p in AxisPhase if p is not AxisPhase.QUICK_STOPPING]
