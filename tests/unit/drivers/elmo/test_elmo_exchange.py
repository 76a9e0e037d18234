"""The compiled exchange on a descriptor: a cycle that was held up, and its twin in time."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time

import pytest

from jointctl.drivers.elmo.cyclic import ElmoPort
from jointctl.drivers.elmo.exchange import exchange_memory, receive
from jointctl.firmware_py.records import Sample
from jointctl.firmware_py.schema import new

REPLY = b"PX\r42;"
LOOK_S = struct.pack("ll", 0, 1000)  # how long a look at an empty line takes: its descriptor is one that blocks


class Line:
    """The loop's end of a line that may be full; its other end answers before it takes the question."""

    def __init__(self) -> None:
        self.ours, self.its = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self.ours.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, LOOK_S)
        self.its.setblocking(False)
        self.port, self.sample = new(ElmoPort, 1), new(Sample, 1)
        port = self.port[0]
        port.fd, port.echo, port.position_radpcount = self.ours.fileno(), 1, 1e-3
        self._data, self._scratch = exchange_memory()

    def __enter__(self) -> Line:
        self.cycle(0)  # compiled, or loaded, by now: the first one takes long
        self._empty()
        self.port[0].expected_count = 0
        return self

    def __exit__(self, *_: object) -> None:
        self.ours.close()
        self.its.close()

    def fill(self) -> None:
        """The next write waits until somebody reads."""
        with contextlib.suppress(BlockingIOError):
            while True:
                self.ours.send(bytes(4096), socket.MSG_DONTWAIT)

    def _empty(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                self.its.recv(1 << 20)

    def answer_after(self, delay_s: float) -> threading.Thread:
        def answer() -> None:
            time.sleep(delay_s)
            self.its.send(REPLY)
            self._empty()

        drive = threading.Thread(target=answer)
        drive.start()
        return drive

    def reply(self, data: bytes) -> None:
        self.its.send(data)

    def slot(self, window_end_ns: int) -> int:
        """The same for a window that ends then."""
        before = int(self.sample[0].count)
        receive(self.port, self._data, self._scratch, self.sample, time.monotonic_ns(), window_end_ns)
        return int(self.sample[0].count) - before

    def cycle(self, window_ns: int) -> int:
        """How many samples one cycle brings that waits for its own until `window_ns` after its wake-up."""
        before, now_ns = int(self.sample[0].count), time.monotonic_ns()
        receive(self.port, self._data, self._scratch, self.sample, now_ns, now_ns + window_ns)
        return int(self.sample[0].count) - before


@pytest.mark.parametrize(("window_ns", "samples"), [(20_000_000, 0), (10_000_000_000, 1)])
def test_a_cycle_held_up_past_its_window_leaves_the_position_to_the_next(window_ns: int, samples: int) -> None:
    with Line() as line:
        line.fill()
        drive = line.answer_after(0.1)
        assert line.cycle(window_ns) == samples
        drive.join()
        taken_from_ns = time.monotonic_ns()
        assert line.cycle(1_000_000) == 1 - samples
        assert line.sample[0].position_rad == pytest.approx(0.042)
        assert (line.sample[0].time_ns >= taken_from_ns) == (samples == 0)


PERIOD_NS = 100_000_000


def asked_once(line: Line, slots_later: float) -> int:
    """The window's end of a cycle that comes `slots_later` after one whose reply came after it."""
    line.port[0].period_ns = PERIOD_NS
    asked_ns = time.monotonic_ns() + 1_000_000
    assert line.slot(asked_ns) == 0
    line.reply(REPLY)
    return asked_ns + int(slots_later * PERIOD_NS)


@pytest.mark.parametrize(("slots_later", "samples"), [(1, 1), (2, 0), (13, 0)])
def test_a_position_asked_for_two_slots_ago_does_not_pass_for_one_of_now(slots_later: int, samples: int) -> None:
    with Line() as line:
        window_ns = asked_once(line, slots_later)
        time.sleep(max(0.0, 1e-9 * (window_ns - time.monotonic_ns()) - 0.02))
        assert line.slot(window_ns) == samples
        assert line.port[0].lost == 1 - samples


def test_a_late_position_is_none_in_a_cycle_that_is_late_itself() -> None:
    with Line() as line:
        window_ns = asked_once(line, 1)
        time.sleep(1e-9 * (window_ns - time.monotonic_ns()) + 0.01)
        assert line.slot(window_ns) == 0


def test_the_late_position_of_the_last_slot_is_no_reason_not_to_wait_for_the_new_one() -> None:
    with Line() as line:
        line.port[0].usual_answer_ns = PERIOD_NS  # neither of them comes unusually late
        window_ns = asked_once(line, 1)
        answer = threading.Timer(0.03, line.reply, [b"PX\r50;"])
        answer.start()
        assert line.slot(window_ns) == 2
        assert line.sample[0].position_rad == pytest.approx(0.05)
        answer.join()
