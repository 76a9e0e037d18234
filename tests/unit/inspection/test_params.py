"""params dump and diff on the virtual drive of this process, and the files that they write and read."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import canopen
import pytest
from canopen.objectdictionary import ODVariable, datatypes
from hypothesis import given
from hypothesis import strategies as st

from jointctl.drivers.errors import ConfigurationError, DataError
from jointctl.tools.configuration.load import shipped_config
from jointctl.tools.inspection.objects import Objects, Place, read_dictionary
from jointctl.tools.inspection.parameters import (
    COMMANDS,
    ParameterSet,
    dcf_text,
    differences,
    is_parameter,
    is_parameter_file,
    load_parameters,
    variables,
)
from jointctl.tools.inspection.subject import ATTEMPTS, Subject, new_dictionary
from jointctl.tools.verbs.params import DIFFERENT, diff, dump
from tests.unit.inspection.parameter_verbs import EDS, OLDER_DUMP, change, output, read, subject

KINDS: list[tuple[int, st.SearchStrategy[Any]]] = [
    (datatypes.BOOLEAN, st.sampled_from([b"\0", b"\1"])),
    (datatypes.INTEGER8, st.integers(-128, 127)),
    (datatypes.INTEGER32, st.integers(-(2**31), 2**31 - 1)),
    (datatypes.UNSIGNED32, st.integers(0, 2**32 - 1)),
    (datatypes.INTEGER64, st.integers(-(2**63), 2**63 - 1)),
    (datatypes.REAL32, st.floats(width=32, allow_nan=False)),
    (datatypes.REAL64, st.floats(allow_nan=False)),
    (datatypes.VISIBLE_STRING, st.text(st.characters(max_codepoint=255), max_size=30)),
    (datatypes.OCTET_STRING, st.binary(max_size=30)),
    (datatypes.DOMAIN, st.binary(max_size=30)),
    (datatypes.TIME_OF_DAY, st.binary(min_size=6, max_size=6)),
]


def dictionary_of_all_kinds() -> Any:
    """One writable object of each type from 2000h on."""
    dictionary: Any = new_dictionary()
    for i, (kind, _) in enumerate(KINDS):
        variable = ODVariable(f"Object {i}", 0x2000 + i)
        variable.data_type, variable.access_type = kind, "rw"
        dictionary.add_object(variable)
    return dictionary


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

    def test_a_dcf_names_what_it_holds(self, file: Path) -> None:
        text = file.read_text()
        assert re.search(r"\[6072\]\nParameterName=Max torque\n[^\[]*ParameterValue=1000\n", text)
        assert "[DeviceComissioning]\nNodeID=1\n" in text  # as CiA 306 spells it

    def test_the_library_s_reader_takes_it(self, file: Path) -> None:
        dictionary = canopen.import_od(str(file))
        assert dictionary[0x6072].value == 1000
        assert dictionary.node_id == 1

    def test_stdout_and_json(self, device_on_bus: Any, file: Path, tmp_path: Path) -> None:
        told, out = output()
        assert dump(subject(device_on_bus), told) == 0
        (tmp_path / "stdout.dcf").write_text(out.getvalue())
        assert load_parameters(tmp_path / "stdout.dcf").parameters == load_parameters(file).parameters
        told, out = output(json=True)
        assert dump(subject(device_on_bus), told) == 0
        assert json.loads(out.getvalue())["parameters"]["6072"] == 1000

    @pytest.mark.parametrize("name", ["drive.toml", "drive", "drive.dcf.txt"])
    def test_another_format_is_refused_before_anything_is_read(
        self, device_on_bus: Any, tmp_path: Path, name: str
    ) -> None:
        with pytest.raises(DataError, match=r"must end in \.dcf: parameters are written as DCF only"):
            dump(subject(device_on_bus), output()[0], tmp_path / name)
        assert not device_on_bus.requests
        assert not list(tmp_path.iterdir())

    def test_what_the_drive_does_not_report_is_not_in_the_file(self, device_on_bus: Any, tmp_path: Path) -> None:
        """The default of the EDS in its place would be written by a restore."""
        device_on_bus.mute += [(0x6072, 0)] * ATTEMPTS
        path = tmp_path / "drive.dcf"
        assert dump(subject(device_on_bus), output()[0], path) == 0
        assert not device_on_bus.mute
        present = read(device_on_bus).parameters
        assert load_parameters(path).parameters == {p: v for p, v in present.items() if p != Place(0x6072)}

    def test_a_file_is_never_overwritten(self, device_on_bus: Any, file: Path) -> None:
        with pytest.raises(DataError, match="exists already"):
            dump(subject(device_on_bus), output()[0], file)

    def test_an_eds_is_needed(self, device_on_bus: Any) -> None:
        with pytest.raises(ConfigurationError, match="which objects"):
            dump(Subject("virtual", device_on_bus.channel, None, 1), output()[0])


class TestDiff:
    def test_two_files(self, file: Path, tmp_path: Path) -> None:
        other = tmp_path / "other.dcf"
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

    @given(data=st.data())
    def test_every_value_survives_or_is_left_out(self, tmp_path_factory: pytest.TempPathFactory, data: Any) -> None:
        values = {Place(0x2000 + i): data.draw(of_type) for i, (_, of_type) in enumerate(KINDS)}
        dictionary = dictionary_of_all_kinds()
        for place, value in values.items():
            default = data.draw(st.sampled_from([None, value]))
            dictionary[place.index].default = default.hex() if isinstance(default, bytes) else default
        found = ParameterSet("x", parameters=dict(values))
        path = tmp_path_factory.mktemp("dcf") / "p.dcf"
        path.write_text(dcf_text(found, dictionary), encoding="utf-8")
        read_back = load_parameters(path)
        assert read_back.parameters == found.parameters
        assert {**found.parameters, **{p: values[p] for p in found.unreadable}} == values
        for place in found.unreadable:
            assert isinstance(values[place], str)
            assert not re.fullmatch(r"[\w.,:;/-]+( [\w.,:/-]+)*", values[place])

    def test_an_object_that_was_not_read_has_no_default(self, tmp_path: Path) -> None:
        dictionary = dictionary_of_all_kinds()
        dictionary[0x2000].default = 5
        path = tmp_path / "p.dcf"
        path.write_text(dcf_text(ParameterSet("x"), dictionary))
        assert load_parameters(path).parameters == {}

    def test_negative_numbers_survive(self, tmp_path: Path) -> None:
        path = tmp_path / "p.dcf"
        path.write_text(dcf_text(ParameterSet("x", parameters={Place(0x6007): -1}), read_dictionary(EDS, 1)))
        assert load_parameters(path).parameters[Place(0x6007)] == -1

    def test_a_configuration_is_no_parameter_file(self) -> None:
        assert not is_parameter_file(shipped_config("virtual"))
        assert not is_parameter_file(Path("virtual"))
        assert is_parameter_file(EDS)


class TestOlderDump:
    """A TOML dump, which versions before DCF only have written: of the virtual drive, as it was then."""

    def test_it_is_read(self) -> None:
        found = load_parameters(OLDER_DUMP)
        assert is_parameter_file(OLDER_DUMP)
        assert (found.device["node"], found.device["product_code"]) == (1, 1)
        assert (len(found.parameters), len(found.readings)) == (150, 64)
        assert found.parameters[Place(0x6072)] == 1000
        assert found.parameters[Place(0x1014)] == 0x81
        assert found.readings[Place(0x1008)] == "jointctl virtual joint"

    def test_every_kind_of_value(self, tmp_path: Path) -> None:
        path = tmp_path / "p.toml"
        path.write_text(
            'format = "jointctl parameters 1"\n[device]\nnode = 1\n[parameters]\n"2000:1" = -5\n"2000:2" = 0.1\n'
            '2001 = "ä \\"b\\""\n2002 = {hex = "00ff"}\n"1016:1" = 0xffffffff # node 127\n[readings]\n[unreadable]\n'
        )
        assert load_parameters(path).parameters == {
            Place(0x2000, 1): -5, Place(0x2000, 2): 0.1, Place(0x2001): 'ä "b"', Place(0x2002): b"\x00\xff",
            Place(0x1016, 1): 0xFFFFFFFF,
        }  # fmt: skip


def test_what_moves_or_acts_is_no_parameter() -> None:
    chosen = {v.index for v in variables(read_dictionary(EDS, 1)) if is_parameter(v)}
    assert {0x6072, 0x605A, 0x1017, 0x1016, 0x1A00, 0x1800} <= chosen
    assert not chosen & COMMANDS
