"""What the supervisor does 50 times a second while the loop runs: sign of life, stop, records, events, what is watched.

Everything new goes into the log and to the display here; what opens, lets go and makes safe is the supervisor's.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from jointctl.drivers.drive import SettingsGuard
from jointctl.firmware_py.cycle import Histogram, Word
from jointctl.firmware_py.states import AxisPhase, CommandKind, Fault, StopRequest, in_words
from jointctl.tools.analysis.margin_gate import cascade_text, require_margin
from jointctl.tools.recording.ros_messages import frame_array
from jointctl.tools.recording.run_log import ERROR, INFO, WARNING, Event, RunLogWriter, ThinnedRecords
from jointctl.tools.recording.run_summary import KeptRecords
from jointctl.tools.session.bus_watch import BusWatch, FrameRecorder, TemperatureWatch
from jointctl.tools.session.control import StopSignals
from jointctl.tools.session.display import Display, EventFinder, Snapshot, phase_name
from jointctl.tools.session.fault_words import NoticeFinder
from jointctl.tools.session.live_changes import LiveChanges, ViewerOrders
from jointctl.tools.session.loop_handle import LoopHandle
from jointctl.tools.session.plan import JointPlan, RunPlan
from jointctl.tools.session.session_drive import Guard, session_drive
from jointctl.tools.session.set_points import SetPointSources

GUARD_ENDED = "the guard of the line has ended: nobody switches the drive off if this program and the loop both die"
DELAY_CYCLES = 300  # how many cycles with the drive off the loop delay is measured over


@dataclass(frozen=True)
class Around:
    """Who else has a part in the run, opened before the loop and closed after it."""

    signals: StopSignals
    bus_watch: BusWatch
    recorder: FrameRecorder | None = None
    guard: Guard | None = None


@dataclass(frozen=True)
class RunParts:
    """What a watch looks at and where it writes; `metadata` is that of the log, for recordings of a stretch."""

    loop: LoopHandle
    around: Around
    log: RunLogWriter
    kept: KeptRecords
    display: Display
    metadata: Mapping[str, Mapping[str, str]]
    set_points: SetPointSources | None = None
    arm_log: RunLogWriter | None = None  # of the first joint of an arm, with the states of all; None there


class RunWatch:
    """Watches one joint of a run, the only one mostly; `poll` it."""

    def __init__(self, plan: RunPlan, axis: Any, parts: RunParts, joint: JointPlan | None = None) -> None:
        """`axis`: the `AxisConstants` that the loop is about to get; `joint`: of an arm, the one to watch."""
        self.joint = joint = joint or plan.joints[0]
        config = joint.config
        self.config, self.loop, self.around = config, parts.loop, parts.around
        self.log, self.kept, self.display = parts.log, parts.kept, parts.display
        self._arm_log, self._names = parts.arm_log, plan.names
        self._set_points = parts.set_points or SetPointSources("the program")  # none from elsewhere
        self.temperature = TemperatureWatch()  # until the drive's own thermometer is known
        self.settings_guard: SettingsGuard | None = None
        self._allowed = False  # whether the loop may enable
        self.delay_s: float | None = None  # of the loop, once it is measured
        self._drive = session_drive(config.drive.kind)
        self._stopped_by_viewer = ""
        self._allow_low_margin = plan.allow_low_margin
        by_velocity = axis.command_kind == CommandKind.VELOCITY
        self._drives_loop_ps = float(axis.velocity_command.position_gain_ps) if by_velocity else None
        self._decimated = ThinnedRecords(plan.log_every, round(plan.log_full_rate_s * config.loop.rate_Hz))
        self._phase, self._asked = AxisPhase.WAITING, StopRequest.NONE
        self._events = EventFinder(self._drive, self._fault_words)
        self._notices = NoticeFinder()
        changes = LiveChanges(
            config, self.loop.block, self._tell_scope, lambda: self.delay_s, allow_low_margin=plan.allow_low_margin
        )
        self._orders = ViewerOrders(changes, self.log.path, parts.metadata)

    def __enter__(self) -> Self:
        self._set_points.begin(self.loop.block.whole, self._names)
        return self

    def __exit__(self, *exception: object) -> None:
        """Viewers can change nothing any more; a recording of theirs ends.  The log gets what is held back of it."""
        self._set_points.end()
        self._orders.__exit__(*exception)
        with contextlib.suppress(OSError):  # a full disk may be why this ends
            self._keep(self._decimated.last())

    @property
    def stopped_by(self) -> str:
        """Name of the signal, or of the viewer, that asked for the end of the run; "" if nobody did."""
        return self.around.signals.name or self._stopped_by_viewer

    def poll(self) -> None:
        """One look at everything; an exception ends the run."""
        self.loop.beat()
        request = max(self.around.signals.request, self.display.stop_request())
        if request is not StopRequest.NONE:
            self.loop.request_stop(request)
        self.take_records()
        if request is not self._asked:
            self._asked = request
            if not self.around.signals.name:
                self._stopped_by_viewer = self.display.stop_reason()
            text = f"{in_words(request)} asked for by {self.stopped_by}"
            self._tell(Event(time.monotonic_ns(), WARNING, "supervisor", text))
        self._guard_settings()
        self.check_delay()
        self._may_enable()
        self.temperature.poll()
        self.tell_bus_news()
        if self.around.guard is not None and self.around.guard.just_ended():
            self.log.write_event(WARNING, "supervisor", GUARD_ENDED)
            self.display.note(GUARD_ENDED)
        self._orders.serve(self.display)
        for level, text in self._set_points.poll():
            self._tell_scope(level, text)
        if (phase := self.loop.phase) is not self._phase:
            self._phase = phase
            self.display.phase(phase_name(phase))

    def _guard_settings(self) -> None:
        """`DeviceError` or `BusError` where what stops the drive without us has been changed, or someone else commands.

        Its reads would lengthen the delay that is measured.
        """
        if self.settings_guard is None:
            return
        for text in self.settings_guard.poll(may_ask=self.delay_s is not None):
            self.log.write_event(WARNING, "drive", text)
            self.display.note(text)

    def tell_bus_news(self) -> None:
        """What the controller of the bus has complained about since the last call."""
        for text in self.around.bus_watch.news():
            self.log.write_event(WARNING, "bus", text)
            self.display.note(text)

    def take_records(self, *, last: bool = False) -> None:
        """What the loop has written since the last call: to log, viewers and display, and the events in it.

        `last`: the loop has ended; what the decimation of the log still holds back goes into it.
        """
        if self.around.recorder is not None and (frames := self.around.recorder.new_frames()):
            self.log.write_frames(frame_array(frames))
        records = self.loop.new_records()
        if len(records):
            self._keep(self._decimated.take(records))
            self._show(records)
        if last:
            self._keep(self._decimated.last())

    def _show(self, records: Any) -> None:
        """New records, shape (N,), to viewers and display, and the events in them."""
        self._orders.keep(records)
        commanded = self.around.signals.commanded_ns != 0  # the drive is off then, and the loop cannot know why
        # first: what has been reported may explain the fault that follows
        for event in self._notices.take(self.loop.block.state[0], int(records[-1].time_ns)):
            self._tell(event)
            self.display.note(event.text)  # of events, a display shows the errors by itself
        for event in self._events.take(records):
            self._tell(event, shown=not (commanded and event.level == ERROR))
        skipped, histograms = int(self.loop.block.words[Word.SKIPPED]), self.loop.block.histograms
        duration_s = float(self.loop.block.constants[0].trajectory.duration_s)  # a viewer may have changed the motion
        drive = self.config.drive.kind
        degC = self.temperature.newest_degC
        self.display.show(Snapshot(records[-1], skipped, histograms, duration_s, drive, records, degC))

    def _keep(self, records: Any) -> None:
        """Into the log, and kept for the summary at the end."""
        if len(records):
            self.kept.append(records)
            self.log.write_records(records)
            if self._arm_log is not None:
                self._arm_log.take_states(records, self.loop.block.axis)

    def check_delay(self) -> None:
        """Once enough cycles have run with the drive off: refuse the gains, or let the loop enable."""
        if self.delay_s is not None or self.loop.cycles < min(DELAY_CYCLES, self.config.loop.rate_Hz):
            return
        histograms = self.loop.block.histograms
        if not histograms[Histogram.ROUND_TRIP].any():
            return  # nothing has been heard: the loop ends that itself, and tells it
        self.delay_s = self._drive.loop_delay_s(self.config, histograms)
        text = f"loop delay {self.delay_s * 1e3:.2f} ms measured, {self.margin_text(self.delay_s)}"
        self.log.write_event(INFO, "supervisor", text)
        self.display.note(text)
        self._may_enable()

    def _may_enable(self) -> None:
        """Once the delay allows the gains, and what stops the drive without us was read back."""
        guard = self.settings_guard
        if not self._allowed and self.delay_s is not None and (guard is None or guard.confirmed):
            self._allowed = True
            self.loop.allow_enable()

    def margin_text(self, delay_s: float) -> str:
        """What is left of the stability with that delay, in words; raises if it is too little to enable.

        Where the drive closes its velocity loop by itself, in a sweep, ours is the slow position correction.
        """
        if self.config.drive.own_loop() is not CommandKind.TORQUE:
            return cascade_text(self.config, delay_s, allow_low_margin=self._allow_low_margin)
        if self._drives_loop_ps is not None:
            margin_deg = math.degrees(0.5 * math.pi - self._drives_loop_ps * delay_s)
            return f"position correction with {margin_deg:.0f} deg phase margin"
        found = require_margin(self.config, delay_s, allow_low_margin=self._allow_low_margin)
        return f"phase margin {found.phase_margin_deg:.0f} deg"

    def _tell(self, event: Event, *, shown: bool = True) -> None:
        self.log.write_event(event.level, event.source, event.text, event.time_ns)
        if shown:
            self.display.event(event)
        self._orders.keep_event(event)

    def _tell_scope(self, level: int, text: str) -> None:
        self._tell(Event(time.monotonic_ns(), level, "scope", text))

    def _fault_words(self, fault: Fault, drive_error: int) -> str:
        """In the words that fit the drive, with the value that the loop has latched."""
        state = self.loop.block.state[0]
        value, encoder_error = float(state.fault_value), int(state.fault_encoder_error)
        return self._drive.fault_text(self.config, fault, value, drive_error, encoder_error).happened
