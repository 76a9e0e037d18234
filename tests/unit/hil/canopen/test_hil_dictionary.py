"""The EDS describes the virtual drive exactly: a walk over every object, through SDO, by what the EDS says alone."""

from __future__ import annotations

import struct
from typing import Any

import canopen
import pytest
from canopen.objectdictionary import ODVariable

from jointctl.drivers.canopen.sdo import download
from jointctl.hil.canopen.device import Cia402Device, DeviceSettings
from jointctl.hil.plant.joint import plant
from tests.places import EDS
from tests.virtual_drive import NODE, Network

FORMATS = {1: "<B", 2: "<b", 3: "<h", 4: "<i", 5: "<B", 6: "<H", 7: "<I"}
TEXT = 9
# What the EDS cannot say in limits: values of these objects must be of a set (named in its comments), or an
# identifier.  In every other writable number each value between the limits is accepted.
CHOICES: dict[int, tuple[int, ...]] = {
    0x1003: (0,),
    0x1010: (0x65766173,),
    0x1011: (0x64616F6C,),
    0x1019: (0, *range(2, 241)),
    0x605A: (0, 1, 2, 5, 6),
    0x6060: (0, 1, 3, 4, 6, 8, 9, 10),
    0x6086: (0,),
    0x6088: (0,),
    0x6098: (0, 33, 34, 35, 37),
}
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
    network = Network(Cia402Device(EDS, DeviceSettings(node_id=NODE), *plant()))
    remote = network.add_node(NODE, str(EDS))
    remote.sdo.RESPONSE_TIMEOUT = 0.5
    network.run(1)
    return remote


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
