"""A question that is answered with no: nothing is done, and that is no success."""

from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import Any

import pytest

from jointctl.drivers.drive import CommissioningReport, DriveIdentity
from jointctl.drivers.errors import DECLINED
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.output import Output
from jointctl.tools.sweeping.options import SweepOptions
from jointctl.tools.verbs import doctor_motion, run, sweep

REPORT = CommissioningReport(DriveIdentity("", "", "", ""), "cst", 0.0, 0.1, 1e-5)


class Asking:
    """A session that asks, and does no more."""

    drive_state = "switch on disabled"

    def __init__(self, plan: Any, consent: Any, *_: Any) -> None:
        self._plan, self._consent = plan, consent

    def run(self) -> None:
        placed = self._plan.motion.placed(REPORT)
        self._consent.show(placed.lines)
        assert self._consent.dry_run or not self._consent.agreed(placed.lines)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("answer", ["n\n", "\n", "", "no\n", "maybe\n"])
@pytest.mark.parametrize("verb", ["run", "sweep", "doctor --motion"])
def test_no_is_a_code_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: str, answer: str) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdin", Terminal(answer))
    monkeypatch.setattr(run, "Session", Asking)
    monkeypatch.setattr(sweep, "Session", Asking)
    monkeypatch.setattr(doctor_motion, "Session", Asking)
    output = Output(stdout=io.StringIO(), stderr=io.StringIO())
    if verb == "run":
        code = run.run(load_config(shipped_config("virtual")), output, assume_yes=False)
    elif verb == "sweep":
        options = SweepOptions(points=24)
        code = sweep.sweep(load_config(shipped_config("sweep_virtual")), output, tmp_path / "data.csv", options)
    else:
        code = doctor_motion.doctor_motion(load_config(shipped_config("virtual")), output, assume_yes=False)
    assert code == DECLINED == 12
    assert not list(tmp_path.glob("*.csv"))


@pytest.mark.parametrize("verb", ["run", "sweep"])
def test_a_dry_run_is_a_success(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: str) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run, "Session", Asking)
    monkeypatch.setattr(sweep, "Session", Asking)
    output = Output(stdout=io.StringIO(), stderr=io.StringIO())
    if verb == "run":
        code = run.run(load_config(shipped_config("virtual")), output, assume_yes=False, dry_run=True)
    else:
        options = SweepOptions(points=24, dry_run=True)
        code = sweep.sweep(load_config(shipped_config("sweep_virtual")), output, tmp_path / "data.csv", options)
    assert code == 0
