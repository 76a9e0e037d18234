"""A TPDO that repeats or delays an old value is not taken for a new sample."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from jointctl.drivers.canopen import exchange
from jointctl.drivers.canopen.cia402 import State
from jointctl.drivers.canopen.cyclic import answer_owed, begin_cycle
from tests.unit.drivers.canopen.wire import RAD_PER_COUNT, STATUSWORDS, Wire


def test_a_tpdo_after_the_answer_is_not_a_new_sample(wire: Wire) -> None:
    """Doubled or late, it would make an old position look fresh."""
    begin_cycle(wire.port, wire.frames)
    assert wire.tpdo(counts=100)
    wire.rpdo(0.0)
    assert not wire.tpdo(STATUSWORDS[State.OPERATION_ENABLED], counts=50)
    assert (wire.sample.count, wire.port.surplus, wire.port.state) == (1, 1, State.SWITCH_ON_DISABLED)
    assert wire.sample.position_rad == pytest.approx(100 * RAD_PER_COUNT)
    begin_cycle(wire.port, wire.frames)
    assert wire.sample.count == 1  # the age goes on
    assert wire.tpdo(counts=101)


def test_a_tpdo_that_comes_after_its_cycle_but_is_the_first_answer_is_one(wire: Wire) -> None:
    begin_cycle(wire.port, wire.frames)
    wire.rpdo(0.0)
    assert wire.tpdo(counts=7)
    begin_cycle(wire.port, wire.frames)
    wire.rpdo(0.0)
    assert wire.tpdo(counts=8)
    assert (wire.sample.count, wire.port.surplus) == (2, 0)


def test_of_a_burst_the_last_one_counts(wire: Wire) -> None:
    for _ in range(3):
        begin_cycle(wire.port, wire.frames)
        wire.rpdo(0.0)
    for counts in (1, 2, 3):
        assert wire.tpdo(counts=counts)
    assert wire.sample.position_rad == pytest.approx(3 * RAD_PER_COUNT)


class Line:
    """`exchange.receive` on a bus without stamps, with a drive whose answers come when the test says."""

    def __init__(self, wire: Wire) -> None:
        self.wire = wire
        self.drive, self.ours = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        wire.port.fd = self.ours.fileno()
        _, self.scratch = exchange.exchange_memory()

    def cycle(self, *answers: tuple[float, int], window_s: float) -> float:
        """One cycle with the drive's (pause [s], counts) after SYNC; returns the counts that it ends with."""
        thread = threading.Thread(target=self._answer, args=(answers,))
        thread.start()
        wire, now_ns = self.wire, time.monotonic_ns()
        exchange.receive(
            wire.ports, wire.frames, self.scratch, wire.samples, np.int64(now_ns), np.int64(now_ns + window_s * 1e9)
        )
        taken = float(wire.sample.position_rad) / RAD_PER_COUNT
        thread.join()
        wire.rpdo(0.0)
        return taken

    def _answer(self, answers: tuple[tuple[float, int], ...]) -> None:
        while struct.unpack_from("<I", self.drive.recv(16))[0] != 0x80:
            pass
        for pause_s, counts in answers:
            time.sleep(pause_s)
            self.drive.send(struct.pack("<IB3xHih", 0x185, 8, 0x0250, counts, 0))


@pytest.fixture
def line(wire: Wire) -> Iterator[Line]:
    made = Line(wire)
    yield made
    made.drive.close()
    made.ours.close()


def test_after_a_cycle_without_answer_the_last_tpdo_counts(line: Line) -> None:
    """Its answer may come behind the next SYNC, and then in front of the next answer: a position one period old."""
    assert line.cycle((0.0, 10), window_s=30.0) == pytest.approx(10)
    assert line.cycle(window_s=0.01) == pytest.approx(10)
    assert line.cycle((0.0, 20), (0.05, 30), window_s=1.0) == pytest.approx(30)
    assert line.wire.port.surplus == 0
    assert line.cycle((0.0, 40), window_s=30.0) == pytest.approx(40)  # no need to wait any more


def test_after_an_answered_cycle_the_first_tpdo_ends_the_wait(line: Line) -> None:
    assert line.cycle((0.0, 10), window_s=30.0) == pytest.approx(10)
    assert line.cycle((0.0, 20), (0.1, 30), window_s=30.0) == pytest.approx(20)
    assert line.cycle((0.0, 40), window_s=30.0) == pytest.approx(40)
    assert line.wire.port.surplus == 1


def test_an_answer_that_comes_between_the_cycles_is_not_owed(line: Line) -> None:
    line.cycle(window_s=0.01)
    line.wire.tpdo(counts=20)
    assert line.cycle((0.0, 30), window_s=30.0) == pytest.approx(30)


@pytest.mark.parametrize(
    ("cycle", "stamped", "second_id", "seen", "owed"),
    [(0, 0, 0, 0, 0), (1, 0, 0, 0, 1), (1, 0, 0, 1, 0), (1, 1, 0, 0, 0), (1, 0, 0x186, 1, 1), (1, 0, 0x186, 2, 1),
     (1, 0, 0x186, 3, 0)],
)  # fmt: skip
def test_when_an_answer_is_owed(wire: Wire, cycle: int, stamped: int, second_id: int, seen: int, owed: int) -> None:
    wire.port.cycle, wire.port.stamped, wire.port.seen, wire.port.second.tpdo_id = cycle, stamped, seen, second_id
    assert answer_owed(wire.port) == owed
