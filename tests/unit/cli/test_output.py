"""What reaches a terminal, a page or a file: safe, however narrow, and never a traceback."""

from __future__ import annotations

import io
import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from jointctl.drivers.errors import DataError
from jointctl.tools.drawing import require_png, save_png
from jointctl.tools.experiments.campaign import Campaign, write_json
from jointctl.tools.experiments.controller_study import PlantResult, StudyResult, StudySettings, write_csv
from jointctl.tools.experiments.scenarios import ErrorFigures
from jointctl.tools.output import Output, command_line, width_of
from jointctl.tools.recording.report_page import Details, Paragraph, Section, draw, page
from jointctl.tools.recording.report_page import Table as PageTable
from jointctl.tools.recording.run_log import INFO, Event
from jointctl.tools.scoping.history import History
from jointctl.tools.session.display import LivePanel
from jointctl.tools.sweeping.data_file import SweepFile
from jointctl.tools.verbs import study as study_module
from jointctl.tools.verbs.info import info_table
from jointctl.tools.verbs.new import new
from jointctl.tools.written_file import prepare_folder, prepare_target, replace_file, require_target
from tests.configurations import shipped
from tests.python_process import largest_file
from tests.sessions import Terminal
from tests.sessions import output as output_to

# --- What reaches a terminal, however narrow ---
NUMBERS = ["0.0949 .. 0.358", "0.00788 .. 0.0162", "0.00762 .. 0.00944"]
PATH = "runs/a_joint_with_a_long_name-20260101-120000.mcap"


def shown_at(columns: int, table: RenderableType, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The lines in a terminal of that width, which none of them exceeds; without colours."""
    monkeypatch.setenv("COLUMNS", str(columns))
    out = Terminal()
    Output(stdout=out, stderr=io.StringIO()).result(table)
    lines = re.sub(r"\x1b\[[0-9;]*m", "", out.getvalue()).splitlines()
    assert max(len(line) for line in lines) <= columns
    return [line.rstrip() for line in lines]


def wide() -> Table:
    table = Table("file", "peak", "RMSE [mrad]", "true RMSE", title="T", caption="C")
    table.add_row(PATH, *NUMBERS)
    table.add_row("[bold]two[/]", "1", "", Text("[2]", "red"))
    return table


def test_a_wide_terminal_shows_the_table_and_a_narrow_one_a_list_of_its_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    needed = width_of(wide())
    assert needed == len(PATH) + len("0.0949") + len("0.00788") + len("0.00762") + 4 * 3 + 1
    assert any(line.startswith("│") for line in shown_at(needed, wide(), monkeypatch))
    assert shown_at(needed - 1, wide(), monkeypatch) == [
        "T", PATH, f"  peak {NUMBERS[0]}, RMSE [mrad] {NUMBERS[1]}", f"  true RMSE {NUMBERS[2]}",
        "[bold]two[/]", "  peak 1, true RMSE [2]", "C",
    ]  # fmt: skip


def test_a_long_word_is_whole_as_long_as_there_is_room_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table("quantity", "value", "note")
    table.add_row("phase margin", "24.2 deg at so many hertz and more", "at least 15 (margin.min_phase_margin_deg)")
    table.add_row("P", "12680.357  1.147959  16.091928", "P11 P12 P22")
    shown = "\n".join(shown_at(60, table, monkeypatch))
    for word in ("(margin.min_phase_margin_deg)", "12680.357", "quantity"):
        assert word in shown


def test_a_table_of_names_and_values_and_one_in_a_group_lose_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table("name", "value")
    table.add_row("log", PATH)
    lines = shown_at(40, Group(table, "after"), monkeypatch)
    cells = [line.split("│")[2] for line in lines if line.startswith("│")]
    assert "".join(cell.strip() for cell in cells) == PATH
    assert lines[-1] == "after"


def test_a_pipe_is_as_wide_as_the_table_needs() -> None:
    table = Table(*"abcdefgh")
    table.add_row(*["0.123456789012345678901"] * 8)
    out = io.StringIO()
    Output(stdout=out).result(Group(table))
    assert out.getvalue().count("0.123456789012345678901") == 8


@pytest.mark.parametrize(("columns", "kept"), [("40", True), ("0", False), ("wide", False), ("", False)])
def test_a_pipe_is_as_wide_as_columns_says(columns: str, kept: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    out = io.StringIO()
    Output(stdout=out, stderr=io.StringIO()).result(wide())
    longest = max(len(line) for line in out.getvalue().splitlines())
    assert (longest <= len(PATH)) is kept  # the longest word is not broken: a list of rows instead of a table


def test_what_a_terminal_wraps_of_a_fact_goes_below_its_text(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    text = "motion     -0.477 .. +0.650 rad, back and forth, about 7 min"
    terminal, pipe = Terminal(), io.StringIO()
    Output(stdout=io.StringIO(), stderr=terminal).fact(text)
    Output(stdout=io.StringIO(), stderr=pipe).fact(text)
    assert terminal.getvalue().splitlines() == [
        "motion     -0.477 .. +0.650 rad, back", "           and forth, about 7 min",
    ]  # fmt: skip
    terminal.truncate(terminal.seek(0))
    Output(stdout=io.StringIO(), stderr=terminal).fact("trajectory sine, 0.2200 rad/s, about 11 s long")
    assert terminal.getvalue().splitlines() == ["trajectory sine, 0.2200 rad/s, about", "           11 s long"]
    assert pipe.getvalue() == text + "\n"  # a line of a file is not broken


def test_a_long_name_of_an_object_does_not_squeeze_what_info_tells_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    words = "profile position, profile velocity"
    found = {
        "limits": {"607D:1 Software position limit, Min position limit": -5},
        "state": {"supported": words},
        "pdos": {"TPDO1": "6041 Statusword (16 bit); 6064 Position actual value (32 bit); 6077 Torque actual value"},
    }
    lines = shown_at(80, info_table(found), monkeypatch)
    assert any(words in line for line in lines)
    assert len(lines) <= 9


@pytest.mark.parametrize("path", ["runs/[old]/a.mcap", "runs/[/old]/a.mcap", "runs/:warning:.mcap"])
def test_what_rich_would_take_for_markup_is_shown_as_it_is(path: str) -> None:
    table = Table("log", title=path)
    table.add_row(path)
    out, err = io.StringIO(), io.StringIO()
    output = Output(stdout=out, stderr=err)
    output.result(path)
    output.result(table)
    output.note(table)
    output.note(path)
    assert out.getvalue().startswith(path)
    assert out.getvalue().count(path) == 3
    assert err.getvalue().count(path) == 3


# --- Nothing that comes from a file, a name or a device is obeyed by a terminal, a page or a reader of JSON ---
EVIL = "a\x1b]0;owned\x07\x1b[2J\x9b31m\u202eb\rc\x7f[red]x[/]<script>alert(1)</script>"
OBEYED = "\x1b\x07\x9b\u202e\r\x7f"


def assert_shown(text: str, times: int) -> None:
    assert not any(c in text for c in OBEYED), ascii(text)
    assert text.count("[red]x[/]") == times
    assert text.count("\\u001b[2J") == times


def test_every_kind_of_message(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    output, _, err = output_to()
    output.note(EVIL)
    output.fact(EVIL)
    output.warning(EVIL)
    output.error(EVIL, EVIL)
    output.error(f"{EVIL}\n{EVIL}")
    output.address(EVIL)
    assert_shown(err.getvalue(), 8)
    assert len(err.getvalue().splitlines()) == 8


def test_each_message_goes_to_its_own_stream_as_one_line() -> None:
    output, out, err = output_to()
    output.result("a result that is much longer than eighty columns, " * 3, {"a": 1})
    output.note("evil\nerror: all is well")
    output.note("a note [bus]")
    output.error("first\nsecond", "do this")
    with output.progress("work", 10.0) as advance:
        advance(5.0)
    assert out.getvalue().count("\n") == 1
    told = "evil\\nerror: all is well\na note [bus]\nerror: first\nerror: second\nhint: do this\n"
    assert err.getvalue() == told


def test_every_kind_of_result() -> None:
    def table() -> Table:
        made = Table(EVIL, "name", title=EVIL, caption=EVIL)
        made.add_row(EVIL, Text(EVIL, "red"))
        return made

    for shown, times in (
        (EVIL, 1), (Text(EVIL), 1), (table(), 5), (Group(table(), EVIL, Text(EVIL), Padding(EVIL, 1)), 8),
    ):  # fmt: skip
        output, out, _ = output_to()
        output.result(shown)
        assert_shown(out.getvalue(), times)
    output, out, _ = output_to()
    output.line(f"{EVIL}\n{EVIL}")
    assert_shown(out.getvalue(), 2)


def test_a_table_that_a_narrow_terminal_shows_as_a_list(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setenv("NO_COLOR", "1")
    made = Table("first", "second", "third")
    made.add_row("\x1b[2Jlong" * 6, "a\nb", "\x9bc")
    output, out, _ = output_to(Terminal)
    output.result(made)
    assert "\x1b[2J" not in out.getvalue()
    assert "\x9b" not in out.getvalue()


def test_a_list_on_a_narrow_terminal_cuts_nothing_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    words = [f"word{k}" for k in range(20)]
    made = Table("first heading", "a second heading", "a third heading")
    made.add_row("row", "1", " ".join(words))
    output, out, _ = output_to()
    output.result(made)
    assert [word for word in out.getvalue().split() if word in words] == words
    assert max(map(len, out.getvalue().splitlines())) <= 40


@pytest.mark.parametrize(("path", "shown"), [("my arm/ö.toml", "'my arm/ö.toml'"), ("runs/a.mcap", "runs/a.mcap")])
def test_a_command_to_be_copied_is_one_of_a_shell(path: str, shown: str) -> None:
    assert command_line("doctor", Path(path)) == f"jointctl doctor {shown}"
    assert shlex.split(command_line("run", path, "--dry-run")) == ["jointctl", "run", path, "--dry-run"]


def test_json_stays_json_and_toml_stays_toml() -> None:
    output, out, err = output_to(json=True, quiet=True)
    output.result("for people", {EVIL: [EVIL, 1.0], "figures": [np.float64(0.5), np.arange(2), float("nan")]})
    output.note("not shown")
    assert not any(c in out.getvalue() for c in OBEYED)
    assert json.loads(out.getvalue()) == {EVIL: [EVIL, 1.0], "figures": [0.5, [0, 1], None]}
    assert err.getvalue() == ""
    output, out, _ = output_to()
    output.line('key = "a\u202e\x7fb"')
    assert tomllib.loads(out.getvalue()) == {"key": "a\u202e\x7fb"}


def test_a_report_page() -> None:
    def paint(figure: Any) -> None:
        axes = figure.add_subplot()
        axes.set_title(EVIL)

    blocks = [
        Paragraph(EVIL),
        PageTable([EVIL], [[EVIL]], EVIL),
        Details(EVIL, "first\n\tsecond"),
        draw(1.0, paint, ""),
    ]
    text = page(EVIL, [Section(EVIL, blocks)], subtitle=EVIL)
    assert_shown(text, text.count("[red]x[/]"))
    assert text.count("[red]x[/]") >= 8
    assert "<script>alert" not in text
    assert "first\n\tsecond" in text


def test_a_name_with_dollar_signs_is_drawn() -> None:
    draw(1.0, lambda figure: figure.suptitle(r"$\frac{ and a$b"), "")


def test_the_scope_and_the_live_panel() -> None:
    history = History()
    history.take_event(Event(0, INFO, EVIL, EVIL))
    history.take_settings({"lines": [EVIL], "motion": EVIL, "gains": {EVIL: [0.0, 1.0, 2.0]}, "number": 3})
    event = history.events[0]
    shown = (event.source, event.text, history.settings["lines"][0], *history.settings["gains"])
    assert_shown(" ".join((*shown, history.settings["motion"])), 5)
    assert history.settings["number"] == 3

    panel = LivePanel(2, "[/nothing]\x1b[2J")
    panel.note(EVIL)
    panel._console.file = drawn = io.StringIO()
    panel._console.print(panel._panel())
    assert "[/nothing]\\u001b[2J" in drawn.getvalue()
    assert not any(c in drawn.getvalue() for c in "\x07\x9b\u202e\r")


# Output that nobody reads, that does not fit, or whose stream is closed: never a traceback, never the end of a run.
JOINTCTL = f"{sys.executable} -m jointctl.tools.verbs"


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


@pytest.mark.parametrize("json_wanted", [False, True])
@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_what_nobody_reads_is_thrown_away(unread: IO[str], stream: str, json_wanted: bool) -> None:
    output = Output(json=json_wanted, **{"stdout": io.StringIO(), "stderr": io.StringIO(), stream: unread})
    output.result("a table", {"a": 1})
    output.result("another one", {"a": 1})
    output.note("two")
    output.warning("three")
    output.error("four", "five")


@pytest.mark.parametrize(
    ("words", "code"),
    [(["--help"], 0), (["run", "--help"], 0), (["--version"], 0), (["--show-completion", "bash"], 0), (["params"], 2)],
)
def test_help_that_nobody_reads_ends_like_any_other(unread: IO[str], words: list[str], code: int) -> None:
    command = [sys.executable, "-P", "-m", "jointctl.tools.verbs", *words]
    environment = {**os.environ, "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}  # whatever starts the tests
    done = subprocess.run(
        command, stdout=unread, stderr=subprocess.PIPE, text=True, timeout=60.0, env=environment, check=False
    )
    assert (done.returncode, done.stderr) == (code, "")


def test_one_that_comes_bit_by_bit_ends_when_nobody_reads_it(unread: IO[str]) -> None:
    assert not Output(stdout=unread, stderr=io.StringIO()).line("a frame")
    assert output_to()[0].line("a frame")


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
        "import jointctl.tools.verbs.start as start; start.main()"
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
        "from jointctl.tools.verbs.start import occupy_standard_streams as occupy; occupy(); import os;"
        "assert all(os.readlink(f'/proc/self/fd/{n}') == os.devnull and os.get_inheritable(n) for n in (0, 1, 2));"
        "print('no harm')"
    )
    done = shell(f'{sys.executable} -c "{code}" <&- >&- 2>&-')
    assert done.returncode == 0


# --- Where results go is tried before the work that makes them ---
def test_a_folder_is_made_and_one_that_is_there_stays(tmp_path: Path) -> None:
    prepare_folder(tmp_path / "a" / "b")
    prepare_folder(tmp_path / "a" / "b")
    prepare_target(tmp_path / "c" / "file.csv")
    prepare_target(None)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "c"]


def test_what_cannot_be_written_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match="file: cannot be made: File exists"):
        prepare_folder(tmp_path / "file")
    with pytest.raises(DataError, match="is a folder, not a file to write"):
        prepare_target(tmp_path)
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write everywhere
    with pytest.raises(DataError, match="no permission"):
        prepare_folder(tmp_path)


@pytest.mark.parametrize("key", ["csv", "figure"])
def test_a_study_is_not_begun(key: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "jointctl.tools.experiments.controller_study.run_study", lambda *_, **__: pytest.fail("hours of simulation")
    )
    folder = tmp_path / "folder.png"
    folder.mkdir()
    with pytest.raises(DataError, match="is a folder"):
        study_module.study(StudySettings(), output_to()[0], **{key: folder})


@pytest.mark.parametrize("kind", ["fifo", "device"])
def test_what_is_no_file_is_not_replaced_by_one(tmp_path: Path, kind: str) -> None:
    """As root, a new /dev/null would be an ordinary file."""
    path = tmp_path / "out.png"
    if kind == "fifo":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/null")
    before = os.stat(path)
    for refused in (require_target, prepare_target, lambda target: replace_file(target, b"x")):
        with pytest.raises(DataError, match="is a device, a FIFO or a socket, and only files are written"):
            refused(path)
    after = os.stat(path)
    assert (after.st_ino, after.st_mode) == (before.st_ino, before.st_mode)


@pytest.mark.parametrize("refused", [require_target, prepare_target, lambda path: require_png(path, ())])
@pytest.mark.parametrize("place", ["file", "folder"])
def test_what_the_modes_protect_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Any, place: str
) -> None:
    """A response or a map of minutes was lost where its picture could not be written."""
    path = tmp_path / "out.png"
    path.write_bytes(b"before")
    refused(path)  # its twin
    protected = path if place == "file" else tmp_path
    monkeypatch.setattr(os, "access", lambda asked, mode: Path(asked) != protected)
    with pytest.raises(DataError, match=r"out\.png: cannot be written: no permission"):
        refused(path)


PLANTS = (PlantResult(0, "lugre", 17, (ErrorFigures(*(0.0 for _ in fields(ErrorFigures))),)),) * 500


def drawing() -> Figure:
    """More than a block of a disk."""
    figure = Figure()
    figure.subplots(2, 2)
    return figure


@pytest.mark.parametrize("before", [None, b"of the last time"])
@pytest.mark.parametrize(
    "write",
    [
        lambda path: replace_file(path, bytes(5000)),
        lambda path: save_png(drawing(), path),
        lambda path: write_csv(StudyResult(("paper",), PLANTS, False), path),
        lambda path: write_json(path, Campaign(shipped(), 1), [], 0.0, [{"kind": "x" * 5000}]),
        lambda path: SweepFile.create(path, 121.0, 0.1, "plan", {"more": "x" * 5000}),
    ],
)  # fmt: skip
def test_a_full_disk_leaves_what_was_there_and_nothing_beside_it(
    tmp_path: Path, write: Callable[[Path], object], before: bytes | None
) -> None:
    path = tmp_path / "out.csv"
    if before is not None:
        path.write_bytes(before)
    with largest_file(4096), pytest.raises(DataError):
        write(path)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == ({"out.csv": before} if before else {})


def test_half_an_arm_does_not_stay(tmp_path: Path) -> None:
    with largest_file(4096), pytest.raises(DataError, match="arm: cannot be written: File too large"):
        new(tmp_path / "arm", output_to()[0], arm=True)
    assert not list(tmp_path.iterdir())
