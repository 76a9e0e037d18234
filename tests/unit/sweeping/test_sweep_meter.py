"""From log records to rows: windows, means, spreads, files that survive a crash, and the bar that is drawn."""

from __future__ import annotations

import errno
import json
import math
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.drive import CommissioningReport, DriveIdentity
from jointctl.drivers.errors import DECLINED, DataError
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.identification.friction_data import SWEEP_COLUMNS, read_friction_data
from jointctl.tools.output import Advance, Output
from jointctl.tools.session.display import Snapshot
from jointctl.tools.sweeping.carry_out import (
    BATCHES,
    LEAST_SAMPLES,
    JointModel,
    MeasuredPoint,
    PlateauResult,
    Samples,
    SweepMeter,
    Tolerance,
    half_interval,
    plateau,
    sticking_share,
    without_ripple,
)
from jointctl.tools.sweeping.data_file import HEADING, SweepFile
from jointctl.tools.sweeping.options import Condition, SweepOptions, SweepPoint
from jointctl.tools.sweeping.plan import Window
from jointctl.tools.verbs import sweep as verb

# --- Means, spreads and confidence of plateaus of a known signal ---
JOINT_ORDER = 18.0 / math.tau
MOTOR_ORDER = 2.0 * 121.0 / math.tau
TIGHT = Tolerance(0.01, 0.0)


def window(
    velocity: float = 0.5, periods: float = 2.0, noise_Nm: float = 0.0, ripple_Nm: float = 0.0, seed: int = 1
) -> Samples:
    """`periods` of the joint ripple at 1 kHz; torque 0.2 Nm and ripples of both orders."""
    length = periods * math.tau / 18.0
    count = round(length / abs(velocity) * 1000.0)
    time_s = 10.0 + np.arange(count) * 1e-3
    position = 0.3 + velocity * (time_s - 10.0)
    noise = np.random.default_rng(seed).normal(0.0, 1.0, (2, count))
    torque = 0.2 + noise_Nm * noise[0] + ripple_Nm * (np.sin(18.0 * position) + np.cos(242.0 * position))
    return Samples(time_s, position, velocity + 0.01 * noise[1], torque)


def result(windows: list[Samples], planned: float = 0.5, tolerance: Tolerance = TIGHT) -> Any:
    return plateau(windows, planned, (JOINT_ORDER, MOTOR_ORDER), tolerance, 1.2e-5)


def test_mean_and_spread_of_a_known_signal() -> None:
    found = result([window(noise_Nm=0.002, ripple_Nm=0.01)])
    assert found.velocity_radps == pytest.approx(0.5, rel=1e-9)
    assert found.motor_torque_Nm == pytest.approx(0.2, abs=3e-4)
    assert found.motor_torque_std_Nm == pytest.approx(math.sqrt(0.01**2 + 0.002**2), rel=0.05)
    assert found.velocity_std_radps == pytest.approx(0.01, rel=0.1)
    assert found.samples == len(window().time_s)
    assert found.position_min_rad == pytest.approx(0.3)
    assert found.settled


def test_ripple_is_not_mistaken_for_chance() -> None:
    w = window(noise_Nm=1e-4, ripple_Nm=0.02)
    residual = without_ripple(w.position_rad, w.motor_torque_Nm, (JOINT_ORDER, MOTOR_ORDER))
    assert np.std(residual) == pytest.approx(1e-4, rel=0.1)
    untouched = without_ripple(w.position_rad, w.motor_torque_Nm, ())
    assert np.std(untouched) > 0.015


def test_a_ripple_of_which_too_little_was_seen_is_not_fitted() -> None:
    w = window(periods=0.5, ripple_Nm=0.02)
    only_motor = without_ripple(w.position_rad, w.motor_torque_Nm, (MOTOR_ORDER,))
    assert np.array_equal(without_ripple(w.position_rad, w.motor_torque_Nm, (JOINT_ORDER, MOTOR_ORDER)), only_motor)


def test_half_interval_covers_the_truth_about_nineteen_times_in_twenty() -> None:
    generator = np.random.default_rng(5)
    white = generator.normal(0.0, 1.0, (400, 1600))
    covered = sum(abs(np.mean(x)) <= half_interval(x) for x in white)
    assert 360 <= covered <= 396


def test_correlated_samples_give_a_wider_interval_than_independent_ones() -> None:
    white = np.random.default_rng(6).normal(0.0, 1.0, 16_000)
    red = np.empty_like(white)
    value = 0.0
    for i, x in enumerate(white):
        value = 0.95 * value + x
        red[i] = value
    red /= np.std(red)
    assert half_interval(red) > 3.0 * half_interval(white / np.std(white))


@pytest.mark.parametrize("count", [0, BATCHES, LEAST_SAMPLES - 1])
def test_too_few_samples_are_never_enough(count: int) -> None:
    assert half_interval(np.zeros(count)) == math.inf
    assert half_interval(np.zeros(LEAST_SAMPLES)) == 0.0


def test_noise_decides_whether_a_point_is_settled() -> None:
    assert result([window(noise_Nm=0.005)]).settled
    noisy = result([window(noise_Nm=0.1)])
    assert not noisy.settled
    assert "known to" in noisy.problem
    assert result([window(noise_Nm=0.1)], tolerance=Tolerance(0.01, 0.05)).settled


@pytest.mark.parametrize(
    ("share", "settled"), [(0.94, False), (0.951, True), (1.0, True), (1.049, True), (1.06, False)]
)
def test_the_planned_speed_must_be_held(share: float, settled: bool) -> None:
    found = result([window(velocity=0.5 * share)])
    assert found.settled is settled
    assert settled or "planned" in found.problem


def test_stick_slip_is_seen_and_even_motion_is_not() -> None:
    even = window(velocity=0.05, periods=1.0)
    jerky = window(velocity=0.05, periods=1.0)
    # the same way in steps of 0.02 rad: at rest for most of the time
    steps = np.floor((jerky.position_rad - 0.3) / 0.02) * 0.02
    jerky.position_rad = 0.3 + steps + np.clip((jerky.position_rad - 0.3 - steps) * 5.0, 0.0, 0.02)
    assert sticking_share([even], 0.05, 1.2e-5) == 0.0
    assert sticking_share([jerky], 0.05, 1.2e-5) > 0.5
    assert result([even], 0.05).settled
    assert result([jerky], 0.05).problem == "the joint stuck and slipped"


def test_windows_of_one_point_are_taken_together() -> None:
    found = result([window(noise_Nm=0.002, seed=1), window(noise_Nm=0.002, seed=2)])
    assert found.samples == 2 * len(window().time_s)
    assert found.velocity_radps == pytest.approx(0.5, rel=1e-9)


# --- From log records to rows: windows, stale samples, gravity, files that survive a crash ---
MODEL = JointModel(100.0, 0.0, 0.0, 1.2e-5, (18.0 / math.tau,))
FAST, BACK = SweepPoint(0, 0.5, 0), SweepPoint(1, -0.5, 0)


def records(seconds: float = 4.0, speed: float = 0.5, torque_Nm: float = 20.0) -> Any:
    """Log records at 1 kHz; torque 99 Nm except from 1 to 2 s and from 2.5 to 3 s."""
    log = new(LogRecord, round(seconds * 1000))
    log.trajectory_s = np.arange(len(log)) * 1e-3
    log.position_rad = speed * log.trajectory_s
    log.velocity_radps = speed
    inside = ((log.trajectory_s >= 1.0) & (log.trajectory_s < 2.0)) | (
        (log.trajectory_s >= 2.5) & (log.trajectory_s < 3.0)
    )
    log.measured_torque_Nm = np.where(inside, torque_Nm, 99.0)
    log.phase = AxisPhase.TRACKING
    return log


def measure(log: Any, windows: tuple[Window, ...], model: JointModel = MODEL, chunk: int = 20) -> list[MeasuredPoint]:
    found: list[MeasuredPoint] = []
    meter = SweepMeter(windows, model, found.append)
    meter.tolerance = Tolerance(0.01, 1e-3)
    for begin in range(0, len(log), chunk):
        meter.feed(log[begin : begin + chunk])
    return found


BOTH_WINDOWS = (Window(FAST, 1.0, 2.0, False), Window(FAST, 2.5, 3.0, True))


@pytest.mark.parametrize("chunk", [1, 7, 20, 4000])
def test_only_the_windows_are_measured_however_the_records_come(chunk: int) -> None:
    (found,) = measure(records(), BOTH_WINDOWS, chunk=chunk)
    assert found.result.motor_torque_Nm == pytest.approx(0.2)
    assert found.result.motor_torque_std_Nm == pytest.approx(0.0, abs=1e-12)
    assert found.result.samples == 1500
    assert found.result.velocity_radps == pytest.approx(0.5)
    assert found.time_s == 3.0


def test_a_point_is_told_as_soon_as_its_last_window_is_over() -> None:
    found: list[MeasuredPoint] = []
    meter = SweepMeter(BOTH_WINDOWS, MODEL, found.append)
    log = records()
    meter.feed(log[:2990])
    assert (len(found), meter.current) == (0, FAST)
    meter.feed(log[2990:3010])
    assert (len(found), meter.current) == (1, None)


def test_samples_that_are_assumed_and_other_phases_do_not_count() -> None:
    log = records()
    log.sample_age_cycles[1100:1200] = 1
    log.measured_torque_Nm[1100:1200] = 50.0
    log.phase[1300:1400] = AxisPhase.RAMPING
    log.measured_torque_Nm[1300:1400] = 50.0
    (found,) = measure(log, BOTH_WINDOWS)
    assert found.result.samples == 1300
    assert found.result.motor_torque_Nm == pytest.approx(0.2)


def test_an_interrupted_window_gives_no_point() -> None:
    assert measure(records()[:2900], BOTH_WINDOWS) == []


def test_a_window_with_too_few_samples_is_named_and_not_written() -> None:
    log = records()
    log.sample_age_cycles[1000 : 2000 - LEAST_SAMPLES + 1] = 3
    for kept, lost in ((0, [FAST]), (1, [])):
        found: list[MeasuredPoint] = []
        meter = SweepMeter((Window(FAST, 1.0, 2.0, True),), MODEL, found.append)
        meter.feed(log)
        assert (len(found), meter.lost_points) == (kept, lost)
        log.sample_age_cycles[2000 - LEAST_SAMPLES] = 0


def test_gravity_is_subtracted() -> None:
    log = records()
    log.measured_torque_Nm = 20.0 + 5.0 * np.sin(log.position_rad - 0.3)
    model = JointModel(100.0, 5.0, 0.3, 1.2e-5, MODEL.orders_prad)
    (found,) = measure(log, BOTH_WINDOWS, model)
    assert found.result.motor_torque_Nm == pytest.approx(0.2)
    assert found.result.motor_torque_std_Nm == pytest.approx(0.0, abs=1e-12)


def test_a_known_load_is_subtracted_and_kept() -> None:
    log = records()
    log.measured_torque_Nm = 20.0 + 5.0 * np.sin(log.position_rad - 0.3) - 7.0
    model = JointModel(100.0, 5.0, 0.3, 1.2e-5, MODEL.orders_prad)
    windows = tuple(replace(w, point=replace(w.point, condition=Condition(-7.0))) for w in BOTH_WINDOWS)
    (found,) = measure(log, windows, model)
    assert found.result.motor_torque_Nm == pytest.approx(0.2)
    position = np.concatenate([log.position_rad[(log.trajectory_s >= w.start_s) & (log.trajectory_s < w.end_s)]
                               for w in BOTH_WINDOWS])  # fmt: skip
    assert found.load_Nm == pytest.approx(np.mean(5.0 * np.sin(position - 0.3)) - 7.0, rel=1e-6)


def test_the_temperature_is_the_mean_over_the_windows_in_simulated_time() -> None:
    found: list[MeasuredPoint] = []
    meter = SweepMeter(BOTH_WINDOWS, MODEL, found.append)
    meter.warmth = np.array([0.0, 4.0]), np.array([20.0, 40.0])
    meter.feed(records())
    lengths = [w.end_s - w.start_s for w in BOTH_WINDOWS]
    middle_s = np.average([0.5 * (w.start_s + w.end_s) for w in BOTH_WINDOWS], weights=lengths)
    assert found[0].temperature_degC == pytest.approx(20.0 + 5.0 * middle_s, abs=0.01)


# --- files ---
def measured(point: SweepPoint, torque_Nm: float = 0.2, problem: str = "") -> MeasuredPoint:
    velocity = point.velocity_radps
    result = PlateauResult(velocity, math.copysign(torque_Nm, velocity), 0.01, 0.002, 900, -0.1, 0.4, 1e-4, problem)
    return MeasuredPoint(point, result, 12.5)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "data.csv"


def created(path: Path, count: int = 0, plan: str = "abc") -> SweepFile:
    file = SweepFile.create(path, 121.0, 0.1, plan, {"drive": {"serial": "7"}})
    for index in range(count):
        file.add(measured(SweepPoint(index, (0.1 + 0.01 * (index // 2)) * (-1) ** index, 0)))
    return file


def test_identification_reads_what_the_sweep_writes(path: Path) -> None:
    created(path, 40).close()
    data = read_friction_data(path)
    assert len(data.velocity_radps) == 40
    assert data.reduction_ratio == 121.0
    assert data.torque_constant_NmpA == 0.1
    assert np.all(data.settled)
    assert np.all(np.sign(data.velocity_radps) == np.sign(data.motor_torque_Nm))


def test_columns_of_a_row(path: Path) -> None:
    file = created(path)
    file.add(measured(SweepPoint(3, -0.25, 2), problem="the joint stuck and slipped"))
    file.close()
    heading, row = path.read_text().splitlines()
    values = dict(zip(heading.split(","), row.split(","), strict=True))
    assert tuple(values) == SWEEP_COLUMNS
    assert float(values["velocity_radps"]) == -0.25
    assert float(values["current_A"]) == pytest.approx(-2.0)
    assert float(values["current_std_A"]) == pytest.approx(0.02)
    assert (values["settled"], values["direction"], values["pass"], values["temperature_degC"]) == ("0", "-1", "2", "")
    sidecar = json.loads(path.with_suffix(".json").read_text())
    assert sidecar["unsettled"] == {"3": "the joint stuck and slipped"}
    assert sidecar["drive"] == {"serial": "7"}


def test_a_sweep_under_loads_has_a_column_of_them_and_goes_on_with_it(path: Path) -> None:
    file = SweepFile.create(path, 121.0, 0.1, "abc", {"loaded": True})
    file.add(replace(measured(SweepPoint(0, 0.1, 0)), load_Nm=7.25))
    file.close()
    file = SweepFile.resume(path, 0.1, "abc")
    file.add(replace(measured(SweepPoint(1, -0.1, 0)), load_Nm=-1.0))
    file.close()
    heading, *rows = path.read_text().splitlines()
    assert heading == f"{HEADING.strip()},load_Nm"
    assert [float(row.split(",")[-1]) for row in rows] == [7.25, -1.0]
    assert len(read_friction_data(path, both=False).velocity_radps) == 2


def test_each_row_is_in_the_file_at_once(path: Path) -> None:
    file = created(path)
    for index in range(3):
        file.add(measured(SweepPoint(index, 0.1 * (index + 1), 0)))
        assert len(path.read_text().splitlines()) == index + 2
    file.close()


def test_resume_knows_what_is_there_and_appends(path: Path) -> None:
    created(path, 4).close()
    file = SweepFile.resume(path, 0.1, "abc")
    assert file.done == {0, 1, 2, 3}
    assert file.elapsed_s == 12.5
    file.add(measured(SweepPoint(4, 0.7, 0)))
    file.close()
    assert len(path.read_text().splitlines()) == 6


@pytest.mark.parametrize("rest", ["0.3,2,0.2,0.01,0.02,900,1,0,0.4,9,,1,0\n", "0.3,2,0.2,0.0"])
def test_rows_that_a_crash_left_beyond_the_sidecar_are_measured_again(path: Path, rest: str) -> None:
    created(path, 4).close()
    before = path.read_text()
    path.write_text(before + rest)
    file = SweepFile.resume(path, 0.1, "abc")
    file.close()
    assert file.done == {0, 1, 2, 3}
    assert path.read_text() == before


def test_existing_files_are_never_overwritten(path: Path) -> None:
    created(path, 2).close()
    before = path.read_text(), path.with_suffix(".json").read_text()
    with pytest.raises(DataError, match=r"data\.csv: exists already"):
        created(path)
    path.unlink()
    with pytest.raises(DataError, match=r"data\.json: exists already"):
        created(path)
    assert path.with_suffix(".json").read_text() == before[1]


def test_another_plan_is_refused_and_nothing_is_changed(path: Path) -> None:
    created(path, 2).close()
    before = path.read_text()
    with pytest.raises(DataError, match=r"another plan \(abc, now xyz\)"):
        SweepFile.resume(path, 0.1, "xyz")
    assert path.read_text() == before


@pytest.mark.parametrize(
    ("csv", "sidecar", "words"),
    [
        (None, None, "cannot be read"),
        (lambda text: "".join(text.splitlines(keepends=True)[:3]), str, "holds 2 whole rows, its sidecar counts 3"),
        (lambda text: text[:-1], str, "holds 2 whole rows, its sidecar counts 3"),
        (lambda text: text.replace("velocity", "speed", 1), str, "line 1 is not the heading that the sweep wrote"),
        (lambda text: text.replace(",", ";"), str, "line 1 is not the heading that the sweep wrote"),
        (str, lambda text: text[:50], "damaged"),
        (str, lambda text: "[]", "not the sidecar"),
        *(
            (str, lambda text, changed=changed: json.dumps(json.loads(text) | changed), "not the sidecar")
            for changed in (
                {"measured": 3},
                {"measured": ["a", 1, 2]},
                {"measured": [-1, 1, 2]},
                {"unsettled": [1]},
                {"unsettled": {"a": "stuck"}},
                {"elapsed_s": "x"},
                {"elapsed_s": math.nan},
                {"elapsed_s": None},
            )
        ),
    ],
)
def test_damaged_files_are_one_line(path: Path, csv: Any, sidecar: Any, words: str) -> None:
    if csv is not None:
        created(path, 3).close()
        assert path.read_text().startswith(HEADING)
        for file, damaged in ((path, csv), (path.with_suffix(".json"), sidecar)):
            file.write_text(damaged(file.read_text()))
        before = path.read_text()
    with pytest.raises(DataError, match=words):
        SweepFile.resume(path, 0.1, "abc")
    assert csv is None or path.read_text() == before


def test_a_disk_that_takes_nothing_more_is_told_with_the_next_row_or_at_the_end(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = created(path, 3)

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    file.add(measured(SweepPoint(3, 0.2, 0)))
    with pytest.raises(DataError, match=r"data\.csv: cannot be written: No space left"):
        file.close()
    assert len(path.read_text().splitlines()) == 5  # what the operating system took is there


def test_a_slow_disk_does_not_hold_the_sweep_up(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = created(path)
    confirmed = threading.Event()
    monkeypatch.setattr(os, "fsync", lambda _: confirmed.wait(60.0) or None)
    file.add(measured(SweepPoint(0, 0.1, 0)))
    file.add(measured(SweepPoint(1, 0.2, 0)))
    assert len(path.read_text().splitlines()) == 3
    assert json.loads(path.with_suffix(".json").read_text())["measured"] == []
    confirmed.set()
    file.close()
    assert json.loads(path.with_suffix(".json").read_text())["measured"] == [0, 1]


# --- When the bar of a sweep is drawn: not before the loop runs, or it paints over what is said until then ---
class Bars(Output):
    """Notes what the bar was told."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.told: list[float | str] = []

    @contextmanager
    def progress(self, title: str, total: float) -> Iterator[Advance]:
        self.told.append(title)
        yield self.told.append
        self.told.append("end")


def test_the_bar_comes_with_the_first_record_of_the_loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    output = Bars(stdout=StringIO(), stderr=StringIO())
    seen: list[list[float | str]] = []

    class Loop:
        drive_state = "off"

        def __init__(self, plan: Any, consent: Any, output: Any, control: Any, display: Any) -> None:
            self._display = display

        def run(self) -> None:
            report = CommissioningReport(DriveIdentity("", "", "", ""), "cst", 0.0, 0.1, 1e-5)
            with self._display(report) as display:
                seen.append(output.told[:])
                for time_s in (-1.0, 2.0):
                    records: Any = new(LogRecord, 1).view(np.recarray)
                    records.trajectory_s = time_s
                    display.show(Snapshot(records[-1], 0, np.zeros(0), 0.0, records=records))

    monkeypatch.setattr("jointctl.tools.session.session.Session", Loop)
    options = SweepOptions(points=24, assume_yes=True)
    assert verb.sweep(load_config(shipped_config("sweep_virtual")), output, tmp_path / "data.csv", options) == DECLINED
    assert seen == [[]]
    assert output.told == ["24 points", 0.0, 2.0, "end"]
