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

from jointctl.drivers.drive import Approval, CommissioningReport, Declined, Drive
from jointctl.drivers.errors import BusError, DataError, DeviceError, JointctlError, MotionFault, NoDeviceError
from jointctl.firmware_py.states import Fault, StopRequest
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.records import axis_constants, trajectory_table
from jointctl.tools.output import Output
from jointctl.tools.recording.kept_records import KeptRecords
from jointctl.tools.recording.run_log import ERROR, INFO, WARNING, RunLogWriter, run_metadata
from jointctl.tools.recording.run_summary import summarise
from jointctl.tools.running.control import Control
from jointctl.tools.running.display.display import Display
from jointctl.tools.running.display.phase_lines import PhaseLines
from jointctl.tools.running.events.held_up import held_up_text
from jointctl.tools.running.guard.guard_handle import GuardHandle, start_guard
from jointctl.tools.running.guard.kept_awake import kept_awake
from jointctl.tools.running.loop.loop_handle import LoopHandle
from jointctl.tools.running.open_drive import check_cyclic_rate, commission, drive_fault_text, open_drive
from jointctl.tools.running.permission.readiness import require_same_motion
from jointctl.tools.running.result.drive_end import warn_unless_off
from jointctl.tools.running.result.run_result import RunResult as RunResult
from jointctl.tools.running.run_watch import Around, RunParts, RunWatch
from jointctl.tools.running.stop_signals import StopSignals
from jointctl.tools.running.watch.bus_watch import bus_watch
from jointctl.tools.running.watch.frame_recorder import recording
from jointctl.tools.running.watch.temperature_watch import TemperatureWatch

POLL_S = 0.02


def came_before(fault: Fault, records: Any, time_ns: int) -> bool:
    """Whether the loop had latched its fault by then."""
    faulty = records[records.fault != Fault.NONE]
    return fault is not Fault.NONE and len(faulty) > 0 and int(faulty[0].time_ns) <= time_ns


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
        control: Control,
        *,
        approve: Approval | None = None,
        allow_low_margin: bool = False,
        display: Callable[[], Display] | None = None,
    ) -> None:
        """`approve` is asked before a drive that is found enabled is braked; None: it is left as it is."""
        self._config, self._output, self._log_path, self._confirm = config, output, log_path, confirm
        self._control, self._approve = control, approve
        self.signals = control.signals
        self._allow_low_margin = allow_low_margin
        self._make_display = display or (lambda: PhaseLines(output))
        self.drive_state = ""  # in words, after the run

    def run(self) -> RunResult | None:
        """The whole run; None if the user declined.  Afterwards the drive is off, or `drive_state` says otherwise."""
        config, signals = self._config, self.signals
        check_cyclic_rate(config)
        tail_path = self._log_path.with_suffix(".tail.mcap")
        with (
            signals.held(),
            LoopHandle(config, self._table(), tail_path, self._control.marker_fd) as loop,
            recording(config) as recorder,
            bus_watch(config) as bus_news,
            kept_awake(config, self._output),
        ):
            drive = open_drive(config, signals.leave_if_asked)
            guard: GuardHandle | None = None
            try:
                guard = start_guard(config, loop)
                try:
                    report = commission(config, drive, self._asking(self._approve))
                except Declined:
                    return None
                signals.leave_if_asked()
                if not self._ask(lambda: self._confirm(report)):
                    return None
                loop.wait_ready(signals.leave_if_asked, self._output.note)
                signals.leave_if_asked()
                if guard is not None:
                    guard.wait_ready()
                return self._supervise(drive, loop, report, Around(signals, bus_news, recorder, guard))
            except (BusError, DeviceError, NoDeviceError):
                if signals.commanded_ns:  # the frames of that stop look like another controller's
                    raise KeyboardInterrupt from None
                raise
            except OSError as error:
                raise DataError(f"{self._log_path}: cannot be written: {error.strerror or error}") from None
            finally:
                self.drive_state = drive.make_safe(asked=bool(signals.commanded_ns))
                drive.close()
                if guard is not None:
                    guard.release(self.drive_state)
                warn_unless_off(self.drive_state, self._output)

    def _ask(self, question: Callable[[], bool]) -> bool:
        """The answer of the user, whom a stop may interrupt."""
        self.signals.raising = True
        try:
            return question()
        finally:
            self.signals.raising = False

    def _asking(self, approve: Approval | None) -> Approval | None:
        return None if approve is None else lambda text: self._ask(lambda: approve(text))

    def _table(self) -> np.ndarray:
        """Rows of the motion, (N, 5); their number is fixed before the drive is known."""
        return trajectory_table(self._config)

    def _constants(self, loop: LoopHandle, report: CommissioningReport) -> Any:
        """`AxisConstants` for the joint as it was found; may still write the rows of `loop.block.table`."""
        constants = axis_constants(self._config, start_position_rad=report.start_position_rad)
        require_same_motion(self._config, loop.block.table)
        return constants

    def _metadata(self, report: CommissioningReport) -> dict[str, dict[str, str]]:
        """What the log says besides the records."""
        return run_metadata(self._config, report)

    def _make_watch(self, parts: RunParts) -> RunWatch:
        """The watch over the run that is about to begin."""
        return RunWatch(self._config, parts, allow_low_margin=self._allow_low_margin)

    def _supervise(self, drive: Drive, loop: LoopHandle, report: CommissioningReport, around: Around) -> RunResult:
        metadata = self._metadata(report)
        with (
            RunLogWriter(self._log_path, metadata) as log,
            KeptRecords(self._log_path.parent) as kept,
            self._make_display() as display,
        ):
            constants = self._constants(loop, report)
            constants[0].sequence.may_enable = 0
            with self._make_watch(RunParts(loop, around, log, kept, display, metadata)) as watch:
                return self._carry_out(drive, loop, constants, watch)

    def _carry_out(self, drive: Drive, loop: LoopHandle, constants: Any, watch: RunWatch) -> RunResult:
        signals = watch.around.signals
        loop.listen()
        signals.on_command = loop.request_stop
        if signals.commanded_ns:  # just before: the loop is told all the same, and never enables
            loop.request_stop(signals.request)
        drive.start_cyclic()
        watch.temperature = TemperatureWatch(drive.thermometer(), watch.log)
        watch.settings_guard = drive.settings_guard()
        started_ns = time.monotonic_ns()
        loop.go(constants, drive.port())
        try:
            while loop.running():
                watch.poll()
                time.sleep(POLL_S)
        except MotionFault as error:
            state = drive.make_safe()
            watch.take_records()
            watch.tell_bus_news()
            watch.log.write_event(ERROR, "supervisor", str(error))
            raise MotionFault(error.message, f"{error.hint}; drive state now: {state}") from None
        except (DeviceError, BusError) as error:  # another program has the drive, or has changed what stops it
            self._brake(loop, signals, StopRequest.QUICK_STOP)
            watch.take_records()
            # `jointctl stop` sends such frames as well
            if not signals.commanded_ns and not self._explained_by_restart(error, loop):
                watch.log.write_event(ERROR, "supervisor", str(error))
                raise MotionFault(error.message, error.hint) from None
        except BaseException:
            self._brake(loop, signals)
            raise
        elapsed_s = (time.monotonic_ns() - started_ns) * 1e-9
        watch.take_records()
        self._raise_what_others_did(watch, loop)
        state = drive.make_safe(asked=bool(signals.commanded_ns))
        watch.take_records()
        watch.tell_bus_news()  # it often explains the fault that has ended the run
        watch.log.write_event(INFO, "drive", f"after the run: {state}")
        recorder = watch.around.recorder
        if recorder is not None and recorder.dropped:
            watch.log.write_event(WARNING, "log", f"{recorder.dropped} CAN frames were not recorded: too slow")
        return self._result(watch, state, elapsed_s)

    @staticmethod
    def _explained_by_restart(error: JointctlError, loop: LoopHandle) -> bool:
        """Objects of a drive that has restarted are as they were at power-on: no other program has changed them."""
        return isinstance(error, DeviceError) and loop.verdict()[0] is Fault.DRIVE_RESTARTED

    def _raise_what_others_did(self, watch: RunWatch, loop: LoopHandle) -> None:
        """Another controller's frames since the last look end the run too, and explain a fault: `MotionFault`."""
        if watch.settings_guard is None or watch.around.signals.commanded_ns:
            return
        try:
            watch.settings_guard.poll(may_ask=False)  # an answer would come into the way of switching off
        except (DeviceError, BusError) as error:
            if self._explained_by_restart(error, loop):
                return
            watch.log.write_event(ERROR, "supervisor", str(error))
            raise MotionFault(error.message, error.hint) from None

    def _brake(self, loop: LoopHandle, signals: StopSignals, how: StopRequest = StopRequest.RAMP) -> None:
        """The supervisor cannot go on (disk full, say), but the joint moves: brake it under control, unlogged.

        The user may still ask for more than a ramp.
        """
        sequence = self._config.sequence
        loop.request_stop(how)
        give_up_s = time.monotonic() + sequence.stop_timeout_s + sequence.release_s + sequence.off_timeout_s
        with contextlib.suppress(MotionFault):
            while loop.running() and time.monotonic() < give_up_s:
                loop.request_stop(signals.request)
                loop.beat()
                time.sleep(POLL_S)

    def _result(self, watch: RunWatch, drive_state: str, elapsed_s: float) -> RunResult:
        loop = watch.loop
        if not len(watch.kept):
            raise JointctlError("the loop ended without one cycle")
        records = watch.kept.records()
        state = loop.block.state[0]
        fault, value = loop.verdict()
        if watch.around.signals.commanded_ns and not came_before(fault, records, watch.around.signals.commanded_ns):
            fault = Fault.NONE  # `jointctl stop` has switched the drive off under the loop
        text = None
        if fault is not Fault.NONE:
            errors = int(state.fault_drive_error), int(state.fault_encoder_error)
            text = drive_fault_text(self._config, fault, value, *errors)
            text = held_up_text(fault, value, text, records, self._config.loop.rate_Hz)
            text = watch.around.bus_watch.explained(fault, text, int(loop.block.port[0].last_errno))
        return RunResult(
            summary=summarise(records, loop.block.histograms, temperatures_degC=watch.temperature.values_degC),
            records=records,
            histograms=loop.block.histograms.copy(),
            fault=fault,
            fault_text=text,
            stopped_by=watch.stopped_by or ("jointctl stop" if loop.stop_requested else ""),
            drive_state=drive_state,
            bus_load=float(loop.block.port[0].bits_sent) / (self._config.bus.bitrate_bitps * elapsed_s),
            serial=self._config.is_serial,
            lost_records=loop.lost_records,
            log_path=self._log_path,
        )
