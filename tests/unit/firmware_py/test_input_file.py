"""Files that a user names: only regular ones up to a size, and only numbers as CSV means them."""

from __future__ import annotations

import os
import socket
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointctl.firmware_py.input_file import (
    DEEPEST,
    number_from,
    open_input,
    parse_json,
    parse_toml,
    read_input,
    require_input,
)

SMALL = 10


@pytest.fixture
def odd(tmp_path: Path) -> Path:
    """A folder with one of each kind that is no regular file."""
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "folder").mkdir()
    (tmp_path / "to_zero").symlink_to("/dev/zero")
    (tmp_path / "dangling").symlink_to("nothing")
    (tmp_path / "loop").symlink_to("loop")
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "socket"))
    return tmp_path


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("fifo", "is a FIFO, not a regular file"), ("folder", "is a folder"),
        ("to_zero", "is a device, not a regular file"), ("/dev/full", "is a device, not a regular file"),
        ("socket", "is a socket, not a regular file"), ("dangling", "No such file"), ("loop", "symbolic links"),
        ("a" * 5000, "too long"), ("a\0b", "is no name of a file"), ("a\ud800b", "is no name of a file"),
    ],
    ids=lambda text: ascii(text)[:20],
)  # fmt: skip
def test_what_is_no_file_is_refused_at_once(odd: Path, name: str, words: str) -> None:
    for refused in (read_input, require_input):
        with pytest.raises(OSError, match=r".") as raised:
            refused(odd / name)
        assert words in str(raised.value.strerror)


@pytest.mark.parametrize(("size", "fits"), [(0, True), (SMALL - 1, True), (SMALL, True), (SMALL + 1, False)])
def test_the_size_is_limited(tmp_path: Path, size: int, fits: bool) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"x" * size)
    if fits:
        assert read_input(path, SMALL) == b"x" * size
        return
    with pytest.raises(OSError, match="has 11 bytes, at most 10 are read"):
        read_input(path, SMALL)


def test_a_file_whose_size_is_not_told_is_limited_too() -> None:
    assert os.stat("/proc/self/status").st_size == 0
    assert read_input("/proc/self/status")
    with pytest.raises(OSError, match="has more than 10 bytes"):
        read_input("/proc/self/status", SMALL)


def test_a_link_to_a_file_is_a_file_and_nothing_stays_open(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    (tmp_path / "link").symlink_to("file")
    before = len(os.listdir("/proc/self/fd"))
    assert read_input(tmp_path / "link") == b"x"
    require_input(tmp_path / "link")
    with pytest.raises(IsADirectoryError):
        open_input(tmp_path, SMALL)
    assert len(os.listdir("/proc/self/fd")) == before


@pytest.mark.parametrize(
    "text", ["1_0", "1_000.5", "٣", "\uff11", "nan", "inf", "-Infinity", "1e", "", " ", ".", "0x10", "1 0", "1\n"]
)
def test_what_python_takes_for_a_number_and_csv_does_not(text: str) -> None:
    with pytest.raises(ValueError, match="is not a number"):
        number_from(text)


@pytest.mark.parametrize("text", ["1", "-1.", "+.5", " 1e-3\t", "1E+05", "007", "1e-320"])
def test_a_number_is_taken(text: str) -> None:
    assert number_from(text) == float(text)


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_every_number_that_is_written_is_read(value: float) -> None:
    assert number_from(repr(value)) == value
    assert number_from(f"{value:g}") == float(f"{value:g}")


@pytest.mark.parametrize(
    "text",
    [
        "a = " + "[" * 20_000 + "]" * 20_000, "a = " + "{a=" * 20_000 + "1" + "}" * 20_000,
        ".".join("a" * 5_000) + " = 1", f"[{'.'.join('a' * 20_000)}]", "a = " + "9" * 5_000, "a = 0x" + "f" * 5_000,
    ],
    ids=["lists", "tables", "dotted key", "dotted section", "digits", "hexadecimal digits"],
)  # fmt: skip
def test_toml_of_any_depth_and_length_is_an_error_of_toml(text: str) -> None:
    with pytest.raises(tomllib.TOMLDecodeError, match="too"):
        parse_toml(text)


@pytest.mark.parametrize("text", ["[" * 100_000 + "]" * 100_000, '{"a":' * 2_000 + "1" + "}" * 2_000, "9" * 5_000])
def test_json_likewise(text: str) -> None:
    with pytest.raises(ValueError, match=r"too|limit"):
        parse_json(text)


@pytest.mark.parametrize(("depth", "fits"), [(DEEPEST - 1, True), (DEEPEST, False)])
def test_the_depth_is_the_one_that_is_stated(depth: int, fits: bool) -> None:
    text = "a = " + "[" * depth + "]" * depth
    if fits:
        assert parse_toml(text)
        assert parse_json(f'{{"a": {"[" * depth + "]" * depth}}}')
        return
    with pytest.raises(tomllib.TOMLDecodeError, match="nested too deeply"):
        parse_toml(text)
