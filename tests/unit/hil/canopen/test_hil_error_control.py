"""NMT, node guarding, heartbeat, SYNC counter and emergency messages of the virtual drive (CiA 301)."""

from __future__ import annotations

import itertools
import struct

import pytest

from jointctl.hil.canopen.records import PowerState
from tests.virtual_drive import NODE, REMOTE, Rig

GUARD = REMOTE | 0x700 + NODE
BOOT, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0, 4, 5, 127


@pytest.fixture
def rig() -> Rig:
    return Rig(step_s=1e-3)


def guard(rig: Rig) -> list[int]:
    return [data[0] for identifier, data in rig.send(GUARD, b"") if identifier == 0x700 + NODE]


@pytest.mark.parametrize("start", [0x80, 0x01, 0x02])
@pytest.mark.parametrize(
    ("command", "state"), [(0x01, OPERATIONAL), (0x02, STOPPED), (0x80, PRE_OPERATIONAL), (0x81, BOOT), (0x82, BOOT)]
)
@pytest.mark.parametrize("node", [0, NODE, NODE + 1])
def test_every_nmt_command_in_every_state(rig: Rig, start: int, command: int, state: int, node: int) -> None:
    rig.send(0, bytes([start, NODE]))
    before = int(rig.device.device[0].nmt)
    sent = rig.send(0, bytes([command, node])) + rig.run(1)
    boots = sent.count((0x700 + NODE, b"\0"))
    if node == NODE + 1:
        state = before
    assert boots == (state == BOOT)
    assert int(rig.device.device[0].nmt) == (state or PRE_OPERATIONAL)


@pytest.mark.parametrize("data", [b"", b"\x01", b"\x01\x05\x00", b"\x00\x05", b"\x03\x05", b"\x7f\x05", b"\x83\x05"])
def test_what_is_no_nmt_command_changes_nothing(rig: Rig, data: bytes) -> None:
    rig.send(0, data)
    rig.run(1)
    assert rig.device.device[0].nmt == PRE_OPERATIONAL
    assert len(rig.sent) == 1


def test_sdo_pdo_sync_and_emergency_live_as_the_nmt_state_says(rig: Rig) -> None:
    read = struct.pack("<BHB4x", 0x40, 0x1001, 0)
    for command, sdo, pdo in ((0x80, True, False), (0x01, True, True), (0x02, False, False)):
        rig.send(0, bytes([command, NODE]))
        assert bool(rig.send(0x600 + NODE, read)) is sdo
        before = rig.get(0x6040)
        rig.send(0x200 + NODE, struct.pack("<H", before ^ 0x40))
        assert (rig.get(0x6040) != before) is pdo


def test_node_guarding_tells_the_state_with_a_toggle_bit(rig: Rig) -> None:
    assert [guard(rig), guard(rig), guard(rig)] == [[0x7F], [0xFF], [0x7F]]
    rig.operational()
    assert guard(rig) == [0x85]
    rig.send(0, bytes([0x02, NODE]))
    assert guard(rig) == [0x04]
    assert rig.send(REMOTE | 0x700 + NODE + 1, b"") == []
    assert rig.send(REMOTE | 0x180 + NODE, b"") == []  # PDOs are not sent on request
    rig.send(0, bytes([0x82, NODE]))
    rig.run(1)
    assert guard(rig) == [0x7F]  # begins with 0 again


def test_heartbeat_excludes_node_guarding(rig: Rig) -> None:
    rig.set(0x100C, 0, 20, 2)
    rig.set(0x100D, 0, 2, 1)
    guard(rig)
    rig.set(0x1017, 0, 1000, 2)
    assert guard(rig) == []
    rig.run(200)
    assert rig.emergencies() == []
    rig.set(0x1017, 0, 0, 2)
    assert len(guard(rig)) == 1


@pytest.mark.parametrize(("silence_ms", "lost"), [(59, False), (60, True)])
@pytest.mark.parametrize(("behaviour", "state"), [(0, PRE_OPERATIONAL), (1, OPERATIONAL), (2, STOPPED)])
def test_life_guarding(rig: Rig, silence_ms: int, lost: bool, behaviour: int, state: int) -> None:
    rig.set(0x1029, 1, behaviour, 1)
    rig.set(0x100C, 0, 20, 2)
    rig.set(0x100D, 0, 3, 1)
    rig.operational()
    rig.enable(9)
    rig.run(200)
    assert rig.emergencies() == []  # not before the first request
    guard(rig)
    rig.run(silence_ms)
    assert rig.emergencies() == ([0x8130] if lost else [])
    assert rig.device.device[0].nmt == (state if lost else OPERATIONAL)
    if lost:
        rig.run(5)
        assert rig.get(0x6041) & 0x4F == 0x08  # 6007 = 1: fault


@pytest.mark.parametrize(("time_ms", "factor"), [(0, 3), (20, 0)])
def test_life_guarding_is_off_with_a_zero(rig: Rig, time_ms: int, factor: int) -> None:
    rig.set(0x100C, 0, time_ms, 2)
    rig.set(0x100D, 0, factor, 1)
    guard(rig)
    rig.run(500)
    assert rig.emergencies() == []


def faults(rig: Rig, *codes: int) -> None:
    """One fault after the other, each reset at once: code, 0000, code, 0000, ..."""
    for code in codes:
        rig.device.device[0].inject_fault_code = code
        rig.run(1)
        rig.device.device[0].inject_fault_code = 0
        rig.control(0x00, 0x80)


def test_emergencies_register_history_and_its_clearing(rig: Rig) -> None:
    faults(rig, 0x2310, 0x3210, 0x4310)
    assert rig.emergencies() == [0x2310, 0, 0x3210, 0, 0x4310, 0]
    registers = [data[2] for identifier, data in rig.sent if identifier == 0x80 + NODE]
    assert registers == [0x03, 0, 0x05, 0, 0x09, 0]
    assert rig.get(0x1003, 0) == 3
    assert [rig.get(0x1003, sub) for sub in (1, 2, 3)] == [0x4310, 0x3210, 0x2310]
    assert rig.write(0x1003, 0, 0, 1) == 0
    assert rig.get(0x1003, 0) == 0
    answer = rig.send(0x600 + NODE, struct.pack("<BHB4x", 0x40, 0x1003, 1))
    assert answer[0][1][4:] == struct.pack("<I", 0x08000024)


def test_the_history_keeps_the_last_eight(rig: Rig) -> None:
    faults(rig, *range(0x2301, 0x230B))
    assert rig.get(0x1003, 0) == 8
    assert [rig.get(0x1003, sub) for sub in range(1, 9)] == list(range(0x230A, 0x2302, -1))


def test_the_inhibit_time_keeps_emergencies_apart_and_loses_none(rig: Rig) -> None:
    rig.set(0x1015, 0, 200, 2)  # 20 ms
    faults(rig, 0x2310, 0x3210)
    assert rig.emergencies() == [0x2310]
    times = []
    for _ in range(70):
        got = [struct.unpack_from("<H", d)[0] for i, d in rig.run(1) if i == 0x80 + NODE]
        times += [(rig.now_ns, code) for code in got]
    assert [code for _, code in times] == [0, 0x3210, 0]
    assert [b[0] - a[0] for a, b in itertools.pairwise(times)] == [20_000_000] * 2


@pytest.mark.parametrize("command", [0x02, 0x82])
def test_waiting_emergencies_end_with_stop_and_reset(rig: Rig, command: int) -> None:
    rig.set(0x1015, 0, 200, 2)
    faults(rig, 0x2310, 0x3210)
    rig.send(0, bytes([command, NODE]))
    rig.run(100)
    rig.send(0, bytes([0x01, NODE]))
    rig.run(100)
    assert rig.emergencies() == [0x2310]


def test_an_invalid_emergency_identifier_sends_none(rig: Rig) -> None:
    rig.set(0x1014, 0, 0x80000085, 4)
    faults(rig, 0x2310)
    assert rig.emergencies() == []
    assert rig.get(0x1003, 1) == 0x2310
    rig.set(0x1014, 0, 0x91, 4)
    faults(rig, 0x2310)
    assert [i for i, _ in rig.sent].count(0x91) == 2


def test_sync_counter_and_start_value(rig: Rig) -> None:
    rig.set(0x1019, 0, 6, 1)
    assert rig.write(0x1800, 6, 3, 1) == 0x08000022
    rig.set(0x1801, 6, 3, 1)
    rig.set(0x1801, 2, 2, 1)
    rig.set(0x1801, 1, 0x40000285, 4)
    rig.operational()
    counted = [any(i == 0x285 for i, _ in rig.send(0x80, bytes([n % 6 + 1]))) for n in range(8)]
    assert counted == [False, False, False, True, False, True, False, True]  # 3 is its first, every second
    assert rig.emergencies() == []


@pytest.mark.parametrize(("overflow", "data"), [(0, b"\x01"), (6, b"")])
def test_a_sync_of_the_wrong_length_is_reported_once_and_ignored(rig: Rig, overflow: int, data: bytes) -> None:
    rig.set(0x1019, 0, overflow, 1)
    rig.set(0x1801, 1, 0x40000285, 4)
    rig.operational()
    right = b"\x01" if overflow else b""
    assert [i for i, _ in rig.send(0x80, right)] == [0x285]
    for _ in range(3):
        assert 0x285 not in [i for i, _ in rig.send(0x80, data)]
    assert rig.emergencies() == [0x8240]
    assert (rig.get(0x1001), rig.get(0x1003), rig.get(0x1003, 1)) == (0x11, 1, 0x8240)
    assert 0x285 in [i for i, _ in rig.send(0x80, right)]
    assert rig.emergencies() == [0x8240, 0]
    assert (rig.get(0x1001), rig.get(0x1003)) == (0, 1)
    rig.send(0x80, data)  # another event
    assert rig.emergencies() == [0x8240, 0, 0x8240]
    assert rig.get(0x1003) == 2


def test_a_pdo_that_is_too_short_is_reported_once_each_time_it_begins(rig: Rig) -> None:
    """Each RPDO for itself; the right length ends it, and so does leaving operational."""
    rig.set(0x1401, 1, 0x80000305, 4)
    rig.set(0x1401, 2, 255, 1)
    rig.set(0x1401, 1, 0x305, 4)
    rig.operational()
    for _ in range(5):
        rig.send(0x200 + NODE, b"\x06")
    assert (rig.emergencies(), rig.get(0x6040)) == ([0x8210], 0)
    assert (rig.get(0x1001), rig.get(0x1003), rig.get(0x1003, 1)) == (0x11, 1, 0x8210)
    rig.send(0x300 + NODE, b"\x06")
    assert rig.emergencies() == [0x8210, 0x8210]
    rig.send(0x200 + NODE, b"\x06\x00")
    assert rig.emergencies() == [0x8210, 0x8210]  # the other one is still wrong
    assert rig.get(0x1001) == 0x11
    rig.send(0, bytes([0x80, NODE]))
    assert rig.emergencies() == [0x8210, 0x8210, 0]
    assert (rig.get(0x1001), rig.get(0x1003)) == (0, 2)


def test_a_pdo_of_the_wrong_length_keeps_no_fault(rig: Rig) -> None:
    rig.operational()
    rig.send(0x200 + NODE, b"\x06")
    rig.device.device[0].inject_fault_code = 0x2310
    rig.run(1)
    rig.device.device[0].inject_fault_code = 0
    rig.control(0x00, 0x80)
    assert rig.get(0x6041) & 0x4F == 0x40
    assert rig.get(0x1001) == 0x11  # of the PDO
    assert rig.emergencies() == [0x8210, 0x2310]


@pytest.mark.parametrize("command", [0x80, 0x02])
@pytest.mark.parametrize(("option", "enabled", "code"), [(1, True, 0x8100), (1, False, 0), (2, True, 0), (3, True, 0)])
def test_leaving_operational_with_the_power_on_is_a_fault_that_is_reported(
    rig: Rig, command: int, option: int, enabled: bool, code: int
) -> None:
    """6007 = 1: with error code, history and emergency, which a stopped node could not send any more."""
    rig.set(0x6007, 0, option, 2)
    rig.operational()
    if enabled:
        rig.enable(9)
    rig.send(0, bytes([command, NODE]))
    rig.run(1200)
    assert rig.emergencies() == ([code] if code else [])
    assert (rig.get(0x603F), rig.get(0x1001), rig.get(0x1003)) == ((code, 0x11, 1) if code else (0, 0, 0))
    assert rig.state() == (PowerState.FAULT if code else PowerState.SWITCH_ON_DISABLED)
    rig.send(0, bytes([0x80, NODE]))
    if code:
        rig.control(0x00, 0x80)
        assert rig.emergencies() == [code, 0]
        assert rig.state() == PowerState.SWITCH_ON_DISABLED


@pytest.mark.parametrize(
    ("cycle_us", "value", "code"),
    [(0, 1, 0x06090030), (0, 2, 0), (0, 240, 0), (0, 241, 0x06090031), (1000, 2, 0x08000022)],
)
def test_the_counter_is_fixed_while_there_is_a_cycle_period(rig: Rig, cycle_us: int, value: int, code: int) -> None:
    rig.set(0x1006, 0, cycle_us, 4)
    assert rig.write(0x1019, 0, value, 1) == code
