"""params dump, diff and restore on the virtual drive of this process: read back, refused, or nothing written."""

from __future__ import annotations

import io
import json
import re
import struct
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import canopen
import pytest
from canopen.objectdictionary import ODVariable, datatypes
from hypothesis import given
from hypothesis import strategies as st

from jointctl.drivers.errors import DECLINED, BusError, ConfigurationError, DataError, DeviceError, UsageError
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
    read_parameters,
    variables,
)
from jointctl.tools.inspection.subject import ATTEMPTS, SdoReader, Subject, canopen_network, new_dictionary
from jointctl.tools.verbs.params import DIFFERENT, _require_off, diff, dump, place_index, restore_file
from tests.device_on_bus import sent_every_10_ms
from tests.sessions import Terminal, output

# --- Subject and output of the verb params, and a DCF that is changed ---
OLDER_DUMP = Path(__file__).with_name("older_dump.toml")
EDS = shipped_config("virtual").with_name("virtual_joint.eds")


def subject(device: Any) -> Subject:
    return Subject("virtual", device.channel, None, 1, EDS)


def read(device: Any) -> ParameterSet:
    with canopen_network(subject(device)) as network:
        return read_parameters(SdoReader(network, 1, subject(device).objects()))


def writes(device: Any) -> list[tuple[int, int]]:
    """(index, sub-index) of every SDO download."""
    return [struct.unpack_from("<HB", data, 1) for identifier, data in device.requests
            if identifier == 0x601 and data[0] >> 5 == 1]  # fmt: skip


def change(file: Path, **values: str) -> None:
    """Replace the values of objects in a DCF, `o6072="500"`, `o1018_2="9"`."""
    text = file.read_text()
    for name, value in values.items():
        index, _, sub = name.removeprefix("o").partition("_")
        section = rf"\[{index}(?:sub{sub})?\]\n" if sub in ("", "0") else rf"\[{index}sub{sub}\]\n"
        pattern = rf"({section}(?:[^\[\n].*\n)*?ParameterValue=).*"
        if sub == "" and not re.search(pattern, text):
            pattern = pattern.replace(section, rf"\[{index}sub0\]\n")
        text, count = re.subn(pattern, rf"\g<1>{value}", text)
        assert count == 1, f"{name}: {count} times"
    file.write_text(text)


# --- params dump and diff on the virtual drive of this process, and the files that they write and read ---
KINDS: list[tuple[int, st.SearchStrategy[Any]]] = [
    (datatypes.BOOLEAN, st.sampled_from([b"\0", b"\1"])), (datatypes.INTEGER8, st.integers(-128, 127)),
    (datatypes.INTEGER32, st.integers(-(2**31), 2**31 - 1)), (datatypes.UNSIGNED32, st.integers(0, 2**32 - 1)),
    (datatypes.INTEGER64, st.integers(-(2**63), 2**63 - 1)), (datatypes.REAL32, st.floats(width=32, allow_nan=False)),
    (datatypes.REAL64, st.floats(allow_nan=False)),
    (datatypes.VISIBLE_STRING, st.text(st.characters(max_codepoint=255), max_size=30)),
    (datatypes.OCTET_STRING, st.binary(max_size=30)), (datatypes.DOMAIN, st.binary(max_size=30)),
    (datatypes.TIME_OF_DAY, st.binary(min_size=6, max_size=6)),
]  # fmt: skip


def dictionary_of_all_kinds() -> Any:
    """One writable object of each type from 2000h on."""
    dictionary: Any = new_dictionary()
    for i, (kind, _) in enumerate(KINDS):
        variable = ODVariable(f"Object {i}", 0x2000 + i)
        variable.data_type, variable.access_type = kind, "rw"
        dictionary.add_object(variable)
    return dictionary


class TestDump:
    def test_every_readable_object_is_in_one_of_the_groups(self, joint: Any, file: Path) -> None:
        found = load_parameters(file)
        readable = {
            Place(v.index, v.subindex) for v in variables(read_dictionary(EDS, 1)) if v.readable and v.index != 0x1003
        }
        assert readable == {p for p in (set(found.parameters) | set(found.readings)) if p.index != 0x1003}
        assert found.parameters[Place(0x6072)] == 1000
        assert found.readings[Place(0x1008)] == "jointctl virtual joint"
        assert found.device["product_code"] == 1
        assert not {place.index for place in found.parameters} & COMMANDS
        assert read(joint).parameters == found.parameters

    def test_a_dcf_names_what_it_holds(self, file: Path) -> None:
        text = file.read_text()
        assert re.search(r"\[6072\]\nParameterName=Max torque\n[^\[]*ParameterValue=1000\n", text)
        assert "[DeviceComissioning]\nNodeID=1\n" in text  # as CiA 306 spells it

    def test_the_library_s_reader_takes_it(self, file: Path) -> None:
        dictionary = canopen.import_od(str(file))
        assert dictionary[0x6072].value == 1000
        assert dictionary.node_id == 1

    def test_stdout_and_json(self, joint: Any, file: Path, tmp_path: Path) -> None:
        told, out, _ = output()
        assert dump(subject(joint), told) == 0
        (tmp_path / "stdout.dcf").write_text(out.getvalue())
        assert load_parameters(tmp_path / "stdout.dcf").parameters == load_parameters(file).parameters
        told, out, _ = output(json=True)
        assert dump(subject(joint), told) == 0
        assert json.loads(out.getvalue())["parameters"]["6072"] == 1000

    @pytest.mark.parametrize("name", ["drive.toml", "drive", "drive.dcf.txt"])
    def test_another_format_is_refused_before_anything_is_read(self, joint: Any, tmp_path: Path, name: str) -> None:
        with pytest.raises(DataError, match=r"must end in \.dcf: parameters are written as DCF only"):
            dump(subject(joint), output()[0], tmp_path / name)
        assert not joint.requests
        assert not list(tmp_path.iterdir())

    def test_what_the_drive_does_not_report_is_not_in_the_file(self, joint: Any, tmp_path: Path) -> None:
        """The default of the EDS in its place would be written by a restore."""
        joint.mute += [(0x6072, 0)] * ATTEMPTS
        path = tmp_path / "drive.dcf"
        assert dump(subject(joint), output()[0], path) == 0
        assert not joint.mute
        present = read(joint).parameters
        assert load_parameters(path).parameters == {p: v for p, v in present.items() if p != Place(0x6072)}

    def test_a_file_is_never_overwritten(self, joint: Any, file: Path) -> None:
        with pytest.raises(DataError, match="exists already"):
            dump(subject(joint), output()[0], file)

    def test_an_eds_is_needed(self, joint: Any) -> None:
        with pytest.raises(ConfigurationError, match="which objects"):
            dump(Subject("virtual", joint.channel, None, 1), output()[0])


class TestDiff:
    def test_two_files(self, file: Path, tmp_path: Path) -> None:
        other = tmp_path / "other.dcf"
        other.write_text(file.read_text())
        first, objects = load_parameters(file), Objects()
        told, out, _ = output()
        assert diff(first, load_parameters(other), objects, told) == 0
        assert "no difference" in out.getvalue()
        change(other, o6072="700", o6064="5")
        told, out, _ = output(json=True)
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

    @pytest.mark.parametrize("value", ["1.5", "banana", "-1", "0x100000000"])
    def test_a_value_that_is_no_number_is_not_replaced_by_its_default(self, tmp_path: Path, value: str) -> None:
        path = tmp_path / "p.dcf"
        path.write_text(
            re.sub(r"(?s)(\[6083\].*?)(DefaultValue=)", rf"\1ParameterValue={value}\n\2", EDS.read_text(), count=1)
        )
        with pytest.raises(DataError, match=rf"\[6083\] ParameterValue \(={value}\) is no number of its DataType"):
            load_parameters(path)
        path.write_text(path.read_text().replace(f"={value}\n", "=7\n"))
        assert load_parameters(path).parameters[Place(0x6083)] == 7

    def test_values_of_compact_members_are_not_replaced_by_their_default(self, tmp_path: Path) -> None:
        path = tmp_path / "p.dcf"
        compact = (
            "\n[3001]\nParameterName=Row\nObjectType=8\nDataType=7\nAccessType=rw\nDefaultValue=1\nCompactSubObj=2\n"
        )
        path.write_text(EDS.read_text() + compact + "[3001Value]\nNrOfEntries=1\n2=9\n")
        with pytest.raises(DataError, match=r"\[3001value\] has values of members without sections"):
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


@pytest.fixture
def file(joint: Any, tmp_path: Path) -> Path:
    """A dump of the drive as it is."""
    path = tmp_path / "drive.dcf"
    assert dump(subject(joint), output()[0], path) == 0
    assert not writes(joint)
    joint.requests.clear()
    return path


def test_what_moves_or_acts_is_no_parameter() -> None:
    chosen = {v.index for v in variables(read_dictionary(EDS, 1)) if is_parameter(v)}
    assert {0x6072, 0x605A, 0x1017, 0x1016, 0x1A00, 0x1800} <= chosen
    assert not chosen & COMMANDS


@pytest.mark.parametrize(
    ("index", "parameter"),
    [
        (0x6840, False),
        (0x687A, False),
        (0x70FF, False),
        (0x9840, False),
        (0x6872, True),
        (0x685A, True),
        (0xA040, True),
    ],
)
def test_nor_is_what_moves_another_axis_of_the_device(index: int, parameter: bool) -> None:
    variable: Any = ODVariable("of an axis", index, 0)
    variable.access_type = "rw"
    assert is_parameter(variable) is parameter


@pytest.mark.parametrize(("axis", "word", "refused"), [(2, 0x0237, True), (8, 0x0217, True), (2, 0x0233, False)])
def test_a_device_is_left_alone_while_any_of_its_axes_is_under_power(axis: int, word: int, refused: bool) -> None:
    words = {0x6041: 0x0250, 0x6041 + (axis - 1) * 0x800: word}
    reader: Any = SimpleNamespace(
        node=1, value=words.__getitem__, objects=SimpleNamespace(variable=lambda index, _: words.get(index))
    )
    with pytest.raises(DeviceError, match=rf"node 1, axis {axis}, is in") if refused else nullcontext():
        _require_off(reader)


# --- params restore on the virtual drive of this process: read back, refused, or nothing written at all ---
@pytest.fixture
def listens_shortly(monkeypatch: pytest.MonkeyPatch) -> None:
    """For another controller, whose SYNC comes each 10 ms here."""
    monkeypatch.setattr("jointctl.drivers.canopen.network.LISTEN_S", 0.1)


def restored(device: Any, file: Path, **how: Any) -> int:
    return restore_file(subject(device), file, output()[0], **{"assume_yes": True, "skip": [], **how})


@pytest.mark.usefixtures("listens_shortly")
class TestRestore:
    def test_only_what_differs_is_written_and_read_back(self, joint: Any, file: Path) -> None:
        change(file, o6072="700", o6065="12345")
        assert restored(joint, file) == 0
        assert sorted(writes(joint)) == [(0x6065, 0), (0x6072, 0)]
        found = read(joint)
        assert (found.parameters[Place(0x6072)], found.parameters[Place(0x6065)]) == (700, 12345)

    def test_nothing_differs_nothing_is_sent_but_reads(self, joint: Any, file: Path) -> None:
        assert restored(joint, file) == 0
        assert not writes(joint)
        assert {identifier for identifier, _ in joint.requests} == {0x601}

    def test_readings_and_commands_are_never_written(self, joint: Any, file: Path) -> None:
        change(file, o6071="300", o6040="15", o6064="5", o60FF="99", o6072="700")
        assert restored(joint, file) == 0
        assert writes(joint) == [(0x6072, 0)]

    def test_a_toml_dump_of_an_older_version_is_restored(self, joint: Any, tmp_path: Path) -> None:
        path = tmp_path / "older.toml"
        text = OLDER_DUMP.read_text().replace("6072 = 1000 ", "6072 = 700 ")
        path.write_text(text.replace("[parameters]", "[parameters]\n6071 = 300\n60C1 = 5"))  # commands, not settings
        assert restored(joint, path) == 0
        assert (0x6072, 0) in writes(joint)
        assert not {index for index, _ in writes(joint)} & {0x6071, 0x60C1}
        assert read(joint).parameters[Place(0x6072)] == 700

    def test_a_mapping_is_restored_in_the_order_of_cia_301(self, joint: Any, file: Path) -> None:
        change(file, o1A01="1", o1A01_1="0x606C0020", o1801_2="255", o1801_1="0x281")
        assert restored(joint, file) == 0
        order = writes(joint)
        assert order == [(0x1801, 2), (0x1A01, 0), (0x1A01, 1), (0x1A01, 0), (0x1801, 1)]
        found = read(joint).parameters
        assert (found[Place(0x1A01, 0)], found[Place(0x1A01, 1)], found[Place(0x1801, 1)]) == (1, 0x606C0020, 0x281)

    def test_a_refused_value_is_told_and_the_others_are_written(self, joint: Any, file: Path) -> None:
        change(file, o605A="77", o6072="700")
        told, out, _ = output(json=True)
        with pytest.raises(DeviceError, match="1 of 2 parameters were not taken"):
            restore_file(subject(joint), file, told, assume_yes=True, skip=[])
        report = json.loads(out.getvalue())
        assert report["restored"] == ["6072"]
        assert report["failed"][0]["object"] == "605A"
        assert "0609" in report["failed"][0]["reason"]

    @pytest.mark.parametrize(("word", "refused"), [(0x0237, True), (0x0217, True), (0x0233, False), (0x0250, False)])
    def test_a_drive_under_power_is_left_alone(self, joint: Any, file: Path, word: int, refused: bool) -> None:
        change(file, o6072="700")
        joint.answers[0x6041, 0] = word
        if refused:
            with pytest.raises(DeviceError, match="nothing is written into a drive under power"):
                restored(joint, file)
        else:
            assert restored(joint, file) == 0
        assert bool(writes(joint)) != refused

    def test_another_controller_is_left_alone(self, joint: Any, file: Path) -> None:
        change(file, o6072="700")
        with (
            sent_every_10_ms("virtual", joint.channel, 0x80),
            pytest.raises(BusError, match="another controller"),
        ):
            restored(joint, file)
        assert not writes(joint)

    @pytest.mark.parametrize("other", [True, False])
    @pytest.mark.parametrize("differs", ["product_code", "node"])
    def test_another_device_or_node_only_if_told_so(self, joint: Any, file: Path, differs: str, other: bool) -> None:
        change(file, o6072="700", **({"o1018_2": "9"} if differs == "product_code" else {}))
        if differs == "node":
            file.write_text(file.read_text().replace("NodeID=1\n", "NodeID=9\n"))
        if other:
            assert restored(joint, file, other_device=True) == 0
        else:
            with pytest.raises(DeviceError, match=rf"{differs} \(=9\) is not that of the drive \(=1\)"):
                restored(joint, file)
        assert bool(writes(joint)) == other

    @pytest.mark.parametrize(("answer", "written"), [("y\n", True), ("n\n", False), ("", False)])
    def test_it_asks(self, joint: Any, file: Path, answer: str, written: bool, monkeypatch: pytest.MonkeyPatch) -> None:
        change(file, o6072="700")
        monkeypatch.setattr(sys, "stdin", Terminal(answer))
        assert restored(joint, file, assume_yes=False) == (0 if written else DECLINED)
        assert bool(writes(joint)) == written

    @pytest.mark.parametrize("what", ["SYNC", "under power", "nothing"])
    def test_what_came_while_the_question_was_open_is_seen(
        self, joint: Any, file: Path, what: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """A joint that moves by now must not lose its controller: not even pre-operational is said."""

        class Asked(Terminal):
            def readline(self, *_: Any) -> str:
                if what == "SYNC":
                    with can.Bus(interface="virtual", channel=joint.channel) as bus:
                        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
                elif what == "under power":
                    joint.answers[0x6041, 0] = 0x0237
                return "y\n"

        change(file, o6072="700")
        monkeypatch.setattr(sys, "stdin", Asked())
        if what == "nothing":
            assert restored(joint, file, assume_yes=False) == 0
        else:
            with pytest.raises((BusError, DeviceError), match=r"another controller|under power"):
                restored(joint, file, assume_yes=False)
        pre_operational = (0, b"\x80\x01") in joint.requests
        assert (bool(writes(joint)), pre_operational) == ((True, True) if what == "nothing" else (False, False))

    def test_without_a_terminal_it_does_not_write(
        self, joint: Any, file: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        change(file, o6072="700")
        monkeypatch.setattr(sys, "stdin", io.StringIO("y\n"))
        with pytest.raises(UsageError):
            restored(joint, file, assume_yes=False)
        assert not writes(joint)

    def test_skipped_objects(self, joint: Any, file: Path) -> None:
        change(file, o6072="700", o6065="12345")
        assert restored(joint, file, skip=[place_index("6072")]) == 0
        assert writes(joint) == [(0x6065, 0)]
        with pytest.raises(ConfigurationError, match="--skip"):
            place_index("12345")
