"""The fault engine itself: what becomes of frames, of the plant, and that no fault changes nothing at all."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, Fault, StopRequest
from jointctl.hil.canopen.records import PowerState
from jointctl.hil.faults import (
    MAX_FAULTS,
    FaultConstants,
    FaultKind,
    draw,
    fault_memory,
    fault_rows,
    is_active,
    no_faults,
    pass_frame,
    take_due,
)
from jointctl.hil.lockstep import TRUE_POWER_STATE, TRUE_ACTUATOR_Nm, TRUE_POSITION_rad
from jointctl.hil.virtual_bus import FRAME_SIZE, FrameQueue
from jointctl.tools.lockstep import LockstepJoint
from tests.made_faults import faults_of, one_fault

NODE = 1
MS = 1_000_000
EPOCH_ns = 7 * MS
STAMP = (7, 8, 9)  # when it was sent, see hil.bus_timing
SYNC, RPDO, OWN_HEARTBEAT = (0x80, 0), (0x201, 4), (0x77E, 1)
TPDO, HEARTBEAT, EMCY = (0x181, 8), (0x701, 1), (0x81, 8)
TO_DRIVE, TO_CONTROLLER = (SYNC, RPDO, OWN_HEARTBEAT), (TPDO, HEARTBEAT, EMCY)


class Wire:
    """One wire with these faults, whose time is the caller's."""

    def __init__(self, faults: Any) -> None:
        self.faults, self.memory = faults, fault_memory(faults, EPOCH_ns)
        self.count = 0

    def send(self, kind: tuple[int, int], to_drive: bool, at_ms: float = 0.0) -> list[bytes]:
        """What arrives at once when a frame of this identifier and length is sent; its data is a running number."""
        frame = np.zeros(FRAME_SIZE, np.uint8)
        frame[0], frame[1], frame[4] = kind[0] & 0xFF, kind[0] >> 8, kind[1]
        frame[5:8] = STAMP
        frame[8 : 8 + kind[1]] = self.count % 256
        self.count += 1
        queue = new(FrameQueue)
        pass_frame(self.faults, self.memory[0], frame, to_drive, NODE, EPOCH_ns + int(at_ms * MS), queue[0])
        return self._taken(queue)

    def due(self, to_drive: bool, at_ms: float) -> list[bytes]:
        queue = new(FrameQueue)
        take_due(self.memory[0], to_drive, EPOCH_ns + int(at_ms * MS), False, queue[0])
        return self._taken(queue)

    @staticmethod
    def _taken(queue: Any) -> list[bytes]:
        return [bytes(queue[0].frames[i]) for i in range(int(queue[0].count))]


LOST = {
    FaultKind.FRAMES_LOST: {*TO_DRIVE, *TO_CONTROLLER}, FaultKind.BUS_OFF: {*TO_DRIVE, *TO_CONTROLLER},
    FaultKind.SYNC_LOST: {SYNC}, FaultKind.RPDO_LOST: {RPDO}, FaultKind.TPDO_LOST: {TPDO},
    FaultKind.CONTROLLER_HEARTBEAT_LOST: {OWN_HEARTBEAT}, FaultKind.DRIVE_HEARTBEAT_LOST: {HEARTBEAT},
}  # fmt: skip


@pytest.mark.parametrize("kind", LOST)
def test_what_is_lost_and_what_is_not(kind: FaultKind) -> None:
    wire = Wire(one_fault(kind))
    for to_drive, frames in ((True, TO_DRIVE), (False, TO_CONTROLLER)):
        for frame in frames:
            assert len(wire.send(frame, to_drive)) == (0 if frame in LOST[kind] else 1), frame


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_the_share_that_is_lost(share: float) -> None:
    wire = Wire(one_fault(FaultKind.TPDO_LOST, magnitude=share))
    arrived = sum(len(wire.send(TPDO, False)) for _ in range(2000))
    assert arrived == pytest.approx(2000 * (1.0 - share), abs=80 if 0.0 < share < 1.0 else 0)


@pytest.mark.parametrize(("at_ms", "present"), [(4.99, False), (5.0, True), (7.99, True), (8.0, False)])
def test_a_fault_is_present_from_its_start_for_its_duration(at_ms: float, present: bool) -> None:
    wire = Wire(one_fault(FaultKind.SYNC_LOST, at_s=0.005, duration_s=0.003))
    assert len(wire.send(SYNC, True, at_ms)) == (0 if present else 1)


def test_before_the_epoch_there_is_no_fault() -> None:
    faults = one_fault(FaultKind.SYNC_LOST)
    assert not is_active(faults[0], fault_memory(faults)[0], 10**15)


@pytest.mark.parametrize(("kind", "frame", "to_drive"), [("RPDO", RPDO, True), ("TPDO", TPDO, False)])
def test_late_frames_come_when_they_are_due_in_their_order(kind: str, frame: tuple[int, int], to_drive: bool) -> None:
    wire = Wire(one_fault(FaultKind[f"{kind}_DELAYED"], magnitude=0.002))
    assert wire.send(frame, to_drive, 0.0) == []
    assert wire.send(frame, to_drive, 1.0) == []
    assert wire.due(to_drive, 1.99) == []
    assert wire.due(not to_drive, 10.0) == []
    (first,) = wire.due(to_drive, 2.0)
    assert (first[8], tuple(first[5:8])) == (0, (0, 0, 0))  # it counts when it comes
    assert [data[8] for data in wire.due(to_drive, 9.0)] == [1]
    assert wire.due(to_drive, 99.0) == []


@pytest.mark.parametrize(("kind", "frame", "to_drive"), [("RPDO", RPDO, True), ("TPDO", TPDO, False)])
def test_doubled_reordered_corrupted_and_of_another_length(kind: str, frame: tuple[int, int], to_drive: bool) -> None:
    twice = Wire(one_fault(FaultKind[f"{kind}_DUPLICATED"])).send(frame, to_drive)
    assert len(twice) == 2
    assert (twice[0][:5], twice[0][8:]) == (twice[1][:5], twice[1][8:])
    assert (tuple(twice[0][5:8]), tuple(twice[1][5:8])) == (STAMP, (0, 0, 0))
    wire = Wire(one_fault(FaultKind[f"{kind}_REORDERED"]))
    came = [(data[8], data[5]) for _ in range(6) for data in wire.send(frame, to_drive)]
    assert came == [(1, 7), (0, 0), (3, 7), (2, 0), (5, 7), (4, 0)]
    (damaged,) = Wire(one_fault(FaultKind[f"{kind}_CORRUPTED"])).send(frame, to_drive)
    assert damaged[:5] == bytes([frame[0] & 0xFF, frame[0] >> 8, 0, 0, frame[1]])
    assert len(set(damaged[8 : 8 + frame[1]])) > 1
    (shorter,) = Wire(one_fault(FaultKind[f"{kind}_LENGTH"], magnitude=3.0)).send(frame, to_drive)
    assert shorter[4] == 3


def test_a_frame_that_is_late_or_overtaken_is_damaged_as_well() -> None:
    """It came whole: a fault beside another one was less than alone."""
    for kind, magnitude in ((FaultKind.TPDO_DELAYED, 0.5), (FaultKind.TPDO_REORDERED, 1.0)):
        for damage in (FaultKind.TPDO_LENGTH, FaultKind.TPDO_CORRUPTED):
            wire = Wire(faults_of((kind, 0.0, 1.0, magnitude), (damage, 0.0, 1.0, 3.0)))
            came = wire.send(TPDO, False) + wire.send(TPDO, False) + wire.due(False, 900.0)
            assert len(came) == 2
            shortened = damage is FaultKind.TPDO_LENGTH
            assert [data[4] for data in came] == [3 if shortened else TPDO[1]] * 2
            assert all((len(set(data[8:16])) > 1) is not shortened for data in came)


def test_foreign_frames_come_before_the_drives_own_and_never_look_like_it() -> None:
    wire = Wire(one_fault(FaultKind.FOREIGN_FRAMES, magnitude=9.0))
    for _ in range(200):
        frames = wire.send(TPDO, False)
        assert len(frames) == 10
        identifiers = [frame[0] | frame[1] << 8 for frame in frames]
        assert identifiers[-1] == TPDO[0]
        assert {TPDO[0], HEARTBEAT[0], EMCY[0]}.isdisjoint(identifiers[:-1])
        assert all(frame[4] <= 8 for frame in frames)


def test_too_many_faults_are_refused() -> None:
    with pytest.raises(ValueError, match=rf"number of faults \(=9\) must be in \[0\.\.{MAX_FAULTS}\]"):
        fault_memory(new(FaultConstants, MAX_FAULTS + 1))


# --- in lockstep ---
def test_without_a_fault_the_run_is_bit_for_bit_that_without_the_engine(lockstep: LockstepJoint) -> None:
    plain, wired = lockstep.run(longest_s=3.0), lockstep.run_with_faults(no_faults(), longest_s=3.0)
    assert plain.log.tobytes() == wired.log.tobytes()


def test_a_run_with_faults_repeats_bit_for_bit(lockstep: LockstepJoint) -> None:
    faults = one_fault(FaultKind.FRAMES_LOST, 0.5, magnitude=0.3, seed=5)
    first, again = lockstep.run_with_faults(faults, longest_s=4.0), lockstep.run_with_faults(faults, longest_s=4.0)
    assert first.log.tobytes() == again.log.tobytes()
    faults[0].seed = 6
    assert lockstep.run_with_faults(faults, longest_s=4.0).log.tobytes() != first.log.tobytes()


def test_the_first_numbers_of_neighbouring_seeds_and_axes_are_spread() -> None:
    first = np.empty((400, 2))
    for seed in range(400):
        faults = one_fault(FaultKind.FRAMES_LOST, 0.5, seed=seed)
        _, memories = fault_rows([faults, faults])
        first[seed] = [draw(memory) for memory in memories]
    for numbers in (first.ravel(), np.abs(np.diff(first)).ravel(), np.abs(np.diff(first, axis=0)).ravel()):
        assert (numbers.min() < 0.01, numbers.max() > 0.95) == (True, True)
    assert np.histogram(first, 10, (0.0, 1.0))[0].min() > 50  # of 80 in the mean


@pytest.mark.parametrize(
    ("kind", "magnitude", "shift_rad"),
    [(FaultKind.ENCODER_JUMP, 0.0004, 0.0004), (FaultKind.ENCODER_DRIFT, 0.002, 0.0008)],
)
def test_the_encoder_is_wrong_by_the_magnitude(
    lockstep: LockstepJoint, kind: FaultKind, magnitude: float, shift_rad: float
) -> None:
    run = lockstep.run_with_faults(one_fault(kind, 1.0, magnitude=magnitude), longest_s=1.46)
    wrong = np.asarray(run.log.position_rad) - run.truth[: len(run.log), TRUE_POSITION_rad]
    enabled = int(np.argmax(run.log.drive_state == 3))
    assert abs(wrong[enabled + 900]) < 2e-5
    assert wrong[enabled + 1399] == pytest.approx(shift_rad, abs=3e-5)


@pytest.mark.parametrize(
    ("kind", "magnitude", "most_Nm"), [(FaultKind.CURRENT_LOOP_DEAD, 1.0, 0.9), (FaultKind.TORQUE_SATURATED, 6.0, 6.9)]
)
def test_the_motor_yields_no_more_than_it_can(
    lockstep: LockstepJoint, kind: FaultKind, magnitude: float, most_Nm: float
) -> None:
    """Torque ripple (0.8 Nm) is there with the power off as well."""
    run = lockstep.run_with_faults(one_fault(kind, 2.0, magnitude=magnitude), longest_s=2.5)
    actuator = np.abs(run.truth[:, TRUE_ACTUATOR_Nm])
    assert actuator[1500:2000].max() > 12.0
    assert actuator[2100:].max() < most_Nm


def test_a_clock_that_leaps_while_the_loop_is_held_up_is_late_by_both(lockstep: LockstepJoint) -> None:
    held, both = (
        lockstep.run_with_faults(faults_of((FaultKind.LOOP_HELD_UP, 2.0, 0.02, 1.0), *more), longest_s=4.0)
        for more in ((), ((FaultKind.CLOCK_STEP, 2.01, 0.01, 0.02),))
    )
    assert both.log.skipped.max() == held.log.skipped.max() + 20


@pytest.mark.parametrize("request_", StopRequest)
def test_a_stop_that_is_requested_and_a_loop_that_is_killed(lockstep: LockstepJoint, request_: StopRequest) -> None:
    stop = (FaultKind.STOP_REQUESTED, 2.0, 30.0, float(request_) + 0.5)
    run = lockstep.run_with_faults(faults_of(stop, (FaultKind.LOOP_KILLED, 2.005, 30.0, 1.0)), tail_s=1.0)
    expected = (AxisPhase.TRACKING, AxisPhase.RAMPING, AxisPhase.QUICK_STOPPING, AxisPhase.DISABLING)[request_]
    assert run.log.phase[-1] in (expected, AxisPhase.FINISHED)
    assert run.log.phase[-8] == AxisPhase.TRACKING
    assert run.truth[-1, TRUE_POWER_STATE] not in (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE)


def test_faults_end_and_leave_no_trace(lockstep: LockstepJoint) -> None:
    """Short enough to be harmless, one after the other: the run goes on, and the encoder is right in the end."""
    kinds = (
        FaultKind.ENCODER_STUCK, FaultKind.ENCODER_REVERSED, FaultKind.TORQUE_REVERSED, FaultKind.CURRENT_LOOP_DEAD,
        FaultKind.LOAD_JUMP, FaultKind.RPDO_LOST, FaultKind.FRAMES_LOST, FaultKind.FOREIGN_FRAMES,
    )  # fmt: skip
    faults = [(kind, 0.5 + 0.2 * i, 0.001, 1.0) for i, kind in enumerate(kinds)]
    run = lockstep.run_with_faults(faults_of(*faults), longest_s=4.0)
    assert run.fault is Fault.NONE
    assert abs(run.log.position_rad[-1] - run.truth[len(run.log) - 1, TRUE_POSITION_rad]) < 2e-5
