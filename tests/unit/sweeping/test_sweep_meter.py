"""From log records to rows: windows, stale samples, gravity, files that survive a crash."""

from __future__ import annotations

import errno
import json
import math
import os
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.errors import DataError
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import AxisPhase
from jointctl.tools.identification.friction_data import SWEEP_COLUMNS, read_friction_data
from jointctl.tools.sweeping.data_file import HEADING, SweepFile
from jointctl.tools.sweeping.grid import SweepPoint
from jointctl.tools.sweeping.meter import JointModel, MeasuredPoint, SweepMeter
from jointctl.tools.sweeping.plan import Window
from jointctl.tools.sweeping.statistics import LEAST_SAMPLES, PlateauResult, Tolerance

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
    found: list[MeasuredPoint] = []
    meter = SweepMeter((Window(FAST, 1.0, 2.0, True),), MODEL, found.append)
    meter.feed(log)
    assert (found, meter.lost_points) == ([], [FAST])
    log.sample_age_cycles[2000 - LEAST_SAMPLES] = 0
    meter = SweepMeter((Window(FAST, 1.0, 2.0, True),), MODEL, found.append)
    meter.feed(log)
    assert (len(found), meter.lost_points) == (1, [])


def test_gravity_is_subtracted() -> None:
    log = records()
    log.measured_torque_Nm = 20.0 + 5.0 * np.sin(log.position_rad - 0.3)
    model = JointModel(100.0, 5.0, 0.3, 1.2e-5, MODEL.orders_prad)
    (found,) = measure(log, BOTH_WINDOWS, model)
    assert found.result.motor_torque_Nm == pytest.approx(0.2)
    assert found.result.motor_torque_std_Nm == pytest.approx(0.0, abs=1e-12)


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


def test_damaged_files_are_one_line(path: Path) -> None:
    with pytest.raises(DataError, match="cannot be read"):
        SweepFile.resume(path, 0.1, "abc")
    created(path, 3).close()
    whole, sidecar = path.read_text(), path.with_suffix(".json").read_text()
    path.write_text("".join(whole.splitlines(keepends=True)[:3]))
    with pytest.raises(DataError, match="holds 2 rows, its sidecar counts 3"):
        SweepFile.resume(path, 0.1, "abc")
    path.write_text(whole.replace("velocity", "speed", 1))
    with pytest.raises(DataError, match="holds 3 rows"):
        SweepFile.resume(path, 0.1, "abc")
    path.write_text(whole)
    path.with_suffix(".json").write_text(sidecar[:50])
    with pytest.raises(DataError, match="damaged"):
        SweepFile.resume(path, 0.1, "abc")
    path.with_suffix(".json").write_text("[]")
    with pytest.raises(DataError, match="not the sidecar"):
        SweepFile.resume(path, 0.1, "abc")
    assert path.read_text() == whole
    assert whole.startswith(HEADING)


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
