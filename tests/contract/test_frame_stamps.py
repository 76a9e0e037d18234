"""The time of sending in a frame of the virtual bus: written by the driver, understood by the virtual drive."""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from pathlib import Path

import numpy as np
import pytest

from drivers.can.frame_io import stamp_frame
from drivers.can.frames import Frame
from firmware_py.schema import new
from hil.device import Cia402Device, DeviceSettings
from hil.device_loop import LATE_WORD, RealtimeDevice
from hil.frame_stamps import OLDEST_STAMP_NS, sent_ns_of
from hil.joint import plant
from hil.plant_records import FrictionKind

EDS = Path(__file__).resolve().parents[2] / "configs" / "virtual_joint.eds"
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

    def __init__(self) -> None:
        self.constants, self.state = plant(step_s=1e-4, friction_kind=FrictionKind.NONE)
        device = Cia402Device(EDS, DeviceSettings(node_id=NODE), self.constants, self.state)
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


def test_the_drive_samples_at_the_time_of_sync_however_late_it_hears_it() -> None:
    """Two SYNCs that arrive at once, stamped 1.6 ms apart, on a joint that moves at 1 rad/s."""
    with Line() as line:
        line.state["motor_velocity_radps"], line.state["joint_velocity_radps"] = 1.0, 1.0
        gaps = []
        for told in (True, False):
            found = []
            for _ in range(20):  # a busy computer may hold this process up between the clock and the socket
                line.sync(time.monotonic_ns())
                with contextlib.suppress(TimeoutError):  # ... for so long that the drive does not answer any more
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


@pytest.mark.parametrize(("ago_ns", "answers"), [(28_000_000, 1), (10_000_000, 2)])
def test_a_sync_is_answered_within_half_its_period_or_not_at_all(ago_ns: int, answers: int) -> None:
    """A SYNC, and one that seems to come 50 ms after it and is heard when it is `ago_ns` old."""
    with Line() as line:
        line.ours.settimeout(0.3)
        for _ in range(20):  # the test may be held up as well
            before = int(line.drive.words[LATE_WORD])
            now_ns = time.monotonic_ns()
            line.sync(now_ns - ago_ns - 50_000_000)
            line.sync(now_ns - ago_ns)
            told = 0
            with contextlib.suppress(TimeoutError):
                while told < 2:
                    line.position_counts()
                    told += 1
            assert told + int(line.drive.words[LATE_WORD]) - before == 2
            if told == answers:
                break
        assert told == answers
