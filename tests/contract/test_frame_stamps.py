"""The time of sending in a frame of the virtual bus: written by the hub, understood by the virtual drive."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.can.virtual_bus import connect
from jointctl.drivers.canopen.cyclic import CanopenPort
from jointctl.drivers.canopen.exchange import end, link_of, receive
from jointctl.firmware_py.records import Command, Sample
from jointctl.firmware_py.schema import new
from jointctl.hil import virtual_bus
from jointctl.hil.bus_timing import (
    OLDEST_STAMP_NS,
    SHORTEST_WINDOW_US,
    SyncWatch,
    note_sent,
    outlived,
    over,
    sent_ns_of,
    stamp_frame,
    stamp_of,
)
from jointctl.hil.canopen.device import Cia402Device, DeviceSettings
from jointctl.hil.faults import FaultKind, no_faults
from jointctl.hil.plant import plant
from jointctl.hil.plant_records import FrictionKind
from jointctl.hil.realtime_device import RealtimeDevice
from jointctl.hil.virtual_bus import VirtualBusHub
from tests.made_faults import one_fault
from tests.places import EDS

NODE = 5
WRAP_NS = (1 << 24) * 1000


def stamped(now_ns: int) -> np.ndarray:
    found = np.zeros(16, np.uint8)
    stamp_frame(found, now_ns)
    return found


@pytest.mark.parametrize("sent_ns", [1_000, 123_456_789_000, WRAP_NS - 1_000, WRAP_NS, 7 * WRAP_NS + 5])
@pytest.mark.parametrize("age_ns", [0, 1_000, 2_500_000, OLDEST_STAMP_NS - 2_000])
def test_the_drive_understands_what_the_hub_writes(sent_ns: int, age_ns: int) -> None:
    # 0 means "untold": the one microsecond in 16 s that would read so is taken for the next
    told_ns = sent_ns_of(stamped(sent_ns), sent_ns + age_ns)
    assert abs(told_ns - sent_ns) <= 1_000 or (sent_ns // 1000) % (1 << 24) == 0


@pytest.mark.parametrize("age_ns", [OLDEST_STAMP_NS + 1_000, WRAP_NS // 2, WRAP_NS - 1_000_000])
def test_a_stamp_from_long_ago_or_from_the_future_is_not_believed(age_ns: int) -> None:
    sent_ns = 3 * WRAP_NS + 17_000
    assert sent_ns_of(stamped(sent_ns), sent_ns + age_ns) == sent_ns + age_ns


def test_a_frame_without_a_stamp_is_of_now() -> None:
    assert sent_ns_of(np.zeros(16, np.uint8), 123_456) == 123_456


def frame(identifier: int, data: bytes = b"", sent_ns: int | None = None) -> bytes:
    spare = b"" if sent_ns is None else stamped(sent_ns).tobytes()[5:8]
    return struct.pack("<IB3s8s", identifier, len(data), spare, data)


class Line:
    """A virtual drive in real time that answers SYNC with its position, and our end of its line."""

    def __init__(self, faults: Any = None) -> None:
        self.constants, self.state = plant(step_s=1e-4, friction_kind=FrictionKind.NONE)
        device = Cia402Device(EDS, DeviceSettings(node_id=NODE), self.constants, self.state, faults)
        self.ours, self._its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.ours.settimeout(60.0)
        self.drive = RealtimeDevice(device, self._its.fileno())

    def __enter__(self) -> Line:
        self.drive.start()
        self._write(0x1800, 1, 0x80000180 + NODE, 4)
        self._write(0x1A00, 0, 0, 1)
        self._write(0x1A00, 1, 0x60640020, 4)
        self._write(0x1A00, 0, 1, 1)
        self._write(0x1800, 2, 1, 1)
        self._write(0x1800, 1, 0x180 + NODE, 4)
        self.ours.send(frame(0, bytes((1, NODE))))
        return self

    def __exit__(self, *_: object) -> None:
        self.drive.stop()
        self.ours.close()
        self._its.close()

    def _write(self, index: int, subindex: int, value: int, size: int) -> None:
        command = {1: 0x2F, 2: 0x2B, 4: 0x23}[size]
        self.ours.send(frame(0x600 + NODE, struct.pack("<BHBI", command, index, subindex, value)))
        while (answer := self.ours.recv(16))[0:2] != struct.pack("<H", 0x580 + NODE):
            pass
        assert answer[8] == 0x60

    def sync(self, sent_ns: int | None) -> None:
        self.ours.send(frame(0x80, sent_ns=sent_ns))

    def position_counts(self) -> int:
        """Of the next sample; `TimeoutError` if none comes."""
        while (answer := self.ours.recv(16))[0:2] != struct.pack("<H", 0x180 + NODE):
            pass
        return int(struct.unpack_from("<i", answer, 8)[0])


@pytest.fixture(params=["no faults", "faults"])
def faults(request: pytest.FixtureRequest) -> Any:
    """Also a wire with faults, none of which is present yet, keeps the times."""
    return no_faults() if request.param == "no faults" else one_fault(FaultKind.TPDO_LOST, duration_s=1.0)


def test_the_drive_samples_at_the_time_of_sync_however_late_it_hears_it(faults: Any) -> None:
    """Two SYNCs that arrive at once, stamped 1.6 ms apart, on a joint that moves at 1 rad/s."""
    with Line(faults) as line:
        line.state["motor_velocity_radps"], line.state["joint_velocity_radps"] = 1.0, 1.0
        gaps = []
        for told in (True, False):
            found = []
            for _ in range(20):  # a busy computer may hold this process up between the clock and the socket
                line.sync(time.monotonic_ns())
                with contextlib.suppress(TimeoutError):
                    line.position_counts()
                    time.sleep(0.02)
                    now_ns = time.monotonic_ns()
                    for ago_ns in (2_000_000, 400_000):
                        line.sync(now_ns - ago_ns if told else None)
                    first, second = line.position_counts(), line.position_counts()
                    found.append((second - first) / float(line.constants[0].counts_prad))
            gaps.append(found)
    assert min(abs(gap - 1.6e-3) for gap in gaps[0]) <= 1e-4
    assert min(abs(gap) for gap in gaps[1]) < 5e-4


def test_the_answer_bears_the_stamp_of_its_sync(faults: Any) -> None:
    with Line(faults) as line:
        for sent_ns in (time.monotonic_ns(), None, time.monotonic_ns()):
            line.sync(sent_ns)
            while (answer := line.ours.recv(16))[0:2] != struct.pack("<H", 0x180 + NODE):
                pass
            assert answer[5:8] == (bytes(3) if sent_ns is None else stamped(sent_ns).tobytes()[5:8])


# --- The hub: it stamps what a cycle consists of, and leaves out an answer whose SYNC is over -----------------------


@pytest.mark.parametrize("noted", [True, False])
def test_a_frame_bears_the_time_at_which_it_was_sent_and_not_that_at_which_it_was_read(noted: bool) -> None:
    ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, its:
        scratch, found = np.zeros(virtual_bus.SCRATCH_WORDS, np.int64), np.zeros(16, np.uint8)
        virtual_bus._receive(its.fileno(), found, scratch)  # nothing yet, but compiled
        virtual_bus._sent_ns(scratch)
        if noted:
            virtual_bus._set_option(its.fileno(), virtual_bus._SO_TIMESTAMPNS, 1, scratch)
        before_ns = time.monotonic_ns()
        ours.send(frame(0x80))
        after_ns = time.monotonic_ns()
        time.sleep(0.05)
        assert virtual_bus._receive(its.fileno(), found, scratch) == 16
        assert found.tobytes() == frame(0x80)
        sent_ns = virtual_bus._sent_ns(scratch)
    assert (before_ns - 1_000_000 < sent_ns < after_ns + 1_000_000) == noted
    assert noted or sent_ns >= after_ns + 50_000_000


def bytes_of(data: bytes) -> np.ndarray:
    return np.frombuffer(data, np.uint8).copy()


PERIOD_NS = 1_000_000
CONTROLLER = 3


def watched(syncs: int) -> tuple[Any, int, int]:
    """(the hub's watch, stamp and time of the newest SYNC) after so many SYNCs of the loop."""
    watch, sync = new(SyncWatch)[0], bytes_of(frame(0x80))
    for number in range(syncs):
        sync, sent_ns = bytes_of(frame(0x80)), 7_000_000_000 + number * PERIOD_NS
        note_sent(watch, sync, CONTROLLER, sent_ns)
    return watch, stamp_of(sync), sent_ns


@pytest.mark.parametrize(("age_us", "late"), [(0, False), (500, False), (501, True), (900, True), (1_100, True)])
def test_half_a_period_after_its_sync_an_answer_is_too_late(age_us: int, late: bool) -> None:
    watch, stamp, sync_ns = watched(3)
    assert over(watch, stamp, sync_ns + age_us * 1000) == late


@pytest.mark.parametrize(
    ("identifier", "sender", "closed"),
    [(0x205, CONTROLLER, True), (0x205, CONTROLLER + 1, False), (0x77E, CONTROLLER, False), (0x80, CONTROLLER, True)],
)
def test_a_pdo_of_the_controller_or_another_sync_closes_the_cycle(identifier: int, sender: int, closed: bool) -> None:
    watch, stamp, sync_ns = watched(3)
    note_sent(watch, bytes_of(frame(identifier)), sender, sync_ns + 100_000)
    assert over(watch, stamp, sync_ns + 150_000) == closed


@pytest.mark.parametrize(
    ("identifier", "sender", "age_us", "left_out"),
    [(0x185, 1, 1000, False), (0x185, 1, 1001, True), (0x205, 0, 3000, False), (0x705, 1, 3000, False)],
)
def test_an_answer_that_was_on_the_wire_for_a_period_is_left_out(
    identifier: int, sender: int, age_us: int, left_out: bool
) -> None:
    """A hub that stood still delivered the position of three periods ago, which looked like a leap at speed."""
    watch = new(SyncWatch)[0]
    watch.sender, watch.period_us = 0, 1000
    answer = np.frombuffer(frame(identifier, bytes(8), 5_000_000_000), np.uint8).copy()
    assert outlived(watch, answer, sender, 5_000_000_000 + 1000 * age_us) == left_out


def test_the_period_follows_the_loop_down_at_once_and_up_slowly() -> None:
    watch, *_ = watched(1)
    assert watch.period_us == OLDEST_STAMP_NS // 1000
    watch, _, sync_ns = watched(2)
    assert watch.period_us == 1000
    sync = bytes_of(frame(0x80))
    note_sent(watch, sync, CONTROLLER, sync_ns + 5 * PERIOD_NS)  # skipped slots
    assert watch.period_us == 1126
    for _ in range(3):  # however fast they come
        sync_ns += 1_000
        sync = bytes_of(frame(0x80))
        note_sent(watch, sync, CONTROLLER, sync_ns + 5 * PERIOD_NS)
    assert not over(watch, stamp_of(sync), sync_ns + 5 * PERIOD_NS + SHORTEST_WINDOW_US * 1000)


@pytest.mark.parametrize("identifier", [0x000, 0x605, 0x585, 0x85, 0x80000080])
def test_what_no_cycle_consists_of_is_not_stamped(identifier: int) -> None:
    """SDO, NMT, EMCY, 29 bit identifiers: taken as they come."""
    watch, *_ = watched(2)
    found = bytes_of(frame(identifier))
    note_sent(watch, found, CONTROLLER, 123_456_000)
    assert (stamp_of(found), watch.open) == (0, 1)


@pytest.fixture
def ends(tmp_path: Any) -> Any:
    """(hub, the controller's end, the drive's end)"""
    path = tmp_path / "bus.sock"
    with VirtualBusHub(path) as hub, connect(str(path)) as controller, connect(str(path)) as drive:
        controller.settimeout(60.0)
        drive.settimeout(60.0)
        yield hub, controller, drive


def test_the_hub_leaves_out_an_answer_whose_sync_is_over(ends: Any) -> None:
    hub, controller, drive = ends
    stamps = []
    while len(stamps) < 20:  # a busy computer may hold this process up
        controller.send(frame(0x80))
        stamps.append(drive.recv(16)[5:8])
        drive.send(tpdo(stamps[-1]))
        drive.send(frame(0x700))
        if controller.recv(16) == tpdo(stamps[-1]):
            controller.recv(16)
            break
    assert stamps[-1] != bytes(3)
    assert hub.counters.late == len(stamps) - 1
    controller.send(frame(0x205))
    drive.recv(16)
    drive.send(tpdo(stamps[-1]))  # after the cycle was closed
    drive.send(tpdo(bytes(3)))  # a drive that knows nothing of stamps, or one that the wire has held up
    assert controller.recv(16)[:5] == tpdo(bytes(3))[:5]
    assert hub.counters.late == len(stamps)


# --- The controller's side: plain frames, as on a real bus ----------------------------------------------------------


class Exchange:
    """The driver's side of one cycle, and the bus's end of its line."""

    def __init__(self) -> None:
        self.bus, self._end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.port, self.sample = new(CanopenPort), new(Sample)
        port = self.port[0]
        port.fd, port.sync_id, port.tpdo_id, port.tpdo_length = self._end.fileno(), 0x80, 0x185, 4
        port.position_at, port.torque_at, port.position_radpcount = 0, -1, 1.0
        port.status_at = 0
        self._link = link_of(self.port)

    def __enter__(self) -> Exchange:
        receive(self._link, self.sample, 1, 0)  # loaded by now: the first one takes long
        self.bus.recv(16)
        self.port[0].cycle = 0
        return self

    def __exit__(self, *_: object) -> None:
        self.bus.close()
        self._end.close()

    def cycle(self, answer: Callable[[bytes], bytes] | None, wait_ns: int = 20_000_000, held_up_ns: int = 0) -> int:
        """How many samples one cycle brings; `answer` makes the drive's frame of the SYNC as it stands on the bus.

        `held_up_ns` passed since the cycle's wake-up.
        """
        before = int(self.sample[0].count)
        bus = threading.Thread(target=self._answer, args=(answer,))
        bus.start()
        now_ns = time.monotonic_ns() - held_up_ns
        receive(self._link, self.sample, now_ns, now_ns + wait_ns)
        bus.join()
        end(self._link, 0, self.sample, new(Command))
        return int(self.sample[0].count) - before

    def _answer(self, answer: Callable[[bytes], bytes] | None) -> None:
        sync = self.bus.recv(16)
        if answer is not None:
            self.bus.send(answer(sync))


def tpdo(stamp: bytes, counts: int = 7) -> bytes:
    return struct.pack("<IB3s8s", 0x185, 4, stamp, struct.pack("<i4x", counts))


def test_the_driver_sends_plain_frames_and_reads_no_stamp() -> None:
    with Exchange() as exchange:
        seen: list[bytes] = []
        assert exchange.cycle(lambda sync: seen.append(sync) or tpdo(bytes((1, 2, 3))), wait_ns=10_000_000_000) == 1
        assert seen[0][5:8] == bytes(3)


def test_the_answer_that_is_owed_is_waited_for_on_the_virtual_bus_too() -> None:
    """After a SYNC without answer the whole window is waited, and of two answers the last one counts."""
    with Exchange() as exchange:
        assert exchange.cycle(None, wait_ns=1_000_000) == 0
        assert exchange.cycle(lambda _: exchange.bus.send(tpdo(bytes(3), 6)) and tpdo(bytes(3)), 50_000_000) == 2
        assert exchange.sample[0].position_rad == 7.0
        assert exchange.cycle(lambda _: tpdo(bytes(3)), wait_ns=10_000_000_000) == 1


def test_a_cycle_held_up_past_its_window_leaves_the_sample_to_the_next() -> None:
    """No one can say when it was sampled."""
    with Exchange() as exchange:
        assert exchange.cycle(lambda _: tpdo(bytes(3)), held_up_ns=45_000_000) == 0
        taken_from_ns = time.monotonic_ns()
        assert exchange.cycle(None) == 1
        assert exchange.sample[0].time_ns >= taken_from_ns
        assert exchange.cycle(lambda _: tpdo(bytes(3)), wait_ns=200_000_000, held_up_ns=100_000_000) == 1
