"""`hil --link`: only the link of an earlier `hil` is replaced; everything else of that name stays as it is."""

from __future__ import annotations

import os
import pty
from collections.abc import Iterator
from pathlib import Path

import pytest

from jointctl.drivers.errors import DataError
from jointctl.tools.verbs import hil_serial
from jointctl.tools.verbs.hil_serial import _make_link, _target


@pytest.fixture
def port() -> Iterator[str]:
    ends = pty.openpty()
    yield os.ttyname(ends[1])
    for end in ends:
        os.close(end)


def test_a_name_that_is_free_and_the_link_of_an_earlier_hil(tmp_path: Path, port: str) -> None:
    link = str(tmp_path / "tty")
    _make_link(link, port)
    assert os.readlink(link) == port
    for earlier in ("/dev/pts/99999", port):  # it was killed; its number is that of a terminal of ours by now
        os.unlink(link)
        os.symlink(earlier, link)
        _make_link(link, port)
        assert os.readlink(link) == port


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("file", "is a regular file"), ("folder", "is a folder"), ("fifo", "is a FIFO"),
        ("link to a file", "which no hil of yours has made"), ("dangling link", "which no hil of yours has made"),
        ("link to null", "which no hil of yours has made"), ("no folder", "No such file"), ("zero", "cannot be made"),
        ("empty", "cannot be made"), ("relative", "which no hil of yours has made"),
    ],
)  # fmt: skip
def test_anything_else_is_left_alone(tmp_path: Path, port: str, kind: str, words: str) -> None:
    link, kept = tmp_path / "tty", tmp_path / "kept"
    kept.write_text("precious")
    {
        "file": lambda: link.write_text("precious"), "folder": link.mkdir, "fifo": lambda: os.mkfifo(link),
        "link to a file": lambda: link.symlink_to(kept), "dangling link": lambda: link.symlink_to(tmp_path / "gone"),
        "link to null": lambda: link.symlink_to("/dev/null"), "relative": lambda: link.symlink_to("../dev/pts/3"),
    }.get(kind, lambda: None)()  # fmt: skip
    name = {"no folder": str(tmp_path / "nowhere" / "tty"), "zero": "a\0b", "empty": ""}.get(kind, str(link))
    before = os.lstat(link) if os.path.lexists(link) else None
    with pytest.raises(DataError, match=words) as raised:
        _make_link(name, port)
    assert raised.value.exit_code == 8
    assert kept.read_text() == "precious"
    if before is not None:
        assert os.lstat(link).st_ino == before.st_ino
        assert not os.path.isfile(link) or link.read_text() == "precious" or kind == "link to null"


def test_a_link_of_another_user(tmp_path: Path, port: str, monkeypatch: pytest.MonkeyPatch) -> None:
    link = tmp_path / "tty"
    link.symlink_to("/dev/pts/99999")
    monkeypatch.setattr(hil_serial.os, "getuid", lambda: os.lstat(link).st_uid + 1)
    with pytest.raises(DataError, match="which no hil of yours has made"):
        _make_link(str(link), port)
    assert _target(str(link)) == "/dev/pts/99999"


def test_a_link_that_another_program_has_put_there_meanwhile_stays(
    tmp_path: Path, port: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Device:
        path = port

        def __enter__(self) -> Device:
            return self

        def __exit__(self, *_: object) -> None: ...

    monkeypatch.setattr(hil_serial, "new_elmo_device", lambda _: Device())
    link = tmp_path / "tty"
    with hil_serial.serve_virtual_elmo(None, str(link)):  # type: ignore[arg-type]
        assert os.readlink(link) == port
    assert not os.path.lexists(link)
    with hil_serial.serve_virtual_elmo(None, str(link)):  # type: ignore[arg-type]
        link.unlink()
        link.write_text("precious")
    assert link.read_text() == "precious"
