"""When the bar of a sweep is drawn: not before the loop runs, or it paints over what is said until then."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jointctl.drivers.drive import CommissioningReport, DriveIdentity
from jointctl.drivers.errors import DECLINED
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import new
from jointctl.tools.configuration.load import load_config, shipped_config
from jointctl.tools.output import Advance, Output
from jointctl.tools.session.display import Snapshot
from jointctl.tools.sweeping.options import SweepOptions
from jointctl.tools.verbs import sweep as verb


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

    monkeypatch.setattr(verb, "Session", Loop)
    options = SweepOptions(points=24, assume_yes=True)
    assert verb.sweep(load_config(shipped_config("sweep_virtual")), output, tmp_path / "data.csv", options) == DECLINED
    assert seen == [[]]
    assert output.told == ["24 points", 0.0, 2.0, "end"]
