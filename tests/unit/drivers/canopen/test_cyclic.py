"""The cyclic exchange: what it sends byte by byte, what it receives, old values, and whatever a bus may deliver."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import math
import os
import socket
import struct
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jointctl.drivers.can.frames import ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG, Frame
from jointctl.drivers.canopen import exchange
from jointctl.drivers.canopen.cia import State
from jointctl.drivers.canopen.cyclic import (
    ERROR_SHOWN_CYCLES,
    FRAME_SLOTS,
    IGNORED_MAX_CYCLES,
    SCRATCH_WORDS,
    SLOT_RECEIVED,
    SLOT_RPDO,
    STILL_REPORTS_CYCLES,
    CanopenPort,
    accept_frame,
    answer_owed,
    begin_cycle,
    end_cycle,
    get_i16,
    get_i32,
    get_u16,
    note_wake,
    put_u16,
    torque_permille,
)
from jointctl.drivers.canopen.pdo import joint_angle_per_count_rad, joint_torque_per_permille_Nm, new_port
from jointctl.drivers.canopen.settings import CanopenSettings
from jointctl.firmware_py.records import Command, Sample
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import DriveRequest, DriveState
from jointctl.tools.configuration.load import load_config
from jointctl.tools.virtual_joint import new_device
from tests.places import CONFIGS
from tests.unit.drivers.canopen.wire import RAD_PER_COUNT, STATUSWORDS, Wire

# --- Counts and per mille of the drive against radians and newton metres of the joint ---
SETTINGS = CanopenSettings(
    node=5, eds_path=Path("drive.eds"), mode="cst", rate_Hz=1000.0, heartbeat_s=0.2, master_node=127,
    quick_stop_option=2, rpdo_transmission_type=1, torque_reference="rated_torque", torque_direction=1,
    torque_max_Nm=60.0, torque_constant_NmpA=0.1, reduction_ratio=121.0, counts_per_turn=2**19,
    encoder_on_motor=False, encoder_direction=1, zero_counts=0,
)  # fmt: skip


@pytest.mark.parametrize(
    ("reference", "rated_torque_mNm", "rated_current_mA"),
    [("rated_torque", 500, 9999), ("rated_current", 9999, 5000)],
)
def test_torque_of_a_thousandth(reference: str, rated_torque_mNm: int, rated_current_mA: int) -> None:
    """500 mNm, or 5 A at 0.1 Nm/A, at the motor are 60.5 Nm at the joint, so a thousandth is 60.5 mNm."""
    settings = dataclasses.replace(SETTINGS, torque_reference=reference)
    assert joint_torque_per_permille_Nm(settings, rated_torque_mNm, rated_current_mA) == pytest.approx(0.0605)


@pytest.mark.parametrize(("on_motor", "turns"), [(False, 1.0), (True, 121.0)])
def test_angle_of_a_count(on_motor: bool, turns: float) -> None:
    settings = dataclasses.replace(SETTINGS, encoder_on_motor=on_motor)
    assert joint_angle_per_count_rad(settings) * 2**19 * turns == pytest.approx(2.0 * math.pi)


@pytest.mark.parametrize("node", [1, 5, 127])
def test_the_port_has_the_standard_identifiers_and_layout(node: int) -> None:
    port = new_port(dataclasses.replace(SETTINGS, node=node), 0.0605, 1000)[0]
    identifiers = (port.sync_id, port.emergency_id, port.tpdo_id, port.rpdo_id, port.heartbeat_id)
    assert identifiers == (0x80, 0x80 + node, 0x180 + node, 0x200 + node, 0x700 + node)
    assert port.own_heartbeat_id == 0x77F
    assert (port.tpdo_length, port.status_at, port.position_at, port.torque_at) == (8, 0, 2, 6)
    assert (port.rpdo_length, port.control_at, port.target_at) == (4, 0, 2)
    assert (port.fd, port.state, port.primed, port.max_permille) == (-1, State.UNDEFINED, 0, 1000)


@pytest.mark.parametrize("direction", [1, -1])
def test_directions_are_in_the_scale(direction: int) -> None:
    settings = dataclasses.replace(SETTINGS, encoder_direction=direction, torque_direction=-direction)
    port = new_port(settings, 0.0605, 1000)[0]
    assert port.position_radpcount == direction * joint_angle_per_count_rad(settings)
    assert port.torque_Nmppermille == -direction * 0.0605


@pytest.mark.parametrize(
    ("heartbeat_s", "rate_Hz", "cycles"), [(0.2, 1000.0, 66), (0.003, 1000.0, 1), (0.001, 500.0, 1), (1.0, 250.0, 83)]
)
def test_three_heartbeats_fit_into_the_time_out(heartbeat_s: float, rate_Hz: float, cycles: int) -> None:
    port = new_port(dataclasses.replace(SETTINGS, heartbeat_s=heartbeat_s, rate_Hz=rate_Hz), 0.06, 1000)[0]
    assert port.heartbeat_cycles == cycles


# --- What the cyclic exchange sends, byte by byte as CiA 301 and CiA 402 lay it out; every frame is written by hand ---
@pytest.fixture
def enabled(wire: Wire) -> Wire:
    wire.tpdo(STATUSWORDS[State.OPERATION_ENABLED])
    return wire


# --- what is sent ---
def test_sync_has_no_data_and_the_heartbeat_says_operational(wire: Wire) -> None:
    assert begin_cycle(wire.port, wire.frames) == 2
    assert wire.frames[0].tobytes() == bytes.fromhex("80000000 00000000 0000000000000000")
    assert wire.frames[1].tobytes() == bytes.fromhex("7f070000 01000000 0500000000000000")


@pytest.mark.parametrize(
    ("every", "expected"), [(3, [2, 1, 1, 2, 1, 1, 2]), (1, [2] * 7), (0, [1] * 7), (66, [2] + [1] * 6)]
)
def test_heartbeat_schedule(wire: Wire, every: int, expected: list[int]) -> None:
    wire.port.heartbeat_cycles = every
    assert [begin_cycle(wire.port, wire.frames) for _ in range(7)] == expected


@pytest.mark.trips("loop: that it is heard", "(IGNORED_MAX_CYCLES + 1, 1)")
@pytest.mark.stays("loop: that it is heard", "(IGNORED_MAX_CYCLES, 2)")
@pytest.mark.parametrize(("cycles", "frames"), [(IGNORED_MAX_CYCLES, 2), (IGNORED_MAX_CYCLES + 1, 1)])
def test_a_drive_that_stays_enabled_loses_the_heartbeat(enabled: Wire, cycles: int, frames: int) -> None:
    enabled.port.heartbeat_cycles = 1
    for _ in range(cycles):
        assert begin_cycle(enabled.port, enabled.frames) == 2
        enabled.rpdo(0.0, DriveRequest.QUICK_STOP)
    assert begin_cycle(enabled.port, enabled.frames) == frames
    # a drive that obeys in the end: within the limit all is forgotten, beyond it its watchdog stays without a heartbeat
    enabled.tpdo(STATUSWORDS[State.SWITCH_ON_DISABLED])
    enabled.port.repeated = 1
    enabled.rpdo(0.0, DriveRequest.QUICK_STOP)
    assert enabled.port.ignored_cycles == (0 if frames == 2 else cycles)
    assert begin_cycle(enabled.port, enabled.frames) == frames


OBEYS = {
    DriveRequest.OFF: {State.SWITCH_ON_DISABLED, State.FAULT, State.FAULT_REACTION_ACTIVE},
    DriveRequest.QUICK_STOP: {
        State.SWITCH_ON_DISABLED, State.FAULT, State.FAULT_REACTION_ACTIVE, State.QUICK_STOP_ACTIVE
    },
}  # fmt: skip


@pytest.mark.parametrize("state", State)
@pytest.mark.parametrize("request_", OBEYS)
@pytest.mark.parametrize("asked", [DriveRequest.ENABLE, DriveRequest.PREPARE, None])
def test_only_reports_of_stopping_show_that_the_drive_stops(
    wire: Wire, state: State, request_: DriveRequest, asked: DriveRequest | None
) -> None:
    """One report may be damaged, or of before it was enabled; a drive that was never asked need not obey."""
    if asked is not None:
        wire.rpdo(0.0, asked)
    wire.port.state = State.SWITCHED_ON if state is not State.SWITCHED_ON else State.FAULT
    enabled = state is State.OPERATION_ENABLED
    moving = enabled or (state is State.QUICK_STOP_ACTIVE and request_ is DriveRequest.OFF)
    for ignored in (asked is not None, asked is not None and moving):  # once, and once more
        begin_cycle(wire.port, wire.frames)
        wire.tpdo(STATUSWORDS.get(state, 0x0001))
        wire.port.ignored_cycles = 0
        wire.rpdo(0.0, request_)
        assert wire.port.ignored_cycles == (ignored or enabled)
    silent_for = 0  # until the report counts no more
    while wire.port.ignored_cycles == 0 and silent_for < 100:
        begin_cycle(wire.port, wire.frames)
        wire.rpdo(0.0, request_)
        silent_for += 1
    lasts = 100 if asked is None or state in OBEYS[request_] else STILL_REPORTS_CYCLES + 1
    assert silent_for == (0 if ignored or enabled else lasts)
    wire.port.ignored_cycles = 0
    wire.rpdo(0.0, DriveRequest.PREPARE)
    assert wire.port.ignored_cycles == enabled


@pytest.mark.parametrize("state", [State.READY_TO_SWITCH_ON, State.SWITCHED_ON])
def test_a_drive_that_waits_for_its_brake_keeps_the_heartbeat(enabled: Wire, state: State) -> None:
    """It reports "switched on" until the brake has closed: a normal stop ended as OFF_TIMEOUT."""
    for _ in range(10 * IGNORED_MAX_CYCLES):
        begin_cycle(enabled.port, enabled.frames)
        enabled.tpdo(STATUSWORDS[state])
        enabled.rpdo(0.0, DriveRequest.OFF)
    assert enabled.port.ignored_cycles == 0


@pytest.mark.parametrize(
    ("torque_Nm", "target"),
    [
        (12.1, "c800"),  # 200 permille = 0x00C8
        (-12.1, "38ff"), (-0.0605, "ffff"), (0.0, "0000"), (math.nan, "0000"), (math.inf, "0000"), (-math.inf, "0000"),
    ],
)  # fmt: skip
def test_rpdo_of_an_enabled_drive(enabled: Wire, torque_Nm: float, target: str) -> None:
    """Controlword 0x000F; node 5 listens at 0x205; no byte of an earlier frame stays."""
    enabled.frames[2].payload[:] = 0xFF
    assert enabled.rpdo(torque_Nm) == bytes.fromhex(f"05020000 04000000 0f00{target}00000000")


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


@pytest.mark.filterwarnings("ignore:.*encountered in scalar:RuntimeWarning")  # plain Python tells of inf - inf
@given(torque_Nm=st.floats(allow_nan=True, allow_infinity=True), limit=st.integers(0, 32767))
def test_whatever_the_torque_the_object_stays_in_its_limit(torque_Nm: float, limit: int) -> None:
    wire = Wire()
    wire.port.max_permille = limit
    permille = torque_permille(wire.port, torque_Nm)
    assert abs(permille) <= limit
    if math.isfinite(torque_Nm) and abs(torque_Nm) < 0.0605 * limit:
        assert abs(permille * 0.0605 - torque_Nm) <= 0.5001 * 0.0605


# --- the exported half of the lockstep simulation ---
def test_exchange_memory_has_room_for_every_slot(wire: Wire) -> None:
    _, frames, scratch, *_ = exchange.link_of(wire.ports)
    assert (len(frames), frames.dtype.itemsize, len(scratch)) == (FRAME_SLOTS, 16, SCRATCH_WORDS)
    assert scratch.dtype == np.int64


def test_one_whole_enable_by_statuswords(wire: Wire) -> None:
    words = []
    for status in (0x0250, 0x0231, 0x0233, 0x1637):
        wire.tpdo(status)
        frame = wire.rpdo(12.1)
        words.append(frame[8:12].hex())
    assert words == ["06000000", "07000000", "0f000000", "0f00c800"]


# --- What the cyclic exchange receives: TPDO, emergencies, errors of the bus, the drive's own heartbeat ---
# --- what is received ------------------------------------------------------------------------------------------
def test_tpdo_by_hand(wire: Wire) -> None:
    # statusword 0x1637, position 0x00012345 = 74565 counts, torque 0xFF38 = -200 permille
    assert wire.receive(0x185, bytes.fromhex("3716 45230100 38ff"), now_ns=77)
    sample = wire.sample
    assert (sample.status_word, sample.drive_state, sample.count) == (0x1637, DriveState.ENABLED, 1)
    assert sample.position_rad == pytest.approx(74565 * RAD_PER_COUNT)
    assert sample.torque_Nm == pytest.approx(-12.1)
    assert sample.time_ns == 77


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


@pytest.mark.parametrize(
    ("identifier", "length"),
    [
        *((0x185, length) for length in range(8)),
        *((identifier, 8) for identifier in (
            0x184, 0x186, 0x285, 0x205, 0x80, 0x85 | EXTENDED_FLAG, 0x185 | EXTENDED_FLAG, 0x185 | REMOTE_FLAG, 0x585,
            0x701,
        )),
    ],
)  # fmt: skip
def test_a_short_tpdo_is_counted_and_ignored_and_what_is_not_ours_is_ignored(
    wire: Wire, identifier: int, length: int
) -> None:
    wire.tpdo(0x0250, 1000, 5)
    before = wire.sample.tobytes()
    assert not wire.receive(identifier, struct.pack("<Hih", 0x1637, 9999, 99)[:length])
    assert wire.sample.tobytes() == before
    assert (wire.port.malformed, wire.port.error_frames) == (length < 8, 0)
    assert wire.port.state == State.SWITCH_ON_DISABLED
    assert wire.tpdo(0x0250, 1001)  # the twin of full length


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


# --- the drive's own heartbeat ---
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
    for data, restarts in (("05", 0), ("85", 0), ("7f", 0), ("", 0), ("00", 1), ("05", 1), ("80", 2)):
        wire.receive(0x705, bytes.fromhex(data))
        assert wire.sample.restarts == restarts
    wire.receive(0x706, b"\x00")
    assert wire.sample.restarts == 2


def test_a_heartbeat_out_of_operational_announces_that_no_samples_come_and_a_sample_refutes_it(wire: Wire) -> None:
    for data, sends_none in (("05", 0), ("04", 1), ("05", 0), ("7f", 1), ("ff", 1), ("", 1), ("00", 0), ("84", 1)):
        wire.receive(0x705, bytes.fromhex(data))
        assert wire.sample.sends_none == sends_none
    wire.receive(0x706, b"\x05")
    assert wire.sample.sends_none == 1
    begin_cycle(wire.port, wire.frames)
    wire.receive(0x185, b"\x37")  # too short: none
    assert wire.sample.sends_none == 1
    wire.receive(0x185, b"\x37\x02\0\0\0\0\0\0")
    assert wire.sample.sends_none == 0


def test_a_drive_that_has_booted_is_off_until_it_reports_otherwise(wire: Wire) -> None:
    """Its last TPDO said "enabled": it was taken for a drive that ignores its stop, and the heartbeat was withheld."""
    for reported, data in ((DriveState.ENABLED, None), (DriveState.OFF, b"\x00"), (DriveState.ENABLED, None)):
        begin_cycle(wire.port, wire.frames)
        if data is None:
            wire.tpdo(STATUSWORDS[State.OPERATION_ENABLED])
        else:
            wire.receive(0x705, data)
        assert wire.sample.drive_state == reported
        wire.rpdo(0.0, DriveRequest.OFF)
        assert wire.port.ignored_cycles == (0 if reported == DriveState.OFF else 1)


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


@given(data=st.binary(min_size=8, max_size=8), value=st.integers(-32768, 65535))
@example(data=bytes.fromhex("0000800000000080"), value=-32768)  # the lowest integers
def test_integers_are_little_endian(data: bytes, value: int) -> None:
    array = np.frombuffer(data, np.uint8).copy()
    found = get_i16(array, 1), get_u16(array, 2), get_i32(array, 4)
    assert found == tuple(struct.unpack_from(form, data, at)[0] for form, at in (("<h", 1), ("<H", 2), ("<i", 4)))
    put_u16(array, 1, value)
    assert array.tobytes() == data[:1] + struct.pack("<H", value % 65536) + data[3:]


# --- A TPDO that repeats or delays an old value is not taken for a new sample ---
def test_a_tpdo_after_the_answer_is_not_a_new_sample(wire: Wire) -> None:
    """Doubled or late, it would make an old position look fresh."""
    begin_cycle(wire.port, wire.frames)
    assert wire.tpdo(counts=100)
    wire.rpdo(0.0)
    assert not wire.tpdo(STATUSWORDS[State.OPERATION_ENABLED], counts=50)
    assert (wire.sample.count, wire.port.surplus, wire.port.state) == (1, 1, State.SWITCH_ON_DISABLED)
    assert wire.sample.position_rad == pytest.approx(100 * RAD_PER_COUNT)
    begin_cycle(wire.port, wire.frames)
    assert wire.sample.count == 1  # the age goes on
    assert wire.tpdo(counts=101)


def test_a_tpdo_that_comes_after_its_cycle_but_is_the_first_answer_is_one(wire: Wire) -> None:
    begin_cycle(wire.port, wire.frames)
    wire.rpdo(0.0)
    assert wire.tpdo(counts=7)
    begin_cycle(wire.port, wire.frames)
    wire.rpdo(0.0)
    assert wire.tpdo(counts=8)
    assert (wire.sample.count, wire.port.surplus) == (2, 0)


def test_of_a_burst_the_last_one_counts(wire: Wire) -> None:
    for _ in range(3):
        begin_cycle(wire.port, wire.frames)
        wire.rpdo(0.0)
    for counts in (1, 2, 3):
        assert wire.tpdo(counts=counts)
    assert wire.sample.position_rad == pytest.approx(3 * RAD_PER_COUNT)


class Line:
    """`exchange.receive` on a bus, with a drive whose answers come when the test says."""

    def __init__(self, wire: Wire) -> None:
        self.wire = wire
        self.drive, self.ours = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        wire.port.fd = self.ours.fileno()
        self.link = exchange.link_of(wire.ports)._replace(frames=wire.frames)

    def cycle(self, *answers: tuple[float, int], window_s: float) -> float:
        """One cycle with the drive's (pause [s], counts) after SYNC; returns the counts that it ends with."""
        thread = threading.Thread(target=self._answer, args=(answers,))
        thread.start()
        wire, now_ns = self.wire, time.monotonic_ns()
        exchange.receive(self.link, wire.samples, np.int64(now_ns), np.int64(now_ns + window_s * 1e9))
        taken = float(wire.sample.position_rad) / RAD_PER_COUNT
        thread.join()
        wire.rpdo(0.0)
        return taken

    def _answer(self, answers: tuple[tuple[float, int], ...]) -> None:
        while struct.unpack_from("<I", self.drive.recv(16))[0] != 0x80:
            pass
        for pause_s, counts in answers:
            time.sleep(pause_s)
            self.drive.send(struct.pack("<IB3xHih", 0x185, 8, 0x0250, counts, 0))


@pytest.fixture
def line(wire: Wire) -> Iterator[Line]:
    made = Line(wire)
    yield made
    made.drive.close()
    made.ours.close()


def test_after_a_cycle_without_answer_the_last_tpdo_counts(line: Line) -> None:
    """Its answer may come behind the next SYNC, and then in front of the next answer: a position one period old."""
    assert line.cycle((0.0, 10), window_s=30.0) == pytest.approx(10)
    assert line.cycle(window_s=0.01) == pytest.approx(10)
    assert line.cycle((0.0, 20), (0.05, 30), window_s=1.0) == pytest.approx(30)
    assert line.wire.port.surplus == 0
    assert line.cycle((0.0, 40), window_s=30.0) == pytest.approx(40)  # no need to wait any more


def test_after_an_answered_cycle_the_first_tpdo_ends_the_wait(line: Line) -> None:
    assert line.cycle((0.0, 10), window_s=30.0) == pytest.approx(10)
    assert line.cycle((0.0, 20), (0.1, 30), window_s=30.0) == pytest.approx(20)
    assert line.cycle((0.0, 40), window_s=30.0) == pytest.approx(40)
    assert line.wire.port.surplus == 1


def test_an_answer_that_comes_between_the_cycles_is_not_owed(line: Line) -> None:
    line.cycle(window_s=0.01)
    line.wire.tpdo(counts=20)
    assert line.cycle((0.0, 30), window_s=30.0) == pytest.approx(30)


class TwoDrives:
    """`exchange` with two drives on one bus, of which those in `answering` answer SYNC; what they received."""

    def __init__(self, wire: Wire, ours: socket.socket, bus: socket.socket) -> None:
        self.ports, self.samples, self.commands = new(CanopenPort, 2), new(Sample, 2), new(Command, 2)
        for axis, port in enumerate(self.ports):
            self.ports[axis] = wire.port
            port.fd = ours.fileno()
            port.tpdo_id, port.rpdo_id, port.emergency_id, port.heartbeat_id = (
                base + axis for base in (0x185, 0x205, 0x85, 0x705)
            )
        self.link, self.bus = exchange.link_of(self.ports), bus

    def cycle(self, window_s: float, *answering: int, before: bytes = b"") -> tuple[bool, list[int]]:
        """(whether it has waited for the end of the window, what it sent); `before` the answers comes a frame."""
        sent: list[int] = []

        def drives() -> None:
            while not sent or sent[-1] != 0x80:
                sent.append(self._identifier())
            if before:
                self.bus.send(before)
            for axis in answering:
                self.bus.send(struct.pack("<IB3xHih", 0x185 + axis, 8, 0x0250, 100 * (axis + 1), 0))

        thread = threading.Thread(target=drives)
        thread.start()
        now_ns = time.monotonic_ns()
        until_ns = now_ns + round(window_s * 1e9)
        exchange.receive(self.link, self.samples, np.int64(now_ns), np.int64(until_ns))
        over = time.monotonic_ns() >= until_ns
        thread.join()
        assert exchange.send(self.link, self.samples, self.commands) == 0
        while sent[-1] != 0x206:
            sent.append(self._identifier())
        return over, sent

    def _identifier(self) -> int:
        return int(struct.unpack_from("<I", self.bus.recv(16))[0])


@pytest.fixture
def two_drives(wire: Wire) -> Iterator[TwoDrives]:
    bus, ours = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with bus, ours:
        yield TwoDrives(wire, ours, bus)


def test_one_exchange_serves_the_drives_of_a_bus(two_drives: TwoDrives) -> None:
    """One SYNC and one heartbeat for both, an RPDO and a sample of each; both are waited for."""
    assert two_drives.cycle(30.0, 0, 1) == (False, [0x80, 0x77F, 0x205, 0x206])
    assert list(two_drives.samples["count"]) == [1, 1]
    assert list(two_drives.samples["position_rad"] / RAD_PER_COUNT) == pytest.approx([100.0, 200.0])


@pytest.mark.parametrize("answering", [0, 1])
def test_its_twin_a_drive_that_does_not_answer_costs_the_window_and_not_the_others_sample(
    two_drives: TwoDrives, answering: int
) -> None:
    assert two_drives.cycle(0.02, answering)[0]
    assert list(two_drives.samples["count"]) == [1 - answering, answering]


def test_rpdos_of_another_controller_are_counted_for_their_drive(two_drives: TwoDrives) -> None:
    two_drives.commands["torque_Nm"] = 3.0
    two_drives.cycle(30.0, 0, 1)
    own = bytes(two_drives.link.batch.frames[1].payload[:4])
    for data in (b"\x0f\0\x64\0", b"\x0f\0", b"\x06\0\0\0"):  # torque, one that is too short, another command
        two_drives.bus.send(struct.pack("<IB3x8s", 0x206, len(data), data))
    for identifier, data in ((0x206, own), (0x306, b"\x0f\0\x64\0"), (0x80000206, b"\x0f\0\x64\0")):
        two_drives.bus.send(struct.pack("<IB3x8s", identifier, 4, data))  # none: as ours, not the drive's, not standard
    two_drives.cycle(30.0, 0, 1)
    assert list(two_drives.ports["of_others"]) == [0, 3]


def test_sync_counts_as_anothers_unless_it_may_be_our_own_repeated(two_drives: TwoDrives) -> None:
    sync = struct.pack("<IB3x8s", 0x80, 0, b"")
    two_drives.bus.send(sync)  # of before
    two_drives.cycle(0.02)  # our own may be among what waits after a cycle without an answer
    two_drives.bus.send(sync)
    two_drives.cycle(3.0, 0, 1, before=sync)  # repeated at once; the answers of before are waited for to the end
    assert list(two_drives.ports["of_another_sync"]) == [0, 0]
    two_drives.bus.send(sync)
    two_drives.cycle(30.0, 0, 1)
    assert list(two_drives.ports["of_another_sync"]) == [1, 1]


@pytest.mark.parametrize(("cycles", "counted"), [(5, 0), (6, 1)])
def test_a_heartbeat_of_our_number_counts_as_anothers_unless_it_may_be_our_last_one_repeated(
    two_drives: TwoDrives, cycles: int, counted: int
) -> None:
    two_drives.ports["heartbeat_cycles"] = 9  # the first cycle sends it
    two_drives.bus.send(struct.pack("<IB3x8s", 0x77F, 1, b"\x05"))  # the supervisor's, of before
    for _ in range(cycles):
        two_drives.cycle(30.0, 0, 1)
    two_drives.bus.send(struct.pack("<IB3x8s", 0x77F, 1, b"\x05"))
    two_drives.cycle(30.0, 0, 1)
    assert list(two_drives.ports["of_another_heart"]) == [counted, counted]
    assert list(two_drives.ports["of_others"]) == [0, 0]


@pytest.mark.parametrize("deaf", [0, 1])
def test_a_drive_that_ignores_a_stop_costs_both_the_heartbeat(two_drives: TwoDrives, deaf: int) -> None:
    two_drives.ports[deaf].ignored_cycles = IGNORED_MAX_CYCLES + 1
    assert two_drives.cycle(30.0, 0, 1)[1] == [0x80, 0x205, 0x206]


@pytest.mark.parametrize("room", [0, 1, 2])
def test_what_the_queue_does_not_take_is_an_error_of_its_own_drive(two_drives: TwoDrives, room: int) -> None:
    """RPDOs go out in one call, which may take the first ones only."""
    ours = socket.socket(fileno=os.dup(int(two_drives.ports[0].fd)))
    with ours, contextlib.suppress(BlockingIOError):
        while True:
            ours.send(bytes(16), socket.MSG_DONTWAIT)
    for _ in range(room):
        two_drives.bus.recv(16)
    for axis, port in enumerate(two_drives.ports):
        port.rpdo_filler[:] = 10 + axis
    failed = exchange.send(two_drives.link, two_drives.samples, two_drives.commands)
    assert failed == (0 if room == 2 else errno.EAGAIN)
    assert list(two_drives.samples["bus_errors"]) == [int(axis >= room) for axis in range(2)]
    frames = []
    with contextlib.suppress(BlockingIOError):
        while frame := two_drives.bus.recv(16, socket.MSG_DONTWAIT):
            frames.append((*struct.unpack_from("<I", frame), frame[15]))
    assert [frame for frame in frames if frame[0]] == [(0x205, 10), (0x206, 11)][:room]


class TwoBuses(TwoDrives):
    """The second drive, with the node of the first, on a bus of its own."""

    def __init__(self, wire: Wire, ours: list[socket.socket], buses: list[socket.socket]) -> None:
        super().__init__(wire, ours[0], buses[0])
        self.buses = buses
        self.ports.bus[:] = (0, 1)
        self.ports.fd[:] = [end.fileno() for end in ours]
        for name in ("tpdo_id", "rpdo_id", "emergency_id", "heartbeat_id"):
            self.ports[name] = self.ports[name][0]

    def both(self, window_s: float, *answering: int) -> list[list[int]]:
        """What each bus got in a cycle in which these drives answer."""
        for number in answering:  # before it: it counts as the answer, since none has come so far
            self.buses[number].send(struct.pack("<IB3xHih", 0x185, 8, 0x0250, 100 * (number + 1), 0))
        now_ns = time.monotonic_ns()
        exchange.receive(self.link, self.samples, np.int64(now_ns), np.int64(now_ns + window_s * 1e9))
        exchange.send(self.link, self.samples, self.commands)
        found: list[list[int]] = []
        for bus in self.buses:
            found.append([])
            with contextlib.suppress(OSError):
                while frame := bus.recv(16, socket.MSG_DONTWAIT):
                    found[-1].append(struct.unpack_from("<I", frame)[0])
        return found


@pytest.fixture
def two_buses(wire: Wire) -> Iterator[TwoBuses]:
    with contextlib.ExitStack() as stack:
        pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(2)]
        for end in (end for pair in pairs for end in pair):
            stack.enter_context(end)
        yield TwoBuses(wire, [ours for _, ours in pairs], [bus for bus, _ in pairs])


def test_each_bus_gets_its_sync_and_heartbeat_and_the_answers_of_one_are_no_others(two_buses: TwoBuses) -> None:
    assert two_buses.both(0.01, 0, 1) == [[0x80, 0x77F, 0x205]] * 2
    assert list(two_buses.samples["count"]) == [1, 1]
    assert list(two_buses.samples["position_rad"] / RAD_PER_COUNT) == pytest.approx([100.0, 200.0])
    assert two_buses.samples[0].sync_late_ns == 0
    assert 0 < two_buses.samples[1].sync_late_ns < 1_000_000_000


@pytest.mark.parametrize("silent", [0, 1])
def test_a_silent_bus_costs_the_other_none_of_its_samples(two_buses: TwoBuses, silent: int) -> None:
    assert two_buses.both(0.01, 1 - silent) == [[0x80, 0x77F, 0x205]] * 2
    assert list(two_buses.samples["count"]) == [silent, 1 - silent]


@pytest.mark.parametrize("lost", [0, 1])
def test_a_bus_that_has_gone_is_an_error_of_its_own_drives(two_buses: TwoBuses, lost: int) -> None:
    two_buses.buses[lost].close()
    two_buses.buses[lost] = two_buses.buses[1 - lost]
    two_buses.both(0.01, 1 - lost)
    assert two_buses.samples[1 - lost].bus_errors == 0
    assert two_buses.samples[lost].bus_errors == 3  # SYNC, heartbeat, RPDO


def test_a_drive_that_ignores_a_stop_costs_every_bus_the_heartbeat(two_buses: TwoBuses) -> None:
    two_buses.ports[1].ignored_cycles = IGNORED_MAX_CYCLES + 1
    assert two_buses.both(0.01, 0, 1) == [[0x80, 0x205]] * 2


@pytest.mark.parametrize(
    ("cycle", "second_id", "seen", "owed"),
    [(0, 0, 0, 0), (1, 0, 0, 1), (1, 0, 1, 0), (1, 0x186, 1, 1), (1, 0x186, 2, 1), (1, 0x186, 3, 0)],
)
def test_when_an_answer_is_owed(wire: Wire, cycle: int, second_id: int, seen: int, owed: int) -> None:
    wire.port.cycle, wire.port.seen, wire.port.second.tpdo_id = cycle, seen, second_id
    assert answer_owed(wire.port) == owed


@pytest.mark.parametrize(("later_ns", "taken"), [(1_000_000, True), (1_500_000, True), (1_500_001, False)])
def test_an_answer_that_has_waited_through_a_pause_is_no_sample(wire: Wire, later_ns: int, taken: bool) -> None:
    """The loop got no processor while it waited; 10 ms later the answer passed for a sample of that slot."""
    wire.port.period_ns = 1_000_000
    note_wake(wire.port, 7_000_000)
    begin_cycle(wire.port, wire.frames)
    wire.rpdo(0.0)
    note_wake(wire.port, 7_000_000 + later_ns)
    assert wire.tpdo(STATUSWORDS[State.FAULT], counts=100) == taken
    assert (wire.sample.count, wire.port.surplus) == ((1, 0) if taken else (0, 1))
    assert wire.port.state == State.FAULT  # what the drive says of itself is taken all the same
    begin_cycle(wire.port, wire.frames)
    assert wire.tpdo(counts=101)  # that of this slot


def test_without_a_period_an_answer_of_any_age_is_a_sample(wire: Wire) -> None:
    note_wake(wire.port, 10**12)
    assert wire.tpdo(counts=100)


# Whatever a bus may deliver: the cyclic protocol, the virtual drive and its SDO server never fail, and stay sane.
quick = settings(max_examples=200)
identifiers = st.one_of(
    st.sampled_from([0x000, 0x080, 0x081, 0x181, 0x201, 0x581, 0x601, 0x701, 0x77E]),
    st.integers(0, 0x7FF),
    st.integers(0, 0xFFFFFFFF),
)
frames = st.tuples(identifiers, st.integers(0, 255), st.binary(min_size=8, max_size=8))


@quick
@given(received=st.lists(frames, min_size=1, max_size=40), torque=st.floats(allow_nan=True, allow_infinity=True))
def test_any_frames_into_the_cyclic_protocol(
    received: list[tuple[int, int, bytes]], torque: float, settings_of_virtual_joint: Any
) -> None:
    port = new_port(settings_of_virtual_joint, 0.0605, 1000)[0]
    memory, sample, command = new(Frame, FRAME_SLOTS), new(Sample)[0], new(Command)[0]
    for now_ns, (identifier, length, data) in enumerate(received):
        begin_cycle(port, memory)
        frame = memory[SLOT_RECEIVED]
        frame.can_id, frame.length = identifier, length
        frame.payload[:] = np.frombuffer(data, np.uint8)
        before = int(sample.count)
        taken = accept_frame(port, frame, sample, now_ns)
        assert taken == (sample.count == before + 1)
        if taken:
            assert identifier == port.tpdo_id
            assert length >= port.tpdo_length
        assert math.isfinite(sample.position_rad)
        assert math.isfinite(sample.torque_Nm)
        assert 0 <= sample.status_word <= 0xFFFF
        assert int(sample.drive_state) in list(DriveState)
        command.torque_Nm, command.request = torque, DriveRequest.ENABLE
        end_cycle(port, memory, sample, command)
        sent = memory[SLOT_RPDO]
        permille = struct.unpack_from("<h", bytes(sent.payload), int(port.target_at))[0]
        assert abs(permille) <= port.max_permille
        if sample.drive_state != DriveState.ENABLED:
            assert permille == 0


@quick
@given(low=st.binary(min_size=8, max_size=8), length=st.integers(0, 8))
def test_a_tpdo_is_decoded_or_counted_as_malformed(low: bytes, length: int, settings_of_virtual_joint: Any) -> None:
    port = new_port(settings_of_virtual_joint, 0.0605, 1000)[0]
    memory, sample = new(Frame, FRAME_SLOTS), new(Sample)[0]
    frame = memory[SLOT_RECEIVED]
    frame.can_id, frame.length = port.tpdo_id, length
    frame.payload[:] = np.frombuffer(low, np.uint8)
    assert accept_frame(port, frame, sample, 5) is (length >= 8)
    if length < 8:
        assert (port.malformed, sample.count) == (1, 0)
        return
    status, counts, torque = struct.unpack("<Hih", low)
    assert sample.status_word == status
    assert port.counts == counts
    assert sample.torque_Nm == pytest.approx(torque * port.torque_Nmppermille)


@pytest.fixture(scope="module")
def device() -> Any:

    return new_device(load_config(CONFIGS / "virtual.toml"))


@quick
@given(received=st.lists(st.tuples(identifiers, st.integers(0, 8), st.binary(min_size=8, max_size=8)), max_size=20))
def test_any_frames_into_the_virtual_drive(device: Any, received: list[tuple[int, int, bytes]]) -> None:
    now_ns = max(int(device.device[0].time_ns), 1)
    for identifier, length, data in received:
        now_ns += 1000
        for frame in device.handle(struct.pack("<IB3x8s", identifier, length, data), now_ns):
            assert len(frame) == 16
            assert frame[4] <= 8
            assert struct.unpack_from("<I", frame)[0] <= 0x7FF
    assert math.isfinite(device.plant_state[0].joint_position_rad)


@quick
@given(requests=st.lists(st.binary(min_size=0, max_size=8), min_size=1, max_size=20))
def test_any_sdo_requests_are_answered_by_eight_bytes_or_not_at_all(device: Any, requests: list[bytes]) -> None:
    for request in requests:
        for response in device.sdo.handle(request):
            assert len(response) == 8
    # and afterwards a good request is answered: an abort, then the device type
    device.sdo.handle(bytes([0x80, 0, 0, 0, 0, 0, 0, 0]))
    (answer,) = device.sdo.handle(bytes([0x40, 0x00, 0x10, 0, 0, 0, 0, 0]))
    assert answer[:4] == bytes([0x43, 0x00, 0x10, 0x00])
