"""Views of the scope's picture: spectra, one signal against another, cursors, CSV."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase
from jointctl.tools.scoping.history import (
    AGAINST,
    POINTS,
    SPECTRUM,
    TIME,
    TIME_NAME,
    History,
    Seen,
    readings,
    seen,
    spectra,
)

TIME_s = np.arange(0.0, 5.0, 1e-3)
SINE = {"angle [rad]": 1.0 + 0.35 * np.sin(math.tau * 7.0 * TIME_s)}


def history(count: int) -> tuple[History, Any]:
    rows = new(LogRecord, count)
    rows.time_ns = 10**12 + np.arange(count) * 1_000_000
    rows.position_rad = 0.35 * np.sin(math.tau * 7.0 * np.arange(count) * 1e-3)
    rows.velocity_radps = np.arange(count) * 1e-3
    rows.phase = AxisPhase.TRACKING
    found = History()
    found.take(rows)
    return found, found.newest(60.0)


def test_the_spectrum_of_a_sine_is_its_amplitude_at_its_frequency() -> None:
    found = spectra(TIME_s, SINE)
    peak = int(np.argmax(found.columns["angle [rad]"]))
    assert found.x[peak] == pytest.approx(7.0, abs=0.01)
    assert found.columns["angle [rad]"][peak] == pytest.approx(0.35, rel=1e-3)
    assert found.x[-1] == pytest.approx(500.0, rel=1e-3)
    far = np.abs(found.x - 7.0) > 2.0
    assert found.columns["angle [rad]"][far].max() < 1e-3  # the mean is none of it, either


def test_a_spectrum_is_of_the_longest_stretch_without_a_gap_in_which_all_has_a_meaning() -> None:
    later = TIME_s + np.where(np.arange(len(TIME_s)) >= 3000, 1.0, 0.0)
    assert len(spectra(later, SINE).x) == 3000 // 2 + 1
    rests = (np.arange(len(TIME_s)) < 500) | (np.arange(len(TIME_s)) >= 4500)
    law = np.where(rests, np.nan, 1.0)
    assert len(spectra(TIME_s, {**SINE, "error [mrad]": law}).x) == 4000 // 2 + 1
    assert len(spectra(later, {**SINE, "error [mrad]": law}).x) == 2500 // 2 + 1
    assert np.isfinite(spectra(TIME_s, {**SINE, "error [mrad]": law}).columns["error [mrad]"]).all()
    assert len(spectra(TIME_s, {"error [mrad]": np.full(len(TIME_s), np.nan)}).x) == 0
    assert len(spectra(TIME_s[:10], {"angle [rad]": TIME_s[:10]}).x) == 0


def test_skipped_cycles_do_not_move_a_spectrum() -> None:
    left = np.ones(len(TIME_s), bool)
    left[np.arange(100, len(TIME_s), 97)] = False
    found = spectra(TIME_s[left], {"angle [rad]": SINE["angle [rad]"][left]})
    peak = int(np.argmax(found.columns["angle [rad]"]))
    assert found.x[peak] == pytest.approx(7.0, abs=0.1)


@pytest.mark.parametrize(
    ("view", "x_name", "columns"),
    [
        (TIME, TIME_NAME, ["velocity [rad/s]", "angle [rad]"]),
        (AGAINST, "velocity [rad/s]", ["angle [rad]"]),
        (SPECTRUM, "frequency [Hz]", ["velocity [rad/s]", "angle [rad]"]),
    ],
)
def test_a_view_has_its_columns(view: str, x_name: str, columns: list[str]) -> None:
    found = seen(view, *history(4000), ["velocity [rad/s]", "angle [rad]"])
    assert found.x_name == x_name
    assert list(found.columns) == columns
    assert all(len(found.drawn(name)) <= POINTS + 2 for name in columns)


def test_one_signal_has_nothing_to_be_shown_against() -> None:
    assert seen(AGAINST, *history(10), ["angle [rad]"]).x_name == TIME_NAME
    assert seen(TIME, *history(10), []).columns == {}


def test_cursors_read_values_between_samples_and_nothing_outside() -> None:
    found = Seen(TIME_NAME, np.array([0.0, 1.0, 2.0]), {"angle [rad]": np.array([0.0, 0.5, 0.1])})
    assert found.at(0.5, "angle [rad]") == 0.25
    assert math.isnan(found.at(2.1, "angle [rad]"))
    head, time, angle = readings(found, 0.5, 1.0).splitlines()
    assert head.split() == ["A", "B", "B", "-", "A"]
    assert time.split()[2:5] == ["0.5", "1", "0.5"]
    assert time.endswith("1/(B - A) = 2 Hz")
    assert angle.split()[2:] == ["0.25", "0.5", "0.25"]
    assert readings(found, 0.5, 3.0).splitlines()[2].split()[2:] == ["0.25", "-", "-"]
    assert "Hz" not in readings(found, 0.5, 0.5)


def test_csv_has_what_is_seen() -> None:
    found = Seen(TIME_NAME, np.array([0.0, 1.0, 2.0]), {"angle [rad]": np.array([0.0, np.nan, 0.1]),
                                                        "velocity [rad/s]": np.array([1.0, 2.0, 3.0])})  # fmt: skip
    assert found.csv(0.5, 2.0) == "time [s],angle [rad],velocity [rad/s]\n1,,2\n2,0.1,3\n"
