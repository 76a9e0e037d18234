"""Frames on the wire: their lengths and the bus budget, and the kernels that send and receive them."""

from __future__ import annotations

import errno
import socket
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import pytest

from jointctl.drivers.can.frames import (
    FRAME_BYTES,
    Frame,
    bus_load,
    highest_rate_Hz,
    worst_cycle_bits,
    worst_frame_bits,
)
from jointctl.drivers.canopen.exchange import receive_frame, send_frame
from jointctl.drivers.errors import ConfigurationError
from jointctl.firmware_py.libc import WAIT_SCRATCH_WORDS, wait_readable_ns
from jointctl.firmware_py.schema import dtype_of, new
from jointctl.tools.configuration.canopen import cyclic_bus_load
from tests.configurations import shipped
from tests.python_process import run_python

# --- Frame lengths and bus budget, against the figures of the hardware specification, section 4 ---
SYNC, POSITION, TORQUE = 0, 8, 4


@pytest.mark.parametrize(("length", "worst"), [(0, 55), (4, 95), (8, 135)])
def test_bits_of_one_frame(length: int, worst: int) -> None:
    assert worst_frame_bits(length) == worst


def test_every_length_follows_the_formula() -> None:
    for length in range(9):
        assert worst_frame_bits(length) == 47 + 8 * length + (33 + 8 * length) // 4


@pytest.mark.parametrize(
    ("lengths", "rate_Hz", "bitrate", "load"),
    [
        ([SYNC, POSITION, TORQUE], 1000.0, 1_000_000, 0.285), ([SYNC, POSITION, TORQUE], 1000.0, 500_000, 0.57),
        ([SYNC, POSITION, TORQUE], 1000.0, 250_000, 1.14),
        ([SYNC, POSITION, POSITION, TORQUE], 2000.0, 1_000_000, 0.84),
        ([SYNC, POSITION, POSITION, 8], 2000.0, 1_000_000, 0.92),
    ],
)  # fmt: skip
def test_the_load_of_a_cycle(lengths: list[int], rate_Hz: float, bitrate: int, load: float) -> None:
    assert bus_load(lengths, rate_Hz, bitrate) == pytest.approx(load, abs=1e-12)
    assert worst_cycle_bits(lengths) * rate_Hz / bitrate == pytest.approx(load, abs=1e-12)
    highest_Hz = highest_rate_Hz(lengths, bitrate, highest_load=0.7)
    assert bus_load(lengths, highest_Hz, bitrate) == pytest.approx(0.7)
    assert highest_rate_Hz(lengths, bitrate) == pytest.approx(rate_Hz / load)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        *((partial(worst_frame_bits, n), rf"data length \(={n}\) must be in \[0..8\]") for n in (-1, 9)),
        *((partial(bus_load, [0], 1000.0, n), rf"bitrate_bitps \(={n}\)") for n in (0, -1, 1_000_001)),
        (partial(bus_load, [0], float("nan"), 1_000_000), "rate_Hz"),
        (partial(highest_rate_Hz, [], 1_000_000), "at least one frame"),
        (partial(highest_rate_Hz, [0], 1_000_000, 1.5), "highest_load"),
    ],
)
def test_what_no_bus_has_is_refused(call: Callable[[], float], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        call()


@pytest.mark.parametrize(
    ("bitrate", "rate_Hz", "mode", "refused"),
    [
        (1_000_000, 2807.0, "cst", ""),
        (1_000_000, 2808.0, "cst", "at most 2807"),
        (500_000, 1000.0, "cst", ""),
        (250_000, 1000.0, "cst", "= 285 bits a cycle, 114% of the bus, 80% allowed"),
        (1_000_000, 2622.0, "cyclic_sync_velocity", ""),
        (1_000_000, 2624.0, "cyclic_sync_velocity", r"SYNC \+ TPDO\(8\) \+ RPDO\(6\) = 305 bits a cycle"),
    ],
)
def test_a_configuration_beyond_the_bus_is_refused_with_the_arithmetic(
    bitrate: int, rate_Hz: float, mode: str, refused: str
) -> None:
    config = shipped(bus__bitrate_bitps=bitrate, loop__rate_Hz=rate_Hz, drive__mode=mode)
    if refused:
        with pytest.raises(ConfigurationError, match=refused):
            cyclic_bus_load(config)
    else:
        assert 0.5 < cyclic_bus_load(config) <= 0.8


# --- The frame kernels on a pair of SEQPACKET sockets: the system calls are those of AF_CAN ---
Pair = tuple[socket.socket, socket.socket]

ALLOCATION_COUNT = """
import socket, sys, threading
import numba
import numpy as np
from numba.core.runtime import rtsys
from jointctl.drivers.canopen.exchange import receive_frame, send_frame
from jointctl.drivers.can.frames import Frame
from jointctl.drivers.can.virtual_bus import connect
from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.libc import WAIT_SCRATCH_WORDS, wait_readable_ns
from jointctl.firmware_py.schema import new
from jointctl.hil.virtual_bus import VirtualBusHub

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
    path = tmp_path_factory.mktemp("b") / "bus.sock"
    said = run_python(ALLOCATION_COUNT, str(path), NUMBA_NRT_STATS="1", NUMBA_DISABLE_JIT="0")
    assert said.split() == ["end", "True", "hub", "True", "hub", "True"]
