"""The drive's watchdog is proven before the first enable: silence must make it react, a heartbeat must not."""

from __future__ import annotations

from typing import Any

import pytest

from jointctl.drivers.canopen.watchdog import BEATS, prove_watchdog
from jointctl.drivers.errors import DeviceError

NODE, MASTER, TIMEOUT_s = 1, 126, 0.2


class StubNetwork:
    """A drive's watchdog in simulated time; `reacts` and `trips_after` decide how it behaves."""

    def __init__(self, reaction: tuple[int, bytes] | None, timeout_s: float = TIMEOUT_s) -> None:
        self.now_s, self.heard_s = 0.0, 0.0
        self.reaction, self.timeout_s = reaction, timeout_s
        self.subscribers: dict[int, Any] = {}
        self.beats = 0

    def subscribe(self, can_id: int, callback: Any) -> None:
        self.subscribers[can_id] = callback

    def unsubscribe(self, can_id: int, callback: Any) -> None:
        del self.subscribers[can_id]

    def send_message(self, can_id: int, data: bytes) -> None:
        assert (can_id, data) == (0x700 + MASTER, b"\x05")
        self.beats += 1
        self.heard_s = self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        if self.reaction and self.beats and self.now_s - self.heard_s > self.timeout_s:
            can_id, data = self.reaction
            self.subscribers[can_id](can_id, bytearray(data), self.now_s)


EMERGENCY = (0x80 + NODE, bytes((0x30, 0x81, 0x10, 0, 0, 0, 0, 0)))


def prove(network: StubNetwork) -> str:
    return prove_watchdog(network, NODE, MASTER, TIMEOUT_s, network.sleep)  # type: ignore[arg-type]


def test_a_working_watchdog_is_seen() -> None:
    network = StubNetwork(EMERGENCY)
    assert prove(network) == "EMCY 8130h"
    assert network.beats == BEATS
    assert network.subscribers == {}


def test_a_change_of_nmt_state_is_a_reaction_too() -> None:
    network = StubNetwork((0x700 + NODE, b"\x7f"))
    network.sleep(0.0)
    network.subscribers.clear()
    original = network.subscribe

    def subscribe(can_id: int, callback: Any) -> None:
        original(can_id, callback)
        if can_id == 0x700 + NODE:
            callback(can_id, bytearray(b"\x05"), 0.0)  # operational so far

    network.subscribe = subscribe  # type: ignore[method-assign]
    assert prove(network) == "NMT state 127"


def test_a_watchdog_that_does_nothing_is_refused() -> None:
    with pytest.raises(DeviceError, match="did not react"):
        prove(StubNetwork(None))


def test_another_emergency_is_no_proof() -> None:
    with pytest.raises(DeviceError, match="did not react"):
        prove(StubNetwork((0x80 + NODE, bytes((0x10, 0x43, 0x10, 0, 0, 0, 0, 0)))))


@pytest.mark.parametrize(("timeout_s", "early"), [(TIMEOUT_s / 3.0 - 0.01, True), (TIMEOUT_s / 3.0 + 0.01, False)])
def test_a_watchdog_that_trips_while_the_heartbeat_comes_is_refused(timeout_s: float, early: bool) -> None:
    network = StubNetwork(EMERGENCY, timeout_s)
    if early:
        with pytest.raises(DeviceError, match="although the heartbeat"):
            prove(network)
    else:
        assert prove(network) == "EMCY 8130h"


class Telling(StubNetwork):
    """Says `frames` one after the other as soon as the heartbeat is stopped, and notes every wait."""

    def __init__(self, *frames: tuple[int, bytes]) -> None:
        super().__init__(None)
        self.frames = frames
        self.waits_s: list[float] = []

    def sleep(self, seconds: float) -> None:
        self.waits_s.append(seconds)
        if len(self.waits_s) == BEATS + 1:
            for can_id, data in self.frames:
                self.subscribers[can_id](can_id, bytearray(data), 0.0)


def heartbeats(*data: bytes) -> list[tuple[int, bytes]]:
    return [(0x700 + NODE, part) for part in data]


@pytest.mark.parametrize(
    ("frames", "seen"),
    [
        ([(0x80 + NODE, b"\x30\x81")], "EMCY 8130h"),
        ([(0x80 + NODE, b"\x30")], ""),
        (heartbeats(b"\x05", b"\x04"), "NMT state 4"),
        (heartbeats(b"\x05", b"\x04", b"\x7f"), "NMT state 4"),
        (heartbeats(b"\x05"), ""),
        (heartbeats(b"\x05", b"\x85"), ""),  # the highest bit is not part of the state
        (heartbeats(b"\x00", b""), ""),
        ([EMERGENCY, *heartbeats(b"\x05", b"\x04")], "EMCY 8130h"),
        ([*heartbeats(b"\x05", b"\x04"), EMERGENCY], "EMCY 8130h"),
    ],
)
def test_what_is_a_reaction_and_what_is_not(frames: list[tuple[int, bytes]], seen: str) -> None:
    network = Telling(*frames)
    if seen:
        assert prove(network) == seen
    else:
        with pytest.raises(DeviceError, match=r"was stopped for 0.8 s and the drive did not react"):
            prove(network)
    assert network.subscribers == {}


def test_a_third_of_the_timeout_between_beats_and_four_timeouts_of_silence() -> None:
    network = Telling()
    with pytest.raises(DeviceError):
        prove(network)
    assert network.waits_s == pytest.approx([TIMEOUT_s / 3.0] * 6 + [TIMEOUT_s / 20.0] * 80)
