"""params dump, restore and diff on the virtual drive of this process, and the files that they write and read."""

from __future__ import annotations

import io
import json
import struct
import sys
from pathlib import Path
from typing import Any

import can
import pytest

from drivers.errors import BusError, ConfigurationError, DataError, DeviceError, UsageError
from tools.configuration.load import shipped_config
from tools.inspection.objects import Objects, Place, read_dictionary
from tools.inspection.parameter_file import is_parameter_file, load_parameters, toml_text, write_dcf
from tools.inspection.parameters import COMMANDS, ParameterSet, differences, is_parameter, read_parameters, variables
from tools.inspection.sdo_reading import SdoReader
from tools.inspection.subject import Subject, canopen_network
from tools.output import Output
from tools.verbs.params import DIFFERENT, diff, dump, place_index, restore_file

EDS = shipped_config("virtual").with_name("virtual_joint.eds")


def subject(device: Any) -> Subject:
    return Subject("virtual", device.channel, None, 1, EDS)


def output(**how: Any) -> tuple[Output, io.StringIO]:
    out = io.StringIO()
    return Output(stdout=out, stderr=io.StringIO(), **how), out


def read(device: Any) -> ParameterSet:
    with canopen_network(subject(device)) as network:
        return read_parameters(SdoReader(network, 1, subject(device).objects()))


def writes(device: Any) -> list[tuple[int, int]]:
    """(index, sub-index) of every SDO download."""
    return [struct.unpack_from("<HB", data, 1) for identifier, data in device.requests
            if identifier == 0x601 and data[0] >> 5 == 1]  # fmt: skip


@pytest.fixture
def file(device_on_bus: Any, tmp_path: Path) -> Path:
    """A dump of the drive as it is."""
    path = tmp_path / "drive.toml"
    assert dump(subject(device_on_bus), output()[0], path) == 0
    assert not writes(device_on_bus)
    device_on_bus.requests.clear()
    return path


def change(file: Path, **values: str) -> None:
    """Replace the values of objects, `o6072="500"`."""
    lines = file.read_text().splitlines()
    for name, value in values.items():
        key = name.removeprefix("o").replace("_", ":")
        (at,) = [i for i, line in enumerate(lines) if line.startswith((f"{key} = ", f'"{key}" = '))]
        lines[at] = f'"{key}" = {value}'
    file.write_text("\n".join(lines) + "\n")


def restored(device: Any, file: Path, **how: Any) -> int:
    return restore_file(subject(device), file, output()[0], **{"assume_yes": True, "skip": [], **how})


class TestDump:
    def test_every_readable_object_is_in_one_of_the_groups(self, device_on_bus: Any, file: Path) -> None:
        found = load_parameters(file)
        readable = {
            Place(v.index, v.subindex) for v in variables(read_dictionary(EDS, 1)) if v.readable and v.index != 0x1003
        }
        assert readable == {p for p in (set(found.parameters) | set(found.readings)) if p.index != 0x1003}
        assert found.parameters[Place(0x6072)] == 1000
        assert found.readings[Place(0x1008)] == "jointctl virtual joint"
        assert found.device["product_code"] == 1
        assert not {place.index for place in found.parameters} & COMMANDS
        assert read(device_on_bus).parameters == found.parameters

    def test_names_stand_beside_the_values(self, file: Path) -> None:
        text = file.read_text()
        assert "6072 = 1000 # Max torque" in text.replace('"', "")
        assert "0x60410010" in text

    def test_a_dcf_holds_the_same(self, device_on_bus: Any, file: Path, tmp_path: Path) -> None:
        path = tmp_path / "drive.dcf"
        assert dump(subject(device_on_bus), output()[0], path) == 0
        assert load_parameters(path).parameters == load_parameters(file).parameters

    def test_stdout_and_json(self, device_on_bus: Any) -> None:
        told, out = output()
        assert dump(subject(device_on_bus), told) == 0
        assert out.getvalue().startswith('format = "jointctl parameters 1"')
        told, out = output(json=True)
        assert dump(subject(device_on_bus), told) == 0
        assert json.loads(out.getvalue())["parameters"]["6072"] == 1000

    def test_a_file_is_never_overwritten(self, device_on_bus: Any, file: Path) -> None:
        with pytest.raises(DataError, match="exists already"):
            dump(subject(device_on_bus), output()[0], file)

    def test_an_eds_is_needed(self, device_on_bus: Any) -> None:
        with pytest.raises(ConfigurationError, match="which objects"):
            dump(Subject("virtual", device_on_bus.channel, None, 1), output()[0])


class TestRestore:
    def test_only_what_differs_is_written_and_read_back(self, device_on_bus: Any, file: Path) -> None:
        change(file, o6072="700", o6065="12345")
        assert restored(device_on_bus, file) == 0
        assert sorted(writes(device_on_bus)) == [(0x6065, 0), (0x6072, 0)]
        found = read(device_on_bus)
        assert (found.parameters[Place(0x6072)], found.parameters[Place(0x6065)]) == (700, 12345)

    def test_nothing_differs_nothing_is_sent_but_reads(self, device_on_bus: Any, file: Path) -> None:
        assert restored(device_on_bus, file) == 0
        assert not writes(device_on_bus)
        assert {identifier for identifier, _ in device_on_bus.requests} == {0x601}

    def test_readings_and_commands_are_never_written(self, device_on_bus: Any, file: Path) -> None:
        change(file, o6071="300", o6040="15", o6064="5", o6072="700")
        text = file.read_text().replace("[parameters]", '[parameters]\n"60FF" = 99\n')
        file.write_text(text.replace('"60FF" = 0', "", 1) if text.count("60FF") > 1 else text)
        assert restored(device_on_bus, file) == 0
        assert writes(device_on_bus) == [(0x6072, 0)]

    def test_a_mapping_is_restored_in_the_order_of_cia_301(self, device_on_bus: Any, file: Path) -> None:
        change(file, o1A01="1", o1A01_1="0x606C0020", o1801_2="255", o1801_1="0x281")
        assert restored(device_on_bus, file) == 0
        order = writes(device_on_bus)
        assert order == [(0x1801, 2), (0x1A01, 0), (0x1A01, 1), (0x1A01, 0), (0x1801, 1)]
        found = read(device_on_bus).parameters
        assert (found[Place(0x1A01, 0)], found[Place(0x1A01, 1)], found[Place(0x1801, 1)]) == (1, 0x606C0020, 0x281)

    def test_a_refused_value_is_told_and_the_others_are_written(self, device_on_bus: Any, file: Path) -> None:
        change(file, o605A="77", o6072="700")
        told, out = output(json=True)
        with pytest.raises(DeviceError, match="1 of 2 parameters were not taken"):
            restore_file(subject(device_on_bus), file, told, assume_yes=True, skip=[])
        report = json.loads(out.getvalue())
        assert report["restored"] == ["6072"]
        assert report["failed"][0]["object"] == "605A"
        assert "0609" in report["failed"][0]["reason"]

    @pytest.mark.parametrize(("word", "refused"), [(0x0237, True), (0x0217, True), (0x0233, False), (0x0250, False)])
    def test_a_drive_under_power_is_left_alone(self, device_on_bus: Any, file: Path, word: int, refused: bool) -> None:
        change(file, o6072="700")
        device_on_bus.answers[0x6041, 0] = word
        if refused:
            with pytest.raises(DeviceError, match="nothing is written into a drive under power"):
                restored(device_on_bus, file)
        else:
            assert restored(device_on_bus, file) == 0
        assert bool(writes(device_on_bus)) != refused

    def test_another_controller_is_left_alone(self, device_on_bus: Any, file: Path) -> None:
        change(file, o6072="700")
        with can.Bus(interface="virtual", channel=device_on_bus.channel) as bus:
            sender = bus.send_periodic(can.Message(arbitration_id=0x80, is_extended_id=False), 0.01)
            with pytest.raises(BusError, match="another controller"):
                restored(device_on_bus, file)
            sender.stop()
        assert not writes(device_on_bus)

    @pytest.mark.parametrize("other", [True, False])
    def test_another_device_only_if_told_so(self, device_on_bus: Any, file: Path, other: bool) -> None:
        file.write_text(file.read_text().replace("product_code = 1", "product_code = 9"))
        change(file, o6072="700")
        if other:
            assert restored(device_on_bus, file, other_device=True) == 0
        else:
            with pytest.raises(DeviceError, match=r"product_code \(=9\) is not that of the drive \(=1\)"):
                restored(device_on_bus, file)
        assert bool(writes(device_on_bus)) == other

    @pytest.mark.parametrize(("answer", "written"), [("y\n", True), ("n\n", False), ("", False)])
    def test_it_asks(
        self, device_on_bus: Any, file: Path, answer: str, written: bool, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        class Terminal(io.StringIO):
            def isatty(self) -> bool:
                return True

        change(file, o6072="700")
        monkeypatch.setattr(sys, "stdin", Terminal(answer))
        assert restored(device_on_bus, file, assume_yes=False) == 0
        assert bool(writes(device_on_bus)) == written

    @pytest.mark.parametrize("what", ["SYNC", "under power", "nothing"])
    def test_what_came_while_the_question_was_open_is_seen(
        self, device_on_bus: Any, file: Path, what: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """A joint that moves by now must not lose its controller: not even pre-operational is said."""

        class Terminal(io.StringIO):
            def isatty(self) -> bool:
                return True

            def readline(self, *_: Any) -> str:
                if what == "SYNC":
                    with can.Bus(interface="virtual", channel=device_on_bus.channel) as bus:
                        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
                elif what == "under power":
                    device_on_bus.answers[0x6041, 0] = 0x0237
                return "y\n"

        change(file, o6072="700")
        monkeypatch.setattr(sys, "stdin", Terminal())
        if what == "nothing":
            assert restored(device_on_bus, file, assume_yes=False) == 0
        else:
            with pytest.raises((BusError, DeviceError), match=r"another controller|under power"):
                restored(device_on_bus, file, assume_yes=False)
        pre_operational = (0, b"\x80\x01") in device_on_bus.requests
        assert (bool(writes(device_on_bus)), pre_operational) == ((True, True) if what == "nothing" else (False, False))

    def test_without_a_terminal_it_does_not_write(
        self, device_on_bus: Any, file: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        change(file, o6072="700")
        monkeypatch.setattr(sys, "stdin", io.StringIO("y\n"))
        with pytest.raises(UsageError):
            restored(device_on_bus, file, assume_yes=False)
        assert not writes(device_on_bus)

    def test_skipped_objects(self, device_on_bus: Any, file: Path) -> None:
        change(file, o6072="700", o6065="12345")
        assert restored(device_on_bus, file, skip=[place_index("6072")]) == 0
        assert writes(device_on_bus) == [(0x6065, 0)]
        with pytest.raises(ConfigurationError, match="--skip"):
            place_index("12345")


class TestDiff:
    def test_two_files(self, file: Path, tmp_path: Path) -> None:
        other = tmp_path / "other.toml"
        other.write_text(file.read_text())
        first, objects = load_parameters(file), Objects()
        told, out = output()
        assert diff(first, load_parameters(other), objects, told) == 0
        assert "no difference" in out.getvalue()
        change(other, o6072="700", o6064="5")
        told, out = output(json=True)
        assert diff(first, load_parameters(other), objects, told) == DIFFERENT
        (found,) = json.loads(out.getvalue())["differences"]
        assert (found["object"], found["first"], found["second"]) == ("6072", 1000, 700)
        places = [str(item.place) for item in differences(first, load_parameters(other), readings=True)]
        assert places == ["6064", "6072"]

    def test_an_object_that_one_side_lacks(self) -> None:
        first = ParameterSet("a", parameters={Place(0x6072): 5})
        (found,) = differences(first, ParameterSet("b"))
        assert (found.first, found.second) == (5, None)


class TestFiles:
    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("x = 1", r'format \(=None\) must be "jointctl parameters 1"'),
            ("nonsense", "cannot be read"),
            ('format = "jointctl parameters 1"\n[parameters]\n"60zz" = 1', "60zz is not an object"),
            ('format = "jointctl parameters 1"\n[parameters]\n"6072" = true', r"must be a number, a text"),
            ('format = "jointctl parameters 1"\n[parameters]\n"6072" = {hex = "x"}', "hexadecimal digits"),
            ('format = "jointctl parameters 1"\nparameters = 3', "must be a section"),
        ],
    )
    def test_bad_files(self, tmp_path: Path, text: str, words: str) -> None:
        path = tmp_path / "p.toml"
        path.write_text(text)
        with pytest.raises(DataError, match=words):
            load_parameters(path)

    def test_every_kind_of_value_survives(self, tmp_path: Path) -> None:
        values: Any = {
            Place(0x2000, 1): -5,
            Place(0x2000, 2): 0.1,
            Place(0x2001): 'ä "b"',
            Place(0x2002): b"\x00\xff",
            Place(0x1016, 1): 0xFFFFFFFF,
        }
        path = tmp_path / "p.toml"
        path.write_text(toml_text(ParameterSet("x", {"node": 1, "name": None}, values), Objects()))
        assert load_parameters(path).parameters == values
        assert is_parameter_file(path)

    def test_negative_numbers_survive_a_dcf(self, tmp_path: Path) -> None:
        dictionary = read_dictionary(EDS, 1)
        write_dcf(ParameterSet("x", parameters={Place(0x6007): -1}), dictionary, tmp_path / "p.dcf")
        assert load_parameters(tmp_path / "p.dcf").parameters[Place(0x6007)] == -1

    def test_a_configuration_is_no_parameter_file(self) -> None:
        assert not is_parameter_file(shipped_config("virtual"))
        assert not is_parameter_file(Path("virtual"))
        assert is_parameter_file(EDS)


def test_what_moves_or_acts_is_no_parameter() -> None:
    chosen = {v.index for v in variables(read_dictionary(EDS, 1)) if is_parameter(v)}
    assert {0x6072, 0x605A, 0x1017, 0x1016, 0x1A00, 0x1800} <= chosen
    assert not chosen & COMMANDS
