"""One run from the configuration to the summary: commission, let the loop go, watch it, log it, make the drive safe.

The supervisor never touches the torque.  It writes a sign of life and a stop word; everything that must happen in
time happens in the loop process.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from drivers.drive import CommissioningReport, Drive
from drivers.errors import DataError, JointctlError, MotionFault
from firmware_py.realtime import Histogram, Word
from firmware_py.states import AxisPhase, Fault, StopRequest
from tools.analysis.margin_gate import require_margin
from tools.configuration.config import Config
from tools.configuration.records import axis_constants, trajectory_table
from tools.output import Output
from tools.recording.can_log import frame_array
from tools.recording.kept_records import KeptRecords
from tools.recording.run_log import ERROR, INFO, WARNING, Event, RunLogWriter
from tools.recording.run_metadata import run_metadata
from tools.recording.run_summary import summarise
from tools.running.changes.viewer_orders import ViewerOrders
from tools.running.display.display import Display, Snapshot
from tools.running.display.phase_lines import PhaseLines
from tools.running.events.event_finder import EventFinder, phase_name
from tools.running.events.held_up import held_up_text
from tools.running.guard.guard_handle import GUARD_ENDED, GuardHandle, start_guard
from tools.running.guard.kept_awake import kept_awake
from tools.running.loop.loop_handle import LoopHandle
from tools.running.loop.shared_block import SERIAL
from tools.running.open_drive import check_cyclic_rate, commission, drive_fault_text, loop_delay_s, open_drive
from tools.running.permission.readiness import require_same_motion
from tools.running.result.drive_end import warn_unless_off
from tools.running.result.run_result import RunResult as RunResult
from tools.running.stop_signals import StopSignals, stop_signals
from tools.running.watch.bus_watch import BusWatch, bus_watch
from tools.running.watch.frame_recorder import FrameRecorder, recording
from tools.running.watch.temperature_watch import TemperatureWatch

POLL_S = 0.02
DELAY_CYCLES = 300  # how many cycles with the drive off the loop delay is measured over


class Supervisor:
    """Carries out one run.  `confirm(report)` is asked before anything can move; False ends the run.

    `display` makes what shows the run while it goes on; by default a line for each phase.
    """

    def __init__(
        self,
        config: Config,
        output: Output,
        log_path: Path,
        confirm: Callable[[CommissioningReport], bool],
        *,
        allow_low_margin: bool = False,
        display: Callable[[], Display] | None = None,
    ) -> None:
        self._config, self._output, self._log_path, self._confirm = config, output, log_path, confirm
        self._allow_low_margin = allow_low_margin
        self._phase, self._asked = AxisPhase.WAITING, StopRequest.NONE
        self._delay_s: float | None = None
        self._make_display = display or (lambda: PhaseLines(output))
        self._display: Display = PhaseLines(output)
        self._recorder: FrameRecorder | None = None
        self._bus_watch = BusWatch(config, None)
        self._events = EventFinder()
        self._temperature = TemperatureWatch()
        self.signals = StopSignals()  # that came during the run
        self._stopped_by_viewer = ""
        self.drive_state = ""  # in words, after the run
        self._guard: GuardHandle | None = None
        self._orders: ViewerOrders | None = None  # what viewers may change, while the loop runs

    def run(self) -> RunResult | None:
        """The whole run; None if the user declined.  Afterwards the drive is off, or `drive_state` says otherwise."""
        config = self._config
        check_cyclic_rate(config)
        tail_path = self._log_path.with_suffix(".tail.mcap")
        with (
            stop_signals() as self.signals,
            LoopHandle(config, self._table(), tail_path) as loop,
            recording(config) as self._recorder,
            bus_watch(config) as self._bus_watch,
            kept_awake(config, self._output),
        ):
            signals, drive = self.signals, open_drive(config)
            try:
                self._guard = start_guard(config, loop)
                report = commission(config, drive)
                self._leave_if_asked(signals)
                signals.raising = True
                confirmed = self._confirm(report)
                signals.raising = False
                if not confirmed:
                    return None
                loop.wait_ready(lambda: self._leave_if_asked(signals), self._output.note)
                self._leave_if_asked(signals)
                if self._guard is not None:
                    self._guard.wait_ready()
                return self._supervise(drive, loop, report, signals)
            except OSError as error:
                raise DataError(f"{self._log_path}: cannot be written: {error.strerror or error}") from None
            finally:
                signals.raising = False
                self.drive_state = drive.make_safe()
                drive.close()
                if self._guard is not None:
                    self._guard.release(self.drive_state)
                warn_unless_off(self.drive_state, self._output)

    def _table(self) -> np.ndarray:
        """Rows of the motion, (N, 5); their number is fixed before the drive is known."""
        return trajectory_table(self._config)

    def _constants(self, loop: LoopHandle, report: CommissioningReport) -> Any:
        """`AxisConstants` for the joint as it was found; may still write the rows of `loop.block.table`."""
        constants = axis_constants(self._config, start_position_rad=report.start_position_rad)
        require_same_motion(self._config, loop.block.table)
        return constants

    @staticmethod
    def _leave_if_asked(signals: StopSignals) -> None:
        if signals.count:
            raise KeyboardInterrupt

    def _supervise(
        self, drive: Drive, loop: LoopHandle, report: CommissioningReport, signals: StopSignals
    ) -> RunResult:
        self._events = self._event_finder(loop)
        metadata = run_metadata(self._config, report)
        with (
            RunLogWriter(self._log_path, metadata) as log,
            KeptRecords(self._log_path.parent) as kept,
            self._make_display() as self._display,
            self._viewer_orders(loop, log, metadata) as self._orders,
        ):
            constants = self._constants(loop, report)
            constants[0].sequence.may_enable = 0
            loop.listen()
            drive.start_cyclic()
            self._temperature = TemperatureWatch(drive.thermometer(), log)
            started_ns = time.monotonic_ns()
            loop.go(constants, drive.port())
            try:
                while loop.running():
                    self._watch(loop, log, kept, signals)
                    time.sleep(POLL_S)
            except MotionFault as error:
                state = drive.make_safe()
                self._take_records(loop, log, kept)
                log.write_event(ERROR, "supervisor", str(error))
                raise MotionFault(error.message, f"{error.hint}; drive state now: {state}") from None
            except BaseException:
                self._brake(loop, signals)
                raise
            elapsed_s = (time.monotonic_ns() - started_ns) * 1e-9
            state = drive.make_safe()
            self._take_records(loop, log, kept)
            log.write_event(INFO, "drive", f"after the run: {state}")
            if self._recorder is not None and self._recorder.dropped:
                log.write_event(WARNING, "log", f"{self._recorder.dropped} CAN frames were not recorded: too slow")
            return self._result(loop, kept, signals, state, elapsed_s)

    def _viewer_orders(self, loop: LoopHandle, log: RunLogWriter, metadata: Any) -> ViewerOrders:
        def tell(level: int, text: str) -> None:
            self._tell(log, Event(time.monotonic_ns(), level, "scope", text))

        allow = self._allow_low_margin
        return ViewerOrders(
            self._config, loop.block, self._log_path, metadata, tell, lambda: self._delay_s, allow_low_margin=allow
        )

    def _tell(self, log: RunLogWriter, event: Event) -> None:
        log.write_event(event.level, event.source, event.text, event.time_ns)
        self._display.event(event)
        if self._orders is not None:
            self._orders.keep_event(event)

    def _event_finder(self, loop: LoopHandle) -> EventFinder:
        """Events in the words that fit the drive; a fault with the value that the loop has latched."""

        def fault_words(fault: Fault, drive_error: int) -> str:
            state = loop.block.state[0]
            value, encoder_error = float(state.fault_value), int(state.fault_encoder_error)
            return drive_fault_text(self._config, fault, value, drive_error, encoder_error).happened

        return EventFinder(cia402=self._config.bus.interface != SERIAL, fault_words=fault_words)

    def _check_delay(self, loop: LoopHandle, log: RunLogWriter) -> None:
        """Once enough cycles have run with the drive off: refuse the gains, or let the loop enable."""
        config = self._config
        if self._delay_s is not None or loop.cycles < min(DELAY_CYCLES, config.loop.rate_Hz):
            return
        if not loop.block.histograms[Histogram.ROUND_TRIP].any():
            return  # nothing has been heard: the loop ends that itself, and tells it
        self._delay_s = loop_delay_s(config, loop.block.histograms)
        found = require_margin(config, self._delay_s, allow_low_margin=self._allow_low_margin)
        text = f"loop delay {self._delay_s * 1e3:.2f} ms measured, phase margin {found.phase_margin_deg:.0f} deg"
        log.write_event(INFO, "supervisor", text)
        self._display.note(text)
        loop.allow_enable()

    def _brake(self, loop: LoopHandle, signals: StopSignals) -> None:
        """The supervisor cannot go on (disk full, say), but the joint moves: brake it under control, unlogged.

        The user may still ask for more than a ramp.
        """
        sequence = self._config.sequence
        loop.request_stop(StopRequest.RAMP)
        give_up_s = time.monotonic() + sequence.stop_timeout_s + sequence.release_s + sequence.off_timeout_s
        with contextlib.suppress(MotionFault):
            while loop.running() and time.monotonic() < give_up_s:
                loop.request_stop(signals.request)
                loop.beat()
                time.sleep(POLL_S)

    def _take_records(self, loop: LoopHandle, log: RunLogWriter, kept: KeptRecords) -> None:
        if self._recorder is not None and (frames := self._recorder.new_frames()):
            log.write_frames(frame_array(frames))
        if not len(records := loop.new_records()):
            return
        self._keep(records, log, kept)
        if self._orders is not None:
            self._orders.keep(records)
        for event in self._events.take(records):
            self._tell(log, event)
        skipped, histograms = int(loop.block.words[Word.SKIPPED]), loop.block.histograms
        duration_s = float(loop.block.constants[0].trajectory.duration_s)  # a viewer may have changed the motion
        cia402 = self._config.bus.interface != SERIAL
        degC = self._temperature.newest_degC
        self._display.show(Snapshot(records[-1], skipped, histograms, duration_s, cia402, records, degC))

    def _keep(self, records: Any, log: RunLogWriter, kept: KeptRecords) -> None:
        """What becomes of new records: the log, and `kept` for the summary at the end."""
        kept.append(records)
        log.write_records(records)

    def _watch(self, loop: LoopHandle, log: RunLogWriter, kept: KeptRecords, signals: StopSignals) -> None:
        loop.beat()
        request = max(signals.request, self._display.stop_request())
        if request is not StopRequest.NONE:
            loop.request_stop(request)
        self._take_records(loop, log, kept)
        if request is not self._asked:
            self._asked = request
            if not signals.name:
                self._stopped_by_viewer = self._display.stop_reason()
            who = signals.name or self._stopped_by_viewer
            text = f"{request.name.lower().replace('_', ' ')} asked for by {who}"
            self._tell(log, Event(time.monotonic_ns(), WARNING, "supervisor", text))
        self._check_delay(loop, log)
        self._temperature.poll()
        for text in self._bus_watch.news():
            log.write_event(WARNING, "bus", text)
            self._display.note(text)
        if self._guard is not None and self._guard.just_ended():
            log.write_event(WARNING, "supervisor", GUARD_ENDED)
            self._display.note(GUARD_ENDED)
        if self._orders is not None:
            self._orders.serve(self._display)
        if (phase := loop.phase) is not self._phase:
            self._phase = phase
            self._display.phase(phase_name(phase))

    def _result(
        self, loop: LoopHandle, kept: KeptRecords, signals: StopSignals, drive_state: str, elapsed_s: float
    ) -> RunResult:
        if not len(kept):
            raise JointctlError("the loop ended without one cycle")
        records = kept.records()
        state = loop.block.state[0]
        fault, value = loop.verdict()
        text = None
        if fault is not Fault.NONE:
            errors = int(state.fault_drive_error), int(state.fault_encoder_error)
            text = drive_fault_text(self._config, fault, value, *errors)
            text = held_up_text(fault, value, text, records, self._config.loop.rate_Hz)
            text = self._bus_watch.explained(fault, text, int(loop.block.port[0].last_errno))
        return RunResult(
            summary=summarise(records, loop.block.histograms, temperatures_degC=self._temperature.values_degC),
            records=records,
            histograms=loop.block.histograms.copy(),
            fault=fault,
            fault_text=text,
            stopped_by=signals.name or self._stopped_by_viewer or ("jointctl stop" if loop.stop_requested else ""),
            drive_state=drive_state,
            bus_load=float(loop.block.port[0].bits_sent) / (self._config.bus.bitrate_bitps * elapsed_s),
            serial=self._config.bus.interface == SERIAL,
            lost_records=loop.lost_records,
            log_path=self._log_path,
        )
