"""`jointctl hil` and `demo`: in which order they start, the link of a port, a computer that stands still."""

from __future__ import annotations

import os
import pty
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from jointctl.drivers.errors import DataError, UsageError
from jointctl.tools import virtual_joint
from jointctl.tools.configuration.arm import SHIPPED_ARM
from jointctl.tools.configuration.canopen import canopen_section
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.output import Output
from jointctl.tools.verbs import hil
from jointctl.tools.verbs.bench_drive import ServeOptions, bench_of
from jointctl.tools.verbs.demo import with_patience
from jointctl.tools.verbs.verb_options import AS_CONFIGURED
from jointctl.tools.virtual_joint import _make_link, _target
from tests.configurations import shipped


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"serial": True}, "--serial and --link are for"), ({"link": "/tmp/tty"}, "--serial and --link are for"),
        ({"model": hil.ModelOptions(eds=Path("x.eds"))}, r"--eds \(=x.eds\) is for"),
    ],
)  # fmt: skip
def test_an_arm_is_served_on_can_as_it_is(options: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words + " a single joint, and .*arm.toml is an arm"):
        hil.hil(config=SHIPPED_ARM, bus=AS_CONFIGURED, output=Output(quiet=True), **options)


# --- `jointctl hil`: in which order it starts ---
@pytest.mark.parametrize("serial", [False, True])
def test_only_what_is_compiled_and_runs_becomes_realtime(monkeypatch: pytest.MonkeyPatch, serial: bool) -> None:
    """A compiler under SCHED_FIFO takes a core from every other loop on the computer."""
    happened: list[str] = []
    given: list[Sequence[int]] = []

    @contextmanager
    def serve(*_: Any) -> Iterator[SimpleNamespace]:
        happened.append("compiled and started")
        ended = threading.Event()
        worker = threading.Thread(target=ended.wait)
        worker.start()
        yield SimpleNamespace(
            words=[0, 0, 1, 0], path="/dev/null", baud_rate_bitps=115_200, worker=worker.native_id, plant_states=None,
            interpreter=SimpleNamespace(state=None),
        )  # fmt: skip
        assert worker.native_id in given[0]
        ended.set()
        worker.join()

    def realtime(cpu: int | None, priority: int | None, threads: Sequence[int] = ()) -> list[str]:
        happened.append("realtime")
        given.append(threads)
        return []

    monkeypatch.setattr(virtual_joint, "serve_virtual_elmo" if serial else "serve_virtual_joint", serve)
    monkeypatch.setattr("jointctl.tools.session.loop_process.become_realtime", realtime)
    monkeypatch.setattr(hil, "_reader_gone", lambda _: True)
    config = load_config(shipped_config("elmo_serial" if serial else "virtual"))
    assert bench_of(config).serve(config, Output(quiet=True), ServeOptions()) == 0
    assert happened == ["compiled and started", "realtime"]


# --- `hil --link`: only the link of an earlier `hil` is replaced; everything else of that name stays as it is ---
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
    monkeypatch.setattr(virtual_joint.os, "getuid", lambda: os.lstat(link).st_uid + 1)
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

    monkeypatch.setattr(virtual_joint, "new_elmo_device", lambda _: Device())
    link = tmp_path / "tty"
    with virtual_joint.serve_virtual_elmo(None, str(link)):  # type: ignore[arg-type]
        assert os.readlink(link) == port
    assert not os.path.lexists(link)
    with virtual_joint.serve_virtual_elmo(None, str(link)):  # type: ignore[arg-type]
        link.unlink()
        link.write_text("precious")
    assert link.read_text() == "precious"


# --- `jointctl demo` on a computer that stands still now and then ---
@pytest.mark.parametrize(
    ("changes", "patience_s"),
    [
        ({}, 0.15),
        ({"drive__heartbeat_s": 0.1}, 0.75 * 0.1),  # a shorter heartbeat leaves less patience
        ({"limits__sample_age_max_s": 0.4}, 0.4),  # limits that are wider stay
    ],
)
def test_a_busy_computer_ends_no_demo_before_the_drive_would(changes: dict[str, float], patience_s: float) -> None:
    config = shipped(**changes)
    limits = with_patience(config).limits
    assert limits.sample_age_max_s == patience_s
    assert changes or limits.skipped_max_s == patience_s < canopen_section(config).heartbeat_s
