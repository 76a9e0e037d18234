"""What the cyclic exchange receives: TPDO, emergencies, errors of the bus, the drive's own heartbeat."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointctl.drivers.can.frames import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG
from jointctl.drivers.canopen.cia402 import State
from jointctl.drivers.canopen.cyclic import ERROR_SHOWN_CYCLES, begin_cycle, get_i16, get_i32, get_u16, put_u16
from jointctl.firmware_py.states import DriveState
from tests.unit.drivers.canopen.wire import RAD_PER_COUNT, Wire

# --- what is received ------------------------------------------------------------------------------------------


def test_tpdo_by_hand(wire: Wire) -> None:
    # statusword 0x1637, position 0x00012345 = 74565 counts, torque 0xFF38 = -200 permille
    assert wire.receive(0x185, bytes.fromhex("3716 45230100 38ff"), now_ns=77)
    sample = wire.sample
    assert (sample.status_word, sample.drive_state, sample.count) == (0x1637, DriveState.ENABLED, 1)
    assert sample.position_rad == pytest.approx(74565 * RAD_PER_COUNT)
    assert sample.torque_Nm == pytest.approx(-12.1)
    assert sample.time_ns == 77


@pytest.mark.parametrize(
    ("data", "counts"),
    [("ffffffff", -1), ("00000080", -(2**31)), ("ffffff7f", 2**31 - 1), ("0000ffff", -65536), ("01000000", 1)],
)
def test_position_is_signed(wire: Wire, data: str, counts: int) -> None:
    wire.receive(0x185, bytes.fromhex("5002" + data + "0000"))
    assert wire.sample.position_rad == pytest.approx(counts * RAD_PER_COUNT)


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("step", [1, 100_000, 2**31 - 1])
def test_position_wraps_both_ways_without_a_jump(wire: Wire, direction: int, step: int) -> None:
    """Several turns of the 32 bit counter in one direction, and all the way back."""
    start = direction * (2**31 - 1 - 2 * min(step, 1000))
    true = start
    wire.tpdo(counts=start)
    for k in range(12):
        true += direction * step * (1 if k < 6 else -1)
        wire.tpdo(counts=(true + 2**31) % 2**32 - 2**31)
        assert wire.port.counts == true
        assert wire.sample.position_rad == pytest.approx(true * RAD_PER_COUNT)
    assert wire.port.counts == start


def test_zero_and_direction_of_the_encoder(wire: Wire) -> None:
    wire.port.zero_counts, wire.port.position_radpcount = 1000, -RAD_PER_COUNT
    wire.tpdo(counts=1500)
    assert wire.sample.position_rad == pytest.approx(-500 * RAD_PER_COUNT)


@pytest.mark.parametrize("length", range(8))
def test_a_short_tpdo_is_counted_and_ignored(wire: Wire, length: int) -> None:
    wire.tpdo(0x0250, 1000, 5)
    before = wire.sample.tobytes()
    assert not wire.receive(0x185, struct.pack("<Hih", 0x1637, 9999, 99)[:length])
    assert wire.port.malformed == 1
    assert wire.sample.tobytes() == before
    assert wire.port.state == State.SWITCH_ON_DISABLED
    assert wire.tpdo(0x0250, 1001)  # the twin of full length


@pytest.mark.parametrize(
    "identifier",
    [0x184, 0x186, 0x285, 0x205, 0x80, 0x85 | EXTENDED_FLAG, 0x185 | EXTENDED_FLAG, 0x185 | REMOTE_FLAG, 0x585, 0x701],
)
def test_foreign_identifiers_are_ignored(wire: Wire, identifier: int) -> None:
    wire.tpdo(0x0250, 1000, 5)
    before = wire.sample.tobytes()
    assert not wire.receive(identifier, struct.pack("<Hih", 0x1637, 9999, 99))
    assert wire.sample.tobytes() == before
    assert (wire.port.malformed, wire.port.error_frames) == (0, 0)


def test_error_frames_of_the_bus_are_counted(wire: Wire) -> None:
    assert not wire.receive(0x185 | ERROR_FLAG, bytes(8))
    assert (wire.port.error_frames, wire.sample.count) == (1, 0)


def test_an_emergency_is_latched(wire: Wire) -> None:
    wire.receive(0x85, bytes.fromhex("1033 01 0000000000"))
    assert wire.sample.drive_error == 0x3310
    wire.receive(0x85, b"\x30")
    assert wire.sample.drive_error == 0x3310
    for _ in range(100):
        begin_cycle(wire.port, wire.frames)
        wire.tpdo()
    assert wire.sample.drive_error == 0x3310


@pytest.mark.parametrize("again", [False, True])
def test_an_error_that_the_drive_has_reset_is_shown_for_a_while_and_then_cleared(wire: Wire, again: bool) -> None:
    """At once it would be forgotten as the cause of the stop; never, a run later would be told an old one."""
    wire.receive(0x85, bytes.fromhex("3081 11 0000000000"))
    wire.receive(0x85, bytes(8))
    for cycle in range(1, ERROR_SHOWN_CYCLES + 3):
        begin_cycle(wire.port, wire.frames)
        if again and cycle == 5:
            wire.receive(0x85, bytes.fromhex("3081 11 0000000000"))
        wire.tpdo()
        expected = 0x8130 if again or cycle <= ERROR_SHOWN_CYCLES else 0
        assert wire.sample.drive_error == expected, cycle


# --- the drive's own heartbeat ---------------------------------------------------------------------------------


@pytest.mark.parametrize("watched", [0, 1])
def test_the_age_of_the_drives_heartbeat(wire: Wire, watched: int) -> None:
    wire.port.heartbeat_watched = watched
    for cycle in range(1, 50):
        begin_cycle(wire.port, wire.frames)
        if cycle in (10, 30):
            wire.receive(0x705, b"\x05")
        wire.rpdo(0.0)
        heard = 30 if cycle >= 30 else 10 if cycle >= 10 else 0
        assert wire.sample.heartbeat_age_cycles == watched * (cycle - heard)
    assert wire.sample.count == 0


def test_a_boot_up_is_a_restart_and_a_heartbeat_is_not(wire: Wire) -> None:
    for data, restarts in (
        (b"\x05", 0),
        (b"\x85", 0),
        (b"\x7f", 0),
        (b"", 0),
        (b"\x00", 1),
        (b"\x05", 1),
        (b"\x80", 2),
    ):
        wire.receive(0x705, data)
        assert wire.sample.restarts == restarts
    wire.receive(0x706, b"\x00")
    assert wire.sample.restarts == 2


def test_bus_load_counts_both_directions_at_worst_stuffing(wire: Wire) -> None:
    """SYNC 55, TPDO 135 and RPDO 95 bits are the 285 of the bus budget."""
    wire.port.cycle = 1
    begin_cycle(wire.port, wire.frames)
    wire.tpdo()
    wire.rpdo(0.0)
    assert wire.port.bits_sent == 285
    wire.port.cycle = 0
    begin_cycle(wire.port, wire.frames)  # SYNC 55 and heartbeat 65
    assert wire.port.bits_sent == 285 + 55 + 65


@settings(deadline=None)  # the first call compiles
@given(data=st.binary(min_size=8, max_size=8))
def test_integers_are_little_endian(data: bytes) -> None:
    array = np.frombuffer(data, np.uint8)
    assert get_u16(array, 1) == struct.unpack_from("<H", data, 1)[0]
    assert get_i16(array, 3) == struct.unpack_from("<h", data, 3)[0]
    assert get_i32(array, 4) == struct.unpack_from("<i", data, 4)[0]


@settings(deadline=None)  # the first call compiles
@given(value=st.integers(-32768, 65535))
def test_put_is_the_inverse_of_get(value: int) -> None:
    array = np.zeros(4, np.uint8)
    put_u16(array, 1, value)
    assert get_u16(array, 1) == value % 65536
    assert (array[0], array[3]) == (0, 0)
