"""What a run left behind."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jointctl.drivers.drive import CommissioningReport
from jointctl.firmware_py.states import Fault
from jointctl.tools.recording.run_summary import RunSummary
from jointctl.tools.running.events.fault_text import FaultText


@dataclass(frozen=True)
class RunResult:
    """What a run left behind."""

    summary: RunSummary
    records: Any
    histograms: np.ndarray[Any, Any]
    fault: Fault
    fault_text: FaultText | None
    stopped_by: str  # name of the signal, or ""
    drive_state: str  # in words, read after the run
    bus_load: float  # measured share: CAN with worst-case stuffing, a serial line in its busier direction
    serial: bool
    lost_records: int
    log_path: Path
    report: CommissioningReport
