"""One cycle for every front end, and for any number of axes."""

from __future__ import annotations

import ast
import math
import os
from collections import deque
from typing import Any

import can
import numpy as np
import pytest

from jointctl.drivers.can.virtual_bus import decode, encode
from jointctl.drivers.canopen.cyclic import CanopenPort
from jointctl.firmware_py.axis import MOVES_AGAIN, _brake
from jointctl.firmware_py.cycle import (
    HISTOGRAM_BINS,
    WORDS,
    Clock,
    CycleMemory,
    Exchange,
    Histogram,
    Slot,
    Word,
    step_cycle,
)
from jointctl.firmware_py.records import AxisConstants, AxisState, Command, LogRecord, Sample
from jointctl.firmware_py.safety import ASTRAY_SHARE, SINKS_SHARE
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.sequence import reset_axis
from jointctl.firmware_py.states import AxisPhase, DriveRequest, DriveState, Fault, StopRequest
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.lockstep import LockstepJoint
from jointctl.tools.session import portable_loop
from jointctl.tools.session.loop_memory import SharedBlock
from tests.axis_on_stub_joint import small_axis_constants
from tests.places import ROOT

PERIOD_NS = 1_000_000
RING = 7  # no multiple of the axes


class Arm:
    """Two axes at rest on drives that obey at once, on an idle computer; stepped in plain Python."""

    def __init__(self) -> None:
        self.constants, self.state = new(AxisConstants, 2), new(AxisState, 2)
        self.constants[:] = small_axis_constants()[0]
        for axis in range(2):
            self.constants[axis].sequence.supervisor_max_cycles = 10
            self.constants[axis].trajectory.amplitude_rad = 0.0
            reset_axis(self.constants[axis], self.state[axis])
        self.memory = CycleMemory(
            self.constants, self.state, np.zeros((2, 1, 5)), new(Sample, 2), new(Command, 2), np.zeros(WORDS, np.int64),
            new(LogRecord, RING), np.zeros((len(Histogram), HISTOGRAM_BINS), np.int64), np.zeros(2, np.int64),
        )  # fmt: skip
        self.slept_ns = 0
        self.now_ns = 0
        self.sends = 0
        self.ended = False
        self.cycles = 0
        self.slow_to_prepare = [0, 0]  # cycles until each drive obeys
        self.slow_to_enable = [0, 0]
        self.moving_rad = [0.0, 0.0]  # in each cycle
        self.silent = [False, False]
        self.torque_off = [False, False]  # by its STO input

    def _receive(self, _: None, samples: Any, now_ns: int, until_ns: int) -> int:
        for axis, (sample, command) in enumerate(zip(samples, self.memory.command, strict=True)):
            if self.silent[axis]:
                continue
            sample.count += 1
            sample.time_ns = now_ns + 1500
            sample.position_rad += self.moving_rad[axis]
            prepare, enable = (command.request == request for request in (DriveRequest.PREPARE, DriveRequest.ENABLE))
            self.slow_to_prepare[axis] -= prepare
            self.slow_to_enable[axis] -= enable
            sample.drive_state = DriveState.OFF
            if self.torque_off[axis]:
                continue
            if prepare or enable:
                sample.drive_state = DriveState.STARTING
            if (prepare or enable) and self.slow_to_prepare[axis] < 0:
                sample.drive_state = DriveState.PREPARED
                if enable and self.slow_to_enable[axis] < 0:
                    sample.drive_state = DriveState.ENABLED
        return 1500

    def _send(self, _: None, samples: Any, commands: Any) -> int:
        self.sends += 1
        return 0

    def run(self, cycles: int) -> Arm:
        exchange = Exchange(self._receive, self._send, None)
        clock = Clock(lambda _: self.now_ns + 2000, lambda *_: self.slept_ns)
        for _ in range(cycles):
            self.now_ns += PERIOD_NS
            self.memory.words[Word.SUPERVISOR_NS] = self.now_ns
            slot = Slot(PERIOD_NS, self.now_ns, self.now_ns, 0, 1, self.now_ns + 600_000)
            self.cycles += 1
            self.ended = step_cycle(self.memory, exchange, clock, slot)
            if self.ended:
                break
        return self

    @property
    def phases(self) -> list[AxisPhase]:
        return [AxisPhase(int(phase)) for phase in self.state.phase]

    @property
    def faults(self) -> list[Fault]:
        return [Fault(int(fault)) for fault in self.state.fault]


def test_two_axes_run_in_one_cycle_and_both_are_logged() -> None:
    arm = Arm().run(300)
    assert arm.phases == [AxisPhase.TRACKING] * 2
    words, memory = arm.memory.words, arm.memory
    assert (words[Word.HEAD], arm.sends) == (600, 300)  # two records, one exchange
    assert words[Word.LOOP_NS] == arm.now_ns + 2000
    newest = [memory.ring[record % RING] for record in (598, 599)]
    assert [int(record.time_ns) for record in newest] == [arm.now_ns] * 2
    assert [int(record.cycle) for record in newest] == [300, 300]
    assert list(memory.histograms.sum(axis=1)) == [300, 600, 300, 0]  # of each axis a round trip
    assert memory.histograms[1, 1] == 600


def test_a_bus_that_gets_its_sync_later_is_counted_and_its_samples_taken_as_of_then() -> None:
    arm = Arm().run(100)
    arm.memory.sample[1].sync_late_ns = 7_300
    arm.run(20)
    assert list(arm.memory.histograms[Histogram.SYNC_SPREAD].nonzero()[0]) == [7]
    assert arm.memory.histograms[Histogram.SYNC_SPREAD, 7] == 20
    assert list(arm.state.sample_late_s) == [0.0, pytest.approx(7.3e-6)]


def test_the_motion_of_one_axis_is_over_the_others_brake_with_it_and_the_loop_ends_with_the_last() -> None:
    arm = Arm().run(100)
    arm.constants[1].trajectory.duration_s = 0.5
    arm.run(900)
    assert arm.ended
    assert (arm.phases, arm.faults) == ([AxisPhase.FINISHED] * 2, [Fault.NONE] * 2)


@pytest.mark.parametrize("tripped", [0, 1])
def test_a_fault_of_one_axis_ramps_the_other_down_in_the_same_cycle(tripped: int) -> None:
    arm = Arm().run(300)
    arm.memory.sample[tripped].drive_error = 0x2310
    arm.memory.sample[tripped].restarts = 1
    arm.run(1)
    other = 1 - tripped
    assert (arm.faults[tripped], arm.faults[other]) == (Fault.DRIVE_RESTARTED, Fault.NONE)
    assert arm.phases[other] == AxisPhase.RAMPING
    assert arm.memory.command[tripped].request == DriveRequest.OFF
    assert arm.memory.command[other].request == DriveRequest.ENABLE  # it brakes along its ramp
    arm.run(500)
    assert arm.ended
    assert arm.faults[other] == Fault.NONE


@pytest.mark.parametrize(
    ("request_", "phase"),
    [(StopRequest.RAMP, AxisPhase.RAMPING), (StopRequest.QUICK_STOP, AxisPhase.QUICK_STOPPING),
     (StopRequest.OFF, AxisPhase.DISABLING)],
)  # fmt: skip
def test_a_stop_reaches_every_axis_in_the_same_cycle(request_: StopRequest, phase: AxisPhase) -> None:
    arm = Arm().run(300)
    arm.memory.words[Word.STOP] = request_
    assert arm.run(1).phases == [phase] * 2


@pytest.mark.parametrize("slow", [0, 1])
def test_no_axis_has_torque_before_all_drives_are_enabled(slow: int) -> None:
    arm = Arm()
    arm.slow_to_enable[slow] = 20
    while arm.cycles < 200 and AxisPhase.ENABLING not in arm.phases:
        arm.run(1)
    assert arm.phases == [AxisPhase.ENABLING] * 2  # asked for in the same cycle
    waited = 0
    while AxisPhase.ENABLING in arm.phases:
        assert arm.phases == [AxisPhase.ENABLING] * 2
        assert list(arm.memory.command.torque_Nm) == [0.0, 0.0]
        waited += 1
        arm.run(1)
    assert waited > 20
    assert min(arm.phases) >= AxisPhase.APPROACH
    assert arm.state[0].trajectory_s == arm.state[1].trajectory_s  # and both motions began in the same cycle


@pytest.mark.parametrize("step", ["slow_to_prepare", "slow_to_enable"])
@pytest.mark.parametrize("slow", [0, 1])
def test_a_drive_that_never_enables_keeps_the_torque_from_the_other(slow: int, step: str) -> None:
    arm = Arm()
    getattr(arm, step)[slow] = 1 << 30
    phases, torques, enabled = set(), 0.0, False
    while arm.cycles < 20_000 and not arm.ended:
        phases.add(arm.run(1).phases[1 - slow])
        torques += float(np.abs(arm.memory.command.torque_Nm).sum())
        enabled |= arm.memory.sample.drive_state[1 - slow] == DriveState.ENABLED
    assert arm.ended
    assert enabled == (step == "slow_to_enable")  # one that is not prepared keeps the brake of the other closed
    assert arm.faults[slow] == Fault.ENABLE_TIMEOUT
    assert arm.faults[1 - slow] == Fault.NONE
    assert torques == 0.0
    assert not phases & {AxisPhase.APPROACH, AxisPhase.TRACKING, AxisPhase.RAMPING}


def sinking(late: int, share: float) -> Arm:
    """The drive of `late` does not enable; the other joint has moved by `share` of what a joint may sink by."""
    arm = Arm()
    arm.slow_to_enable[late] = 1 << 30
    for axis in range(2):
        arm.constants[axis].limits.position_jump_max_rad = 1.0
    while arm.memory.sample.drive_state[1 - late] != DriveState.ENABLED:
        arm.run(1)
    arm.run(5)
    arm.memory.sample[1 - late].position_rad += share * SINKS_SHARE * arm.constants[0].limits.following_error_max_rad
    return arm


@pytest.mark.parametrize("late", [0, 1])
@pytest.mark.parametrize("share", [1.001, -1.001])
def test_an_enabled_joint_that_sinks_is_laid_to_the_drive_that_it_waits_for(late: int, share: float) -> None:
    """All are off in the same cycle."""
    arm = sinking(late, share)
    arm.run(1)
    assert arm.faults == [Fault.ENABLE_TIMEOUT if axis == late else Fault.NONE for axis in range(2)]
    assert list(arm.memory.command.request) == [DriveRequest.OFF] * 2
    assert list(arm.memory.command.torque_Nm) == [0.0, 0.0]


@pytest.mark.parametrize("late", [0, 1])
@pytest.mark.parametrize("share", [0.999, -0.999])
def test_its_twin_that_sags_a_little_waits_and_begins_with_the_other(late: int, share: float) -> None:
    arm = sinking(late, share)
    arm.run(3)
    assert (arm.phases, arm.faults) == ([AxisPhase.ENABLING] * 2, [Fault.NONE] * 2)
    arm.slow_to_enable[late] = 0
    arm.run(3)
    assert (arm.phases, arm.faults) == ([AxisPhase.APPROACH] * 2, [Fault.NONE] * 2)


@pytest.mark.parametrize("late", [0, 1])
@pytest.mark.parametrize(
    ("enabled", "silent_cycles", "fault"),
    [
        (False, 2, Fault.ENABLE_TIMEOUT),
        (False, 3, Fault.STALE_SAMPLE),
        (True, 2, Fault.NONE),
        (True, 3, Fault.STALE_SAMPLE),
    ],
)
def test_a_joint_that_is_waited_for_since_its_samples_stay_away_is_named_for_that(
    late: int, enabled: bool, silent_cycles: int, fault: Fault
) -> None:
    """A drive that was enabled when it was last heard may be so still."""
    arm = sinking(late, 0.0)
    if enabled:
        arm.memory.sample[late].drive_state = DriveState.ENABLED
    arm.silent[late] = True
    arm.run(silent_cycles - 1)
    arm.memory.sample[1 - late].position_rad += 0.1
    arm.run(1)
    assert arm.faults == [fault if axis == late else Fault.NONE for axis in range(2)]


@pytest.mark.parametrize("astray", [0, 1])
@pytest.mark.parametrize(("share", "shaken"), [(0.9, 0), (1.1, 1)])
def test_a_joint_that_is_astray_shakes_the_other_and_not_itself(astray: int, share: float, shaken: int) -> None:
    arm = Arm().run(300)
    state, limits = arm.state[astray], arm.constants[astray].limits
    state.reference.position_rad = state.measured_position_rad
    state.measured_position_rad += share * ASTRAY_SHARE * limits.following_error_max_rad
    arm.run(1)
    assert [int(arm.state[axis].shaken) for axis in (astray, 1 - astray)] == [0, shaken]


@pytest.mark.parametrize("fell", [0, 1])
def test_a_drive_that_falls_back_before_all_are_enabled_takes_the_other_with_it(fell: int) -> None:
    arm = Arm()
    arm.slow_to_enable[fell] = 1 << 30
    while arm.memory.sample.drive_state[1 - fell] != DriveState.ENABLED:
        arm.run(1)
    arm.slow_to_prepare[fell] = 1 << 30
    assert [int(request) for request in arm.run(1).memory.command.request] == [DriveRequest.PREPARE] * 2
    assert arm.run(1).memory.sample.drive_state[1 - fell] == DriveState.PREPARED


@pytest.mark.parametrize("step", ["slow_to_prepare", "slow_to_enable"])
@pytest.mark.parametrize("fell", [0, 1])
def test_a_drive_that_falls_back_to_off_ends_the_start_of_all(fell: int, step: str) -> None:
    """As by its STO input, which is closed again at once: that must not begin a motion."""
    arm = Arm()
    getattr(arm, step)[fell] = 1 << 30
    while arm.memory.sample.drive_state[1 - fell] not in (DriveState.PREPARED, DriveState.ENABLED):
        arm.run(1)
    arm.torque_off[fell] = True
    arm.run(1)
    assert arm.faults == [Fault.DRIVE_NOT_ENABLED if axis == fell else Fault.NONE for axis in range(2)]
    arm.torque_off[fell], getattr(arm, step)[fell] = False, 0
    requests = set()
    while arm.cycles < 20_000 and not arm.ended:
        requests |= {int(request) for request in arm.run(1).memory.command.request}
    assert (arm.ended, requests) == (True, {DriveRequest.OFF})


@pytest.mark.parametrize("moving", [0, 1])
def test_no_drive_is_enabled_while_another_joint_moves(moving: int) -> None:
    arm = Arm()
    arm.moving_rad[moving] = 1e-4
    requests = set()
    while arm.cycles < 20_000 and not arm.ended:
        requests |= {int(request) for request in arm.run(1).memory.command.request}
    assert arm.ended
    assert arm.faults == [Fault.NOT_AT_STANDSTILL if axis == moving else Fault.NONE for axis in range(2)]
    assert requests == {DriveRequest.OFF}


@pytest.mark.parametrize(("allowed", "faulty"), [(1, 1), (0, 0)])
def test_joints_that_never_stand_at_once_do_not_wait_for_a_moment_in_which_they_do(allowed: int, faulty: int) -> None:
    """They were enabled in the first cycle in which all readings happened to be slow, however long after the start.

    Its twin waits for the supervisor, as long as it takes.
    """
    arm = Arm()
    arm.constants["sequence"]["may_enable"] = allowed
    for turn in range(20):
        arm.moving_rad = [0.0, 0.0]
        for step in range(12):
            arm.moving_rad[turn % 2] = 2e-4 * (-1) ** step
            arm.run(1)
    assert [fault for fault in arm.faults if fault] == [Fault.NOT_AT_STANDSTILL] * faulty
    assert arm.ended == bool(faulty)


@pytest.mark.parametrize("phase", [AxisPhase.WAITING, AxisPhase.ENABLING])
def test_a_fault_before_the_torque_switches_every_axis_off_in_the_same_cycle(phase: AxisPhase) -> None:
    arm = Arm()
    arm.slow_to_enable = [1 << 30, 30]
    while arm.cycles < 100 and (arm.phases != [phase] * 2 or arm.state[0].phase_cycle < 2):
        arm.run(1)
    arm.memory.sample[1].restarts += 1
    arm.run(1)
    assert arm.faults == [Fault.NONE, Fault.DRIVE_RESTARTED]
    assert list(arm.memory.command.request) == [DriveRequest.OFF] * 2


@pytest.mark.parametrize("late", [0, 1])
def test_a_joint_that_stands_keeps_its_torque_until_the_other_one_stands(late: int) -> None:
    arm = Arm().run(300)
    arm.memory.words[Word.STOP] = StopRequest.RAMP
    arm.moving_rad[late] = 2.0 * float(arm.constants[late].limits.standstill_radps) * PERIOD_NS * 1e-9
    arm.run(60)
    assert arm.phases == [AxisPhase.RAMPING] * 2
    arm.moving_rad[late] = 0.0
    while arm.phases == [AxisPhase.RAMPING] * 2 and arm.cycles < 2000:
        arm.run(1)
    assert arm.phases == [AxisPhase.RELEASING] * 2
    assert arm.run(500).ended
    assert arm.faults == [Fault.NONE] * 2


def standing(late: int, times: float, steps: int) -> Arm:
    """Both have stood; then the reading of `late` moves so many `standstill_radps`, for so many cycles."""
    arm = Arm().run(300)
    arm.memory.words[Word.STOP] = StopRequest.RAMP
    while not arm.state.ready.all() and arm.cycles < 2000:
        arm.run(1)
    assert arm.phases == [AxisPhase.RAMPING] * 2
    for _ in range(steps):
        arm.state[late].held_back = 1
        arm.state[late].velocity.velocity_radps = times * arm.constants[late].limits.standstill_radps
        arm.state[late].measured_position_rad += 1e-6  # no flicker
        _brake(arm.constants[late], arm.state[late], 1)
    return arm


@pytest.mark.parametrize("late", [0, 1])
def test_joints_that_have_stood_release_their_torque_in_the_same_cycle_whatever_one_reads_in_it(late: int) -> None:
    arm = Arm().run(300)
    arm.memory.words[Word.STOP] = StopRequest.RAMP
    while not arm.state.ready.all() and arm.cycles < 2000:
        arm.run(1)
    arm.moving_rad[late] = 0.5 * PERIOD_NS * 1e-9  # far above its standstill
    arm.run(1)
    assert arm.state[late].velocity.velocity_radps > MOVES_AGAIN * arm.constants[late].limits.standstill_radps
    assert arm.phases == [AxisPhase.RELEASING] * 2


@pytest.mark.parametrize("late", [0, 1])
@pytest.mark.parametrize(("times", "ready"), [(0.9, 1), (1.1, 1), (2.9, 1), (3.1, 0), (-3.1, 0), (math.nan, 0)])
def test_a_joint_that_has_stood_stays_ready_until_it_clearly_moves(late: int, times: float, ready: int) -> None:
    arm = standing(late, times, 20)
    assert (arm.state[late].ready, arm.state[late].phase) == (ready, AxisPhase.RAMPING)
    assert bool(arm.state[late].still_cycles > 0) is (abs(times) < 1.0)


@pytest.mark.parametrize("late", [0, 1])
def test_a_joint_that_never_comes_to_rest_does_not_hold_the_other_for_good(late: int) -> None:
    arm = Arm().run(300)
    arm.memory.words[Word.STOP] = StopRequest.RAMP
    for axis in range(2):
        arm.constants[axis].sequence.stop_max_cycles = 100
    arm.moving_rad[late] = 2.0 * float(arm.constants[late].limits.standstill_radps) * PERIOD_NS * 1e-9
    arm.run(102)
    assert arm.faults == [Fault.STOP_TIMEOUT if axis == late else Fault.NONE for axis in range(2)]
    assert arm.run(1000).ended
    assert arm.faults[1 - late] == Fault.NONE


@pytest.mark.parametrize(("slept_ns", "faults"), [(1_000_000, Fault.NONE), (1_000_001, Fault.SUSPENDED)])
def test_standby_stops_every_axis(slept_ns: int, faults: Fault) -> None:
    arm = Arm().run(300)
    arm.slept_ns = slept_ns
    assert arm.run(1).faults == [faults] * 2


@pytest.mark.parametrize("first", [0, 1])
def test_set_points_and_changes_count_once_they_have_come_for_every_axis(first: int) -> None:
    arm = Arm().run(5)
    for axis, expected in ((first, 0), (1 - first, 1)):
        arm.constants[axis].stream.written[0] = arm.constants[axis].change.order[0] = 1
        arm.run(1)
        for state in arm.state:
            assert (int(state.stream.written), int(state.change.order)) == (expected, expected)


# --- the front ends --------------------------------------------------------------------------------------------


CALLERS = {
    "sense_axis": {"firmware_py/cycle.py"}, "move_axis": {"firmware_py/cycle.py"},
    "command_axis": {"firmware_py/cycle.py"}, "write_log": {"firmware_py/cycle.py"},
    "check_suspension": {"firmware_py/cycle.py"}, "step_cycle": {"firmware_py/cycle.py", "hil/lockstep.py"},
    "run_cycles": {"firmware_py/cycle.py", "tools/session/portable_loop.py"},
}  # fmt: skip


def test_there_is_one_cycle() -> None:
    """The files of the program in which each function is called."""
    found: dict[str, set[str]] = {}
    for layer in ("firmware_py", "drivers", "hil", "tools"):
        for path in (ROOT / layer).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in CALLERS:
                    found.setdefault(node.func.id, set()).add(str(path.relative_to(ROOT)))
    assert found == CALLERS


class MemoryBus:
    """A python-can bus without a wire to a virtual drive, and the clock of the loop: it stands still in a cycle."""

    def __init__(self, joint: LockstepJoint) -> None:
        self._device = joint._virtual
        self.now_ns = joint.start_ns - PERIOD_NS
        self._looked = 0
        self._waiting: deque[bytes] = deque()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._waiting.extend(self._device.handle(encode(msg), self.now_ns))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        return decode(self._waiting.popleft(), 0.0, "") if self._waiting else None

    def monotonic_ns(self) -> int:
        self._looked += 1
        return self.now_ns + self._looked - 1

    def sleep_until_ns(self, deadline_ns: int, _: Any) -> None:
        self.now_ns, self._looked = deadline_ns, 0
        self._waiting.extend(self._device.advance(deadline_ns))


def test_the_portable_loop_and_lockstep_do_the_same_to_the_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compiled and in plain Python, frames moved in memory and over a python-can bus: one and the same cycle."""
    config = load_config(shipped_config("virtual"))
    joint = LockstepJoint(config.changed(trajectory__duration_s=0.5))
    expected = joint.run().log
    bus, block = MemoryBus(joint), SharedBlock.create(len(joint.table), CanopenPort)
    try:
        portable_loop.warm_up()
        monkeypatch.setattr(portable_loop, "time", bus)
        monkeypatch.setattr(portable_loop, "sleep_until_ns", bus.sleep_until_ns)
        block.table[:], block.constants[:], block.port[:] = joint.table, joint.constants(), joint._port
        reset_axis(block.constants[0], block.state[0])
        executed = portable_loop.run_portable_loop(bus, block, PERIOD_NS, 600_000, len(expected) + 10)
        found = block.ring[:executed].copy()
    finally:
        os.close(block.fd)
    assert executed == len(expected) > 2000
    assert found.phase[-1] == AxisPhase.FINISHED
    for name in expected.dtype.names:
        if name not in ("round_trip_ns", "work_ns"):  # looking at the clock takes 1 ns there
            assert np.array_equal(found[name], expected[name]), name
