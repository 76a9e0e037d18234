"""The frame kernels on a pair of SEQPACKET sockets: the system calls are those of AF_CAN."""

from __future__ import annotations

import errno
import os
import socket
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from jointctl.drivers.can.frame_io import receive_frame, send_frame
from jointctl.drivers.can.frames import FRAME_BYTES, Frame
from jointctl.firmware_py.libc import WAIT_SCRATCH_WORDS, wait_readable_ns
from jointctl.firmware_py.schema import dtype_of, new

Pair = tuple[socket.socket, socket.socket]

ALLOCATION_COUNT = """
import socket, sys, threading
import numba
import numpy as np
from numba.core.runtime import rtsys
from jointctl.drivers.can.frame_io import receive_frame, send_frame
from jointctl.drivers.can.frames import Frame
from jointctl.drivers.can.virtual_bus import connect
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.libc import WAIT_SCRATCH_WORDS, wait_readable_ns
from jointctl.firmware_py.schema import new
from jointctl.hil.bus.virtual_bus import VirtualBusHub

@numba.njit(error_model="numpy", nogil=True)
def exchange(source, sink, frames, scratch, count):
    done = 0
    for _ in range(count):
        done += send_frame(source, frames, 0) == 0
        if wait_readable_ns(sink, 10_000_000_000, scratch):
            receive_frame(sink, frames, 1)
    return done

def allocations():
    counts = rtsys.get_allocation_stats()
    return counts.alloc, counts.mi_alloc

frames, scratch = new(Frame, 2), np.zeros(WAIT_SCRATCH_WORDS, np.int64)
left, right = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
exchange(left.fileno(), right.fileno(), frames, scratch, 1)
counts = []
for count in (1, 100_000):
    before = allocations()
    assert exchange(left.fileno(), right.fileno(), frames, scratch, count) == count
    counts.append((allocations()[0] - before[0], allocations()[1] - before[1]))
print("end", counts[0] == counts[1])

for timing in (False, True):
    with VirtualBusHub(sys.argv[1], timing=timing) as hub:
        a, b = connect(sys.argv[1]), connect(sys.argv[1])
        exchange(a.fileno(), b.fileno(), frames, scratch, 10)  # the hub's thread is in its loop now
        counts = []
        for count in (1, 2_000):
            before = allocations()
            assert exchange(a.fileno(), b.fileno(), frames, scratch, count) == count
            counts.append((allocations()[0] - before[0], allocations()[1] - before[1]))
        print("hub", counts[0] == counts[1])
        assert counts[0] == counts[1], counts
        a.close(), b.close()
"""


@pytest.fixture
def pair() -> Iterator[Pair]:
    left, right = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with left, right:
        yield left, right


def test_the_record_is_struct_can_frame() -> None:
    dtype = dtype_of(Frame)
    assert dtype.itemsize == FRAME_BYTES == 16
    assert {name: dtype.fields[name][1] for name in ("can_id", "length", "payload")} == {
        "can_id": 0,
        "length": 4,
        "payload": 8,
    }


def test_a_frame_goes_through_at_any_index(pair: Pair) -> None:
    frames = new(Frame, 5)
    frames["can_id"][3], frames["length"][3], frames["payload"][3] = 0x181, 8, range(8)
    assert send_frame(pair[0].fileno(), frames, 3) == 0
    assert receive_frame(pair[1].fileno(), frames, 1) == 1
    assert frames[1].tobytes() == frames[3].tobytes() == b"\x81\x01\x00\x00\x08\x00\x00\x00" + bytes(range(8))
    for untouched in (0, 2, 4):
        assert frames[untouched].tobytes() == bytes(16)


def test_nothing_waiting_is_0(pair: Pair) -> None:
    assert receive_frame(pair[1].fileno(), new(Frame), 0) == 0


@pytest.mark.parametrize("size", [1, 15, 17, 72])
def test_a_wrong_size_is_an_error_and_the_next_frame_is_whole(pair: Pair, size: int) -> None:
    frames = new(Frame)
    pair[0].send(b"\xff" * size)
    pair[0].send(b"\x42" + bytes(15))
    assert receive_frame(pair[1].fileno(), frames, 0) == -errno.EBADMSG
    assert receive_frame(pair[1].fileno(), frames, 0) == 1
    assert frames["can_id"][0] == 0x42


def test_a_full_queue_is_told_at_once_and_nothing_is_lost(pair: Pair) -> None:
    frames = new(Frame, 2)
    taken = 0
    while (code := send_frame(pair[0].fileno(), frames, 0)) == 0:
        taken += 1
        frames["can_id"][0] = taken
        assert taken < 1_000_000
    assert code == errno.EAGAIN
    for number in range(taken):
        assert receive_frame(pair[1].fileno(), frames, 1) == 1
        assert frames["can_id"][1] == number
    assert receive_frame(pair[1].fileno(), frames, 1) == 0
    assert send_frame(pair[0].fileno(), frames, 0) == 0


def test_the_end_of_the_other_side(pair: Pair) -> None:
    frames = new(Frame)
    pair[0].close()
    assert receive_frame(pair[1].fileno(), frames, 0) == -errno.ECONNRESET
    assert send_frame(pair[1].fileno(), frames, 0) == errno.EPIPE  # and no SIGPIPE


def test_a_bad_descriptor() -> None:
    assert receive_frame(-1, new(Frame), 0) == -errno.EBADF
    assert send_frame(-1, new(Frame), 0) == errno.EBADF


def test_waiting(pair: Pair) -> None:
    scratch = np.zeros(WAIT_SCRATCH_WORDS, np.int64)
    fd = pair[1].fileno()
    assert not wait_readable_ns(fd, 0, scratch)
    assert not wait_readable_ns(fd, -5, scratch)
    assert not wait_readable_ns(fd, 1_000_000, scratch)
    pair[0].send(bytes(16))
    assert wait_readable_ns(fd, 0, scratch)
    assert wait_readable_ns(fd, 3_000_000_000, scratch)
    assert receive_frame(fd, new(Frame), 0) == 1
    assert not wait_readable_ns(fd, 0, scratch)
    pair[0].close()
    assert wait_readable_ns(fd, 3_000_000_000, scratch)
    assert scratch.dtype == np.int64


def test_no_allocation_in_100_000_exchanges_nor_in_the_hub(tmp_path_factory: pytest.TempPathFactory) -> None:
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_DISABLE_JIT"}
    environment["NUMBA_NRT_STATS"] = "1"
    path = tmp_path_factory.mktemp("b") / "bus.sock"
    done = subprocess.run(
        [sys.executable, "-c", ALLOCATION_COUNT, str(path)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["end", "True", "hub", "True", "hub", "True"]
