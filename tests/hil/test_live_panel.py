"""What `run` shows: a live panel on a terminal, lines elsewhere; neither holds up the run.  Raw frames in its log."""

from __future__ import annotations

import dataclasses
import io
import os
import termios
import time
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.cycle import HISTOGRAM_BINS, Histogram
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase, DriveState, Fault
from jointctl.tools.output import Output
from jointctl.tools.recording.run_log_reader import missing_records
from jointctl.tools.session.display import LivePanel, PhaseLines, Snapshot, panel, run_display, time_left
from tests.hil.terminal import Terminal, opened_terminal

ESCAPE = "\x1b["
TERMINAL = {**os.environ, "TERM": "xterm-256color"}


def snapshot(**fields: Any) -> Snapshot:
    record = new(LogRecord)
    record.phase, record.drive_state, record.status_word = AxisPhase.TRACKING, DriveState.ENABLED, 0x1237
    record.error_rad, record.command_torque_Nm, record.trajectory_s = 1.5e-3, -20.0, 4.0
    for name, value in fields.items():
        record[name] = value
    histograms = np.zeros((len(Histogram), HISTOGRAM_BINS), np.int64)
    histograms[0, 40] = 100
    return Snapshot(record[0], 3, histograms, 10.0)


def text_of(shown: Any, width: int = 100) -> str:
    from rich.console import Console

    out = io.StringIO()
    Console(file=out, width=width).print(shown)
    return out.getvalue()


def test_the_panel_tells_state_error_torque_deadlines_and_time_left() -> None:
    text = text_of(panel("joint: sine", "tracking", snapshot(), ["loop delay 1.00 ms"]))
    for words in (" tracking", "operation enabled", "+1.500 mrad", "-20.00 Nm", "41 us", "3 cycles", "6.0 s", "none"):
        assert words in text
    assert "loop delay 1.00 ms" in text


@pytest.mark.parametrize(
    ("torque_Nm", "limit_Nm", "words"),
    [(0.0123, 0.3, "+0.0123 Nm"), (-20.0, 60.0, "-20.00 Nm"), (-20.0, 0.0, "-20.00 Nm"), (812.3, 1000.0, "+812.30 Nm")],
)
def test_the_panel_has_the_digits_that_the_joint_needs(torque_Nm: float, limit_Nm: float, words: str) -> None:
    """A finger of 0.3 Nm showed +0.01 Nm."""
    shown = dataclasses.replace(
        snapshot(command_torque_Nm=torque_Nm, velocity_radps=0.00123), torque_max_Nm=limit_Nm, velocity_max_radps=0.05
    )
    text = text_of(panel("joint: sine", "tracking", shown, []))
    assert words in text
    assert "+0.00123 rad/s" in text


@pytest.mark.parametrize(("temperature_degC", "words"), [(41.26, "temperature 41.3 °C"), (None, "temperature -")])
def test_the_panel_tells_the_temperature_where_the_drive_does(temperature_degC: float | None, words: str) -> None:
    shown = dataclasses.replace(snapshot(velocity_radps=-0.25), temperature_degC=temperature_degC)
    text = text_of(panel("joint: sine", "tracking", shown, []))
    assert words in text
    assert "-0.250 rad/s" in text


@pytest.mark.parametrize("width", [120, 80, 60, 40])
def test_no_name_and_no_value_is_cut_off_in_a_narrow_terminal(width: int) -> None:
    shown = dataclasses.replace(snapshot(), temperature_degC=41.26)
    text = text_of(panel("joint: sine", "tracking", shown, []), width)
    for words in ("wake-up p99", "temperature", "operation enabled", "+1.500 mrad", "-20.00 Nm", "41.3 °C", "3 cycles"):
        assert words in text
    assert max(map(len, text.splitlines())) == min(width, 78)


def test_the_panel_keeps_its_height() -> None:
    states: list[tuple[Any, list[str]]] = [
        (None, []),
        (snapshot(), ["a"]),
        (snapshot(fault=Fault.FOLLOWING_ERROR, phase=AxisPhase.QUICK_STOPPING), ["a", "b", "c" * 200]),
    ]
    heights = {len(text_of(panel("t", "starting", shown, notes)).splitlines()) for shown, notes in states}
    assert len(heights) == 1
    assert "following error" in text_of(panel("t", "", states[2][0], []))


@pytest.mark.parametrize(
    ("trajectory_s", "duration_s", "phase", "text"),
    [
        (-1.0, 10.0, AxisPhase.APPROACH, "11.0 s"), (0.0, 60.0, AxisPhase.TRACKING, "1:00.0 min"),
        (0.1, 60.0, AxisPhase.TRACKING, "59.9 s"), (61.0, 60.0, AxisPhase.TRACKING, "0.0 s"),
        (61.0, 0.0, AxisPhase.TRACKING, "until stopped"), (61.0, 60.0, AxisPhase.RAMPING, "stopping"),
    ],
)  # fmt: skip
def test_time_left(trajectory_s: float, duration_s: float, phase: int, text: str) -> None:
    assert time_left(trajectory_s, duration_s, phase) == text


def read_all(fd: int) -> str:
    text = b""
    try:
        while data := os.read(fd, 65536):
            text += data
    except OSError:
        pass
    return text.decode()


@pytest.mark.parametrize("how", ["stopped", "closed"])
def test_a_terminal_that_takes_nothing_holds_nobody_up(how: str) -> None:
    master, slave = opened_terminal()
    try:
        if how == "stopped":
            termios.tcflow(slave, termios.TCOOFF)  # Ctrl-S
        else:
            os.close(master)
        with LivePanel(slave, "t", refresh_s=0.01) as live:
            for _ in range(20):
                live.show(snapshot())
                live.note("n")
                time.sleep(0.005)
        assert not live._thread.is_alive()
        if how == "stopped":
            termios.tcflow(slave, termios.TCOON)
            assert "tracking" not in read_all(master)
    finally:
        os.close(slave)
        if how == "stopped":
            os.close(master)


def read_until_tracking(master: int, timeout_s: float) -> str:
    text, give_up = "", time.monotonic() + timeout_s
    while " tracking" not in text:
        assert time.monotonic() < give_up, text
        text += read_all(master)
        time.sleep(0.01)
    return text


def test_a_terminal_that_takes_it_gets_the_panel() -> None:
    master, slave = opened_terminal()
    try:
        with LivePanel(slave, "joint: sine", refresh_s=0.01) as live:
            live.show(snapshot())
            text = read_until_tracking(master, 30.0)
        assert "joint: sine" in text
    finally:
        os.close(slave)
        os.close(master)


def test_lines_where_there_is_no_terminal() -> None:
    for options in ({}, {"json": True}, {"quiet": True}):
        display = run_display(Output(stderr=io.StringIO(), **options), "t")(None)
        assert isinstance(display, PhaseLines)
    out = io.StringIO()
    with PhaseLines(Output(stderr=out)) as display:
        display.phase("tracking")
        display.show(snapshot())
        display.note("loop delay")
    assert out.getvalue() == "  tracking\n  loop delay\n"


def test_run_on_a_terminal_shows_the_panel_and_its_log_has_every_cycle_and_frame(bench: Any) -> None:
    config = bench.with_joint(trajectory__duration_s=5.0, log__frames=True)
    terminal = Terminal(bench, "run", config, "-y", env=TERMINAL)
    done, text = terminal.finished(180.0), terminal.text
    assert done.code == 0, text
    for words in (ESCAPE, "operation enabled", "time left", "wake-up p99", " tracking", "phase margin"):
        assert words in text
    assert "records were lost" not in text
    assert ESCAPE not in done.out
    assert "tracking error" in done.out
    log = bench.log()
    assert log.complete
    assert missing_records(log.records) == 0
    assert log.records.cycle[0] == 1
    frames = log.frames[log.frames["is_extended"] == 0]
    cycles = len(log.records)
    assert np.count_nonzero(frames["id"] == 0x80) >= cycles  # one SYNC a cycle
    assert np.count_nonzero(frames["id"] == 0x201) >= 0.99 * cycles
    assert np.count_nonzero(frames["id"] == 0x601) > 20  # what commissioning asked, which is ours
    assert np.count_nonzero(frames["id"] == 0x581) > 20
    told = [event.text for event in log.events]
    assert any(text.startswith("operation enabled") for text in told)
    assert any("phase margin" in text for text in told)
    assert log.metadata["versions"]["numpy"] == np.__version__
    assert len(log.metadata["friction"]["sha256"]) == 64


def test_a_run_on_a_stopped_terminal_goes_on_to_its_end(bench: Any) -> None:
    config = bench.with_joint(trajectory__duration_s=2.0)
    master, slave = opened_terminal()
    try:
        started = bench.start("run", config, "-y", stderr=slave, env=TERMINAL)
        read_until_tracking(master, 180.0)
        termios.tcflow(slave, termios.TCOOFF)
        assert started.process.wait(30.0) == 0
    finally:
        termios.tcflow(slave, termios.TCOON)
        os.close(slave)
        os.close(master)
    assert bench.disabled()
    records = bench.log().records
    assert int(records.fault.max()) == Fault.NONE
    assert records.trajectory_s[records.phase == AxisPhase.TRACKING][-1] > 1.9
