"""The plain Python loop against a small drive that is the bus itself: no threads, no processes, no real time."""

from __future__ import annotations

import json
import os
import struct
import sys
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import can
import pytest

from jointctl.drivers.canopen.cyclic import CanopenPort
from jointctl.drivers.errors import BusError, ConfigurationError
from jointctl.firmware_py import cycle
from jointctl.firmware_py.cycle import Histogram, Word
from jointctl.firmware_py.sequence import reset_axis
from jointctl.firmware_py.states import AxisPhase, Fault, StopRequest, TrajectoryKind
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.session import loop_process, loops, portable_loop
from jointctl.tools.session.loop_memory import LoopOrder, SharedBlock
from jointctl.tools.session.portable_loop import (
    HIGHEST_RATE_HZ,
    check_portable_rate,
    held_rate_Hz,
    portable_note,
    run_portable_loop,
)
from tests.sessions import constants_of

# --- A small drive that is the bus itself, and a clock that only moves when it is asked ---
PERIOD_NS = 1_000_000
RECEIVE_NS = 600_000
SYNC, RPDO, TPDO, OWN_HEARTBEAT = 0x80, 0x201, 0x181, 0x77E
LIMIT = 8  # failed cycles in a row that are allowed
NEXT_STATUS = {(0x40, 6): 0x21, (0x21, 7): 0x23, (0x23, 0x0F): 0x27, (0x27, 0x0F): 0x27, (0x27, 2): 0x40}


class DriveBus:
    """A bus with one drive at rest: RPDOs take effect at the SYNC, which it answers with its TPDO."""

    def __init__(self, echo: bool = False) -> None:
        self.sent: list[tuple[int, bytes]] = []
        self.waiting: deque[can.Message] = deque()
        self.status = 0x40
        self.control = 0
        self.syncs = 0
        self.powered_syncs = 0
        self.echo = echo
        self.on_send: Callable[[DriveBus, int], None] = lambda bus, identifier: None
        self.on_recv: Callable[[DriveBus], None] = lambda bus: None

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        identifier, data = message.arbitration_id, bytes(message.data)
        if identifier == SYNC:
            self.syncs += 1
            self.powered_syncs += self.status == 0x27
        self.on_send(self, identifier)
        self.sent.append((identifier, data))
        if self.echo:
            self.waiting.append(message)
        if identifier == RPDO:
            self.control = struct.unpack_from("<H", data)[0]
        elif identifier == SYNC:
            self.status = NEXT_STATUS.get((self.status, self.control), 0x40 if self.control == 0 else self.status)
            self.waiting.append(frame(TPDO, struct.pack("<Hih", self.status, 0, 0)))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        self.on_recv(self)
        return self.waiting.popleft() if self.waiting else None

    def count(self, identifier: int) -> int:
        return sum(sent == identifier for sent, _ in self.sent)


def frame(identifier: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=identifier, is_extended_id=False, data=data)


class Clock:
    """Time that passes while the loop sleeps, and a little with every look at it: a busy computer changes nothing."""

    def __init__(self) -> None:
        self.now_ns = 1_000_000_000

    def monotonic_ns(self) -> int:
        self.now_ns += 1000
        return self.now_ns

    def sleep(self, duration_s: float) -> None:
        self.now_ns += round(duration_s * 1e9)

    def sleep_until_ns(self, deadline_ns: int, _: Any) -> None:
        self.now_ns = max(self.now_ns, deadline_ns)


def run(bus: DriveBus, block: SharedBlock, max_cycles: int = 5000) -> int:
    return run_portable_loop(bus, block, PERIOD_NS, RECEIVE_NS, max_cycles)


def outcome(block: SharedBlock) -> tuple[AxisPhase, Fault]:
    return AxisPhase(int(block.state[0].phase)), Fault(int(block.state[0].fault))


@pytest.fixture(scope="module")
def warm() -> None:
    """Compiling in the middle of a run would be an overrun of seconds."""
    portable_loop.warm_up()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """The clock of the loop."""
    clock = Clock()
    monkeypatch.setattr(portable_loop, "time", clock)
    monkeypatch.setattr(portable_loop, "sleep_until_ns", clock.sleep_until_ns)
    return clock


@pytest.fixture
def block(clock: Clock, warm: None) -> Iterator[SharedBlock]:
    """Holds position 0 for 50 ms; no limit of the schedule or of the supervisor is at work."""
    block = SharedBlock.create(1, CanopenPort)
    block.constants[:] = constants_of(load_config(shipped_config("virtual")), start_position_rad=0.0)
    axis = block.constants[0]
    axis.trajectory.kind = TrajectoryKind.HOLD
    axis.trajectory.duration_s = 0.05
    axis.sequence.approach_s = 0.0
    axis.sequence.settle_cycles = 5
    axis.sequence.release_s = 0.005
    axis.sequence.supervisor_max_cycles = 0
    axis.limits.skipped_max_cycles = 1 << 40
    axis.limits.sample_age_max_cycles = LIMIT
    reset_axis(axis, block.state[0])
    port = block.port[0]
    port.sync_id, port.tpdo_id, port.rpdo_id = SYNC, TPDO, RPDO
    port.emergency_id, port.heartbeat_id, port.own_heartbeat_id = 0x81, 0x701, OWN_HEARTBEAT
    port.heartbeat_cycles = 5
    port.tpdo_length, port.rpdo_length = 8, 4
    port.position_at, port.torque_at, port.target_at = 2, 6, 2
    port.position_radpcount, port.torque_Nmppermille, port.max_permille = 1e-4, 0.06, 1000
    yield block
    os.close(block.fd)


# --- The plain Python loop against a small drive that is the bus itself: no threads, no processes, no real time ---
def test_a_regular_run_ends_disabled_and_is_logged(block: SharedBlock) -> None:
    bus = DriveBus()
    executed = run(bus, block)
    assert outcome(block) == (AxisPhase.FINISHED, Fault.NONE)
    assert bus.powered_syncs > 10
    assert bus.status == 0x40
    assert bus.count(SYNC) == bus.count(RPDO) == executed == block.words[Word.HEAD]
    assert bus.count(OWN_HEARTBEAT) == -(-executed // 5)
    assert bus.sent[-1] == (RPDO, bytes(4))
    assert block.histograms[Histogram.WAKE].sum() == executed
    records = block.ring[:executed]
    assert set(records.phase) >= {AxisPhase.WAITING, AxisPhase.ENABLING, AxisPhase.TRACKING, AxisPhase.DISABLING}
    assert records.skipped.sum() == block.words[Word.SKIPPED]


@pytest.mark.parametrize("dead", [False, True])
def test_an_exception_sends_controlword_0_and_a_sync_once(
    block: SharedBlock, monkeypatch: pytest.MonkeyPatch, dead: bool
) -> None:
    """On a dead bus it is still the exception."""
    bus = DriveBus()
    command_axis = cycle.command_axis
    frames_before = []

    def failing(*arguments: Any) -> None:
        if bus.powered_syncs >= 10:
            frames_before.append(len(bus.sent))
            bus.on_send = on_send
            raise MemoryError("no more")
        command_axis(*arguments)

    def on_send(bus: DriveBus, identifier: int) -> None:
        if dead:
            raise can.CanOperationError("bus off")

    monkeypatch.setattr(cycle, "command_axis", failing)
    with pytest.raises(MemoryError, match="no more"):
        run(bus, block)
    assert bus.sent[frames_before[0] :] == ([] if dead else [(RPDO, bytes(4)), (SYNC, b"")])
    assert (bus.status == 0x40) is not dead


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
def test_a_sample_of_an_earlier_sync_is_one_period_older(block: SharedBlock, late: bool) -> None:
    """As in the compiled loop."""

    class LateBus(DriveBus):
        """Answers come when the next cycle begins."""

        def recv(self, timeout: float | None = None) -> can.Message | None:
            return super().recv(timeout) if timeout == 0.0 or not late else None

    run(LateBus(), block, 4)
    assert block.state[0].sample_age_cycles == 0
    late_periods = block.state[0].sample_late_s / (PERIOD_NS * 1e-9)
    assert late_periods < 0.0 if late else late_periods >= 0.0


# --- What a bus may do to the plain Python loop: failed sends, error frames, a receive that raises, foreign frames ---


@pytest.mark.parametrize(
    "error", [can.CanOperationError("queue full"), OSError(105, "ENOBUFS"), RuntimeError("vendor"), None]
)
@pytest.mark.parametrize("failing_cycles", [1, LIMIT - 1, LIMIT, LIMIT + 1, LIMIT + 2])
def test_failed_sends_and_error_frames_trip_only_beyond_the_limit(
    block: SharedBlock, failing_cycles: int, error: Exception | None
) -> None:
    """Without an error to raise, an error frame comes with the SYNC."""
    bus = DriveBus()

    def on_send(bus: DriveBus, identifier: int) -> None:
        if not 10 <= bus.powered_syncs < 10 + failing_cycles:
            return
        if error is not None and identifier == RPDO:
            raise error
        if error is None and identifier == SYNC and bus.status == 0x27:
            bus.waiting.append(can.Message(is_error_frame=True))

    bus.on_send = on_send
    run(bus, block)
    assert outcome(block) == (AxisPhase.FINISHED, Fault.BUS_ERROR if failing_cycles > LIMIT else Fault.NONE)
    port = block.port[0]
    failures = (int(port.send_failures), int(port.error_frames), int(port.consecutive_failures))
    assert failures == ((failing_cycles, 0, 0) if error else (0, failing_cycles, 0))


@pytest.mark.parametrize("for_good", [True, False])
def test_a_receive_that_raises_does_not_leave_the_loop(block: SharedBlock, for_good: bool) -> None:
    bus = DriveBus()

    def on_recv(bus: DriveBus) -> None:
        if bus.powered_syncs >= 10 and (for_good or bus.powered_syncs < 13):
            raise can.CanOperationError("could not unpack received message")

    bus.on_recv = on_recv
    block.constants[0].sequence.stop_max_cycles = block.constants[0].sequence.off_max_cycles = 20
    run(bus, block)
    assert block.state[0].phase == AxisPhase.FINISHED
    found = block.state[0].fault
    assert found in (Fault.BUS_ERROR, Fault.STALE_SAMPLE) if for_good else found == Fault.NONE
    assert bus.sent[-1] == (RPDO, bytes(4))


def test_own_echoes_are_not_counted(block: SharedBlock) -> None:
    bits = []
    for echo in (False, True):
        block.port[0].bits_sent = block.port[0].cycle = 0
        reset_axis(block.constants[0], block.state[0])
        run(DriveBus(echo), block, max_cycles=20)
        bits.append(int(block.port[0].bits_sent))
    # the first TPDO behind an echo may be left for the next cycle, so that one may be missing at the end
    assert 0 <= bits[0] - bits[1] <= 135


def test_foreign_frames_do_no_harm(block: SharedBlock) -> None:
    bus = DriveBus()
    foreign = [
        can.Message(arbitration_id=TPDO, is_extended_id=True, data=bytes(8)),
        can.Message(arbitration_id=TPDO, is_extended_id=False, is_fd=True, data=bytes(12)),
        can.Message(arbitration_id=TPDO, is_extended_id=False, is_remote_frame=True, dlc=8),
        frame(TPDO, b"\x27\x00"),
        frame(0x701, b""),
    ]

    def on_send(bus: DriveBus, identifier: int) -> None:
        if identifier == SYNC:
            bus.waiting.extend(foreign)

    bus.on_send = on_send
    executed = run(bus, block)
    assert outcome(block) == (AxisPhase.FINISHED, Fault.NONE)
    assert block.port[0].malformed == executed


# --- The process of the plain Python loop: which rates it takes, and that it ends with one line ---
@pytest.mark.parametrize(("rate_Hz", "refused"), [(1.0, False), (500.0, False), (500.001, True), (1000.0, True)])
def test_rates_up_to_500_hz_are_allowed(rate_Hz: float, refused: bool) -> None:
    words = r"loop\.rate_Hz .*must be at most 500 .*slcan"
    with pytest.raises(ConfigurationError, match=words) if refused else nullcontext():
        check_portable_rate("slcan", rate_Hz)


def order(interface: str, period_ns: int, block: SharedBlock) -> str:
    channel = "no-such-bus"
    fd = os.dup(block.fd)
    timing = period_ns, 600_000, None, None
    return LoopOrder(os.getpid(), fd, fd, 1, "canopen", interface, channel, *timing).argument()


@pytest.mark.parametrize(
    ("interface", "period_ns", "code", "text"),
    [
        ("nonsense", 10_000_000, 4, "interface (='nonsense') must be one of"),
        ("udp_multicast", 1_000_000, 3, "loop.rate_Hz (=1000) must be at most 500"),
        ("jointctl", 1_000_000, 4, "no virtual bus at"),
    ],
)
def test_the_process_ends_with_one_line(
    interface: str,
    period_ns: int,
    code: int,
    text: str,
    block: SharedBlock,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(loop_process, "_block_signals", lambda: None)
    monkeypatch.setattr(loops, "compiled_call", lambda *_: lambda cycles: cycles)
    monkeypatch.setattr(sys, "argv", ["loop", order(interface, period_ns, block)])
    block.words[Word.BUS] = 1
    assert loop_process.main() == code
    lines = capsys.readouterr().err.splitlines()
    assert text in lines[-1]
    assert sum("plain Python loop over" in line for line in lines[:-1]) == len(lines) - 1


def test_the_bus_is_opened_when_the_supervisor_has_it_and_not_before(
    block: SharedBlock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loops, "compiled_call", lambda *_: lambda cycles: cycles)
    waits: list[float] = []

    def wait(seconds: float) -> None:
        waits.append(seconds)
        block.words[Word.BUS] = len(waits) == 3

    monkeypatch.setattr(loops.time, "sleep", wait)
    given = replace(LoopOrder(**json.loads(order("jointctl", 1_000_000, block))), supervisor_pid=os.getppid())
    with pytest.raises(BusError, match="no virtual bus at"), loops.compiled_loop(given, block):
        pass
    assert len(waits) == 3


@pytest.mark.parametrize("how", ["its process has ended", "its process has become another program"])
def test_a_loop_whose_supervisor_goes_before_the_bus_is_there_ends(
    block: SharedBlock, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    monkeypatch.setattr(loops, "compiled_call", lambda *_: lambda cycles: cycles)
    theirs, ours = os.pipe()
    if how == "its process has become another program":
        os.close(ours)
    pid = -1 if how == "its process has ended" else os.getppid()
    given = LoopOrder(**json.loads(order("jointctl", 1_000_000, block)))
    given = replace(given, supervisor_pid=pid, supervisor_fd=theirs)
    with pytest.raises(BusError, match="before the bus was there"), loops.compiled_loop(given, block):
        pass


def test_what_nobody_reads_any_more_does_not_end_the_process(
    block: SharedBlock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop_process, "_block_signals", lambda: None)
    monkeypatch.setattr(loops, "compiled_call", lambda *_: lambda cycles: cycles)
    monkeypatch.setattr(sys, "argv", ["loop", order("udp_multicast", 10_000_000, block)])
    monkeypatch.setattr(sys, "stderr", SimpleNamespace(write=Mock(side_effect=BrokenPipeError)))
    assert loop_process.main() == BusError.exit_code  # after its note about the plain Python loop


def test_an_unexpected_exception_is_one_line_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(loop_process, "_block_signals", lambda: None)
    monkeypatch.setattr(sys, "argv", ["loop", json.dumps({"surprise": 1})])
    assert loop_process.main() == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("loop: TypeError at loop_process.py:")
    assert "surprise" in line


def test_the_rate_that_is_held_is_told_and_one_beyond_it_warned_of() -> None:
    assert "holds about 400 Hz now; expect" in portable_note("slcan", 400.0, 400.0)
    assert "holds about 400 Hz now, LESS than loop.rate_Hz (=401)" in portable_note("slcan", 401.0, 400.0)


def test_the_rate_that_is_held_follows_from_wake_up_and_work() -> None:
    assert 0.0 < held_rate_Hz(0.6) <= HIGHEST_RATE_HZ
    assert held_rate_Hz(0.999) < 100.0  # of a period, 10 us and less are left for both
