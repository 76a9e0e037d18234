"""The end of a run: what is told first, and the exit code."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.drive import CommissioningReport, DriveIdentity
from jointctl.drivers.errors import DataError, DeviceError
from jointctl.firmware_py.realtime import HISTOGRAM_BINS, Histogram
from jointctl.firmware_py.states import Fault
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.output import Output
from jointctl.tools.recording.run_log import ERROR, WARNING, Event
from jointctl.tools.recording.run_summary import summarise
from jointctl.tools.session import result as run_report
from jointctl.tools.session.display import PhaseLines
from jointctl.tools.session.fault_words import fault_text
from jointctl.tools.session.result import RunResult
from tests.run_records import run_records

CONFIG = load_config(shipped_config("virtual"))
WITHOUT_PICTURE = CONFIG.model_copy(update={"log": CONFIG.log.model_copy(update={"picture": False})})

REPORT = CommissioningReport(DriveIdentity("", "", "", ""), "cst", 0.0, 0.1, 1e-5)


def result(folder: Path, fault: Fault) -> RunResult:
    records = run_records()
    histograms = np.zeros((len(Histogram), HISTOGRAM_BINS), np.int64)
    return RunResult(
        summary=summarise(records, histograms), records=records, histograms=histograms, fault=fault,
        fault_text=fault_text(fault, 5.0, 0) if fault is not Fault.NONE else None, stopped_by="", drive_state="off",
        bus_load=0.3, serial=True, lost_records=0, log_path=folder / "run.mcap", report=REPORT,
    )  # fmt: skip


@pytest.mark.parametrize(("fault", "code"), [(Fault.BUS_ERROR, 7), (Fault.NONE, 0)])
def test_the_cause_is_told_before_the_picture_is_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: Fault, code: int
) -> None:
    out, err = io.StringIO(), io.StringIO()
    told: list[str] = []
    monkeypatch.setattr(run_report, "save_run_figure", lambda *_: told.append(err.getvalue()))
    assert run_report.report_run(result(tmp_path, fault), Output(stdout=out, stderr=err), CONFIG) == code
    assert err.getvalue() == told[0]  # nothing more comes after it
    assert told[0].startswith("error: BUS_ERROR") == (fault is Fault.BUS_ERROR)
    assert ("hint: likely cause" in told[0]) == (fault is Fault.BUS_ERROR)
    assert "picture" in out.getvalue()


@pytest.mark.parametrize("fault", [Fault.NONE, Fault.BUS_ERROR])
def test_a_picture_that_cannot_be_written_does_not_hide_the_result(tmp_path: Path, fault: Fault) -> None:
    (tmp_path / "run.png").mkdir()
    out, err = io.StringIO(), io.StringIO()
    code = run_report.report_run(result(tmp_path, fault), Output(stdout=out, stderr=err), CONFIG)
    assert code == (0 if fault is Fault.NONE else 7)
    assert "run.png: cannot be written: Is a directory" in err.getvalue().replace("\n", " ")
    assert "run.mcap" in out.getvalue()
    assert "│ picture" not in out.getvalue()


def reported_to_a_full_disk(found: RunResult) -> int:
    with Path("/dev/full").open("w") as full:
        return run_report.report_run(found, Output(stdout=full, stderr=io.StringIO()), WITHOUT_PICTURE)


def test_a_fault_outweighs_a_result_that_cannot_be_written(tmp_path: Path) -> None:
    assert reported_to_a_full_disk(result(tmp_path, Fault.BUS_ERROR)) == 7


def test_so_does_a_drive_that_is_not_off(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match="did not confirm"):
        reported_to_a_full_disk(replace(result(tmp_path, Fault.NONE), drive_state="operation enabled"))


def test_without_them_it_is_the_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="standard output"):
        reported_to_a_full_disk(result(tmp_path, Fault.NONE))


def test_without_a_picture_none_is_drawn_or_told(tmp_path: Path) -> None:
    out = io.StringIO()
    assert run_report.report_run(result(tmp_path, Fault.NONE), Output(stdout=out), WITHOUT_PICTURE) == 0
    assert ".png" not in out.getvalue()
    assert list(tmp_path.iterdir()) == []
    out = io.StringIO()
    run_report.report_run(result(tmp_path, Fault.NONE), Output(json=True, stdout=out), WITHOUT_PICTURE)
    assert json.loads(out.getvalue())["picture"] is None


@pytest.mark.parametrize(("level", "told"), [(ERROR, True), (WARNING, False)])
def test_a_fault_is_told_when_it_happens(level: int, told: bool) -> None:
    err = io.StringIO()
    lines: Any = PhaseLines(Output(stderr=err))
    lines.event(Event(0, level, "loop", "BUS_ERROR (13): the serial port is gone"))
    assert ("BUS_ERROR (13)" in err.getvalue()) == told
