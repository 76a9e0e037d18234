"""Commissioning by the real driver against the virtual drive, and every reason to refuse."""

from __future__ import annotations

import dataclasses
import math
import re
import struct
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import can
import pytest

from jointctl.drivers.canopen import commissioning, network
from jointctl.drivers.canopen.cia import ControlWord, Mode, NmtCommand, State
from jointctl.drivers.canopen.commissioning import LARGEST_PERMILLE, READY_POLL_S, STEEP_RADPS2, wait_until_ready
from jointctl.drivers.canopen.drive import GATE_S, REOPEN_ATTEMPTS, REOPEN_PAUSE_S, CanopenDrive
from jointctl.drivers.canopen.network import LISTEN_S
from jointctl.drivers.canopen.sdo import ATTEMPTS as SDO_ATTEMPTS
from jointctl.drivers.canopen.settings import interpolation_period
from jointctl.drivers.canopen.switch_off import state_of
from jointctl.drivers.drive import UNTOUCHED
from jointctl.drivers.errors import BusError, ConfigurationError, DeviceError, JointctlError, NoDeviceError

pytestmark = pytest.mark.usefixtures("short_timeout")


def refusal(joint: Any, kind: type[JointctlError] = DeviceError, **changes: Any) -> str:
    """The message of a commissioning that must fail with exactly this class, in one line, drive left disabled."""
    with joint.opened(**changes) as drive, pytest.raises(JointctlError) as caught:
        drive.commission()
    assert type(caught.value) is kind
    assert "\n" not in str(caught.value)
    if joint.device is not None:
        assert joint.value(0x6041) & 0x6F != 0x27
    return str(caught.value)


# --- the way that works ---
@pytest.fixture
def commissioned(joint: Any) -> Iterator[Any]:
    with joint.opened() as drive:
        yield joint, drive, drive.commission()


def test_the_report(commissioned: Any) -> None:
    _, _, report = commissioned
    count_rad = 2.0 * math.pi / 2**19
    assert (report.mode, report.commands_velocity) == ("cyclic_sync_torque", False)
    assert report.start_position_rad == pytest.approx(0.1, abs=count_rad)
    assert (report.torque_resolution_Nm, report.position_resolution_rad) == pytest.approx((0.0605, count_rad))
    identity = report.identity
    assert (identity.name, identity.serial, identity.revision) == ("jointctl virtual joint", "1", "0x00010000")
    assert report.settings["max torque"] == "1000 permille = 60.5 Nm"
    assert report.settings["60C2"] == "1e-3 s"
    assert report.settings["watchdog"].startswith("200 ms")
    assert "max velocity" not in report.settings


def test_what_is_in_the_drive_afterwards(commissioned: Any) -> None:
    bus, drive, _ = commissioned
    assert bus.value(0x6060) == bus.value(0x6061) == 10
    assert bus.value(0x6072) == 1000
    assert bus.value(0x6071) == 0
    assert (bus.value(0x60C2, 1), bus.value(0x60C2, 2)) in ((1, -3), (1, 253))
    assert bus.value(0x1016, 1) == 126 << 16 | 200
    assert bus.value(0x1017) == 200
    assert (bus.value(0x6007), bus.value(0x605A), bus.value(0x1029, 1)) == (3, 2, 2)
    assert [bus.value(0x1A00, k) for k in range(4)] == [3, 0x60410010, 0x60640020, 0x60770010]
    assert [bus.value(0x1600, k) for k in range(3)] == [2, 0x60400010, 0x60710010]
    assert (bus.value(0x1800, 1), bus.value(0x1800, 2)) == (0x40000181, 1)  # bit 30 as the drive had it
    assert (bus.value(0x1400, 1), bus.value(0x1400, 2)) == (0x201, 1)
    for base in (0x1400, 0x1800):
        assert all(bus.value(base + k, 1) & 0x80000000 for k in (1, 2, 3))
    assert bus.device.device[0].nmt == 127
    port = drive.port()[0]
    assert (port.max_permille, port.node, port.heartbeat_cycles) == (1000, 1, 66)


def test_the_drive_watches_the_heartbeat_for_the_time_that_is_configured(joint: Any) -> None:
    with joint.opened(heartbeat_s=0.9) as drive:
        drive.commission()
    assert joint.value(0x1016, 1) == 126 << 16 | 900


def test_targets_are_zeroed_before_anything_else_is_written(commissioned: Any) -> None:
    bus, _, _ = commissioned
    written = [
        struct.unpack_from("<H", data, 1)[0] for cob, data in bus.requests if cob == 0x601 and data[0] & 0xE0 == 0x20
    ]
    assert not {0x607F, 0x6083} & set(written)  # of the velocity modes
    first = {index: written.index(index) for index in written}
    frames = [cob == 0 for cob, data in bus.requests if cob == 0 or (cob == 0x601 and data[0] & 0xE0 == 0x20)]
    assert frames[0]  # in pre-operational, where PDOs can be mapped
    assert written[0] == 0x6040
    assert first[0x6071] < first[0x60FF] < first[0x6060] < first[0x6072] < first[0x60C2] < first[0x1016] < first[0x1800]
    assert set(bus.downloads(0x60FF)) == set(bus.downloads(0x60B1)) == set(bus.downloads(0x60B2)) == {0}
    assert set(bus.downloads(0x6040)) == {0}  # nothing but "disable voltage" is ever written while commissioning


def test_a_pdo_is_remapped_in_the_order_of_the_standard(commissioned: Any) -> None:
    bus, _, _ = commissioned
    steps = []
    for cob, data in bus.requests:
        index, sub = struct.unpack_from("<HB", data, 1) if len(data) == 8 else (0, 0)
        if cob == 0x601 and data[0] & 0xE0 == 0x20 and index in (0x1800, 0x1A00):
            steps.append((index, sub, struct.unpack_from("<I", data, 4)[0]))
    assert [step[:2] for step in steps] == [
        (0x1800, 1), (0x1800, 2), (0x1A00, 0), (0x1A00, 1), (0x1A00, 2), (0x1A00, 3), (0x1A00, 0), (0x1800, 1),
    ]  # fmt: skip
    assert steps[0][2] & 0x80000000
    assert (steps[2][2], steps[6][2]) == (0, 3)
    assert steps[7][2] == 0x40000181


def test_cyclic_start_and_make_safe(commissioned: Any) -> None:
    bus, drive, _ = commissioned
    drive.start_cyclic()
    assert drive.make_safe() == "switch on disabled"
    assert bus.device.device[0].nmt == 127
    assert bus.value(0x1016, 1) == 0
    assert (0x000, b"\x01\x01") in bus.requests


def test_torque_mode_where_the_drive_has_no_cyclic_one(joint: Any) -> None:
    joint.answers[(0x6502, 0)] = 1 << 3
    with joint.opened(mode="auto") as drive:
        report = drive.commission()
    assert report.mode == "torque"
    assert joint.value(0x6060) == 4
    assert joint.value(0x6087) == 1_000_000
    assert any("TQ" in remark for remark in report.remarks)
    assert (joint.downloads(0x60C2, 1), joint.downloads(0x60C2, 2)) == ([1], [-3 & 0xFF])  # it has the object


@pytest.mark.parametrize(("mode", "shown"), [("csv", Mode.CYCLIC_SYNC_VELOCITY), ("pv", Mode.PROFILE_VELOCITY)])
def test_a_velocity_mode_begins_with_no_target_and_the_drives_own_limit(joint: Any, mode: str, shown: Mode) -> None:
    with joint.opened(mode=mode) as drive:
        report = drive.commission()
    assert report.commands_velocity
    assert joint.value(0x6060) == shown
    assert joint.downloads(0x60FF)[-1] == 0
    written = [data[1:3] for cob, data in joint.requests if cob == 0x601 and data[0] & 0xE0 == 0x20]
    assert b"\xff\x60" in written[written.index(b"\x60\x60") :]  # the choice of the mode may have brought one
    unit_radps = 2.0 * math.pi / 2**19  # counts/s at the joint
    assert joint.value(0x607F) == math.ceil(1.0 / unit_radps)
    assert report.settings["max velocity"] == f"{joint.value(0x607F)} counts/s = 1.00 rad/s"
    steep = [round(STEEP_RADPS2 / unit_radps)] if shown is Mode.PROFILE_VELOCITY else []
    assert (joint.downloads(0x6083), joint.downloads(0x6084)) == (steep, steep)
    assert any("profile velocity mode (PV)" in remark for remark in report.remarks) == bool(steep)


# --- a drive that closes its own loops ---
OWN_LOOP: dict[str, Any] = {"holds_alone": True, "torque_offset": True, "velocity_offset": True}


def test_csp_begins_with_the_target_where_the_joint_stands(joint: Any) -> None:
    joint.answers[(0x6064, 0)] = 4321
    with joint.opened(mode="csp", following_error_max_rad=0.05, **OWN_LOOP) as drive:
        report = drive.commission()
        port = drive.port()[0]
    assert (report.mode, joint.value(0x6060), joint.value(0x6061)) == ("cyclic_sync_position", 8, 8)
    assert joint.downloads(0x607A)[-1] == 4321
    written = [data[1:3] for cob, data in joint.requests if cob == 0x601 and data[0] & 0xE0 == 0x20]
    assert b"\x7a\x60" in written[written.index(b"\x60\x60") :]  # the choice of the mode may have brought one
    assert (joint.value(0x6065), joint.value(0x6066)) == (math.ceil(0.05 / (math.tau / 2**19)), 20)
    assert (joint.downloads(0x60C2, 1), joint.downloads(0x60C2, 2)) == ([1], [-3 & 0xFF])
    assert [joint.value(0x1600, sub) for sub in range(4)] == [3, 0x60400010, 0x607A0020, 0x60B20010]
    assert [joint.value(0x1601, sub) for sub in range(2)] == [1, 0x60B10020]
    assert (joint.value(0x1400, 5), joint.value(0x1401, 5)) == (100, 100)  # the deadlines of both
    assert (port.target_is_position, port.torque_offset_at, port.offset_rpdo_id) == (1, 6, 0x301)


def test_csv_of_a_run_maps_the_torque_offset_and_its_twin_of_a_sweep_does_not(joint: Any) -> None:
    with joint.commissioned(mode="csv", holds_alone=True, torque_offset=True) as drive:
        port = drive.port()[0]
    assert [joint.value(0x1600, sub) for sub in range(4)] == [3, 0x60400010, 0x60FF0020, 0x60B20010]
    assert (port.target_is_velocity, port.torque_offset_at, port.offset_rpdo_id) == (1, 6, 0)
    with joint.commissioned(mode="csv") as drive:
        assert drive.port()[0].torque_offset_at == -1
    assert joint.value(0x1600) == 2


@pytest.mark.parametrize(("torque_max_Nm", "cut"), [(60.0, False), (3000.0, True)])
def test_a_torque_beyond_what_6072_holds_is_reported(joint: Any, torque_max_Nm: float, cut: bool) -> None:
    with joint.opened(torque_max_Nm=torque_max_Nm, max_torque_permille=None) as drive:
        report = drive.commission()
    assert any(f"6072 holds at most {LARGEST_PERMILLE}" in remark for remark in report.remarks) is cut
    assert (joint.value(0x6072) == LARGEST_PERMILLE) is cut


@pytest.mark.parametrize(("rate_Hz", "period"), [(1000.0, (1, -3)), (2000.0, (5, -4)), (500.0, (2, -3))])
def test_the_period_is_written_with_its_exponent(joint: Any, rate_Hz: float, period: tuple[int, int]) -> None:
    with joint.opened(rate_Hz=rate_Hz) as drive:
        drive.commission()
    assert (joint.downloads(0x60C2, 1), joint.downloads(0x60C2, 2)) == ([period[0]], [period[1] & 0xFF])


@pytest.mark.parametrize("left", [0, 126 << 16 | 500])
def test_a_watchdog_that_was_left_armed_is_ended_first(joint: Any, left: int) -> None:
    joint.send(0x601, struct.pack("<BHBI", 0x23, 0x1016, 1, left))
    joint.requests.clear()
    with joint.opened() as drive:
        drive.commission()
    assert joint.downloads(0x1016, 1) == [*([0] if left else []), 126 << 16 | 200]


# --- refusals ---
def test_a_drive_that_does_not_answer_or_falls_silent(joint: Any, empty_bus: Any) -> None:
    message = refusal(joint, NoDeviceError, node=7)
    assert "node 7 does not answer; these do: 1" in message
    assert "drive.node" in message
    alone = "node 1 does not answer, and neither does any other"
    assert alone in refusal(empty_bus, NoDeviceError)
    with empty_bus.opened() as drive, pytest.raises(NoDeviceError, match=alone):
        drive.clear_fault()
    joint.mute += [(0x6076, 0)] * 3
    message = refusal(joint, NoDeviceError)
    assert "reading object 6076 (motor rated torque) got no answer in 3 attempts" in message


@pytest.mark.parametrize("attempts", [0, SDO_ATTEMPTS])
def test_only_a_node_that_does_not_answer_is_sent_pre_operational_at_first(joint: Any, attempts: int) -> None:
    joint.mute += [(0x1000, 0)] * attempts
    with joint.opened(boot_timeout_s=1.0) as drive:
        drive.commission()
    first = next(place for place, (cob, _) in enumerate(joint.requests) if cob == 0)
    assert joint.requests[first] == (0, bytes([NmtCommand.ENTER_PRE_OPERATIONAL, 1]))
    read = [struct.unpack_from("<H", data, 1)[0] for cob, data in joint.requests[:first] if cob == 0x601]
    assert (0x6041 in read) is (attempts == 0)


def test_a_node_is_given_the_time_that_it_takes_to_boot(empty_bus: Any) -> None:
    with empty_bus.opened(boot_timeout_s=1.0) as drive:
        tries = round(1.0 / (drive._node.sdo.RESPONSE_TIMEOUT * SDO_ATTEMPTS))
        with pytest.raises(NoDeviceError):
            drive.commission()
    sent = [data for cob, data in empty_bus.requests if cob == 0]
    assert sent == [bytes([NmtCommand.ENTER_PRE_OPERATIONAL, 1])] * tries


def test_a_node_that_is_anothers_while_it_does_not_answer_is_sent_nothing(joint: Any) -> None:
    joint.mute += [(0x1000, 0)] * SDO_ATTEMPTS

    def gate() -> None:
        if joint.requests:
            joint.send(0x080, b"")

    with joint.opened(boot_timeout_s=1.0) as drive:
        drive._objects.gate = gate
        with pytest.raises(BusError, match="SYNC"):
            drive.commission()
    assert not [data for cob, data in joint.requests if cob == 0]


UNRATED = {"rated_torque_Nm": None, "rated_current_A": None}


@pytest.mark.parametrize(
    ("changes", "answers", "pattern"),
    [
        # what differs from the configuration
        ({"vendor_id": 0x9A}, {}, r"drive\.vendor_id is 0x0, the configuration says 0x9a"),
        ({"product_code": 0x30924}, {}, r"drive\.product_code is 0x1, the configuration says 0x30924"),
        ({"rated_torque_Nm": 0.506}, {}, r"drive\.rated_torque_Nm \(=0\.506\) does not agree with the drive's 0\.5 Nm"),
        ({"rated_current_A": 4.9}, {}, r"drive\.rated_current_A \(=4\.9\) does not agree with the drive's 5 A"),
        ({"rate_Hz": 3000.0}, {}, r"loop\.rate_Hz \(=3000\)"),
        ({"quick_stop_option": 4}, {},
         r"writing 4 to object 605A \(quick stop option\) was refused: .* \(SDO abort 06090030h\)"),
        ({"torque_reference": "rated_torque", **UNRATED}, {(0x6076, 0): 0}, "object 6076 is 0"),
        ({"torque_reference": "rated_current", **UNRATED}, {(0x6075, 0): 0}, "object 6075 is 0"),
        # a drive that does not do what it must
        ({}, {(0x1000, 0): 401}, r"node 1 has device profile 401, a drive has 402"),
        ({}, {(0x6502, 0): 5}, r"does not support cyclic_sync_torque \(6502 = 00000005h\); drive\.mode is cst"),
        ({}, {(0x6061, 0): 8}, r"6061 shows mode 8, mode 10 was selected"),
        ({}, {(0x6072, 0): 3000}, r"object 6072 \(max torque\) reads back 3000, 1000 was written"),
        ({}, {(0x60C2, 1): 4}, r"object 60C2:1 \(interpolation time period\) reads back 4, 1 was written"),
        ({}, {(0x1016, 1): 0}, r"object 1016:1 \(consumer heartbeat time\) reads back 0, 8257736 was written"),
        ({}, {(0x1A00, 2): 0x606C0020},
         r"1A00:2 \(PDO 1800 mapping of position actual value\) reads back 606C0020h, 60640020h was written"),
        ({}, {(0x1800, 1): 0x40000182},
         r"object 1800:1 \(PDO 1800 COB-ID\) reads back 40000182h, 40000181h was written"),
        ({}, {(0x6041, 0): 0x0218}, r"node 1 is in fault \(error code 0000h\) .*never resets one by itself"),
        ({}, {(0x6041, 0): 0x021F, (0x603F, 0): 0x8611}, r"node 1 is in fault \(error code 8611h\)"),
        ({}, {(0x6071, 0): 5}, r"object 6071 \(target torque\) reads back 5, 0 was written"),
    ],
)  # fmt: skip
def test_what_is_not_as_it_must_be_is_refused(
    joint: Any, changes: dict[str, Any], answers: dict[tuple[int, int], int], pattern: str
) -> None:
    joint.answers.update(answers)
    assert re.search(pattern, refusal(joint, **changes))


@pytest.mark.parametrize("change", [{"vendor_id": 0}, {"product_code": 1}, {"rated_torque_Nm": 0.5049}])
def test_the_twins_that_agree(joint: Any, change: dict[str, Any]) -> None:
    with joint.opened(**change) as drive:
        drive.commission()


@pytest.mark.parametrize(
    ("off_for", "pattern"),
    [(1, "node 1 is operation enabled, and was off a moment ago"), (2, "node 1 stays enabled although controlword 0")],
)
def test_a_drive_that_gets_power_while_it_is_commissioned(joint: Any, off_for: int, pattern: str) -> None:
    joint.sequences[0x6041, 0] = [0x1250] * off_for
    joint.answers[0x6041, 0] = 0x1637
    assert re.search(pattern, refusal(joint))


@pytest.mark.parametrize(("name", "drives"), [("rated_torque_Nm", "0.5 Nm"), ("rated_current_A", "5 A")])
def test_a_rated_value_that_is_not_compared_is_told(joint: Any, name: str, drives: str) -> None:
    remark = f"drive.{name} is not given: nothing to compare the drive's {drives} with"
    for change in ({}, {name: None}):
        with joint.opened(**change) as drive:
            assert (remark in drive.commission().remarks) is bool(change)


@pytest.mark.parametrize("index", [0x1000, 0x6040, 0x6041, 0x6060, 0x6061, 0x6064, 0x6071, 0x6072, 0x60C2, 0x1016])
def test_an_object_that_the_eds_does_not_have(commission: Any, joint: Any, index: int) -> None:
    with pytest.raises(
        DeviceError, match=rf"EDS edited\.eds has no object {index:04X}.*which jointctl needs"
    ) as caught:
        commission(without=(f"{index:04X}",))
    assert "\n" not in str(caught.value)
    assert joint.value(0x6041) & 0x6F != 0x27


@pytest.mark.parametrize("content", [None, "this is no EDS file"])
def test_an_eds_file_that_cannot_be_read(joint: Any, tmp_path: Path, content: str | None) -> None:
    eds = tmp_path / "broken.eds"
    if content is not None:
        eds.write_text(content)
    with pytest.raises(ConfigurationError, match=r"drive\.eds \(=.*broken\.eds\) is not a readable EDS file") as caught:
        joint.opened(eds_path=eds).__enter__()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("step", ["port", "start_cyclic"])
def test_nothing_goes_on_before_commissioning(joint: Any, step: str) -> None:
    with joint.opened() as drive, pytest.raises(DeviceError, match="not been commissioned"):
        getattr(drive, step)()


# --- the user's stop, other controllers, a bus that fails ---
class Stop(Exception):
    """What the gate raises."""


@pytest.mark.parametrize(("wait_s", "slices_s"), [(0.0, []), (GATE_S, [GATE_S]), (0.12, [GATE_S, GATE_S, 0.02])])
def test_a_wait_looks_for_a_stop_before_each_of_its_parts_and_at_its_end(
    joint: Any, wait_s: float, slices_s: list[float]
) -> None:
    with joint.opened() as drive:
        log: list[float] = []
        drive._sleep, drive._gate = log.append, lambda: log.append(-1.0)
        drive._pause(wait_s)
    assert log == pytest.approx([number for part in slices_s for number in (-1.0, part)] + [-1.0])


@pytest.fixture
def stoppable(joint: Any) -> Iterator[Any]:
    """The commissioned driver, and the list that asks for a stop as soon as there is something in it."""

    def gate() -> None:
        if asked:
            raise Stop

    asked: list[bool] = []
    drive = joint.drive(joint.settings, gate=gate)
    try:
        drive.commission()
        yield drive, asked
    finally:
        drive.close()


def test_once_a_stop_was_asked_for_the_drive_is_only_made_safe(joint: Any, stoppable: Any) -> None:
    drive, asked = stoppable
    asked.append(True)
    joint.requests.clear()
    for step in (drive.commission, drive.start_cyclic, lambda: drive._objects.read(0x1000, what="device type")):
        with pytest.raises(Stop):
            step()
    assert joint.requests == []
    assert drive.make_safe() == "switch on disabled"


@pytest.mark.parametrize(("configured_s", "used_s"), [(None, 0.15), (0.7, 0.7)])
def test_answers_are_waited_for_as_configured(joint: Any, configured_s: float | None, used_s: float) -> None:
    with joint.opened(sdo_timeout_s=configured_s) as drive:
        waits_s: float = drive._node.sdo.RESPONSE_TIMEOUT
    assert waits_s == used_s


def test_a_drive_that_cannot_be_made_leaves_no_bus_open(joint: Any, tmp_path: Path) -> None:
    bus: Any = can.Bus(interface="virtual", channel=joint.channel)
    with pytest.raises(ConfigurationError):
        CanopenDrive(bus, dataclasses.replace(joint.settings, eds_path=tmp_path / "none.eds"))
    assert bus._is_shutdown


@pytest.mark.parametrize(("heartbeat_of", "anothers"), [(42, True), (43, False)])
def test_a_drive_that_watches_a_node_on_the_bus_is_anothers(joint: Any, heartbeat_of: int, anothers: bool) -> None:
    joint.store(0x1016, 1, 42 << 16 | 500)
    with joint.opened() as drive:
        for node in (heartbeat_of, 9):
            joint.send(0x700 + node, b"\x05")
        if anothers:
            with pytest.raises(BusError, match=r"node 1 watches the heartbeat of node 42 \(1016\)"):
                drive.commission()
            assert not any(cob == 0 for cob, _ in joint.requests)
        else:
            assert "other nodes are on the bus: heartbeats of 9, 43" in drive.commission().remarks


@pytest.mark.parametrize("step", ["commission", "clear_fault"])
def test_nothing_is_sent_before_the_bus_was_silent_for_its_time(joint: Any, step: str) -> None:
    def sleep(seconds: float) -> None:
        slept_s.append(seconds)
        if sum(slept_s) > LISTEN_S - 2.0 * GATE_S and not joint.requests:
            joint.send(0x080, b"")

    slept_s: list[float] = []
    with joint.opened() as drive:
        drive._others._started_s = drive._others._clock()
        drive._sleep = sleep
        with pytest.raises(BusError, match="another controller is active on this bus: 1 x SYNC"):
            getattr(drive, step)()
        assert sum(slept_s) == pytest.approx(LISTEN_S, abs=GATE_S)
        assert joint.requests == [(0x080, b"")]


def test_a_controller_that_comes_at_the_last_moment_keeps_its_drive(
    joint: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = "jointctl.drivers.canopen.drive.brake_if_enabled"
    monkeypatch.setattr(step, lambda *_: joint.send(0x080, b""))
    seen = "another controller is active on this bus: 1 x SYNC"
    with joint.opened() as drive, pytest.raises(BusError, match=seen):
        drive.commission()
    assert (0, bytes([NmtCommand.ENTER_PRE_OPERATIONAL, 1])) not in joint.requests


@pytest.mark.parametrize(("increments", "turns", "counts"), [(65536, 2, 32768.0), (65536, 0, 0.0)])
def test_the_drives_own_encoder_resolution(joint: Any, increments: int, turns: int, counts: float) -> None:
    joint.answers |= {(0x608F, 1): increments, (0x608F, 2): turns}
    with joint.opened() as drive:
        assert drive.commission().counts_per_motor_turn == counts


def test_remarks_of_an_earlier_commissioning_are_not_repeated(joint: Any) -> None:
    with joint.opened() as drive:
        drive._objects.remarks.append("of an earlier one")
        assert "of an earlier one" not in drive.commission().remarks


@pytest.mark.parametrize("status_word", [0x0200, 0x0205])  # not ready; none that the standard knows
def test_a_drive_that_is_not_ready_is_given_time_between_two_looks(joint: Any, status_word: int) -> None:
    joint.answers[(0x6041, 0)] = status_word
    pauses_s: list[float] = []
    with joint.opened() as drive:
        with pytest.raises(DeviceError, match="after 1 s"):
            wait_until_ready(drive._objects, 1, 1.0, pauses_s.append)
        assert pauses_s == [READY_POLL_S] * (round(1.0 / READY_POLL_S) - 1)
        assert joint.downloads(0x6040)[:4] == [ControlWord.SHUTDOWN, ControlWord.DISABLE_VOLTAGE] * 2
        pauses_s.clear()
        with pytest.raises(DeviceError, match="after 0 s"):
            wait_until_ready(drive._objects, 1, 0.0, pauses_s.append)
    assert pauses_s == []


def test_a_drive_that_is_ready_gets_no_voltage(joint: Any) -> None:
    joint.answers[(0x6041, 0)] = 0x0221
    with joint.opened() as drive:
        wait_until_ready(drive._objects, 1, 1.0, lambda _: None)
        joint.settle()
    assert joint.downloads(0x6040) == [ControlWord.DISABLE_VOLTAGE]


def test_an_encoder_resolution_that_cannot_be_read_is_none() -> None:
    def refuse(*_: Any, **__: Any) -> int:
        raise DeviceError("refused")

    assert commissioning.counts_per_motor_turn(cast(Any, SimpleNamespace(has=lambda *_: True, read=refuse))) == 0.0


def test_what_is_exactly_at_its_bound_is_taken(joint: Any) -> None:
    assert commissioning._compare_rated("rated_current_A", 9.0, 8.0, 0.125, "A") == []
    assert interpolation_period(1e6 / 255) == (255, -6)
    assert interpolation_period(0.1) == (10, 0)
    with pytest.raises(DeviceError, match="has no 60C2 value"):
        interpolation_period(1e6 / 256)
    with joint.opened() as drive:
        scale = drive.commission().torque_resolution_Nm
    full = {"max_torque_permille": 900, "rated_tolerance": 0.0}
    with joint.opened(**full, torque_max_Nm=900 * scale) as drive:
        assert drive.commission().settings["max torque"].startswith("900 permille")
    with joint.opened(**full, torque_max_Nm=900 * scale * 1.001) as drive, pytest.raises(DeviceError, match="is cut"):
        drive.commission()


def test_the_torque_slope_of_the_drive(joint: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    joint.answers[(0x6087, 0)] = 2000
    with joint.opened() as drive:
        monkeypatch.setattr(drive._objects, "highest", {0x6087: 2000}.get)
        (remark,) = commissioning.set_torque_slope(drive._objects, 0.5, 1000.0)
        with pytest.raises(DeviceError, match="at most 1000 Nm/s"):
            commissioning.set_torque_slope(drive._objects, 0.5, 1000.5)
    assert set(joint.downloads(0x6087)) == {2000}
    assert remark.endswith("; 6087 = 2000 permille/s")


@pytest.mark.parametrize(("expected_A", "agrees"), [(0.0445, True), (0.0455, True), (0.0443, False), (0.0457, False)])
def test_a_rated_value_may_be_off_by_what_the_drive_rounds_it(expected_A: float, agrees: bool) -> None:
    """A small motor: 45 mA is 1.1 % from 44.5 mA, and 6075 has no more digits."""
    with nullcontext() if agrees else pytest.raises(DeviceError, match=r"does not agree with the drive's 0\.045 A"):
        assert commissioning._compare_rated("rated_current_A", 0.045, expected_A, 0.01, "A", 1e-3) == []


def test_a_drive_that_does_not_tell_its_rated_value_is_not_compared() -> None:
    with pytest.raises(DeviceError, match="cannot be compared"):
        commissioning._compare_rated("rated_current_A", 0.0, 5.0, 0.01, "A")
    assert commissioning._compare_rated("rated_current_A", 1.0, 1.0, 0.01, "A") == []


@pytest.mark.parametrize(("of_eds", "of_drive", "told"), [(1, 2, True), (0, 2, False), (1, 0, False), (2, 2, False)])
def test_an_eds_of_another_product_is_a_remark_where_both_tell_it(
    joint: Any, of_eds: int, of_drive: int, told: bool
) -> None:
    findings = commissioning.Findings()
    eds = SimpleNamespace(name="some.eds", vendor_id=0, product_code=of_eds)
    commissioning._compare_with_eds(joint.settings, eds, 0, of_drive, findings)
    assert [remark.startswith("EDS some.eds is of product") for remark in findings.remarks] == [True] * told


def test_a_drive_is_given_time_to_switch_off_and_to_change_its_mode(
    joint: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow = [State.QUICK_STOP_ACTIVE, State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE]
    states = iter([State.SWITCH_ON_DISABLED, *slow, State.SWITCH_ON_DISABLED])
    monkeypatch.setattr(commissioning, "state_of", lambda _: next(states))
    joint.answers[(0x6061, 0)] = 3
    pauses_s: list[float] = []
    with joint.opened() as drive:
        commissioning.disable(drive._objects, joint.settings, pauses_s.append)
        assert pauses_s == [commissioning.PAUSE_S] * 3
        with pytest.raises(DeviceError, match="6061 shows mode 3"):
            commissioning.choose_mode(drive._objects, joint.settings, commissioning.Findings(), pauses_s.append)
    assert pauses_s == [commissioning.PAUSE_S] * (3 + commissioning.ATTEMPTS)


def test_what_was_verified_before_a_new_commissioning_is_forgotten(joint: Any) -> None:
    with joint.opened() as drive:
        drive._objects.write_verified(0x6087, 0, 1000, what="torque slope")
        assert (0x6087, 0) in drive._objects.verified()
        drive.commission()
        assert (0x6087, 0) not in drive._objects.verified()
        assert (0x6072, 0) in drive._objects.verified()


def test_a_stop_at_the_last_moment_keeps_the_drive_from_being_started(joint: Any, stoppable: Any) -> None:
    drive, asked = stoppable
    drive._others.refuse = lambda: asked.append(True)  # the last look before NMT start
    joint.requests.clear()  # the watchdog's proof is over
    with pytest.raises(Stop):
        drive.start_cyclic()
    assert (0, bytes([NmtCommand.START, 1])) not in joint.requests


def test_the_frames_of_the_loop_are_not_received_from_its_start_on(joint: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[tuple[int, int]]] = []
    monkeypatch.setattr(network, "receive_only", lambda _, wanted: asked.append(wanted))
    with joint.commissioned() as drive:
        assert not asked
        drive.start_cyclic()
    assert [(0x081, 0x7FF) in wanted for wanted in asked] == [True]


@pytest.mark.parametrize("started", [True, False])
def test_who_comes_after_the_start_does_not_keep_us_from_switching_off(joint: Any, started: bool) -> None:
    with joint.commissioned() as drive:
        if started:
            drive.start_cyclic()
        joint.send(0x601, b"\x2b\x40\x60\x00\x06\0\0\0")
        assert drive.make_safe() == ("switch on disabled" if started else UNTOUCHED)


def test_a_drive_whose_fault_was_cleared_is_made_safe(joint: Any) -> None:
    with joint.opened() as drive:
        drive.clear_fault()
        assert drive.make_safe() == "switch on disabled"


def test_who_comes_after_another_commissioning_keeps_the_drive_until_it_is_started_again(joint: Any) -> None:
    with joint.commissioned() as drive:
        drive.start_cyclic()
        assert drive.make_safe() == "switch on disabled"
        drive.commission()
        joint.send(0x601, b"\x2b\x40\x60\x00\x06\0\0\0")
        assert drive.make_safe() == UNTOUCHED


def test_without_an_object_for_it_there_is_no_thermometer(joint: Any) -> None:
    with joint.commissioned(temperature=None) as drive:
        assert drive.thermometer() is None


def test_its_twin_that_another_controller_has_since_is_left_alone(joint: Any) -> None:
    with joint.opened() as drive:
        drive.clear_fault()
        joint.send(0x080, b"")
        assert drive.make_safe() == UNTOUCHED


def test_who_comes_while_a_fault_is_looked_at_keeps_the_drive(joint: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def looked(objects: Any) -> State:
        found = state_of(objects)
        joint.send(0x080, b"")
        return found

    monkeypatch.setattr("jointctl.drivers.canopen.drive.state_of", looked)
    with joint.opened() as drive, pytest.raises(BusError, match="1 x SYNC"):
        drive.clear_fault()
    assert not [data for cob, data in joint.requests if cob == 0]


def test_our_own_frames_that_come_back_are_no_ones_elses(joint: Any) -> None:
    drive = joint.drive(joint.settings, echoes=True)
    try:
        drive.commission()
        drive.start_cyclic()
        assert drive.make_safe() == "switch on disabled"
    finally:
        drive.close()


@pytest.mark.parametrize("step", ["commission", "clear_fault"])
def test_an_rpdo_that_only_the_drive_knows_of_is_anothers_command(joint: Any, step: str) -> None:
    joint.answers[0x1401, 1] = 0x333
    with joint.opened() as drive:
        joint.send(0x333, bytes(8))
        with pytest.raises(BusError, match=r"another controller is active on this bus: 1 x RPDO of the drive \(333h\)"):
            getattr(drive, step)()
    assert {struct.unpack_from("<H", data, 1)[0] for cob, data in joint.requests if cob == 0x601} <= {
        0x1000, *range(0x1400, 0x1600)
    }  # fmt: skip


@pytest.mark.parametrize("step", ["commission", "start_cyclic"])
@pytest.mark.parametrize("seen", [True, False])
def test_what_another_controller_has_spoilt_is_told_as_its_doing(joint: Any, seen: bool, step: str) -> None:
    def gate() -> None:
        written = joint.requests and joint.requests[-1][1][1:3] == b"\x72\x60"
        if written or step == "start_cyclic":
            joint.send(0x080, b"")

    with joint.opened() as drive:
        if step == "start_cyclic":
            drive.commission()
        joint.answers[0x6072, 0] = 3000
        drive._objects.gate = gate if seen else lambda: None
        with pytest.raises(BusError if seen else DeviceError, match="SYNC" if seen else "6072"):
            getattr(drive, step)()


@pytest.mark.parametrize(("step", "when"), [("commission", "during commissioning"), ("start_cyclic", "before the run")])
def test_a_bus_that_fails_is_told_with_the_step(joint: Any, step: str, when: str) -> None:
    def dead(*_: Any) -> None:
        raise can.CanOperationError("no buffer space")

    with joint.opened() as drive:
        if step == "start_cyclic":
            drive.commission()
        drive._network.send_message = dead  # type: ignore[method-assign]
        with pytest.raises(BusError, match=f"the bus failed {when}: no buffer space"):
            getattr(drive, step)()
        del drive._network.send_message


def test_a_drive_that_has_lost_its_mode_is_not_started(joint: Any) -> None:
    with joint.commissioned() as drive:
        joint.requests.clear()
        joint.answers[0x6061, 0] = 8
        with pytest.raises(DeviceError, match="node 1: 6061 shows mode 8, it was 10"):
            drive.start_cyclic()
        assert (0x000, b"\x01\x01") not in joint.requests


# --- an adapter that serves one program at a time ---
class Adapter:
    """Opens the bus of a test again, at the n-th attempt."""

    def __init__(self, bus: Any, drive: CanopenDrive, at_attempt: int) -> None:
        self._bus, self._at_attempt = bus, at_attempt
        self.attempts, self.pauses_s = 0, list[float]()
        drive._reopen, drive._sleep = self.open, self.pauses_s.append

    def open(self) -> Any:
        self.attempts += 1
        if self.attempts < self._at_attempt:
            raise BusError("still in use")
        return can.Bus(interface="virtual", channel=self._bus.channel)


@pytest.mark.parametrize("at_attempt", [1, 3, REOPEN_ATTEMPTS])
def test_an_adapter_is_lent_to_the_loop_and_taken_back(joint: Any, at_attempt: int) -> None:
    with joint.commissioned() as drive:
        adapter = Adapter(joint, drive, at_attempt)
        lent: Any = drive._network.bus
        drive.start_cyclic()
        assert lent._is_shutdown
        assert drive.settings_guard() is drive.thermometer() is None
        assert drive.make_safe() == "switch on disabled"
        assert adapter.attempts == at_attempt
        assert adapter.pauses_s == [REOPEN_PAUSE_S] * (at_attempt - 1)
        assert drive.make_safe() == "switch on disabled"
        assert adapter.attempts == at_attempt  # it has it


def test_an_adapter_that_does_not_come_back_leaves_the_watchdog_to_stop_the_joint(joint: Any) -> None:
    with joint.commissioned() as drive:
        adapter = Adapter(joint, drive, REOPEN_ATTEMPTS + 1)
        drive.start_cyclic()
        state = drive.make_safe()
    assert state.startswith("unknown: the bus cannot be opened again (still in use)")
    assert "watchdog stops the joint within 0.2 s" in state
    assert adapter.attempts == REOPEN_ATTEMPTS


@pytest.mark.parametrize("change", ["mode", "deadline", "another"])
def test_a_drive_that_changes_at_its_start_is_not_handed_over(joint: Any, change: str) -> None:
    with joint.commissioned() as drive:
        Adapter(joint, drive, 1)

        def gate() -> None:
            if (0x000, b"\x01\x01") in joint.requests:
                joint.answers.update({(0x6061, 0): 8} if change == "mode" else {})
                joint.answers.update({(0x1400, 5): 0} if change == "deadline" else {})
                if change == "another":
                    joint.send(0x000, b"\x80\x01")

        drive._objects.gate = gate
        with pytest.raises(BusError if change == "another" else DeviceError):
            drive.start_cyclic()
        assert not drive._handed_over
