"""The drive's temperature: read beside the loop without waiting, and harmless if it fails."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import canopen
import pytest
from canopen.objectdictionary import ODVariable

from jointctl.drivers.canopen.drive import Thermometer
from jointctl.drivers.canopen.sdo import SdoReads
from jointctl.drivers.canopen.settings import TemperatureObject
from jointctl.drivers.drive import Reading
from jointctl.drivers.errors import DeviceError

INDEX, NODE = 0x2103, 5
S = 1_000_000_000
INTEGER16, UNSIGNED8, REAL32, VISIBLE_STRING, INTEGER64 = 3, 5, 8, 9, 21


class Line:
    """What the thermometer sees of a network: requests are kept, answers come when the test says so."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, bytes]] = []
        self.broken = False
        self.answer: Callable[..., None] | None = None

    def subscribe(self, identifier: int, callback: Callable[..., None]) -> None:
        assert identifier == 0x580 + NODE
        self.answer = callback

    def send_message(self, identifier: int, data: bytes) -> None:
        if self.broken:
            raise OSError(100, "network is down")
        self.sent.append((identifier, data))


class Bench:
    """A thermometer with its line and its clock."""

    def __init__(self, data_type: int = INTEGER16, **wanted: Any) -> None:
        node = canopen.RemoteNode(NODE, canopen.ObjectDictionary())
        variable = ODVariable("temperature", INDEX, 0)
        variable.data_type = data_type
        node.object_dictionary.add_object(variable)
        self.line, self.now_ns = Line(), 10 * S
        place = {"index": INDEX, "unit_degC": 0.1, **wanted}
        reads = SdoReads(self.line, node, lambda: self.now_ns)  # type: ignore[arg-type]
        self.meter = Thermometer(node, TemperatureObject(**place), "x.eds", reads)  # type: ignore[arg-type]

    def after(self, seconds: float) -> Reading | None:
        self.now_ns += round(seconds * S)
        return self.meter.poll()

    def says(self, data: bytes) -> Reading | None:
        assert self.line.answer is not None
        self.line.answer(0x580 + NODE, bytearray(data), 0.0)
        return self.meter.poll()

    def heard(self, data: bytes) -> Reading:
        """What the answer to a request of now is."""
        self.after(0.0)
        found = self.says(data)
        assert found is not None
        return found


def upload(value: bytes, index: int = INDEX) -> bytes:
    return struct.pack("<BHB4s", 0x43 | (4 - len(value)) << 2, index, 0, value)


def test_one_request_a_second_however_often_it_is_asked() -> None:
    bench = Bench()
    for _ in range(150):  # 3 s of the supervisor's pace
        asked = len(bench.line.sent)
        bench.after(0.02)
        if len(bench.line.sent) > asked:
            bench.says(upload(struct.pack("<h", 251)))
    assert [identifier for identifier, _ in bench.line.sent] == [0x600 + NODE] * 3
    assert bench.line.sent[0][1] == bytes.fromhex("4003210000000000")


@pytest.mark.parametrize(
    ("data_type", "wanted", "answer", "expected_degC"),
    [
        (INTEGER16, {}, struct.pack("<h", -405), -40.5),
        (INTEGER16, {}, struct.pack("<hH", 251, 0), 25.1),  # a server that always answers with 4 bytes
        (UNSIGNED8, {"unit_degC": 1.0}, b"\xc8", 200.0),
        (UNSIGNED8, {"unit_degC": 1.0, "offset_degC": -40.0}, b"\x3c", 20.0),
        (REAL32, {"unit_degC": 1.0}, struct.pack("<f", 36.5), 36.5),
    ],
)
def test_types_unit_and_offset(data_type: int, wanted: dict[str, float], answer: bytes, expected_degC: float) -> None:
    found = Bench(data_type, **wanted).heard(upload(answer))
    assert found.temperature_degC == pytest.approx(expected_degC)
    assert (found.time_ns, found.problem) == (10 * S, "")


def test_without_an_answer_it_is_unknown_and_asked_again() -> None:
    bench = Bench()
    assert bench.after(0.0) is None
    assert bench.after(0.999) is None  # the twin: an answer may take so long
    found = bench.after(0.001)
    assert found == Reading(11 * S, None, "object 2103 (temperature): no answer within 1 s")
    assert len(bench.line.sent) == 2
    assert bench.heard(upload(struct.pack("<h", 300))).temperature_degC == pytest.approx(30.0)


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (struct.pack("<BHBI", 0x80, INDEX, 0, 0x06020000), "object does not exist (SDO abort 06020000h)"),
        (struct.pack("<BHBI", 0x80, INDEX, 0, 0x08000000), "refused (SDO abort 08000000h)"),
        (upload(b"\x01"), "16 bits are expected"),
        (struct.pack("<BHBI", 0x41, INDEX, 0, 20), "is no expedited answer"),  # a segmented transfer: not a number
    ],
)
def test_an_abort_and_nonsense_make_it_unknown(answer: bytes, words: str) -> None:
    bench = Bench()
    found = bench.heard(answer)
    assert found.temperature_degC is None
    assert words in found.problem
    assert bench.after(0.5) is None
    bench.after(0.5)
    assert len(bench.line.sent) == 2  # it may recover


def test_not_a_number_is_none() -> None:
    assert Bench(REAL32).heard(upload(struct.pack("<f", float("nan")))).temperature_degC is None


@pytest.mark.parametrize(
    "foreign",
    [
        upload(struct.pack("<h", 251), 0x6064),  # another program's answer on the same SDO channel
        struct.pack("<BHB4x", 0x60, INDEX, 0),  # a download's
        b"\x43\x03",
        bytes(8),
    ],
)
def test_answers_to_others_are_not_taken(foreign: bytes) -> None:
    bench = Bench()
    bench.after(0.0)
    assert bench.says(foreign) is None
    assert bench.says(upload(struct.pack("<h", 251))) is not None
    assert bench.says(upload(struct.pack("<h", 252))) is None  # nobody has asked


@pytest.mark.parametrize(("pause_s", "asked"), [(0.049, 1), (0.05, 2)])
def test_it_waits_while_somebody_else_uses_the_channel(pause_s: float, asked: int) -> None:
    """One node has one SDO server: a request in the midst of `jointctl info` would disturb it."""
    bench = Bench()
    bench.after(0.0)
    bench.says(upload(struct.pack("<h", 251)))
    bench.now_ns += S
    bench.says(upload(b"\x01", 0x6502))
    assert len(bench.line.sent) == 1
    bench.after(pause_s)
    assert len(bench.line.sent) == asked


def test_a_bus_that_takes_nothing_is_the_loops_business() -> None:
    bench = Bench()
    bench.line.broken = True
    assert bench.after(0.0) is None
    assert bench.after(1.0) is None
    bench.line.broken = False
    bench.after(1.0)
    assert bench.says(upload(struct.pack("<h", 251))) is not None


@pytest.mark.parametrize(("data_type", "index"), [(VISIBLE_STRING, 0x2103), (INTEGER64, 0x2103), (INTEGER16, 0x2104)])
def test_what_is_no_short_number_in_the_eds_is_refused(data_type: int, index: int) -> None:
    words = rf"x\.eds has no object {index:04X} \(temperature\) that is a number"
    with pytest.raises(DeviceError, match=words):
        Bench(data_type, index=index)
