"""The time of sending in a frame of the virtual bus: written by the driver, understood by the virtual drive."""

from __future__ import annotations

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
from hil.device_loop import RealtimeDevice
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


def test_the_drive_samples_at_the_time_of_sync_however_late_it_hears_it() -> None:
    """Two SYNCs that arrive at once, stamped 1.5 ms apart, on a joint that moves at 1 rad/s."""
    constants, state = plant(step_s=1e-4, friction_kind=FrictionKind.NONE)
    device = Cia402Device(EDS, DeviceSettings(node_id=NODE), constants, state)
    ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.settimeout(10.0)

    def frame(identifier: int, data: bytes = b"", sent_ns: int | None = None) -> bytes:
        spare = b"" if sent_ns is None else stamped(sent_ns).tobytes()[5:8]
        return struct.pack("<IB3s8s", identifier, len(data), spare, data)

    def write(index: int, subindex: int, value: int, size: int) -> None:
        command = {1: 0x2F, 2: 0x2B, 4: 0x23}[size]
        ours.send(frame(0x600 + NODE, struct.pack("<BHBI", command, index, subindex, value)))
        while (answer := ours.recv(16))[0:2] != struct.pack("<H", 0x580 + NODE):
            pass
        assert answer[8] == 0x60

    def position_counts() -> int:
        while (answer := ours.recv(16))[0:2] != struct.pack("<H", 0x180 + NODE):
            pass
        return int(struct.unpack_from("<i", answer, 8)[0])

    with ours, its, RealtimeDevice(device, its.fileno()):
        write(0x1800, 1, 0x80000180 + NODE, 4)
        write(0x1A00, 0, 0, 1)
        write(0x1A00, 1, 0x60640020, 4)
        write(0x1A00, 0, 1, 1)
        write(0x1800, 2, 1, 1)
        write(0x1800, 1, 0x180 + NODE, 4)
        ours.send(frame(0, bytes((1, NODE))))
        state["motor_velocity_radps"], state["joint_velocity_radps"] = 1.0, 1.0
        gaps = []
        for told in (True, False):
            found = []
            for _ in range(20):  # a busy computer may hold this process up between the clock and the socket
                ours.send(frame(0x80, sent_ns=time.monotonic_ns()))
                position_counts()
                time.sleep(0.005)
                now_ns = time.monotonic_ns()
                for ago_ns in (2_000_000, 500_000):
                    ours.send(frame(0x80, sent_ns=now_ns - ago_ns if told else None))
                first, second = position_counts(), position_counts()
                found.append((second - first) / float(constants[0].counts_prad))
            gaps.append(found)
    assert min(abs(gap - 1.5e-3) for gap in gaps[0]) <= 1e-4
    assert min(abs(gap) for gap in gaps[1]) < 5e-4
