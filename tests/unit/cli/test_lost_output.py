"""Output that nobody reads, that does not fit, or whose stream is closed: never a traceback, never the end of a run."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import pytest

from jointctl.drivers.errors import DataError
from jointctl.tools.output import Output

JOINTCTL = f"{sys.executable} -m jointctl.tools.cli"


def shell(line: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["sh", "-c", line], capture_output=True, text=True, timeout=60.0)


@pytest.fixture
def unread() -> Iterator[IO[str]]:
    """The end of a pipe whose reader has gone."""
    reading, writing = os.pipe()
    os.close(reading)
    stream = os.fdopen(writing, "w")
    yield stream
    stream.close()


def test_a_result_that_nobody_reads_is_thrown_away(unread: IO[str]) -> None:
    output = Output(stdout=unread, stderr=io.StringIO())
    output.result("a table")
    output.result("another one")


def test_one_that_comes_bit_by_bit_ends_when_nobody_reads_it(unread: IO[str]) -> None:
    assert not Output(stdout=unread, stderr=io.StringIO()).line("a frame")
    assert Output(stdout=io.StringIO(), stderr=io.StringIO()).line("a frame")


def test_json_that_nobody_reads_is_thrown_away(unread: IO[str]) -> None:
    Output(json=True, stdout=unread, stderr=io.StringIO()).result("", {"a": 1})


def test_what_stderr_does_not_take_is_no_reason_to_end(unread: IO[str]) -> None:
    output = Output(stdout=io.StringIO(), stderr=unread)
    output.note("one")
    output.note("two")
    output.warning("three")
    output.error("four", "five")


def test_a_slow_reader_of_stderr_hears_what_is_said_when_it_has_caught_up() -> None:
    reading, writing = os.pipe()
    os.set_blocking(reading, False)
    os.set_blocking(writing, False)
    with os.fdopen(reading, "rb", buffering=0) as reader, os.fdopen(writing, "w") as stream:
        output = Output(stdout=io.StringIO(), stderr=stream)
        for number in range(3000):
            output.note(f"note {number:050d}")
        while reader.read(1 << 16):
            pass
        output.error("the drive did not confirm that it is off")
        assert (reader.read(1 << 16) or b"").endswith(b"error: the drive did not confirm that it is off\n")


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_one_that_never_catches_up_does_not_change_the_exit_code(unbuffered: str) -> None:
    code = (
        "import os, sys; os.set_blocking(2, False); sys.argv = ['jointctl', 'check', 'absent.toml']\n"
        "try:\n    os.write(2, bytes(1 << 20))\nexcept BlockingIOError:\n    pass\n"
        "import jointctl.tools.cli.start as start; start.main()"
    )
    reading, writing = os.pipe()
    try:
        environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
        done = subprocess.run([sys.executable, "-c", code], stderr=writing, env=environment, timeout=60.0)
    finally:
        os.close(reading)
        os.close(writing)
    assert done.returncode == 3


@pytest.mark.parametrize("json", [False, True])
def test_a_result_that_does_not_fit_is_an_error(json: bool) -> None:
    with Path("/dev/full").open("w") as full, pytest.raises(DataError, match="standard output: cannot be written: No"):
        Output(json=json, stdout=full, stderr=io.StringIO()).result("a table", {"a": 1})


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_disk_without_room_is_one_line_of_any_verb(unbuffered: str) -> None:
    done = shell(f"PYTHONUNBUFFERED={unbuffered} {JOINTCTL} --version >/dev/full")
    assert (done.returncode, done.stderr.count("\n")) == (8, 1)
    assert done.stderr.startswith("error: ")


@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_a_verb_works_with_closed_streams(closed: str) -> None:
    assert shell(f"{JOINTCTL} --version {closed}").returncode == 0


def test_nothing_else_gets_the_number_of_a_closed_stream() -> None:
    code = (
        "from jointctl.tools.cli.standard_streams import occupy_standard_streams as occupy; occupy(); import os;"
        "assert all(os.readlink(f'/proc/self/fd/{n}') == os.devnull and os.get_inheritable(n) for n in (0, 1, 2));"
        "print('no harm')"
    )
    done = shell(f'{sys.executable} -c "{code}" <&- >&- 2>&-')
    assert done.returncode == 0
