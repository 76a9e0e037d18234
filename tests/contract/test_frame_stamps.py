"""The time of sending in a frame of the virtual bus: written by the driver, understood by the virtual drive."""

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

from jointctl.drivers.can.frame_io import stamp_frame
from jointctl.drivers.can.frames import Frame
from jointctl.drivers.canopen.cyclic import CanopenPort
from jointctl.drivers.canopen.exchange import end, exchange_memory, receive
from jointctl.firmware_py.records import Command, Sample
from jointctl.firmware_py.schema import new
from jointctl.hil.canopen.device import Cia402Device, DeviceSettings
from jointctl.hil.faults.kinds import FaultConstants, FaultKind, no_faults
from jointctl.hil.frame_stamps import OLDEST_STAMP_NS, sent_ns_of
from jointctl.hil.plant.joint import plant
from jointctl.hil.plant.records import FrictionKind
from jointctl.hil.realtime_device import RealtimeDevice
from tests.places import EDS

NODE = 5
WRAP_NS = (1 << 24) * 1000


def stamped(now_ns: int) -> np.ndarray:
    frames = new(Frame, 1)
    stamp_frame(frames, 0, now_ns)
    return np.frombuffer(frames.tobytes(), np.uint8)


@pytest.mark.parametrize("sent_ns", [1_000, 123_456_789_000, WRAP_NS - 1_000, WRAP_NS, 7 * WRAP_NS + 5])
@pytest.mark.parametrize("age_ns", [0, 1_000, 2_500_000, OLDEST_STAMP_NS - 2_000])
def test_the_drive_understands_what_the_driver_writes(sent_ns: int, age_ns: int) -> None:
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
        self.ours.settimeout(1.0)
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
    found = no_faults() if request.param == "no faults" else new(FaultConstants, 1)
    for fault in found:
        fault.kind, fault.start_s, fault.duration_s, fault.magnitude = FaultKind.TPDO_LOST, 0.0, 1.0, 1.0
    return found


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


class Exchange:
    """The driver's side of one cycle, and the bus's end of its line."""

    def __init__(self) -> None:
        self.bus, self._end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.port, self.sample = new(CanopenPort), new(Sample)
        port = self.port[0]
        port.fd, port.stamped, port.sync_id, port.tpdo_id, port.tpdo_length = self._end.fileno(), 1, 0x80, 0x185, 4
        port.position_at, port.torque_at, port.position_radpcount = 0, -1, 1.0
        port.status_at = 0
        self._frames, self._scratch = exchange_memory()

    def __enter__(self) -> Exchange:
        receive(self.port, self._frames, self._scratch, self.sample, 1, 0)  # loaded by now: the first one takes long
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
        receive(self.port, self._frames, self._scratch, self.sample, now_ns, now_ns + wait_ns)
        bus.join()
        end(self.port, self._frames, self.sample, new(Command))
        return int(self.sample[0].count) - before

    def _answer(self, answer: Callable[[bytes], bytes] | None) -> None:
        sync = self.bus.recv(16)
        if answer is not None:
            self.bus.send(answer(sync))


def tpdo(stamp: bytes) -> bytes:
    return struct.pack("<IB3s8s", 0x185, 4, stamp, struct.pack("<i", 7))


def test_only_the_answer_to_this_sync_counts() -> None:
    with Exchange() as exchange:
        assert exchange.cycle(lambda sync: tpdo(sync[5:8])) == 1
        assert exchange.cycle(lambda sync: tpdo(bytes((sync[5] ^ 1, *sync[6:8])))) == 0
        assert exchange.port[0].surplus == 1
        assert exchange.cycle(lambda _: tpdo(bytes(3))) == 1  # a drive that knows nothing of stamps


def test_an_answer_that_came_after_its_cycle_is_left_out() -> None:
    kept: list[bytes] = []
    with Exchange() as exchange:
        assert (
            exchange.cycle(lambda sync: kept.append(sync[5:8]) or struct.pack("<IB3s8s", 0x700, 0, bytes(3), b"")) == 0
        )
        exchange.bus.send(tpdo(kept[0]))
        assert exchange.cycle(None) == 0
        exchange.bus.send(tpdo(bytes(3)))  # without a stamp nobody can tell
        assert exchange.cycle(None) == 1


def test_a_cycle_held_up_past_its_window_leaves_the_sample_to_the_next() -> None:
    """Who says when it was sampled?  A bus without stamps, as every real one."""
    with Exchange() as exchange:
        exchange.port[0].stamped = 0
        assert exchange.cycle(lambda _: tpdo(bytes(3)), held_up_ns=45_000_000) == 0
        taken_from_ns = time.monotonic_ns()
        assert exchange.cycle(None) == 1
        assert exchange.sample[0].time_ns >= taken_from_ns
        assert exchange.cycle(lambda _: tpdo(bytes(3)), wait_ns=200_000_000, held_up_ns=100_000_000) == 1
