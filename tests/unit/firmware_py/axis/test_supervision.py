"""A run and what watches it: each fault just beyond its limit, suspension, readings that stand still."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.cycle import SUSPENDED_MIN_NS, WORDS, Word, slept_ns
from jointctl.firmware_py.records import AxisState
from jointctl.firmware_py.safety import check_suspension, reaction_to
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.sequence import reset_axis
from jointctl.firmware_py.states import AxisPhase, DriveRequest, DriveState, Fault, Reaction
from tests.axis_on_stub_joint import NewRig, assert_fault
from tests.unit.firmware_py.stub_loop import Loop


# --- what ends a run, each just beyond its limit ---
def late_client(run: Any, silent_ms: int) -> None:
    stream = run.axis.stream
    stream.client_timeout_ns = 100_000_000
    stream.alive_ns[0] = run.state.slot_ns + 1_000_000 - silent_ms * 1_000_000
    run.tick()


def late_heartbeat(run: Any, age_cycles: int) -> None:
    run.axis.limits.heartbeat_age_max_cycles = 600
    run.sample.heartbeat_age_cycles = age_cycles
    run.tick()


def reports(name: str) -> Callable[[Any, int], None]:
    """A sample whose field has that value, or a supervisor of that age."""

    def disturb(run: Any, value: int) -> None:
        setattr(run if name.startswith("supervisor") else run.sample, name, value)
        run.tick()

    return disturb


def missing_samples(run: Any, count: int) -> None:
    for _ in range(count):
        run.tick(fresh=False)


def every_nth_sample(run: Any, n: int) -> None:
    """A delay of (n - 1) / 2 periods in the mean, which the check of the margins has not seen."""
    for cycle in range(60):
        run.tick(fresh=cycle % n == 0)


def every_nth_command(run: Any, n: int) -> None:
    """The others are not sent, although SYNC is: the drive holds a torque for n periods."""
    for cycle in range(60):
        run.sample.bus_errors = cycle % n
        run.tick()


def every_nth_slot(run: Any, n: int) -> None:
    for _ in range(20):
        run.tick(n)


def shows(run: Any, drive_state: int) -> None:
    run.joint.drive_state = DriveState(drive_state)
    run.tick()


@pytest.mark.trips(Fault.STALE_SAMPLE, "(Fault.STALE_SAMPLE, missing_samples, 5, 6)")
@pytest.mark.stays(Fault.STALE_SAMPLE, "(Fault.STALE_SAMPLE, missing_samples, 5")
@pytest.mark.trips(Fault.STALE_SAMPLE, "(Fault.STALE_SAMPLE, every_nth_sample, 2, 3)")
@pytest.mark.stays(Fault.STALE_SAMPLE, "(Fault.STALE_SAMPLE, every_nth_sample, 2")
@pytest.mark.trips(Fault.BUS_ERROR, '(Fault.BUS_ERROR, reports("bus_errors"), 5, 6)')
@pytest.mark.stays(Fault.BUS_ERROR, '(Fault.BUS_ERROR, reports("bus_errors"), 5')
@pytest.mark.trips(Fault.BUS_ERROR, "(Fault.BUS_ERROR, every_nth_command, 2, 3)")
@pytest.mark.stays(Fault.BUS_ERROR, "(Fault.BUS_ERROR, every_nth_command, 2")
@pytest.mark.trips(Fault.DRIVE_SILENT, "(Fault.DRIVE_SILENT, late_heartbeat, 600, 601)")
@pytest.mark.stays(Fault.DRIVE_SILENT, "(Fault.DRIVE_SILENT, late_heartbeat, 600")
@pytest.mark.trips(Fault.SUPERVISOR_LOST, '(Fault.SUPERVISOR_LOST, reports("supervisor_age_cycles"), 10, 11)')
@pytest.mark.stays(Fault.SUPERVISOR_LOST, '(Fault.SUPERVISOR_LOST, reports("supervisor_age_cycles"), 10')
@pytest.mark.trips(Fault.CLIENT_SILENT, "(Fault.CLIENT_SILENT, late_client, 100, 101)")
@pytest.mark.stays(Fault.CLIENT_SILENT, "(Fault.CLIENT_SILENT, late_client, 100")
@pytest.mark.trips(Fault.OVERRUN, "(Fault.OVERRUN, lambda run, skipped: run.tick(skipped + 1), 8, 9)")
@pytest.mark.stays(Fault.OVERRUN, "(Fault.OVERRUN, lambda run, skipped: run.tick(skipped + 1), 8")
@pytest.mark.trips(Fault.OVERRUN, "(Fault.OVERRUN, every_nth_slot, 2, 3)")
@pytest.mark.stays(Fault.OVERRUN, "(Fault.OVERRUN, every_nth_slot, 2")
@pytest.mark.trips(Fault.DRIVE_FAULT, "(Fault.DRIVE_FAULT, shows, DriveState.ENABLED, DriveState.FAULT)")
@pytest.mark.parametrize(
    ("fault", "disturb", "inside", "beyond"),
    [
        (Fault.STALE_SAMPLE, missing_samples, 5, 6),
        (Fault.STALE_SAMPLE, every_nth_sample, 2, 3),
        (Fault.BUS_ERROR, reports("bus_errors"), 5, 6),
        (Fault.BUS_ERROR, every_nth_command, 2, 3),
        (Fault.DRIVE_SILENT, late_heartbeat, 600, 601),
        (Fault.SUPERVISOR_LOST, reports("supervisor_age_cycles"), 10, 11),
        (Fault.CLIENT_SILENT, late_client, 100, 101),
        (Fault.OVERRUN, lambda run, skipped: run.tick(skipped + 1), 8, 9),
        (Fault.OVERRUN, every_nth_slot, 2, 3),
        (Fault.DRIVE_RESTARTED, reports("restarts"), 0, 1),
        (Fault.DRIVE_FAULT, shows, DriveState.ENABLED, DriveState.FAULT),
        (Fault.DRIVE_FAULT, shows, DriveState.ENABLED, DriveState.FAULT_BRAKING),
    ],
)  # fmt: skip
@pytest.mark.parametrize("phase", [AxisPhase.APPROACH, AxisPhase.TRACKING])
def test_just_beyond_its_limit_a_fault_ends_the_run_and_just_inside_it_goes_on(
    rig: NewRig, phase: AxisPhase, fault: Fault, disturb: Callable[[Any, int], None], inside: int, beyond: int
) -> None:
    """Which reaction belongs to which fault: test_safety.py; in every phase, values and codes: _edges.py."""
    run = rig(0.0).until(phase).run(2)
    disturb(run, inside)
    assert (run.phase, run.state.fault) == (phase, Fault.NONE)
    run = rig(0.0).until(phase).run(2)
    disturb(run, beyond)
    run.joint.drive_state = min(run.joint.drive_state, DriveState.FAULT)  # a drive that brakes in a fault ends in it
    assert_fault(run, fault, Reaction(reaction_to(fault, phase)))


# --- the computer slept ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("slept_ns", "trips"), [(0, False), (SUSPENDED_MIN_NS // 2, False), (200_000_000, True)])
@pytest.mark.parametrize("set_by", ["supervisor", "loop"])
def test_the_loop_compares_its_clock_with_one_that_does_not_stand_still(
    axis_constants: Any, slept_ns: int, trips: bool, set_by: str
) -> None:
    loop = Loop(axis_constants)
    if set_by == "supervisor":
        now_ns = time.monotonic_ns()
        loop.words[Word.ASLEEP_NS] = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - now_ns
    else:
        loop.run(1)  # the first cycle takes the difference as it is
    loop.run(30)
    assert loop.state[0].fault == Fault.NONE
    loop.words[Word.ASLEEP_NS] -= slept_ns  # as if the difference had grown
    loop.run(30)
    assert loop.state[0].fault == (Fault.SUSPENDED if trips else Fault.NONE)
    if trips:
        assert loop.state[0].fault_value == pytest.approx(slept_ns * 1e-9, rel=0.05)
        assert loop.command[0].request != DriveRequest.ENABLE


def asleep_so_far_ns() -> int:
    """CLOCK_BOOTTIME - CLOCK_MONOTONIC, from the two of a thousand readings that lie closest together."""
    tried = []
    for _ in range(1000):
        before_ns = time.monotonic_ns()
        boot_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        after_ns = time.monotonic_ns()
        tried.append((after_ns - before_ns, boot_ns - (before_ns + after_ns) // 2))
    return min(tried)[1]


@pytest.mark.trips(Fault.SUSPENDED, "(100_000, True)")
@pytest.mark.stays(Fault.SUSPENDED, "(-100_000, False)")
@pytest.mark.parametrize(("past_ns", "trips"), [(-100_000, False), (100_000, True)])
def test_standby_just_shorter_and_just_longer_than_it_can_be_measured(
    axis_constants: Any, past_ns: int, trips: bool
) -> None:
    """A processor that is lost between the two readings makes the sleep look shorter: one good pair is enough."""
    state, words, timespec = new(AxisState)[0], np.zeros(WORDS, np.int64), np.zeros(2, np.int64)
    reset_axis(axis_constants[0], state)
    words[Word.ASLEEP_NS] = asleep_so_far_ns() - SUSPENDED_MIN_NS - past_ns
    for _ in range(200):
        if slept_ns(words, timespec) > SUSPENDED_MIN_NS:
            check_suspension(state, 1.0)
    assert state.fault == (Fault.SUSPENDED if trips else Fault.NONE)


# --- the drive's own heartbeat ---------------------------------------------------------------------------------


def test_samples_that_stay_away_as_well_are_the_cause_that_is_told(rig: NewRig) -> None:
    run = rig(0.0).until(AxisPhase.TRACKING).run(5)
    run.axis.limits.heartbeat_age_max_cycles = 3
    run.sample.heartbeat_age_cycles = 4
    run.state.sample_age_cycles = run.axis.limits.sample_age_max_cycles
    run.tick(fresh=False)
    assert run.state.fault == Fault.STALE_SAMPLE


# --- readings that stand still -----------------------------------------------------------------------------------


@pytest.mark.parametrize("every", [1, 2, 5])
@pytest.mark.parametrize("stuck", [True, False])
def test_a_stuck_reading_with_holes_is_noticed_all_the_same(rig: NewRig, every: int, stuck: bool) -> None:
    """Each hole began the watch anew: a stuck encoder behind a bus with losses was not seen.  The twin moves."""
    run = rig(0.0)
    run.axis.limits.frozen_max_rad = 0.01
    run.axis.limits.saturation_max_cycles = run.axis.limits.sample_age_max_cycles = 1 << 40
    run.until(AxisPhase.TRACKING).run(20)
    if stuck:
        run.joint.step = lambda *_: None
    for cycle in range(100):
        run.tick(fresh=cycle % every == 0)
        if run.state.fault:
            break
    assert run.state.fault == (Fault.POSITION_FROZEN if stuck else Fault.NONE)
    assert (run.phase is AxisPhase.TRACKING) is not stuck
