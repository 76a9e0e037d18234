"""One run from the configuration to the summary: commission, let the loop go, watch it, log it, make the drive safe.

The session supervises: it never touches the torque.  It writes a sign of life and a stop word; everything that must
happen in time happens in the loop process.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from jointctl.drivers.can.socketcan import interface_blamed
from jointctl.drivers.drive import Approval, CommissioningReport, Declined, DriveGroup, common_state, is_safe
from jointctl.drivers.errors import (
    BusError,
    DataError,
    DeviceError,
    JointctlError,
    MotionFault,
    NoDeviceError,
    blamed,
    refused_by_system,
)
from jointctl.firmware_py.cycle import Histogram
from jointctl.firmware_py.states import Fault, StopRequest
from jointctl.tools.child_process import OwnVirtualJoint
from jointctl.tools.configuration.config import Config, first_on_bus
from jointctl.tools.output import Output
from jointctl.tools.recording.ros_messages import JOINT_NAMES
from jointctl.tools.recording.run_log import ERROR, INFO, THINNING, WARNING, RunLogWriter, run_metadata
from jointctl.tools.recording.run_summary import KeptRecords, histogram_times, summarise
from jointctl.tools.session.control import Control, stop_has_come
from jointctl.tools.session.display import Display, JointDisplay, PhaseLines, ViewerRequest
from jointctl.tools.session.fault_words import held_up_text, read_off_text
from jointctl.tools.session.loop_handle import LoopHandle
from jointctl.tools.session.loops import loop_of
from jointctl.tools.session.plan import Consent, JointPlan, Placed, RunPlan, prepare_log, require_ready
from jointctl.tools.session.result import RunResult, warn_unless_off
from jointctl.tools.session.run_watch import (
    Around,
    BusWatch,
    FrameRecorder,
    RunParts,
    RunWatch,
    TemperatureWatch,
    bus_watch,
    recording,
)
from jointctl.tools.session.session_drive import Guard, session_drive
from jointctl.tools.session.set_points import SetPointSources

POLL_S = 0.02
NOTED_WITHIN_NS = 250_000_000  # from the request of `jointctl stop` until the program has taken note of it, at most
# How a loop reports a drive that `jointctl stop` has switched off under it; no other fault is that command's doing.
OF_A_SWITCHED_OFF_DRIVE = {Fault.DRIVE_NOT_ENABLED, Fault.DRIVE_FAULT, Fault.ENABLE_TIMEOUT, Fault.STALE_SAMPLE,
                           Fault.NO_SAMPLES, Fault.SAMPLES_MISSING}  # fmt: skip
SYNC_SPREAD_us = 100.0  # of the buses of an arm: what is longer is a warning
Answer = TypeVar("Answer")


def came_before(fault: Fault, records: np.recarray, time_ns: int) -> bool:
    """Whether the loop had latched its fault by then, and not by what `jointctl stop` did to the drive.

    Its request is sent first, but a program that is busy may take note of it after the drive has been stopped.
    """
    faulty = records[records.fault != Fault.NONE]
    busy_ns = NOTED_WITHIN_NS if fault in OF_A_SWITCHED_OFF_DRIVE else 0
    return fault is not Fault.NONE and len(faulty) > 0 and int(faulty[0].time_ns) <= time_ns - busy_ns


class Session:
    """Carries out one plan: run, sweep, motion check and live page differ in plan, consent and display only.

    `consent` has the last word before anything moves.  `display` makes what shows the run, once the joint is known;
    by default a line for each phase.  `set_points`: sources in processes of their own.
    """

    def __init__(
        self,
        plan: RunPlan,
        consent: Consent,
        output: Output,
        control: Control,
        display: Callable[[CommissioningReport], Display] | None = None,
        set_points: SetPointSources | None = None,
    ) -> None:
        self.plan, self._config, self._set_points = plan, plan.config, set_points
        self._consent, self._output, self._control = consent, output, control
        self.signals = control.signals
        self._make_display = display or (lambda _: PhaseLines(output))
        self._joints = plan.joints
        self._kind = session_drive(plan.config.drive.kind)
        self.drive_state = ""  # in words, after the run
        self.loop: LoopHandle | None = None  # once it has been started
        self.own: OwnVirtualJoint | None = None  # which may still be starting, on a bus of this program alone

    def run(self) -> RunResult | None:
        """The whole run; None if it was declined.  Afterwards the drive is off, or `drive_state` says otherwise."""
        try:
            return self._run()
        except OSError as error:  # what writes a file, and what uses a bus, has an error of its own
            raise refused_by_system(error) from error

    def _run(self) -> RunResult | None:
        config, signals = self._config, self.signals
        self._kind.check_rate(config)
        with (
            signals.held(),
            self._loop() as loop,
            self._bus_there(loop),
            self._buses() as looking_on,
            self._kind.kept_awake(self._output),
        ):
            self.loop = loop
            drives = self._opened()
            guard: Guard | None = None
            try:
                guard = self._kind.guard(config, loop)
                if self.own is not None:  # its drive starts beside the loop and the listening
                    self.own.until_ready(signals.leave_if_asked)
                try:
                    reports = self.commissioned(config, drives, self._may_brake())
                except Declined:
                    return None
                signals.require_same([report.identity for report in reports])
                signals.leave_if_asked()
                placed = self._ask(lambda: self._possible(reports))
                if placed is None:
                    return None
                loop.wait_ready(signals.leave_if_asked, self._output.note)
                if guard is not None:
                    guard.wait_ready()
                if not self._ask(lambda: self._agreed(placed)):
                    return None
                signals.leave_if_asked()
                around = {axis: Around(signals, *watchers, guard) for axis, watchers in looking_on.items()}
                return self._supervise(drives, loop, reports, placed, around)
            except (BusError, DeviceError, NoDeviceError):
                if signals.commanded_ns:  # the frames of that stop look like another controller's
                    raise KeyboardInterrupt from None
                raise
            finally:
                self.drive_state = self._common(self._made_safe(drives))
                drives.close()
                if guard is not None:
                    guard.release(self.drive_state)
                warn_unless_off(self.drive_state, self._output)

    def _loop(self) -> LoopHandle:
        """The loop process, started; it waits for its word."""
        plan, port, marker_fds = self.plan, loop_of(self._config.drive.kind)[0], self._control.marker_fds
        model = None if plan.arm is None else plan.arm.config.model
        tails = [joint.log_path.with_suffix(".tail.mcap") for joint in self._joints]
        return LoopHandle(self._config, plan.tables, port, tails, marker_fds, model, plan.configs)

    @contextlib.contextmanager
    def _bus_there(self, loop: LoopHandle) -> Iterator[None]:
        if self.own is not None:  # what compiles the loop is there long before the bus is
            self.own.until_bus(self.signals.leave_if_asked)
            self._control.bus_is_there()
        loop.bus_is_there()
        yield

    @contextlib.contextmanager
    def _buses(self) -> Iterator[dict[int, tuple[BusWatch, FrameRecorder | None]]]:
        """Who looks on at each bus, by the number of the first joint on it."""
        with contextlib.ExitStack() as stack:
            found: dict[int, tuple[BusWatch, FrameRecorder | None]] = {}
            for axis in sorted(set(first_on_bus(self.plan.configs))):
                config = self._joints[axis].config
                recorder = stack.enter_context(recording(config))
                found[axis] = stack.enter_context(bus_watch(config)), recorder
            yield found

    def _opened(self) -> DriveGroup:
        """The drives of all joints, nothing sent to them yet."""
        return self._kind.open_all(self.plan.configs, self.signals.leave_if_asked, self.own is not None)

    def _made_safe(self, drives: DriveGroup) -> list[str]:
        """The state of each drive, in words."""
        return drives.make_safe(asked=bool(self.signals.commanded_ns))

    def _common(self, states: Sequence[str]) -> str:
        return common_state([joint.name for joint in self._joints], states)

    def _ask(self, question: Callable[[], Answer]) -> Answer:
        """The answer of the user, whom a stop may interrupt."""
        self.signals.raising = True
        try:
            return question()
        finally:
            self.signals.raising = False

    @staticmethod
    def commissioned(config: Config, drives: DriveGroup, approve: Approval | None) -> list[CommissioningReport]:
        """`DriveGroup.commission`; a failure also names what is wrong with the interface, if something is."""
        with interface_blamed(config.bus.interface, config.bus.channel, config.bus.bitrate_bitps):
            return drives.commission(approve)

    def _may_brake(self) -> Approval | None:
        brake = self._consent.brake
        return None if brake is None else lambda text: self._ask(lambda: brake(text))

    def _possible(self, reports: Sequence[CommissioningReport]) -> Placed | None:
        """The motion from where the joint stands, shown and possible; None if it is only shown.

        Of an arm those of all joints: one that cannot begin keeps all of them from it.
        """
        plan = self.plan
        placed = plan.placed(reports)
        if self._set_points is not None:
            placed = self._set_points.announced(placed, self._config)
        self._consent.show(placed.lines)
        if self._consent.dry_run:
            return None
        for joint, report in zip(self._joints, reports, strict=True):
            with blamed(joint.name):
                require_ready(joint.config, report, joint.log_path)
                joint.motion.require_start(report.start_position_rad)
        return placed

    def _agreed(self, placed: Placed) -> bool:
        """Asked once all is ready: a loop may compile for minutes, and would move the joint long after the yes."""
        if not self._consent.agreed(placed.lines):
            return False
        self.signals.agreed()
        for joint in self._joints:
            prepare_log(joint.config, joint.log_path, self._output)
        return True

    def _metadata(self, joint: JointPlan, report: CommissioningReport) -> dict[str, dict[str, str]]:
        """Of the log of a joint."""
        plan, metadata = self.plan, run_metadata(joint.config, report)
        if plan.arm is not None:  # its [motion] is what the joint does, not the joint's own [trajectory]
            arm = plan.arm.config
            metadata["arm"] = {"configuration": arm.text, "path": str(arm.path), "joint": joint.name}
        if plan.log_every > 1:
            metadata[THINNING] = {"every": str(plan.log_every), "whole_s": f"{plan.log_full_rate_s:g}"}
        return metadata

    def _supervise(
        self, drives: DriveGroup, loop: LoopHandle, reports: Sequence[CommissioningReport], placed: Placed,
        around: Mapping[int, Around],
    ) -> RunResult:  # fmt: skip
        plan = self.plan
        if plan.arm is None:
            loop.block.table[:] = placed.table
        placed.constants.sequence.may_enable[:] = 0
        result: RunResult | None = None
        try:
            with contextlib.ExitStack() as stack:
                display = stack.enter_context(self._make_display(reports[0]))
                watches: list[RunWatch] = []
                orders: list[ViewerRequest] = []
                for axis, (joint, report) in enumerate(zip(self._joints, reports, strict=True)):
                    metadata = self._metadata(joint, report)
                    names = (plan.names if axis == 0 else (joint.name,)) if joint.name else JOINT_NAMES
                    log = stack.enter_context(RunLogWriter(joint.log_path, metadata, names))
                    kept = stack.enter_context(KeptRecords(joint.log_path.parent))
                    shown: Display = JointDisplay(display, joint.name, orders, axis) if joint.name else display
                    # frames and troubles of a bus belong to no joint: they are in the log of the first one on it
                    no_bus = replace(around[0], bus_watch=BusWatch(joint.config, None), recorder=None)
                    own = around.get(axis, no_bus)
                    points, together = (self._set_points, None) if axis == 0 else (None, watches[0].log)
                    parts = RunParts(loop.of_axis(axis), own, log, kept, shown, metadata, points, together)
                    watches.append(stack.enter_context(RunWatch(plan, placed.constants[axis], parts, joint)))
                result = self._carry_out(drives, loop, placed.constants, reports, watches)
        except DataError as error:
            if result is None:
                raise
            self._output.warning(f"{error.message}: this log is lost")
            result = replace(result, log_lost=True)
        assert result is not None
        return result

    def _carry_out(
        self, drives: DriveGroup, loop: LoopHandle, constants: np.recarray, reports: Sequence[CommissioningReport],
        watches: Sequence[RunWatch],
    ) -> RunResult:  # fmt: skip
        """Start, motion and end of the loop; then the drives are switched off, and the logs say how it went."""
        started_ns = self._start(drives, loop, constants, watches)
        self._poll_until_ended(drives, loop, watches)
        elapsed_s = (time.monotonic_ns() - started_ns) * 1e-9
        for each in watches:
            each.take_records(last=True)
            each.tell_stop(each.around.signals.request)
        for each in watches:
            with blamed(each.joint.name):
                self._raise_what_others_did(each, loop)
        states = self._made_safe(drives)
        self._log_after_run(loop, watches, self._common(states))
        loads = [
            self._kind.bits_sent(loop.block.port, axis) / (joint.config.bus.bitrate_bitps * elapsed_s)
            for axis, joint in enumerate(self._joints)
        ]
        results = [
            self._result(each, report, self._common(states), load, own)
            for each, report, load, own in zip(watches, reports, loads, states, strict=True)
        ]
        return replace(results[0], others=tuple(results[1:]))

    @staticmethod
    def _start(drives: DriveGroup, loop: LoopHandle, constants: np.recarray, watches: Sequence[RunWatch]) -> int:
        """The loop begins, and from here on a stop reaches it; when that was, in ns of the monotonic clock."""
        signals = watches[0].around.signals
        loop.listen()
        signals.on_command = loop.request_stop
        if signals.commanded_ns:  # just before: the loop gets it all the same, and never enables
            loop.request_stop(signals.request)
        drives.start_cyclic()
        for drive, each in zip(drives.drives, watches, strict=True):
            each.temperature = TemperatureWatch(drive.thermometer(), each.log, each.loop.block.constants[0].law)
            each.settings_guard = drive.settings_guard()
        signals.begin()
        started_ns = time.monotonic_ns()
        loop.go(constants, drives.port())
        return started_ns

    def _poll_until_ended(self, drives: DriveGroup, loop: LoopHandle, watches: Sequence[RunWatch]) -> None:
        """Look after the loop while it runs; where that fails, the joint is braked before the error goes on."""
        watch = watches[0]
        try:
            while loop.running():
                for each in watches:
                    with blamed(each.joint.name):
                        each.poll()
                time.sleep(POLL_S)
        except MotionFault as error:
            state = self._common(self._made_safe(drives))
            self._log_end(watches, error)
            raise MotionFault(error.message, f"{error.hint}; drive state now: {state}") from None
        except (DeviceError, BusError) as error:  # another program has the drive, or has changed what stops it
            self._brake(loop, watch, StopRequest.QUICK_STOP)
            stopped = stop_has_come(watch.around.signals, self.plan.configs)
            if not stopped and not self._explained_by_restart(error, loop):
                self._log_end(watches, error)
                raise MotionFault(error.message, error.hint) from None
        except BaseException as error:
            self._brake(loop, watch)
            if isinstance(error, DataError):  # a disk that is full, say
                error.message += "; the motion was ended for it"
            raise

    @staticmethod
    def _log_after_run(loop: LoopHandle, watches: Sequence[RunWatch], state: str) -> None:
        """The last records and frames, and what a run tells of its buses when it is over."""
        watch = watches[0]
        for each in watches:
            if each.around.recorder is not None:
                each.around.recorder.end()
        for each in watches:
            each.take_records(last=True)
            each.tell_bus_news()  # it often explains the fault that has ended the run
        watch.log.write_event(INFO, "drive", f"after the run: {state}")
        for each in watches:
            if each.around.recorder is not None and each.around.recorder.dropped:
                dropped = each.around.recorder.dropped
                each.log.write_event(WARNING, "log", f"{dropped} CAN frames were not recorded: too slow")
        if (spread := histogram_times(loop.block.histograms[Histogram.SYNC_SPREAD])) is not None:  # several buses
            watch.log.write_event(
                INFO if spread.max_us <= SYNC_SPREAD_us else WARNING, "bus",
                f"SYNC of all buses within {spread.p99_us:.0f} us in 99 % of the cycles, "
                f"{spread.max_us:.0f} us at most",
            )  # fmt: skip

    @staticmethod
    def _log_end(watches: Sequence[RunWatch], error: JointctlError) -> None:
        """What has ended the run, in the logs; it is shown all the same where they cannot be written."""
        with contextlib.suppress(DataError):
            for each in watches:
                each.take_records(last=True)
            for each in watches:
                each.tell_bus_news()
            watches[0].log.write_event(ERROR, "supervisor", str(error))

    @staticmethod
    def _explained_by_restart(error: JointctlError, loop: LoopHandle) -> bool:
        """Objects of a drive that has restarted are as they were at power-on: no other program has changed them."""
        verdicts = [loop.of_axis(axis).verdict()[0] for axis in range(loop.block.axes)]
        return isinstance(error, DeviceError) and Fault.DRIVE_RESTARTED in verdicts

    def _raise_what_others_did(self, watch: RunWatch, loop: LoopHandle) -> None:
        """Another controller's frames since the last look end the run too, and explain a fault: `MotionFault`."""
        signals = watch.around.signals
        if signals.commanded_ns:
            return
        try:
            watch.guard_settings(may_ask=False)  # an answer would come into the way of switching off
        except (DeviceError, BusError) as error:
            if stop_has_come(signals, self.plan.configs) or self._explained_by_restart(error, loop):
                return
            watch.log.write_event(ERROR, "supervisor", str(error))
            raise MotionFault(error.message, error.hint) from None

    def _brake(self, loop: LoopHandle, watch: RunWatch, how: StopRequest = StopRequest.RAMP) -> None:
        """The supervisor cannot go on (disk full, say), but the joint moves: brake it under control, unlogged.

        The user may still ask for more than a ramp, at the page, by Foxglove and ROS 2 as well.  The joints of an arm
        wait for the slowest one.
        """
        times_s = [(s.stop_timeout_s, s.release_s, s.off_timeout_s) for s in (c.sequence for c in self.plan.configs)]
        loop.request_stop(how)
        give_up_s = time.monotonic() + sum(map(max, zip(*times_s, strict=True)))
        with contextlib.suppress(MotionFault):
            while loop.running() and time.monotonic() < give_up_s:
                loop.request_stop(watch.around.signals.request)
                with contextlib.suppress(Exception):  # of a display that cannot go on either
                    loop.request_stop(watch.display.stop_request())
                loop.beat()
                time.sleep(POLL_S)

    def _result(
        self, watch: RunWatch, report: CommissioningReport, drive_state: str, bus_load: float, own_state: str
    ) -> RunResult:
        """`drive_state`: of all joints, `own_state`: of this one."""
        loop, config = watch.loop, watch.config
        if not len(watch.kept):
            raise JointctlError("the loop ended without one cycle")
        log_path = watch.joint.log_path
        if log_lost := not watch.log.is_in_place():
            self._output.warning(f"{log_path}: was removed or renamed during the run: this log is lost")
        records = watch.kept.records()
        state = loop.block.state[0]
        fault, value = loop.verdict()
        if watch.around.signals.commanded_ns and not came_before(fault, records, watch.around.signals.commanded_ns):
            fault = Fault.NONE  # `jointctl stop` has switched the drive off under the loop
        text = None
        if fault is not Fault.NONE:
            errors = int(state.fault_drive_error), int(state.fault_encoder_error)
            text = self._kind.fault_text(config, fault, value, *errors)
            text = held_up_text(fault, value, text, records, config.loop.rate_Hz)
            if fault is Fault.OFF_TIMEOUT and is_safe(own_state):
                text = read_off_text(text, own_state)
            text = watch.mode_explained(fault, text) if is_safe(drive_state) else text
            text = watch.around.bus_watch.explained(fault, text, int(loop.block.port[0].last_errno))
        summary = summarise(records, loop.block.histograms, temperatures_degC=watch.temperature.values_degC)
        return RunResult(
            summary=replace(summary, fault=fault.name),
            records=records,
            histograms=loop.block.histograms.copy(),
            fault=fault,
            fault_text=text,
            stopped_by=watch.stopped_by or ("jointctl stop" if loop.stop_requested else ""),
            drive_state=drive_state,
            bus_load=bus_load,
            load_row=self._kind.load_row(bus_load),
            lost_records=loop.lost_records,
            log_path=log_path,
            log_lost=log_lost,
            report=report,
            name=watch.joint.name,
            fault_slot_ns=int(state.fault_slot_ns),
            fault_value=float(state.fault_value),
        )
