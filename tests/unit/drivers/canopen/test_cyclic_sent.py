"""What the cyclic exchange sends, byte by byte as CiA 301 and CiA 402 lay it out; every frame is written by hand."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointctl.drivers.canopen import exchange
from jointctl.drivers.canopen.cia402 import State
from jointctl.drivers.canopen.cyclic import (
    FRAME_SLOTS,
    IGNORED_MAX_CYCLES,
    SCRATCH_WORDS,
    begin_cycle,
    torque_permille,
)
from jointctl.firmware_py.states import DriveRequest
from tests.unit.drivers.canopen.wire import STATUSWORDS, Wire


@pytest.fixture
def enabled(wire: Wire) -> Wire:
    wire.tpdo(STATUSWORDS[State.OPERATION_ENABLED])
    return wire


# --- what is sent ----------------------------------------------------------------------------------------------


def test_sync_has_no_data(wire: Wire) -> None:
    wire.port.cycle = 1
    assert begin_cycle(wire.port, wire.frames) == 1
    assert wire.frames[0].tobytes() == bytes.fromhex("80000000 00000000 0000000000000000")


def test_heartbeat_says_operational(wire: Wire) -> None:
    assert begin_cycle(wire.port, wire.frames) == 2
    assert wire.frames[1].tobytes() == bytes.fromhex("7f070000 01000000 0500000000000000")


@pytest.mark.parametrize(
    ("every", "expected"), [(3, [2, 1, 1, 2, 1, 1, 2]), (1, [2] * 7), (0, [1] * 7), (66, [2] + [1] * 6)]
)
def test_heartbeat_schedule(wire: Wire, every: int, expected: list[int]) -> None:
    wire.port.heartbeat_cycles = every
    assert [begin_cycle(wire.port, wire.frames) for _ in range(7)] == expected


@pytest.mark.parametrize(("cycles", "frames"), [(IGNORED_MAX_CYCLES, 2), (IGNORED_MAX_CYCLES + 1, 1)])
def test_a_drive_that_stays_enabled_loses_the_heartbeat(enabled: Wire, cycles: int, frames: int) -> None:
    enabled.port.heartbeat_cycles = 1
    for _ in range(cycles):
        assert begin_cycle(enabled.port, enabled.frames) == 2
        enabled.rpdo(0.0, DriveRequest.QUICK_STOP)
    assert begin_cycle(enabled.port, enabled.frames) == frames
    # a drive that obeys in the end: within the limit all is forgotten, beyond it its watchdog stays without a heartbeat
    enabled.tpdo(STATUSWORDS[State.SWITCH_ON_DISABLED])
    enabled.rpdo(0.0, DriveRequest.QUICK_STOP)
    assert enabled.port.ignored_cycles == (0 if frames == 2 else cycles)
    assert begin_cycle(enabled.port, enabled.frames) == frames


def test_rpdo_of_an_enabled_drive(enabled: Wire) -> None:
    # 12.1 Nm = 200 permille = 0x00C8; controlword 0x000F; node 5 listens at 0x205
    assert enabled.rpdo(12.1) == bytes.fromhex("05020000 04000000 0f00c80000000000")


def test_rpdo_of_a_negative_torque_is_twos_complement(enabled: Wire) -> None:
    assert enabled.rpdo(-12.1) == bytes.fromhex("05020000 04000000 0f0038ff00000000")
    assert enabled.rpdo(-0.0605) == bytes.fromhex("05020000 04000000 0f00ffff00000000")


def test_a_motor_mounted_the_other_way_round(enabled: Wire) -> None:
    enabled.port.torque_Nmppermille = -0.0605
    assert enabled.rpdo(12.1)[8:12] == bytes.fromhex("0f0038ff")
    enabled.tpdo(torque=-200)
    assert enabled.sample.torque_Nm == pytest.approx(12.1)


@pytest.mark.parametrize("state", State)
@pytest.mark.parametrize("request_", DriveRequest)
def test_torque_is_zero_unless_asked_and_operation_enabled(wire: Wire, state: State, request_: DriveRequest) -> None:
    wire.tpdo(STATUSWORDS.get(state, 0x0001))
    assert wire.port.state == state
    frame = wire.rpdo(12.1, request_)
    may = state is State.OPERATION_ENABLED and request_ is DriveRequest.ENABLE
    assert frame[10:12] == (b"\xc8\x00" if may else b"\x00\x00")
    assert frame[12:] == b"\0\0\0\0"
    assert not frame[8] & 0x80


@pytest.mark.parametrize("limit", [1000, 32767])
@pytest.mark.parametrize("sign", [1, -1])
def test_torque_saturates_and_never_wraps(enabled: Wire, limit: int, sign: int) -> None:
    enabled.port.max_permille = limit
    for k in range(-20, 21):
        value = sign * (limit + k)
        expected = sign * min(limit + k, limit)
        sent = struct.unpack("<h", enabled.rpdo(value * 0.0605)[10:12])[0]
        assert sent == expected
    for far in (40_000.0, 65_536.0, 1e9, 1e30, 1e300):
        assert struct.unpack("<h", enabled.rpdo(sign * far * 0.0605)[10:12])[0] == sign * limit


@pytest.mark.parametrize("torque_Nm", [math.nan, math.inf, -math.inf])
def test_a_torque_that_is_not_finite_is_zero(enabled: Wire, torque_Nm: float) -> None:
    assert enabled.rpdo(torque_Nm)[8:12] == bytes.fromhex("0f000000")


@pytest.mark.filterwarnings("ignore:.*encountered in scalar:RuntimeWarning")  # plain Python tells of inf - inf
@settings(deadline=None)  # the first call compiles
@given(torque_Nm=st.floats(allow_nan=True, allow_infinity=True), limit=st.integers(0, 32767))
def test_whatever_the_torque_the_object_stays_in_its_limit(torque_Nm: float, limit: int) -> None:
    wire = Wire()
    wire.port.max_permille = limit
    permille = torque_permille(wire.port, torque_Nm)
    assert abs(permille) <= limit
    if math.isfinite(torque_Nm) and abs(torque_Nm) < 0.0605 * limit:
        assert abs(permille * 0.0605 - torque_Nm) <= 0.5001 * 0.0605


def test_no_byte_of_an_earlier_frame_stays(enabled: Wire) -> None:
    enabled.frames[2].payload[:] = 0xFF
    assert enabled.rpdo(0.0) == bytes.fromhex("05020000 04000000 0f00000000000000")


# --- the exported half of the lockstep simulation --------------------------------------------------------------


def test_exchange_memory_has_room_for_every_slot() -> None:
    frames, scratch = exchange.exchange_memory()
    assert (len(frames), frames.dtype.itemsize, len(scratch)) == (FRAME_SLOTS, 16, SCRATCH_WORDS)
    assert scratch.dtype == np.int64


def test_one_whole_enable_by_statuswords(wire: Wire) -> None:
    words = []
    for status in (0x0250, 0x0231, 0x0233, 0x1637):
        wire.tpdo(status)
        frame = wire.rpdo(12.1)
        words.append(frame[8:12].hex())
    assert words == ["06000000", "07000000", "0f000000", "0f00c800"]
