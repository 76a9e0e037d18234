"""Drives as they are met: objects they lack, limits and delays of their own, PDOs on any identifier."""

from __future__ import annotations

import re
import struct
from dataclasses import replace
from typing import Any

import pytest

from jointctl.drivers.can.frames import Frame
from jointctl.drivers.canopen.cyclic import accept_frame, end_cycle
from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import DeviceError, NoDeviceError
from jointctl.firmware_py.records import Command, Sample
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import DriveRequest
from tests.places import EDS

# --- Drives as they are met: objects they lack, limits and delays of their own (docs/hardware.md) ---
pytestmark = pytest.mark.usefixtures("short_timeout")
NO_ACCESS, READ_ONLY, OUT_OF_RANGE = 0x06010000, 0x06010002, 0x06090030
NO_OBJECT, NO_SUB_INDEX = "06020000", "06090011"
STATUS, POSITION, TORQUE, VELOCITY = 0x60410010, 0x60640020, 0x60770010, 0x606C0020
CONTROL, TARGET, MODE, LIMIT, TARGET_VELOCITY, SPEED_LIMIT = (
    0x60400010, 0x60710010, 0x60600008, 0x60720010, 0x60FF0020, 0x607F0020,
)  # fmt: skip


# --- objects that a drive does not have: the EDS does not list them, or lists them all the same ---
def take_away(bus: Any, index: int, sub: int | None = None) -> None:
    """The drive's dictionary loses an object, or one of its entries; our EDS still lists it."""
    objects = bus.device.objects
    for key in [key for key in objects.entries if key[0] == index and sub in (None, key[1])]:
        del objects.entries[key]
    if sub is None:
        objects._indices.discard(index)


@pytest.fixture(params=["EDS", "drive"])
def lacking(request: pytest.FixtureRequest, commission: Any, joint: Any) -> Any:
    """Commissions a drive without some objects, (index, sub): the EDS has not got them either, or only the drive."""

    def run(*places: tuple[int, int | None], **changes: Any) -> CommissioningReport:
        if request.param == "EDS":
            names = (f"{index:04X}" + ("" if sub is None else f"sub{sub:X}") for index, sub in places)
            return commission(without=tuple(names), **changes)
        for place in places:
            take_away(joint, *place)
        return commission(**changes)

    return run


@pytest.mark.parametrize(
    ("index", "sub", "remark"),
    [
        (0x6502, None, "no object 6502"), (0x603F, None, ""), (0x1017, None, "no object 1017"),
        (0x6007, None, "no object 6007"), (0x1029, None, ""), (0x605A, None, ""), (0x60B2, None, ""),
        (0x60FF, None, ""), (0x1005, None, ""), (0x1006, None, ""), (0x1019, None, ""),
        (0x1400, 5, "no object 1400:5"), (0x1800, 3, ""), (0x1800, 5, ""), (0x1018, 4, ""), (0x1008, None, ""),
    ],
)  # fmt: skip
def test_what_may_be_absent_is(lacking: Any, joint: Any, index: int, sub: int | None, remark: str) -> None:
    report = lacking((index, sub))
    assert report.mode == "cyclic_sync_torque"
    assert not remark or any(remark in line for line in report.remarks)
    assert joint.value(0x1016, 1) != 0


@pytest.mark.parametrize(("without", "velocity_max_radps"), [(("607F",), 1.0), ((), None)])
def test_a_velocity_limit_of_the_drive_is_set_where_both_have_one(
    commission: Any, joint: Any, without: tuple[str, ...], velocity_max_radps: float | None
) -> None:
    report = commission(without=without, mode="csv", velocity_max_radps=velocity_max_radps)
    assert report.commands_velocity
    assert "max velocity" not in report.settings
    assert not joint.downloads(0x607F)


def test_a_torque_that_is_not_measured_is_not_mapped(lacking: Any, commission: Any, joint: Any) -> None:
    assert not lacking((0x6077, None)).measures_torque
    port = commission.port[0]
    assert (port.torque_at, port.tpdo_length) == (-1, 6)
    assert [joint.value(0x1A00, k) for k in range(3)] == [2, STATUS, POSITION]


OWN_LOOP: dict[str, Any] = {"mode": "csp", "holds_alone": True, "torque_offset": True, "velocity_offset": True}


@pytest.mark.parametrize(
    ("index", "how", "words"),
    [
        (0x60B2, OWN_LOOP, "object 60B2 .*offset"),
        # a sweep used such a drive: with the computer dead one that merely leaves operational may go on turning
        *((0x6007, how, f"object 6007 .* dies, in mode {how['mode']} it may go on holding or turning")
          for how in (OWN_LOOP, {"mode": "csv"}, {"mode": "pv"})),
    ],
)  # fmt: skip
def test_a_drive_that_lacks_what_a_loop_of_its_own_needs_is_refused(
    lacking: Any, index: int, how: dict[str, Any], words: str
) -> None:
    with pytest.raises(DeviceError, match=words):
        lacking((index, None), **how)


def test_its_twin_in_torque_mode_the_same_drive_is_accepted(lacking: Any) -> None:
    assert lacking((0x6007, None), (0x60B2, None)).mode == "cyclic_sync_torque"


@pytest.mark.parametrize("without", [0x6007, 0x60B2])
def test_where_the_mode_is_open_a_sweep_takes_torque_then(lacking: Any, without: int) -> None:
    report = lacking((without, None), mode="velocity or torque")
    refused = without == 0x6007
    assert report.mode == ("cyclic_sync_torque" if refused else "cyclic_sync_velocity")
    assert any("a mode of torque: no object 6007" in line for line in report.remarks) is refused


def test_without_60b1_6065_and_a_torque_mode_csp_goes_on_with_remarks(lacking: Any, commission: Any) -> None:
    remarks = lacking((0x60B1, None), (0x6065, None), (0x6071, None), (0x6077, None), **OWN_LOOP).remarks
    assert (commission.port[0].offset_rpdo_id, commission.port[0].torque_offset_at) == (0, 6)
    for index in ("60B1", "6065", "6077"):
        assert any(f"no object {index}" in remark for remark in remarks)


@pytest.mark.parametrize("sub", [None, 1, 2])
def test_a_profile_mode_does_without_slope_and_period_or_half_of_it(lacking: Any, joint: Any, sub: int | None) -> None:
    report = lacking((0x6087, None), (0x60C2, sub), mode="tq")
    assert any("no object 6087" in line for line in report.remarks)
    assert "60C2" not in report.settings
    assert not any(joint.downloads(0x60C2, left) for left in (1, 2))


@pytest.mark.parametrize("sub", [1, 2])
def test_half_an_encoder_resolution_is_none(lacking: Any, sub: int) -> None:
    assert lacking((0x608F, sub)).counts_per_motor_turn == 0.0


SCALED = """
[6091]\nObjectType=8\n[6091sub1]\nDataType=7\n[6091sub2]\nDataType=7
[6092]\nObjectType=8\n[6092sub1]\nDataType=7\n[6092sub2]\nDataType=7
"""


@pytest.mark.parametrize("mode", [{"mode": "cst"}, OWN_LOOP])
@pytest.mark.parametrize(
    ("gear", "feed", "indices"),
    [((121, 1), (360_000, 1), ["6091", "6092"]), ((1, 1), (524288, 121), []), ((1, 1), (0, 0), [])],
)
def test_a_position_that_the_drive_scales_is_told_in_every_mode(
    commission: Any, joint: Any, mode: Any, gear: Any, feed: Any, indices: list[str]
) -> None:
    joint.device.objects.entries |= {
        (index, sub): replace(joint.device.objects.entries[0x608F, sub], index=index, default=value)
        for index, values in ((0x6091, gear), (0x6092, feed)) for sub, value in enumerate(values, 1)
    }  # fmt: skip
    remarks = commission(eds=EDS.read_text() + SCALED, **mode).remarks
    assert [line[:4] for line in remarks if line[:4] in ("6091", "6092")] == indices


POLARITY = "\n[607E]\nObjectType=7\nDataType=5\nAccessType=rw\n"


def inverting(joint: Any, polarity: int) -> str:
    """The EDS of a drive with that polarity."""
    sample = joint.device.objects.entries[0x1001, 0]
    joint.device.objects.entries[0x607E, 0] = replace(sample, index=0x607E, default=polarity)
    return EDS.read_text() + POLARITY


@pytest.mark.parametrize("mode", [{"mode": "csv"}, {"mode": "pv"}, OWN_LOOP])
@pytest.mark.parametrize(("polarity", "inverted"), [(0x80, "positions"), (0x40, "velocities")])
def test_a_velocity_that_counts_the_other_way_than_the_position_is_refused(
    commission: Any, joint: Any, mode: dict[str, Any], polarity: int, inverted: str
) -> None:
    """The joint turned away from its reference until the following error had tripped."""
    with pytest.raises(DeviceError, match=rf"607E \(polarity\) is {polarity:02X}h, which inverts {inverted} alone"):
        commission(eds=inverting(joint, polarity), **mode)


@pytest.mark.parametrize(
    ("polarity", "mode", "remarks"),
    [
        (0x00, {"mode": "csv"}, 0), (0xC0, {"mode": "csv"}, 1), (0x40, {"mode": "cst"}, 0),
        (0x40, {**OWN_LOOP, "velocity_offset": False}, 0),
    ],
)  # fmt: skip
def test_its_twins_whose_directions_agree_or_do_not_matter(
    commission: Any, joint: Any, polarity: int, mode: dict[str, Any], remarks: int
) -> None:
    found = commission(eds=inverting(joint, polarity), **mode).remarks
    assert sum("positions and velocities are inverted" in line for line in found) == remarks


def test_a_drive_that_does_not_tell_its_scale_is_commissioned_with_a_remark(commission: Any, joint: Any) -> None:
    joint.unread.update({(index, sub): 0x08000022 for index in (0x6091, 0x6092) for sub in (1, 2)})
    remarks = commission(eds=EDS.read_text() + SCALED, mode="cst").remarks
    told = "\n".join(remarks)
    assert all(re.search(rf"6064 is not known: .*{index}.* was refused", told) for index in ("6091", "6092")), told


@pytest.mark.parametrize(
    ("places", "answers", "message"),
    [
        ([(0x1016, None)], {}, r"no object 1016:1 .* which jointctl needs: without it the drive cannot"),
        ([(0x1016, 1)], {}, r"no object 1016:1 .* which jointctl needs: without it the drive cannot"),
        ([(0x6007, None), (0x1029, None)], {}, r"neither object 6007 .* nor 1029:1"),
        ([(0x6502, None)], {(0x6061, 0): 0}, "6061 shows mode 0, mode 10 was selected"),
        ([(0x603F, None)], {(0x6041, 0): 0x0218}, r"is in fault \(error code 0000h\)"),
    ],
)
def test_what_a_drive_is_refused_for_that_lacks_objects(
    lacking: Any, joint: Any, places: list[tuple[int, int | None]], answers: dict[tuple[int, int], int], message: str
) -> None:
    joint.answers.update(answers)
    with pytest.raises(DeviceError, match=message):
        lacking(*places)


@pytest.mark.parametrize(("reference", "index"), [("rated_torque", 0x6076), ("rated_current", 0x6075)])
def test_a_drive_without_the_rated_value_that_6071_hangs_on(lacking: Any, reference: str, index: int) -> None:
    with pytest.raises(DeviceError, match=f"it has no object {index:04X}, so 6071 has no scale"):
        lacking((index, None), torque_reference=reference, rated_torque_Nm=None, rated_current_A=None)


@pytest.mark.parametrize(
    ("index", "sub", "name", "code"),
    [
        (0x6064, None, r"6064 \(position actual value\)", NO_OBJECT),
        (0x6072, None, r"6072 \(max torque\)", NO_OBJECT),
        (0x6071, None, r"6071 \(target torque\)", NO_OBJECT),
        (0x60C2, 1, r"60C2:1 \(interpolation time period\)", NO_SUB_INDEX),
    ],
)
def test_what_must_be_there_is_refused_by_name(
    commission: Any, joint: Any, index: int, sub: int | None, name: str, code: str
) -> None:
    take_away(joint, index, sub)
    words = rf"object {name} was refused: .* does not exist \(SDO abort {code}h\)"
    with pytest.raises(DeviceError, match=words) as was:
        commission()
    assert "EDS edited.eds lists it" in was.value.hint


def test_an_object_is_asked_for_once_and_anew_with_each_commissioning(joint: Any) -> None:
    with joint.commissioned() as drive:
        objects = drive._objects
        before = len(joint.requests)
        assert [objects.has(0x6077) for _ in range(5)] == [True] * 5
        assert len(joint.requests) == before
        take_away(joint, 0x6077)
        assert objects.has(0x6077)
        assert not drive.commission().measures_torque


def test_other_refusals_do_not_make_an_object_absent(commission: Any, joint: Any) -> None:
    """A drive that will not take 6007 now has it all the same: not the same as a drive without."""
    joint.refused[(0x6007, 0)] = 0x08000022
    with pytest.raises(DeviceError, match=r"6007 .* not in the present device state"):
        commission()


def test_a_drive_without_a_target_velocity_is_switched_off(joint: Any) -> None:
    for index in (0x60FF, 0x1016):
        take_away(joint, index)
    assert joint.stop_drive() == "switch on disabled"


def test_an_object_that_cannot_be_written_but_holds_the_value(commission: Any, joint: Any) -> None:
    joint.refused[(0x60C2, 1)] = joint.refused[(0x60C2, 2)] = READ_ONLY
    report = commission()
    assert "60C2:1 (interpolation time period) cannot be written; it is 1, as it must be" in report.remarks
    with pytest.raises(DeviceError, match=r"60C2:1 .* was refused: object is read only"):
        commission(rate_Hz=500.0)


def test_a_period_that_cannot_be_written_may_hold_it_in_other_numbers(commission: Any, joint: Any) -> None:
    joint.refused[(0x60C2, 1)] = joint.refused[(0x60C2, 2)] = READ_ONLY
    joint.store(0x60C2, 1, 10)
    joint.store(0x60C2, 2, -4)
    assert commission().settings["60C2"] == "10e-4 s"
    joint.store(0x60C2, 1, 11)
    with pytest.raises(DeviceError, match=r"60C2:1 .* was refused: object is read only"):
        commission()


# --- torque mode with a slope ---
@pytest.mark.parametrize("rate_Nmps", [1209.0, 1211.0])
def test_a_torque_slope_that_the_drive_limits_is_used_where_the_loop_is_slower(
    commission: Any, joint: Any, rate_Nmps: float
) -> None:
    joint.refused[(0x6087, 0)] = OUT_OF_RANGE
    joint.store(0x6087, 0, 20_000)  # 0.0605 Nm per permille: 1210 Nm/s
    if rate_Nmps > 1210.0:
        with pytest.raises(DeviceError, match=r"at most 1210 Nm/s .*set limits\.torque_rate_max_Nmps to 1210 or less"):
            commission(mode="tq", torque_rate_max_Nmps=rate_Nmps)
        return
    report = commission(mode="tq", torque_rate_max_Nmps=rate_Nmps)
    assert any("6087 = 20000 permille/s" in remark for remark in report.remarks)


# --- torque in per mille of what ---
@pytest.mark.parametrize(("reference", "resolution_Nm"), [("rated_torque", 0.0605), ("rated_current", 0.0484)])
def test_permille_of_rated_torque_or_of_rated_current(commission: Any, reference: str, resolution_Nm: float) -> None:
    report = commission(torque_reference=reference, torque_constant_NmpA=0.08, max_torque_permille=None)
    assert report.torque_resolution_Nm == pytest.approx(resolution_Nm)
    assert report.settings["max torque"].endswith("= 60.0 Nm")


# --- time ---


def test_a_drive_that_boots_for_seconds_and_one_for_longer_than_allowed(commission: Any, joint: Any) -> None:
    # each attempt: a request and an abort of the library
    joint.deaf_frames = 10
    joint.sequences[(0x6041, 0)] = [0x0200] * 20  # not ready to switch on
    commission(boot_timeout_s=2.0)
    assert (joint.deaf_frames, joint.sequences[(0x6041, 0)]) == (0, [])
    joint.answers[(0x6041, 0)] = 0x0200
    message = r"node 1 is not ready to switch on \(statusword 0200h\) after 0\.3 s \(motor supply, .*boot_timeout_s\)"
    with pytest.raises(DeviceError, match=message):
        commission(boot_timeout_s=0.3)
    joint.deaf_frames = 1000
    with pytest.raises(NoDeviceError, match="node 1 does not answer"):
        commission(boot_timeout_s=0.5)


def test_no_statusword_until_the_first_controlword_that_is_not_zero(commission: Any, joint: Any) -> None:
    joint.sequences[(0x6041, 0)] = [0, 0, 0, 0]
    commission(boot_timeout_s=1.0)
    words = joint.downloads(0x6040)
    assert words[:2] == [0x00, 0x06]
    assert not {0x07, 0x0F} & set(words)
    assert joint.value(0x6041) & 0x6F == 0x40


def test_answers_that_stay_away_now_and_then(commission: Any, joint: Any) -> None:
    joint.mute += [(0x1018, 2), (0x6060, 0), (0x1A00, 3), (0x1A00, 3), (0x1016, 1)]
    commission()
    assert joint.mute == []


# --- limits of torque ---
@pytest.mark.parametrize(("torque_Nm", "refused"), [(48.4, False), (49.0, True)])
def test_a_torque_limit_that_6072_would_cut_unseen_is_refused(commission: Any, torque_Nm: float, refused: bool) -> None:
    """1000 permille of 5 A and 0.08 Nm/A at 121:1 are 48.4 Nm; the configuration alone cannot know it."""
    how = {"torque_reference": "rated_current", "torque_constant_NmpA": 0.08, "max_torque_permille": 1000}
    if refused:
        with pytest.raises(DeviceError, match=r"limits.torque_max_Nm \(=49\) must be in \(0..48.4\], what drive.max"):
            commission(torque_max_Nm=torque_Nm, **how)
    else:
        assert commission(torque_max_Nm=torque_Nm, **how).settings["max torque"] == "1000 permille = 48.4 Nm"


# --- PDOs as drives have them: on any identifier, fixed, half writable; used, restored or refused with the reason ---
def fixed_map(bus: Any, base: int, cob_id: int, kind: int, *entries: int) -> None:
    """A PDO whose map cannot be changed."""
    bus.store(base, 1, cob_id)
    bus.store(base, 2, kind)
    bus.store(base + 0x200, 0, len(entries))
    for sub, entry in enumerate(entries, start=1):
        bus.store(base + 0x200, sub, entry)


def refuse_maps(bus: Any, first: int) -> None:
    """Abort every change of the mapping of the four PDOs from `first` (1400 or 1800)."""
    bus.refused.update({(base + 0x200, sub): NO_ACCESS for base in range(first, first + 4) for sub in range(9)})


# --- PDOs ---
@pytest.mark.parametrize("cob_id", [0x181, 0x1A5, 0x80000181, 0xC00001F0, 0x40000181])
def test_defaults_on_any_identifier_are_replaced(commission: Any, joint: Any, cob_id: int) -> None:
    joint.store(0x1800, 1, cob_id)
    joint.store(0x1400, 1, cob_id + 0x80)
    joint.store(0x1800, 2, 255)
    joint.store(0x1800, 3, 500)
    joint.store(0x1800, 5, 100)
    commission()
    assert joint.value(0x1800, 1) & ~0x40000000 == 0x181
    assert joint.value(0x1400, 1) & ~0x40000000 == 0x201
    assert [joint.value(0x1800, sub) for sub in (2, 3, 5)] == [1, 0, 0]
    assert (commission.port[0].tpdo_id, commission.port[0].rpdo_id) == (0x181, 0x201)


def test_a_pdo_that_cannot_be_switched_off_is_told(commission: Any, joint: Any) -> None:
    joint.store(0x1802, 1, 0x381)
    joint.refused[(0x1802, 1)] = NO_ACCESS
    assert any("1802:1" in r and "it stays enabled on 381h" in r for r in commission().remarks)


def test_a_drive_that_makes_sync_itself_is_told_not_to(commission: Any, joint: Any) -> None:
    joint.store(0x1005, 0, 0x40000080)
    joint.store(0x1006, 0, 2000)
    assert "1005 was 40000080h, it is now 00000080h" in commission().remarks
    assert (joint.value(0x1005), joint.value(0x1006)) == (0x80, 1000)


@pytest.mark.parametrize(("asked", "taken"), [(1, True), (255, False)])
def test_a_drive_that_only_answers_to_sync(commission: Any, joint: Any, asked: int, taken: bool) -> None:
    """Its PDOs are synchronous and stay so; between two SYNCs it says nothing."""
    for base in (*range(0x1400, 0x1404), *range(0x1800, 0x1804)):
        joint.store(base, 2, 1)
        joint.refused[base, 2] = OUT_OF_RANGE
    if not taken:
        with pytest.raises(DeviceError, match=r"transmission type 1, .*set drive\.rpdo_transmission_type = 1,"):
            commission(rpdo_transmission_type=asked)
        return
    report = commission(rpdo_transmission_type=asked)
    for base in (0x1400, 0x1800):
        told = f"{base:04X}:2 (PDO {base:04X} transmission type) cannot be written; it is 1, as it must be"
        assert told in report.remarks
    joint.stop()
    device, now_ns = joint.device, joint.now_ns

    def tpdos(frames: list[bytes]) -> int:
        return sum(struct.unpack_from("<I", frame)[0] == commission.port[0].tpdo_id for frame in frames)

    device.handle(struct.pack("<IB3x8s", 0, 2, b"\x01\x01"), now_ns)
    sync = struct.pack("<IB3x8s", commission.port[0].sync_id, 0, b"")
    heard = []
    for cycle in range(1, 4):
        at_ns = now_ns + cycle * 20_000_000
        heard.append((tpdos(device.advance(at_ns)), tpdos(device.handle(sync, at_ns))))
    assert heard == [(0, 1)] * 3


@pytest.mark.parametrize("asked", [1, 255])
def test_a_drive_that_refuses_an_asynchronous_command_and_can_be_mapped(
    commission: Any, joint: Any, asked: int
) -> None:
    """None of its own maps would do: not the map has to be changed, but what is asked for."""
    for base in range(0x1400, 0x1404):
        fixed_map(joint, base, 0x80000201, 1, CONTROL)
        joint.refused[base, 2] = OUT_OF_RANGE
    if asked == 1:
        assert commission(rpdo_transmission_type=asked).settings["mode"]
        return
    with pytest.raises(DeviceError, match=r"1400:2 .*was refused: value out of range") as caught:
        commission(rpdo_transmission_type=asked)
    assert caught.value.hint == "set drive.rpdo_transmission_type = 1"


def test_a_fixed_feedback_map_is_used_by_its_offsets(commission: Any, joint: Any) -> None:
    refuse_maps(joint, 0x1800)
    fixed_map(joint, 0x1800, 0x181, 1, STATUS, TORQUE)
    fixed_map(joint, 0x1801, 0x281, 1, STATUS, VELOCITY)
    fixed_map(joint, 0x1802, 0x3A5, 1, TORQUE, POSITION, STATUS)
    report = commission()
    port = commission.port[0]
    assert (port.tpdo_id, port.tpdo_length) == (0x3A5, 8)
    assert (port.torque_at, port.position_at, port.status_at) == (0, 2, 6)
    assert report.measures_torque
    assert any("PDO 1802 is used as it is, on 3A5h" in remark for remark in report.remarks)
    assert joint.value(0x1800, 1) & 0x80000000
    assert not joint.value(0x1802, 1) & 0x80000000
    frame, sample = new(Frame)[0], new(Sample)[0]
    frame.can_id, frame.length = 0x3A5, 8
    for at, byte in enumerate(struct.pack("<hiH", -100, 1234, 0x1637)):
        frame.payload[at] = byte
    assert accept_frame(port, frame, sample, 1)
    assert sample.status_word == 0x1637
    assert sample.torque_Nm == pytest.approx(-6.05)
    assert sample.position_rad == pytest.approx(1234 * report.position_resolution_rad)


@pytest.mark.parametrize(
    ("first", "cob_id", "pdos", "kind", "entries", "message"),
    [
        (0x1800, 0x181, 4, 1, (STATUS, VELOCITY),
         r"none of the drive's own TPDOs holds statusword \(6041\), position actual value \(6064\) together"),
        (0x1800, 0x181, 1, 255, (STATUS, POSITION), r"PDO 1800 .*transmission type 255: it does not answer every SYNC"),
        (0x1400, 0x201, 4, 1, (CONTROL, TARGET, SPEED_LIMIT),
         "also carries object 607F: jointctl does not know what to send there"),
    ],
)  # fmt: skip
def test_a_fixed_map_that_cannot_be_used_is_refused(
    commission: Any, joint: Any, first: int, cob_id: int, pdos: int, kind: int, entries: tuple[int, ...], message: str
) -> None:
    refuse_maps(joint, first)
    for k in range(pdos):
        fixed_map(joint, first + k, cob_id + k * 0x100, kind, *entries)
    joint.refused[first, 2] = READ_ONLY
    with pytest.raises(DeviceError, match=message):
        commission()


def test_a_fixed_command_map_is_filled_where_the_loop_writes_nothing(commission: Any, joint: Any) -> None:
    refuse_maps(joint, 0x1400)
    fixed_map(joint, 0x1400, 0x80000201, 255, CONTROL, MODE)
    fixed_map(joint, 0x1401, 0x80000301, 255, LIMIT, CONTROL, MODE, TARGET)
    report = commission()
    port = commission.port[0]
    assert (port.rpdo_id, port.rpdo_length, port.control_at, port.target_at) == (0x301, 7, 2, 5)
    assert any("PDO 1401 is used as it is" in remark for remark in report.remarks)
    frames, sample, command = new(Frame, 4), new(Sample)[0], new(Command)[0]
    port.state, command.request, command.torque_Nm = 4, DriveRequest.ENABLE, 6.05
    end_cycle(port, frames, sample, command)
    assert bytes(frames[2].payload)[:7] == struct.pack("<HHbh", 1000, 0x0F, 10, 100)
    assert frames[2].length == 7


def test_dummies_and_target_velocity_in_a_fixed_command_map_are_zero(commission: Any, joint: Any) -> None:
    refuse_maps(joint, 0x1400)
    fixed_map(joint, 0x1400, 0x201, 1, 0x00050008, CONTROL, 0x00050008, TARGET)
    commission()
    port = commission.port[0]
    assert (port.rpdo_length, port.control_at, port.target_at) == (6, 1, 4)
    assert bytes(port.rpdo_filler) == bytes(8)


def test_a_fixed_command_map_of_another_transmission_type_is_refused(commission: Any, joint: Any) -> None:
    refuse_maps(joint, 0x1400)
    fixed_map(joint, 0x1400, 0x201, 255, CONTROL, TARGET)
    joint.refused[(0x1400, 2)] = READ_ONLY
    with pytest.raises(DeviceError, match=r"transmission type 255, .*set drive\.rpdo_transmission_type = 255"):
        commission()
    commission(rpdo_transmission_type=255)


def test_a_map_of_which_only_some_steps_are_refused_is_restored(commission: Any, joint: Any) -> None:
    fixed_map(joint, 0x1800, 0x181, 1, POSITION, STATUS)
    joint.refused[(0x1A00, 1)] = NO_ACCESS
    commission()
    assert [joint.value(0x1A00, k) for k in range(3)] == [2, POSITION, STATUS]
    assert (commission.port[0].position_at, commission.port[0].status_at) == (0, 4)
