"""EDS and DCF files as they are found: odd, wrong, mutated, or of another drive."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import pytest
from canopen.objectdictionary import datatypes
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jointctl.drivers.canopen.eds import EdsFile, decoded, number_of, parse_sections, read_eds
from jointctl.drivers.errors import ConfigurationError, DeviceError
from tests.places import EDS

# --- EDS and DCF files as they are found: odd encodings, missing and wrong entries, and any mutation of a good one ---
TEXT = EDS.read_text()


def eds_of(tmp_path: Path, text: str | bytes) -> EdsFile:
    path = tmp_path / "drive.eds"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_eds(path, 5)


def edited(section: str, line: str, replacement: str) -> str:
    """The shipped EDS with one line of one section replaced."""
    pattern = rf"(?ms)(^\[{section}\][^\[]*?^){line}$"
    changed, count = re.subn(pattern, lambda match: match[1] + replacement, TEXT, count=1)
    assert count == 1
    return changed


def test_a_good_file_gets_no_remark_and_is_what_the_library_reads() -> None:
    import canopen

    eds, library = read_eds(EDS, 1), canopen.import_od(str(EDS), 1)
    assert eds.all_remarks() == []
    assert not eds.unusable
    for index in (i for i in library if i >= 0x1000):
        theirs = library[index]
        members = [None] if hasattr(theirs, "data_type") else list(theirs)
        for sub in members:
            right = theirs if sub is None else theirs[sub]
            ours = eds.dictionary.get_variable(index, sub or 0)
            assert ours is not None, (index, sub)
            for key in ("data_type", "access_type", "default", "min", "max", "name", "pdo_mappable"):
                assert getattr(ours, key) == getattr(right, key), (f"{index:04X}:{sub}", key)


@pytest.mark.parametrize(
    ("data", "remark"),
    [
        (TEXT.encode("utf-8-sig"), None),
        (TEXT.replace("\n", "\r\n").encode(), None),
        (TEXT.replace("\n", "\r").encode(), None),
        (TEXT.replace("Device type", "Gerätetyp °").encode("latin-1"), "is not UTF-8: read as Latin-1"),
        (TEXT.replace("Device type", "Gerätetyp °").encode(), None),
        (TEXT.encode("utf-16"), "is UTF-16, CiA 306 asks for ASCII"),
        (TEXT.encode() + b"\0\0", "holds NUL characters, which were skipped"),
        (TEXT.replace("[6071]", "[ 0x6071 ]").encode(), None),
        (TEXT.replace("sub1]", "SUB1]").replace("ParameterName", "PARAMETERNAME").encode(), None),
        (TEXT.replace("0x00020192", "0X00020192 ; a drive").encode(), None),
        (b"no section yet\n" + TEXT.encode(), "line 1: neither [section] nor key=value: skipped"),
        (b"Key=too early\n" + TEXT.encode(), "line 1: before the first section: skipped"),
        (TEXT.encode() + b"\n[DeviceComissioning]\nNodeID=0x7\n", "was made for node 7, this is node 5"),
    ],
)
def test_the_same_objects_whatever_the_file_looks_like(tmp_path: Path, data: bytes, remark: str | None) -> None:
    eds = eds_of(tmp_path, data)
    assert eds.all_remarks() == ([f"EDS drive.eds: {remark}"] if remark else [])
    assert eds.dictionary.get_variable(0x6071).data_type == datatypes.INTEGER16
    assert eds.dictionary.get_variable(0x1000).default == 0x20192
    assert eds.dictionary.get_variable(0x1018, 1).data_type == datatypes.UNSIGNED32


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0x1F", 31), ("0X1f", 31), ("31", 31), ("1F", 31), ("ff", 255), ("017", 15), ("08", 8), (" 0x10 ", 16),
        ("$NODEID+0x180", 0x185), ("0x180+$NODEID", 0x185), ("$nodeid", 5), ("$NODEID + 0x600", 0x605),
        ("0x80000000UL", 1 << 31), ("-5", -5), ("", None), ("none", None), ("0x", None), ("1.5", None),
        ("12h", None), ("9" * 5000, None), ("$NODEID+x", None), ("0", 0), ("+0x10", 16), ("-0x10", -16),
        # what Python takes for a number, and CiA 306 does not know
        ("1_0", None), ("0x1_0", None), ("0_7", None), ("1F_0", None), ("$NODEID+1_0", None), ("0o17", None),
        ("\u0661", None), ("\ufb00", None),
    ],
)  # fmt: skip
def test_numbers(text: str, value: int | None) -> None:
    assert number_of(text, 5) == value


@pytest.mark.parametrize(
    ("section", "line", "changed", "kind", "remarks"),
    [
        ("6071", "DefaultValue=0", "DefaultValue=1_0", "INTEGER16", ["defaultvalue (=1_0) is no INTEGER16: ignored"]),
        ("6071", "DataType=0x0003", "Comment=none", "INTEGER16",
         ["has no DataType: INTEGER16 of the standard is used"]),
        ("6041", "DataType=0x0006", "DataType=0x0003", "UNSIGNED16",
         ["DataType (=INTEGER16) is UNSIGNED16 in the standard, which is used"]),
        ("6087", "DataType=0x0007", "DataType=0x0006", "UNSIGNED16",
         ["DataType (=UNSIGNED16) is UNSIGNED32 in the standard: the file's is used", "highlimit"]),
    ],
)  # fmt: skip
def test_what_is_wrong_in_a_section_is_told_and_the_standard_is_used_but_for_a_length(
    tmp_path: Path, section: str, line: str, changed: str, kind: str, remarks: list[str]
) -> None:
    eds = eds_of(tmp_path, edited(section, line, changed))
    variable = eds.dictionary.get_variable(int(section, 16))
    assert variable.data_type == getattr(datatypes, kind)
    assert (variable.default is None) is ("1_0" in changed)
    for told, remark in zip(eds.all_remarks(), remarks, strict=True):
        assert told.startswith(f"EDS drive.eds: [{section}] {remark}")


def test_another_length_is_not_believed_inside_the_pdos(tmp_path: Path) -> None:
    eds = eds_of(tmp_path, edited("6071", "DataType=0x0003", "DataType=0x0004"))
    assert eds.dictionary.get_variable(0x6071) is None
    assert eds.unusable == {(0x6071, 0): "DataType (=INTEGER32) must be INTEGER16"}


def test_defects_of_objects_that_are_not_used_are_one_line(tmp_path: Path) -> None:
    text = TEXT + "".join(f"\n[{index:04X}]\nParameterName=x\nObjectType=0x7\n" for index in range(0x3000, 0x3010))
    eds = eds_of(tmp_path, text)
    expected = "objects that jointctl does not use have 16 defects, such as [3000] has no DataType"
    assert eds.all_remarks() == [f"EDS drive.eds: {expected}"]
    assert len(eds.unusable) == 16


@pytest.mark.parametrize(
    ("limits", "remark"),
    [
        ("LowLimit=5\nHighLimit=4", "LowLimit (=5) is above HighLimit (=4): both ignored"),
        ("LowLimit=1000", "lowlimit (=1000) is no INTEGER8: ignored"),
        ("HighLimit=twelve\x1b[31m", "highlimit (=twelve?[31m) is no INTEGER8: ignored"),
    ],
)
def test_limits_that_make_no_sense_are_ignored(tmp_path: Path, limits: str, remark: str) -> None:
    text = re.sub(r"(?ms)^\[60C2sub2\].*?(?=^\[)", f"[60C2sub2]\nDataType=2\n{limits}\n", TEXT)
    eds = eds_of(tmp_path, text)
    assert eds.all_remarks() == [f"EDS drive.eds: [60C2sub2] {remark}"]
    assert (eds.dictionary.get_variable(0x60C2, 2).min, eds.dictionary.get_variable(0x60C2, 2).max) == (None, None)


def test_a_second_section_only_adds(tmp_path: Path) -> None:
    eds = eds_of(tmp_path, TEXT + "\n[1018sub1]\nDataType=0x0007\nDefaultValue=7\n")
    assert [line.partition(": ")[2].partition(": ")[2] for line in eds.all_remarks()] == [
        "[1018sub1] a second time: only what the first lacks is taken",
        "[1018sub1] defaultvalue a second time with another value: skipped",
    ]
    assert eds.dictionary.get_variable(0x1018, 1).default == 0


def test_members_without_their_object_and_compact_ones(tmp_path: Path) -> None:
    without = re.sub(r"(?ms)^\[1029\].*?(?=^\[)", "", TEXT)
    eds = eds_of(tmp_path, without)
    assert eds.dictionary.get_variable(0x1029, 1).data_type == datatypes.UNSIGNED8
    assert any("belongs to no section [1029]" in line for line in eds.all_remarks())
    compact = "\n[3001]\nParameterName=Row\nObjectType=0x8\nDataType=0x7\nAccessType=rw\nCompactSubObj=3\n"
    eds = eds_of(tmp_path, TEXT + compact)
    assert [eds.dictionary.get_variable(0x3001, k) is not None for k in range(5)] == [True, True, True, True, False]


def test_a_pdo_without_its_mapping_has_an_empty_one(tmp_path: Path) -> None:
    """The `canopen` library looks up the mapping of every PDO, also of one that jointctl does not use."""
    import canopen

    for index in ("1A01", "1603"):
        eds = eds_of(tmp_path, re.sub(rf"(?ms)^\[{index}(sub\d)?\].*?(?=^\[)", "", TEXT))
        pdo = f"{int(index, 16) - 0x200:04X}"
        assert eds.all_remarks() == [f"EDS drive.eds: [{index}] is missing: PDO {pdo} has no mapping"]
        assert eds.dictionary.get_variable(int(index, 16), 0) is None
        canopen.RemoteNode(5, eds.dictionary)


def test_only_a_regular_file_is_read(tmp_path: Path) -> None:
    """Not a FIFO without a writer either, which would never end: `new` looks at every EDS file of its folder."""
    (tmp_path / "null.eds").symlink_to(os.devnull)
    with pytest.raises(ConfigurationError, match="is not a readable EDS file: is a device, not a regular file"):
        read_eds(tmp_path / "null.eds", 1)


def test_a_file_without_objects_is_refused(tmp_path: Path) -> None:
    for text in ("", "[FileInfo]\nA=1\n", "nonsense", "\0" * 100):
        with pytest.raises(ConfigurationError, match="is not a readable EDS file: it describes no object"):
            eds_of(tmp_path, text)
    with pytest.raises(ConfigurationError, match="is not a readable EDS file"):
        read_eds(tmp_path, 1)


LINES = TEXT.splitlines()
CUTS = st.lists(
    st.tuples(
        st.integers(0, len(LINES) - 1),
        st.sampled_from(["drop", "double", "swap", "upper", "junk", "number", "header", "cut"]),
        st.text(max_size=12),
    ),
    max_size=30,
)


def mutated(cuts: list[tuple[int, str, str]]) -> str:
    """The shipped EDS with lines dropped, doubled, swapped, cut, or given other values."""
    lines = list(LINES)
    for at, kind, text in cuts:
        line = lines[at % len(lines)]
        key = line.partition("=")[0]
        changed = {
            "drop": [], "double": [line, line], "swap": [lines[at // 2], line], "upper": [line.upper()], "junk": [text],
            "number": [f"{key}={text}"], "header": [f"[{text}]", line], "cut": [line[: len(text)]],
        }[kind]  # fmt: skip
        lines[at % len(lines) : at % len(lines) + 1] = changed
    return "\n".join(lines)


@settings(max_examples=120)
@given(CUTS)
@example([(0, "junk", "[6040]")])
def test_any_mutation_of_a_file_is_read_or_refused_in_one_line(
    tmp_path: Path, cuts: list[tuple[int, str, str]]
) -> None:
    data = mutated(cuts).encode("utf-8", errors="surrogatepass")
    try:
        eds = eds_of(tmp_path, data)
    except ConfigurationError as error:
        lines = str(error).splitlines()
    else:
        lines = [line for remark in eds.all_remarks() for line in remark.splitlines()]
        assert len(lines) == len(eds.all_remarks())
        assert all(eds.dictionary.get_variable(index, 0) is not None or index for index in eds.dictionary)
        return
    assert len(lines) == 1


@settings(max_examples=100)
@given(st.binary(max_size=400))
def test_any_bytes_are_text_and_sections(data: bytes) -> None:
    text, _ = decoded(data)
    sections, remarks = parse_sections(text)
    assert all(isinstance(keys, dict) for keys in sections.values())
    assert all(isinstance(line, str) for line in remarks)


# --- EDS files that name another drive or are wrong: tolerated with a remark, or refused where it matters ---
pytestmark = pytest.mark.usefixtures("short_timeout")


# --- identity ---
@pytest.mark.parametrize(("named", "accepted"), [(None, False), (0x9A, True), (0x9B, False)])
def test_an_eds_of_another_maker_or_product(commission: Any, joint: Any, named: int | None, accepted: bool) -> None:
    joint.answers.update({(0x1018, 1): 0x9A, (0x1018, 2): 0x77})
    remarks = commission().remarks
    assert "EDS edited.eds is of product 0x1, node 1 is product 0x77" in remarks
    assert not any("vendor" in remark for remark in remarks)  # the shipped EDS says vendor 0: of no one
    text = TEXT.replace("VendorNumber=0", "VendorNumber=0x2E1")
    if accepted:
        remarks = commission(eds=text, vendor_id=named).remarks
        assert "EDS edited.eds is of vendor 0x2e1, node 1 is of vendor 0x9a" in remarks
        return
    words = "edited.eds is of vendor 0x2e1" if named is None else "drive.vendor_id is 0x9a, the configuration says"
    with pytest.raises(DeviceError, match=words):
        commission(eds=text, vendor_id=named)


# --- EDS files that are wrong where it matters, and elsewhere ---
def test_a_sloppy_eds_is_used_and_its_defects_are_told(commission: Any) -> None:
    text = TEXT.replace("[6041]\n", "[6041]\nDescription=gerätespezifisch\n").replace("[1000]", "junk\n[1000]")
    text = re.sub(r"(?s)(\[6064\].*?)DataType=0x0004\n", r"\1", text, count=1)
    told = [remark for remark in commission(eds=text).remarks if remark.startswith("EDS edited.eds: ")]
    assert len(told) == 3
    assert "[6064] has no DataType: INTEGER32 of the standard is used" in told[2]


@pytest.mark.parametrize(
    ("index", "right", "wrong", "message"),
    [
        (6071, 3, 4, r"object 6071 \(target torque\) DataType \(=INTEGER32\) must be INTEGER16, and jointctl needs it"),
        (6072, 6, 5, r"6072 \(max torque\) has 8 bits, which do not hold 1000"),
    ],
)
def test_an_eds_that_is_wrong_about_an_object_that_is_needed_is_refused(
    commission: Any, index: int, right: int, wrong: int, message: str
) -> None:
    text = re.sub(rf"(?s)(\[{index}\].*?DataType=0x000){right}\n", rf"\g<1>{wrong}\n", TEXT, count=1)
    with pytest.raises(DeviceError, match=message):
        commission(eds=text)
