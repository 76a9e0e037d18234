"""The EDS describes the virtual drive and the CiA 406 node exactly; what is stored comes back."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import canopen
import pytest
from canopen.objectdictionary import ODVariable

from jointctl.drivers.canopen.eds import read_eds
from jointctl.drivers.canopen.sdo import download
from jointctl.hil.canopen.device import DeviceSettings
from jointctl.tools.virtual_joint import new_device
from tests.places import CONFIGS, EDS
from tests.python_process import largest_file
from tests.two_encoders import NODE as TWO_NODES
from tests.two_encoders import short_run
from tests.virtual_drive import NODE, Network, Rig, network_node, virtual_drive

# --- The EDS describes the virtual drive exactly: a walk over every object, through SDO, by what the EDS says alone ---
FORMATS = {1: "<B", 2: "<b", 3: "<h", 4: "<i", 5: "<B", 6: "<H", 7: "<I"}
TEXT = 9
# What the EDS cannot say in limits: values of these objects must be of a set (named in its comments), or an
# identifier.  In every other writable number each value between the limits is accepted.
CHOICES: dict[int, tuple[int, ...]] = {
    0x1003: (0,), 0x1010: (0x65766173,), 0x1011: (0x64616F6C,), 0x1019: (0, *range(2, 241)), 0x605A: (0, 1, 2, 5, 6),
    0x6060: (0, 1, 3, 4, 6, 8, 9, 10), 0x6086: (0,), 0x6088: (0,), 0x6098: (0, 33, 34, 35, 37),
}  # fmt: skip
IDENTIFIERS = (0x1005, 0x1014, *range(0x1400, 0x1404), *range(0x1800, 0x1804))
# Fixed while the PDO is valid, as the first ones are at the start: a mapping 0601 0000, others 0800 0022.
WITH_PDO = (
    *range(0x1600, 0x1604),
    *range(0x1A00, 0x1A04),
    *((index, sub) for index in range(0x1800, 0x1804) for sub in (3, 6)),
)
SETTINGS = {(0x1018, 1), (0x1018, 2), (0x1018, 3), (0x1018, 4), (0x6075, 0), (0x6076, 0), (0x608F, 1), (0x608F, 2)}
LIVE = {0x6041}  # tells the present state


@pytest.fixture(scope="module")
def node() -> Any:
    return network_node(Network(virtual_drive()), 0.5)


def all_variables() -> list[ODVariable]:
    found: list[ODVariable] = []
    for item in canopen.import_od(str(EDS), node_id=NODE).values():
        found += [item] if isinstance(item, ODVariable) else list(item.values())
    return found


VARIABLES = all_variables()
NAMES = [f"{v.index:04X}:{v.subindex}" for v in VARIABLES]
WRITABLE = [v for v in VARIABLES if v.writable]


def code_of(node: Any, variable: ODVariable, data: bytes) -> int:
    """Abort code of a download, 0 = accepted."""
    try:
        download(node.sdo, variable.index, variable.subindex, data)
    except canopen.SdoAbortedError as abort:
        return int(abort.code)
    return 0


def bounds(variable: ODVariable) -> tuple[int, int]:
    size = struct.calcsize(FORMATS[variable.data_type])
    signed = variable.data_type in (1, 2, 3, 4) and variable.data_type != 1
    low, high = (-(1 << 8 * size - 1), (1 << 8 * size - 1) - 1) if signed else (0, (1 << 8 * size) - 1)
    return (variable.min if variable.min is not None else low, variable.max if variable.max is not None else high)


@pytest.mark.parametrize("variable", VARIABLES, ids=NAMES)
def test_reading_gives_the_type_and_the_default(node: Any, variable: ODVariable) -> None:
    assert variable.data_type in FORMATS or variable.data_type == TEXT
    if variable.index == 0x1003 and variable.subindex:
        with pytest.raises(canopen.SdoAbortedError, match="0x08000024"):
            node.sdo.upload(0x1003, variable.subindex)  # no error yet
        return
    data = node.sdo.upload(variable.index, variable.subindex)
    if variable.data_type == TEXT:
        assert data.decode() == variable.default
        return
    assert len(data) == struct.calcsize(FORMATS[variable.data_type]) == len(variable) // 8
    value = struct.unpack(FORMATS[variable.data_type], data)[0]
    low, high = bounds(variable)
    assert low <= value <= high
    if (variable.index, variable.subindex) not in SETTINGS and variable.index not in LIVE:
        assert value == variable.default


@pytest.mark.parametrize("variable", [v for v in VARIABLES if not v.writable])
def test_writing_what_is_read_only_is_refused(node: Any, variable: ODVariable) -> None:
    assert code_of(node, variable, b"\0" * max(1, len(variable) // 8)) == 0x06010002
    assert code_of(node, variable, b"\0" * 9) == 0x06010002


@pytest.mark.parametrize("variable", [v for v in WRITABLE if v.data_type != TEXT])
def test_writing_respects_length_limits_and_sets(node: Any, variable: ODVariable) -> None:
    index, sub, kind = variable.index, variable.subindex, FORMATS[variable.data_type]
    size = struct.calcsize(kind)
    before = node.sdo.upload(index, sub)
    low, high = bounds(variable)
    state = index in WITH_PDO or (index, sub) in WITH_PDO
    assert code_of(node, variable, before + b"\0") == 0x06070012
    if size > 1:
        assert code_of(node, variable, before[:-1]) == 0x06070013
    too_high = 0x06040042 if sub == 0 and index in WITH_PDO else 0x06090031
    for value, code in ((low - 1, 0x06090032), (high + 1, too_high)):
        try:
            data = struct.pack(kind, value)
        except struct.error:
            continue
        assert code_of(node, variable, data) == code
    assert node.sdo.upload(index, sub) == before
    for value in sorted({low, min(low + 1, high), (low + high) // 2, max(high - 1, low), high}):
        code = code_of(node, variable, struct.pack(kind, value))
        if index in CHOICES:
            refused = 0x08000020 if index in (0x1010, 0x1011) else 0x06090030
            assert code == (0 if value in CHOICES[index] else refused), value
        elif index in IDENTIFIERS and sub <= 1:
            assert code in (0, 0x06090030, 0x08000022)
        elif index in IDENTIFIERS and sub == 2:
            assert code == (0x06090030 if 240 < value < 254 else 0)
        elif state:  # mapping and its checks: test_hil_sdo_server.py
            assert code in (0, 0x06010000, 0x08000022, 0x06020000, 0x06040041, 0x06040042)
        else:
            assert code == 0, value
        if code == 0 and index not in (0x1010, 0x1011):
            assert node.sdo.upload(index, sub) == struct.pack(kind, value)
    if not state and index not in (0x1010, 0x1011):
        code_of(node, variable, before)


@pytest.mark.parametrize("index", [0x1010, 0x1011, 0x1018, 0x1200, 0x1400, 0x1600, 0x1800, 0x1A00, 0x6099, 0x60E3])
def test_a_sub_index_beyond_the_last_one(node: Any, index: int) -> None:
    last = node.sdo.upload(index, 0)[0] if index not in (0x1600, 0x1A00) else 8
    with pytest.raises(canopen.SdoAbortedError, match="0x06090011"):
        node.sdo.upload(index, last + 1)


@pytest.mark.parametrize("index", [0x0001, 0x1000 - 1, 0x1002, 0x100E, 0x1280, 0x1404, 0x2101, 0x6000, 0x60E5, 0xFFFF])
def test_what_the_eds_does_not_list_is_not_there(node: Any, index: int) -> None:
    for access in (lambda: node.sdo.upload(index, 0), lambda: node.sdo.download(index, 0, b"\0")):
        with pytest.raises(canopen.SdoAbortedError, match="0x06020000"):
            access()


def test_supported_modes_are_the_modes_that_6060_takes(node: Any) -> None:
    supported = node.sdo[0x6502].raw
    for mode in range(-1, 12):
        code = code_of(node, node.object_dictionary[0x6060], struct.pack("<b", mode))
        assert (code == 0) is (mode == 0 or (mode > 0 and bool(supported >> mode - 1 & 1))), mode
    assert supported >> 16 == 0


def test_supported_homing_methods_are_those_that_6098_takes(node: Any) -> None:
    methods = {node.sdo[0x60E3][sub].raw for sub in range(1, node.sdo[0x60E3][0].raw + 1)}
    for method in range(-128, 128):
        code = code_of(node, node.object_dictionary[0x6098], struct.pack("<b", method))
        assert (code == 0) is (method == 0 or method in methods), method


# --- The virtual CiA 406 node, frame by frame and by its EDS ---
@pytest.fixture
def two_nodes(tmp_path: Path) -> Rig:
    return Rig(device=new_device(short_run(tmp_path, TWO_NODES, virtual__initial_position_rad=0.25)))


def test_the_eds_is_read_by_the_library_and_is_that_of_an_encoder() -> None:
    dictionary = canopen.import_od(str(CONFIGS / "joint_encoder.eds"), 2)
    assert dictionary[0x1000].default & 0xFFFF == 406
    assert dictionary[0x6004].pdo_mappable
    assert dictionary[0x1800][1].default == 0x40000182


def test_the_eds_needs_no_remark_and_is_not_measured_as_that_of_a_drive() -> None:
    assert read_eds(CONFIGS / "joint_encoder.eds", 2, encoder=True).all_remarks() == []
    assert "[6502]" in "".join(read_eds(CONFIGS / "joint_encoder.eds", 2).all_remarks())


def test_boot_up_heartbeat_and_nmt_of_its_own(two_nodes: Rig) -> None:
    assert (0x702, b"\0") in two_nodes.sent
    sent = two_nodes.send(0x602, struct.pack("<BHBI", 0x2B, 0x1017, 0, 100)) + two_nodes.run(1)
    assert (0x702, b"\x7f") in sent
    two_nodes.send(0, b"\x01\x02")
    assert (0x702, b"\x05") in two_nodes.run(106)
    assert two_nodes.device.device[0].nmt == 127  # the drive was not meant
    two_nodes.send(0, b"\x81\x02")
    assert (0x702, b"\0") in two_nodes.run(1)


def test_its_position_at_every_sync(two_nodes: Rig) -> None:
    two_nodes.send(0x602, struct.pack("<BHBI", 0x2F, 0x1800, 2, 1))
    assert 0x182 not in dict(two_nodes.send(0x80, b""))
    two_nodes.send(0, b"\x01\x02")
    sent = dict(two_nodes.send(0x80, b""))
    assert int.from_bytes(sent[0x182], "little") == round(0.25 / math.tau * 524288) + 100_000


def test_an_error_is_an_emergency_and_an_alarm(two_nodes: Rig) -> None:
    encoder = two_nodes.device.device[0].encoder
    encoder.error_code = 0x5000
    assert (0x82, b"\x00\x50\x21\0\0\0\0\0") in two_nodes.run(1)
    identifier, answer = two_nodes.send(0x602, struct.pack("<BHB4x", 0x40, 0x6503, 0))[-1]
    assert (identifier, answer[4]) == (0x582, 1)
    encoder.error_code = 0
    assert (0x82, bytes(8)) in two_nodes.run(1)


def test_every_object_of_the_node_can_be_read(two_nodes: Rig) -> None:
    for entry in two_nodes.device.encoder.objects:
        answer = two_nodes.send(0x602, struct.pack("<BHB4x", 0x40, entry.index, entry.sub))[-1][1]
        assert answer[0] & 0xE0 == 0x40, f"{entry.index:04X}:{entry.sub}"


# Objects 1010 and 1011 of the virtual drive: saved values come back after a reset, and after a restart with a file.
SAVE = int.from_bytes(b"save", "little")
LOAD = int.from_bytes(b"load", "little")


def restart(rig: Rig, command: int = 0x81) -> None:
    rig.send(0, bytes([command, NODE]))
    rig.run(1)


def changed_rig(path: Path | None = None) -> Rig:
    rig = Rig(DeviceSettings(node_id=NODE, parameter_file=path), step_s=1e-3)
    rig.set(0x1017, 0, 500, 2)
    rig.set(0x6072, 0, 800, 2)
    rig.set(0x6071, 0, 55, 2)
    rig.device._write(0x2100, 0, b"elbow")
    return rig


def values(rig: Rig) -> tuple[int, int, int, bytes]:
    rig.device.answer_sdo(bytes(16), rig.now_ns)  # the strings of a reset are restored with the next request
    return rig.get(0x1017), rig.get(0x6072), rig.get(0x6071), rig.device.objects.read(0x2100, 0)


@pytest.mark.parametrize(
    ("sub", "after"), [(1, (500, 800, 0, b"elbow")), (2, (500, 1000, 0, b"joint")), (3, (0, 800, 0, b"elbow"))]
)
def test_what_was_saved_comes_back_after_a_reset(sub: int, after: tuple[int, int, int, bytes]) -> None:
    rig = changed_rig()
    rig.set(0x1010, sub, SAVE, 4)
    assert rig.get(0x1010, sub) == 1
    restart(rig)
    assert values(rig) == after
    for part in (1, 2, 3):
        rig.set(0x1011, part, LOAD, 4)
    assert rig.get(0x6072) == after[1]  # not before the next reset
    restart(rig)
    assert values(rig) == (0, 1000, 0, b"joint")


@pytest.mark.parametrize(
    ("saved", "then", "command", "expected"),
    [
        (1, (0x1011, 2, LOAD, 4), 0x81, (0, 800, 0, b"elbow")),  # restoring a part leaves the other
        (2, (0x1017, 0, 100, 2), 0x82, (500, 800, 55, b"elbow")),  # what is saved of the communication
    ],
)
def test_a_part_is_saved_or_restored_by_itself(
    saved: int, then: tuple[int, int, int, int], command: int, expected: tuple[object, ...]
) -> None:
    rig = changed_rig()
    rig.set(0x1010, saved, SAVE, 4)
    rig.set(*then)
    restart(rig, command)
    assert values(rig) == expected


@pytest.mark.parametrize("index", [0x1010, 0x1011])
@pytest.mark.parametrize("signature", [0, 1, SAVE ^ LOAD, int.from_bytes(b"evas", "little"), 0xFFFFFFFF])
def test_another_signature_is_refused(index: int, signature: int) -> None:
    rig = changed_rig()
    assert rig.write(index, 1, signature, 4) == 0x08000020
    assert rig.write(index, 1, SAVE if index == 0x1011 else LOAD, 4) == 0x08000020
    restart(rig)
    assert values(rig)[1] == 1000


@pytest.mark.parametrize(("words", "code"), [((0x06, 0x07), 0), ((0x06, 0x07, 0x0F), 0x08000022)])
def test_nothing_is_saved_while_the_motor_has_torque(words: tuple[int, ...], code: int) -> None:
    rig = changed_rig()
    rig.control(*words)
    assert rig.write(0x1010, 1, SAVE, 4) == code
    assert rig.write(0x1011, 1, LOAD, 4) == code


def test_a_file_outlives_the_drive(tmp_path: Path) -> None:
    path = tmp_path / "joint.json"
    rig = changed_rig(path)
    assert not path.exists()
    rig.set(0x1010, 1, SAVE, 4)
    again = Rig(DeviceSettings(node_id=NODE, parameter_file=path), step_s=1e-3)
    assert values(again) == (500, 800, 0, b"elbow")
    again.set(0x1011, 1, LOAD, 4)
    assert json.loads(path.read_text()) == {}
    third = Rig(DeviceSettings(node_id=NODE, parameter_file=path), step_s=1e-3)
    assert values(third) == (0, 1000, 0, b"joint")


def test_a_file_that_cannot_be_written_is_a_hardware_error(tmp_path: Path) -> None:
    rig = changed_rig(tmp_path / "gone" / "joint.json")
    assert rig.write(0x1010, 1, SAVE, 4) == 0x06060000
    restart(rig)
    assert values(rig)[0] == 0


def test_half_a_file_does_not_stay(tmp_path: Path) -> None:
    rig = changed_rig(tmp_path / "joint.json")
    with largest_file(4):
        assert rig.write(0x1010, 1, SAVE, 4) == 0x06060000
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("text", ["", "[]", '{"6041:0": 1}', '{"1017:0": "x"}', '{"1017:0": 70000}', '{"nonsense": 1}'])
def test_a_bad_file_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "joint.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"parameter file joint\.json: "):
        Rig(DeviceSettings(node_id=NODE, parameter_file=path))
