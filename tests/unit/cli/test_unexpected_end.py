"""What no verb has foreseen, and a computer that has too little of something: one line and a documented code."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from jointctl.tools.cli import main as main_module
from jointctl.tools.cli.start import FREE_DESCRIPTORS
from jointctl.tools.cli.unexpected_end import TRACEBACK

COMMAND = [sys.executable, "-P", "-m", "jointctl.tools.cli"]


def ended(*arguments: str, files: int | None = None, **options: Any) -> subprocess.CompletedProcess[str]:
    def limit() -> None:
        if files is not None:
            resource.setrlimit(resource.RLIMIT_NOFILE, (files, files))

    return subprocess.run(
        [*COMMAND, *arguments], capture_output=True, text=True, timeout=120, preexec_fn=limit,
        stdin=subprocess.DEVNULL, **options,
    )  # fmt: skip


@pytest.mark.parametrize("files", [6, 7, 10, FREE_DESCRIPTORS])
@pytest.mark.parametrize("verb", [("run", "virtual", "-y"), ("validate", "virtual", "none.csv"), ("--version",)])
def test_too_few_files_may_be_opened(files: int, verb: tuple[str, ...]) -> None:
    done = ended(*verb, files=files)
    assert done.returncode == 1
    assert done.stderr.startswith("error: open files: ")
    assert len(done.stderr.splitlines()) == 2
    assert done.stdout == ""


def test_its_twin_enough_files() -> None:
    assert ended("--version", files=FREE_DESCRIPTORS + 8).returncode == 0


def test_a_stop_is_tried_all_the_same(tmp_path: Path) -> None:
    config = tmp_path / "joint.toml"
    config.write_text('[bus]\ninterface = "jointctl"\nchannel = "nobody"\n[drive]\nnode = 1\n')
    done = ended("stop", str(config), files=16)
    assert done.returncode == 4
    assert "no virtual bus" in done.stderr


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (RuntimeError("odd\x1b[2J\nsecond"), "a fault of jointctl itself: RuntimeError: odd\\u001b[2J\\nsecond"),
        (RecursionError("too deep"), "RecursionError"),
        (MemoryError(), "too little memory"),
        (OSError(24, "Too many open files"), "open files: Too many open files"),
        (OSError(36, "File name too long"), "File name too long"),
        (PermissionError(13, "Permission denied"), "Permission denied"),
    ],
)
def test_an_unexpected_error_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], error: Exception, words: str
) -> None:
    def fail(**_: Any) -> None:
        raise error

    monkeypatch.setattr(main_module, "app", fail)
    for name in ("occupy_standard_streams", "never_refuse_a_character", "_start_quickly"):
        monkeypatch.setattr(main_module, name, lambda: None)
    monkeypatch.setattr(main_module.atexit, "register", lambda *_: None)
    monkeypatch.delenv(TRACEBACK)
    with pytest.raises(SystemExit) as raised:
        main_module.main()
    assert raised.value.code == 1
    told = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(told) == 1
    assert words in told[0]
    monkeypatch.setenv(TRACEBACK, "1")
    with pytest.raises(type(error)):
        main_module.main()


def test_what_the_encoding_of_the_terminal_lacks_is_escaped(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONIOENCODING": "ascii:strict"}
    done = ended("check", str(tmp_path / "\u540d\udcff.toml"), env=environment)
    assert done.returncode == 3
    assert "\\u540d" in done.stderr
    assert "\\udcff" in done.stderr
    assert len(done.stderr.splitlines()) == 2


@pytest.mark.parametrize(
    "arguments",
    [
        ("check", "{}"), ("identify", "{}"), ("validate", "virtual", "{}"), ("log", "info", "{}"), ("report", "{}"),
        ("study", "--file", "{}"), ("params", "diff", "{}", "{}"), ("clear-fault", "{}"),
        ("sweep", "sweep_virtual", "--lockstep", "-o", "x.csv", "--grid", "list", "--speeds", "{}"),
        ("info", "-i", "virtual", "-c", "0", "-t", "1", "--eds", "{}"), ("params", "diff", "{}.eds", "{}.eds"),
    ],
    ids=lambda arguments: " ".join(arguments[:2]),
)  # fmt: skip
@pytest.mark.parametrize("name", ["/dev/zero", "fifo"])
def test_every_reader_refuses_what_is_no_file(tmp_path: Path, arguments: tuple[str, ...], name: str) -> None:
    os.mkfifo(tmp_path / "fifo")
    os.mkfifo(tmp_path / "fifo.eds")
    (tmp_path / "zero.eds").symlink_to("/dev/zero")
    if ".eds" in arguments[-1]:
        name = name.removeprefix("/dev/")
    done = ended(*(word.format(name) for word in arguments), cwd=tmp_path)
    assert done.returncode in (2, 3, 8), done.stderr
    assert "Traceback" not in done.stderr
    assert len([line for line in done.stderr.splitlines() if line.startswith("error: ")]) == 1


_ROOT = str(Path(__file__).parents[3])
