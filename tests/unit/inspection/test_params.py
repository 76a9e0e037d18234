"""params dump and diff on the virtual drive of this process, and the files that they write and read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from jointctl.drivers.errors import ConfigurationError, DataError
from jointctl.tools.configuration.load import shipped_config
from jointctl.tools.inspection.objects import Objects, Place, read_dictionary
from jointctl.tools.inspection.parameters import (
    COMMANDS,
    ParameterSet,
    differences,
    is_parameter,
    is_parameter_file,
    load_parameters,
    toml_text,
    variables,
    write_dcf,
)
from jointctl.tools.inspection.subject import Subject
from jointctl.tools.verbs.params import DIFFERENT, diff, dump
from tests.unit.inspection.parameter_verbs import EDS, change, output, read, subject


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
