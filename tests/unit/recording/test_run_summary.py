"""Summary and figure of a run, from records whose answers are known in advance."""

from __future__ import annotations

import dataclasses
import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console

from jointctl.drivers.errors import DataError
from jointctl.firmware_py.cycle import HISTOGRAM_BINS, Histogram
from jointctl.firmware_py.states import Fault
from jointctl.tools.configuration.records import trajectory_constants
from jointctl.tools.configuration.sections import SineSwitch
from jointctl.tools.recording import run_summary
from jointctl.tools.recording.run_summary import (
    TIMES,
    drawn_indices,
    histogram_times,
    learning_factor,
    save_run_figure,
    summarise,
    summary_table,
)
from tests.configurations import shipped
from tests.run_records import run_records


def test_error_is_that_of_tracking_only() -> None:
    summary = summarise(run_records())
    assert (summary.error.range_rad.least, summary.error.range_rad.greatest) == (-0.5e-3, 2e-3)
    assert summary.error.range_rad.peak == 2e-3
    assert summary.error.rmse_rad == pytest.approx(np.sqrt(0.1 * 4e-6 + 0.9 * 0.25e-6))
    assert summary.late_error.rmse_rad == pytest.approx(0.5e-3)
    assert summary.late_error.from_s == pytest.approx(0.5, abs=2e-3)
    assert summary.cycles == 1100
    assert summary.duration_s == pytest.approx(1.099)
    assert summary.fault == "NONE"


def test_a_beginning_a_little_before_0_has_no_sign() -> None:
    summary = summarise(run_records())
    assert summary.error is not None
    early = dataclasses.replace(summary, error=dataclasses.replace(summary.error, from_s=-0.01))
    shown = list(summary_table(early).columns[0].cells)
    assert any(str(cell).startswith("tracking error (0.0..") for cell in shown)


def test_a_changed_motion_sets_the_loops_time_back_but_not_the_summarys() -> None:
    changed = run_records()
    changed.trajectory_s[600:] = -1.0 + np.arange(500) * 1e-3
    found, expected = summarise(changed), summarise(run_records())
    assert found.tracked_s == pytest.approx(expected.tracked_s)
    assert found.settling_s == pytest.approx(expected.settling_s)
    assert found.late_error.from_s == pytest.approx(0.5, abs=2e-3)
    assert found.late_error.rmse_rad == pytest.approx(0.5e-3)


def test_settling_time_is_when_the_error_stays_within_1_mrad() -> None:
    records = run_records()
    assert summarise(records).settling_s == pytest.approx(0.1)
    records.error_rad[100 + 700] = -1.0001e-3
    assert summarise(records).settling_s == pytest.approx(0.701)
    records.error_rad[100 + 700] = -1e-3
    assert summarise(records).settling_s == pytest.approx(0.1)
    records.error_rad[-1] = 1.0001e-3
    assert summarise(records).settling_s is None
    records.error_rad[-1] = np.nan
    assert summarise(records).settling_s is None


def shown_row(records: np.recarray, name: str) -> str:
    text = io.StringIO()
    Console(file=text, width=100).print(summary_table(summarise(records)))
    return next(line for line in text.getvalue().splitlines() if name in line)


def settled_row(records: np.recarray) -> str:
    return shown_row(records, "within 1 mrad for good")


@pytest.mark.parametrize(("age", "words"), [(0, " 0 cycles "), (1, " 1 cycle "), (2, " 2 cycles ")])
def test_one_cycle_is_no_cycles(age: int, words: str) -> None:
    records = run_records()
    records.sample_age_cycles[50] = age
    assert words in shown_row(records, "oldest sample")


def test_an_error_that_was_never_outside_is_told_in_words() -> None:
    records = run_records()
    assert "after 0.10 s" in settled_row(records)
    records.error_rad[100:] = 0.5e-3
    assert "from the start" in settled_row(records)
    records.error_rad[100] = 1.1e-3  # the first cycle alone
    assert "after 0.00 s" in settled_row(records)
    records.error_rad[-1] = 2e-3
    assert "not reached" in settled_row(records)


def test_torques_are_those_of_tracking() -> None:
    summary = summarise(run_records())
    assert (summary.command_torque_Nm.least, summary.command_torque_Nm.greatest) == (-10.0, 20.0)
    assert (summary.network_torque_Nm.least, summary.network_torque_Nm.greatest) == (1.5, 1.5)


def test_deadlines_from_records() -> None:
    records = run_records()
    records.skipped[[3, 7]] = (2, 3)
    records.sample_age_cycles[9] = 4
    summary = summarise(records)
    assert (summary.wake_late.count, summary.wake_late.max_us) == (1100, 1099.0)
    assert summary.wake_late.p50_us == 550.0
    assert summary.wake_late.p99_us == 1089.0
    # cycles without a sample do not count as a round trip of zero
    assert (summary.round_trip.count, summary.round_trip.p50_us) == (550, 300.0)
    assert summary.skipped_cycles == 5
    assert summary.oldest_sample_cycles == 4


def test_the_rows_of_the_histograms_are_those_of_the_loop() -> None:
    assert tuple(TIMES.values()) == ("wake_late", "round_trip", "work")
    assert (Histogram.WAKE, Histogram.ROUND_TRIP, Histogram.WORK) == (0, 1, 2)


def test_deadlines_from_histograms() -> None:
    histograms = np.zeros((len(Histogram), HISTOGRAM_BINS), np.int64)
    histograms[Histogram.WAKE, 10] = 989
    histograms[Histogram.WAKE, 20] = 10
    histograms[Histogram.WAKE, 500] = 1
    histograms[Histogram.WORK, -1] = 2
    summary = summarise(run_records(), histograms)
    wake, work = summary.wake_late, summary.work
    assert wake is not None
    assert work is not None
    assert (wake.count, wake.p50_us, wake.p99_us, wake.p99_9_us, wake.max_us) == (1000, 11.0, 21.0, 21.0, 501.0)
    assert wake.over_range == 0
    assert work.over_range == 2
    assert summary.round_trip is None


@pytest.mark.parametrize(("slow", "p99_us"), [(10, 1.0), (11, 101.0)])
def test_the_99th_percentile_changes_with_the_last_hundredth(slow: int, p99_us: float) -> None:
    histogram = np.zeros(HISTOGRAM_BINS, np.int64)
    histogram[0], histogram[100] = 1000 - slow, slow
    times = histogram_times(histogram)
    assert times is not None
    assert times.p99_us == p99_us


def test_a_run_that_never_tracked_has_no_errors() -> None:
    records = run_records()[:50]
    records.fault[20:] = Fault.ENABLE_TIMEOUT
    summary = summarise(records)
    assert summary.error is None
    assert summary.settling_s is None
    assert summary.command_torque_Nm is None
    assert summary.fault == "ENABLE_TIMEOUT"
    assert summarise(records[:0]).cycles == 0


def test_the_summary_is_json_and_a_table() -> None:
    data = json.loads(json.dumps(summarise(run_records()).to_dict(), allow_nan=False))
    assert data["error"]["range_rad"]["greatest"] == 2e-3
    assert data["wake_late"]["max_us"] == 1099.0
    text = io.StringIO()
    Console(file=text, width=100).print(summary_table(summarise(run_records())))
    assert "-0.500 .. 2.000 mrad" in text.getvalue()
    assert "after 0.10 s" in text.getvalue()


def test_the_figure_is_a_png_and_marks_the_fault(tmp_path: Path) -> None:
    records = run_records()
    plain = save_run_figure(records, tmp_path / "figures" / "plain.png", "plain").read_bytes()
    records.fault[600:] = Fault.FOLLOWING_ERROR
    fault = save_run_figure(records, tmp_path / "fault.png", "plain").read_bytes()
    assert plain.startswith(b"\x89PNG\r\n")
    assert plain != fault
    with pytest.raises(DataError, match="nothing to draw, the run has 0 records"):
        save_run_figure(records[:0], tmp_path / "none.png", "none")


def height_of(png: Path) -> int:
    return int.from_bytes(png.read_bytes()[20:24], "big")  # of the IHDR chunk


@pytest.mark.parametrize("closed_here", [True, False])
def test_the_torque_of_a_drive_that_closes_the_loop_is_drawn(
    monkeypatch: pytest.MonkeyPatch, closed_here: bool
) -> None:
    records, labels = run_records(), list[str]()

    def drawn(figure: Figure, path: Path) -> Path:
        labels.extend(str(line.get_label()) for line in figure.axes[2].get_lines())
        return path

    records["feedback_torque_Nm"] = 1.0 if closed_here else 0.0
    monkeypatch.setattr(run_summary, "save_png", drawn)
    save_run_figure(records, Path("run.png"), "run")
    assert ("measured" in labels) is not closed_here
    assert "command" in labels


def test_a_law_without_network_has_neither_its_panel_nor_its_row(tmp_path: Path) -> None:
    records = run_records()
    high = height_of(save_run_figure(records, tmp_path / "with.png", "with"))
    records.network_torque_Nm = 0.0
    records.observer_torque_Nm[100:] = 2.0
    assert height_of(save_run_figure(records, tmp_path / "without.png", "without")) < 0.9 * high
    text = io.StringIO()
    Console(file=text, width=100).print(summary_table(summarise(records)))
    assert "command torque" in text.getvalue()
    assert "network torque" not in text.getvalue()


@pytest.mark.parametrize("count", [2, 4000, 4001, 100_003])
def test_no_peak_is_lost_in_the_figure(count: int) -> None:
    values = np.sin(np.arange(count))
    values[count // 3], values[-1] = 5.0, -7.0
    drawn = drawn_indices(values)
    assert len(drawn) <= 4004
    assert {0, count - 1} <= set(drawn)
    assert (values[drawn].min(), values[drawn].max()) == (-7.0, 5.0)
    assert np.all(np.diff(drawn) > 0)


@pytest.mark.parametrize(
    ("motion", "switch_s", "learned", "expected"),
    [
        ({}, math.inf, True, 2.0),
        ({}, 15.0, True, 2.0),  # another sine from then on, of which no whole period was run
        ({}, math.inf, False, None),
        ({"frequency_Hz": 0.01}, math.inf, True, None),
    ],
)
def test_what_learning_adds_is_compared_with_the_first_period_at_the_same_places(
    motion: dict[str, Any], switch_s: float, learned: bool, expected: float | None
) -> None:
    """Its error has another place in the period, a start that counts for nothing, and then twice the size."""
    motion = {f"trajectory__{key}": value for key, value in {"frequency_Hz": 0.1, **motion}.items()}
    if switch_s < math.inf:
        motion["trajectory__switch"] = SineSwitch(
            at_s=switch_s, amplitude_rad=0.1, frequency_Hz=0.05, shift_s=0.0, offset_rad=0.0
        )
    config = shipped("precise").changed(trajectory__duration_s=30.0, **motion)
    time_s = np.arange(0.0, 30.0, 0.01)
    rows = np.zeros(time_s.size, dtype=[(n, float) for n in ("trajectory_s", "error_rad", "learned_torque_Nm")])
    later = (time_s >= 10.0) & (time_s < switch_s)
    rows["trajectory_s"], rows["learned_torque_Nm"] = time_s, later * learned
    rows["error_rad"] = np.where(time_s < 0.9, 9.0, (1.0 + later) * (2.0 + np.sin(2.0 * np.pi * time_s / 10.0)))
    table = np.zeros((1, 5))
    found = learning_factor(trajectory_constants(config, table), table, rows.view(np.recarray))
    assert found == (None if expected is None else pytest.approx(expected, rel=1e-6))
