"""One run from the configuration to the summary: commission, let the loop go, watch it, log it, make the drive safe.

The supervisor never touches the torque.  It writes a sign of life and a stop word; everything that must happen in
time happens in the loop process.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.can.open import open_python_can
from drivers.canopen.drive import CanopenDrive
from drivers.drive import CommissioningReport
from drivers.errors import JointctlError, MotionFault
from firmware_py.states import AxisPhase, Fault, StopRequest
from tools.config import Config
from tools.config_drive import canopen_settings, cyclic_bus_load
from tools.config_records import axis_constants, trajectory_table
from tools.fault_text import FaultText, fault_text
from tools.loop_handle import LoopHandle
from tools.output import Output
from tools.run_log import RunLogWriter
from tools.run_summary import RunSummary, summarise
from tools.stop_signals import StopSignals, stop_signals

POLL_S = 0.02
INFORMATION, WARNING, ERROR = 20, 30, 40


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
    bus_load: float  # measured share, worst-case stuffing
    lost_records: int
    log_path: Path


class Supervisor:
    """Carries out one run.  `confirm(report)` is asked before anything can move; False ends the run."""

    def __init__(
        self, config: Config, output: Output, log_path: Path, confirm: Callable[[CommissioningReport], bool]
    ) -> None:
        self._config = config
        self._output = output
        self._log_path = log_path
        self._confirm = confirm
        self._phase = AxisPhase.WAITING

    def run(self) -> RunResult | None:
        """The whole run; None if the user declined.  The drive is disabled when this returns or raises."""
        config = self._config
        cyclic_bus_load(config)
        table = trajectory_table(config)
        with stop_signals() as signals, LoopHandle(config, table) as loop:
            bus = open_python_can(config.bus.interface, config.bus.channel, config.bus.bitrate_bitps)
            drive = CanopenDrive(bus, canopen_settings(config))
            try:
                report = drive.commission()
                if signals.count or not self._confirm(report):
                    return None
                loop.wait_ready(lambda: self._leave_if_asked(signals))
                return self._supervise(drive, loop, report, signals)
            finally:
                drive.make_safe()
                drive.close()

    @staticmethod
    def _leave_if_asked(signals: StopSignals) -> None:
        if signals.count:
            raise KeyboardInterrupt

    def _supervise(
        self, drive: CanopenDrive, loop: LoopHandle, report: CommissioningReport, signals: StopSignals
    ) -> RunResult:
        config = self._config
        metadata = {
            "run": {"configuration": config.text, "path": str(config.path)},
            "drive": {**vars(report.identity), "mode": report.mode, **report.settings},
        }
        chunks: list[Any] = []
        with RunLogWriter(self._log_path, metadata) as log:
            constants = axis_constants(config, start_position_rad=report.start_position_rad)
            drive.start_cyclic()
            started_ns = time.monotonic_ns()
            loop.go(constants, drive.port())
            try:
                while loop.running():
                    self._watch(loop, log, chunks, signals)
                    time.sleep(POLL_S)
            except MotionFault as error:
                log.write_event(ERROR, "supervisor", str(error))
                state = drive.make_safe()
                raise MotionFault(error.message, f"{error.hint}; drive state now: {state}") from None
            finally:
                elapsed_s = (time.monotonic_ns() - started_ns) * 1e-9
                self._take_records(loop, log, chunks)
            state = drive.make_safe()
            log.write_event(INFORMATION, "drive", f"after the run: {state}")
            return self._result(loop, chunks, signals, state, elapsed_s)

    def _take_records(self, loop: LoopHandle, log: RunLogWriter, chunks: list[Any]) -> None:
        records = loop.new_records()
        if len(records):
            chunks.append(records)
            log.write_records(records)

    def _watch(self, loop: LoopHandle, log: RunLogWriter, chunks: list[Any], signals: StopSignals) -> None:
        loop.beat()
        if signals.request is not StopRequest.NONE:
            loop.request_stop(signals.request)
        self._take_records(loop, log, chunks)
        phase = loop.phase
        if phase is not self._phase:
            self._phase = phase
            text = phase.name.lower().replace("_", " ")
            log.write_event(INFORMATION, "loop", text)
            self._output.note(f"  {text}")

    def _result(
        self, loop: LoopHandle, chunks: list[Any], signals: StopSignals, drive_state: str, elapsed_s: float
    ) -> RunResult:
        if not chunks:
            raise JointctlError("the loop ended without one cycle")
        records = np.concatenate(chunks).view(np.recarray)
        state = loop.block.state[0]
        fault = Fault(int(state.fault))
        text = None
        if fault is not Fault.NONE:
            text = fault_text(fault, float(state.fault_value), int(state.fault_drive_error))
        bits = float(loop.block.port[0].bits_sent)
        return RunResult(
            summary=summarise(records, loop.block.histograms),
            records=records,
            histograms=loop.block.histograms.copy(),
            fault=fault,
            fault_text=text,
            stopped_by=signals.name,
            drive_state=drive_state,
            bus_load=bits / (self._config.bus.bitrate_bitps * elapsed_s),
            lost_records=loop.lost_records,
            log_path=self._log_path,
        )
