"""The plain Python loop against a small drive that is the bus itself: no threads, no processes, no real time."""

from __future__ import annotations

from typing import Any

import can
import pytest

from jointctl.firmware_py.realtime import Histogram, Word
from jointctl.firmware_py.states import AxisPhase, Fault, StopRequest
from jointctl.tools.session import portable_loop
from jointctl.tools.session.loop_handle import SharedBlock
from tests.unit.session.portable_bus import OWN_HEARTBEAT, PERIOD_NS, RPDO, SYNC, Clock, DriveBus, run


def test_a_regular_run_ends_disabled_and_is_logged(block: SharedBlock) -> None:
    bus = DriveBus()
    executed = run(bus, block)
    assert (block.state[0].phase, block.state[0].fault) == (AxisPhase.FINISHED, Fault.NONE)
    assert bus.powered_syncs > 10
    assert bus.status == 0x40
    assert bus.count(SYNC) == bus.count(RPDO) == executed == block.words[Word.HEAD]
    assert bus.count(OWN_HEARTBEAT) == -(-executed // 5)
    assert bus.sent[-1] == (RPDO, bytes(4))
    assert block.histograms[Histogram.WAKE].sum() == executed
    records = block.ring[:executed]
    assert set(records.phase) >= {AxisPhase.WAITING, AxisPhase.ENABLING, AxisPhase.TRACKING, AxisPhase.DISABLING}
    assert records.skipped.sum() == block.words[Word.SKIPPED]


def test_an_exception_sends_controlword_0_and_a_sync_once(block: SharedBlock, monkeypatch: pytest.MonkeyPatch) -> None:
    bus = DriveBus()
    step_axis = portable_loop.step_axis
    frames_before = []

    def failing(*arguments: Any) -> None:
        if bus.powered_syncs >= 10:
            frames_before.append(len(bus.sent))
            raise MemoryError("no more")
        step_axis(*arguments)

    monkeypatch.setattr(portable_loop, "step_axis", failing)
    with pytest.raises(MemoryError, match="no more"):
        run(bus, block)
    assert bus.sent[frames_before[0] :] == [(RPDO, bytes(4)), (SYNC, b"")]
    assert bus.status == 0x40


def test_an_exception_on_a_dead_bus_is_still_the_exception(block: SharedBlock, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*_: Any) -> None:
        raise MemoryError("no more")

    def dead(bus: DriveBus, identifier: int) -> None:
        raise can.CanOperationError("bus off")

    bus = DriveBus()
    bus.on_send = dead
    monkeypatch.setattr(portable_loop, "step_axis", failing)
    with pytest.raises(MemoryError, match="no more"):
        run(bus, block)


def test_an_overrun_skips_slots_and_sends_no_burst(block: SharedBlock, clock: Clock) -> None:
    bus = DriveBus()

    def on_send(bus: DriveBus, identifier: int) -> None:
        if identifier == RPDO and bus.syncs == 3:
            clock.sleep(0.012)

    bus.on_send = on_send
    executed = run(bus, block, max_cycles=6)
    assert executed == bus.count(SYNC) == 6
    records = block.ring[:6]
    assert records.skipped[3] >= 10
    assert block.words[Word.SKIPPED] == records.skipped.sum()
    periods = (records.time_ns[1:] - records.time_ns[:-1]) / PERIOD_NS
    assert list(periods) == [1 + skipped for skipped in records.skipped[1:]]
    assert block.state[0].cycle == 6 + records.skipped.sum()


@pytest.mark.parametrize("request_", [StopRequest.NONE, StopRequest.RAMP, StopRequest.OFF])
def test_the_stop_word_ends_the_run(block: SharedBlock, request_: StopRequest) -> None:
    bus = DriveBus()
    block.constants[0].trajectory.duration_s = 0.0  # until stopped

    def on_send(bus: DriveBus, identifier: int) -> None:
        if bus.powered_syncs == 10:
            block.words[Word.STOP] = request_

    bus.on_send = on_send
    executed = run(bus, block, max_cycles=150)
    assert (block.state[0].phase == AxisPhase.FINISHED) == (request_ is not StopRequest.NONE)
    assert (executed < 150) == (request_ is not StopRequest.NONE)


@pytest.mark.parametrize("silent", [True, False])
def test_a_lost_supervisor_stops_the_joint(block: SharedBlock, clock: Clock, silent: bool) -> None:
    bus = DriveBus()
    block.constants[0].sequence.supervisor_max_cycles = 200
    block.words[Word.SUPERVISOR_NS] = clock.monotonic_ns() - 250 * PERIOD_NS * silent

    def on_send(bus: DriveBus, identifier: int) -> None:
        if not silent:
            block.words[Word.SUPERVISOR_NS] = clock.monotonic_ns()

    bus.on_send = on_send
    run(bus, block)
    assert block.state[0].fault == (Fault.SUPERVISOR_LOST if silent else Fault.NONE)


@pytest.mark.parametrize("late", [True, False])
def test_a_sample_of_an_earlier_sync_belongs_to_no_slot(block: SharedBlock, late: bool) -> None:
    """As in the compiled loop: it is not moved on by how late this cycle woke up."""

    class LateBus(DriveBus):
        """Answers come when the next cycle begins."""

        def recv(self, timeout: float | None = None) -> can.Message | None:
            return super().recv(timeout) if timeout == 0.0 or not late else None

    run(LateBus(), block, 4)
    assert block.state[0].sample_age_cycles == 0
    assert bool(block.state[0].sample_late_s == 0.0) == late
