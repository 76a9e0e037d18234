"""What the supervisor does 50 times a second while the loop runs: sign of life, stop, records, events, what is watched.

Everything new goes into the log and to the display here; what opens, lets go and makes safe is the supervisor's.
"""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Self

import can
import numpy as np

from jointctl.drivers.can import socketcan
from jointctl.drivers.can.frames import FRAME_STRUCT
from jointctl.drivers.can.open import SHARED_INTERFACES, open_python_can
from jointctl.drivers.can.socketcan import error_frame_text, link_problem, link_state, send_problem, trouble
from jointctl.drivers.drive import SettingsGuard, Thermometer
from jointctl.drivers.errors import BusError, ConfigurationError, DataError
from jointctl.firmware_py.cycle import Histogram, Word
from jointctl.firmware_py.records import AxisConstants, LawConstants
from jointctl.firmware_py.states import AxisPhase, CommandKind, Fault, StopRequest, in_words
from jointctl.tools.analysis.margin_gate import cascade_text
from jointctl.tools.configuration.config import Config
from jointctl.tools.recording.ros_messages import frame_array
from jointctl.tools.recording.run_log import ERROR, INFO, WARNING, Event, RunLogWriter, ThinnedRecords
from jointctl.tools.recording.run_summary import KeptRecords
from jointctl.tools.session.control import StopSignals
from jointctl.tools.session.display import Display, EventFinder, Snapshot, phase_name
from jointctl.tools.session.fault_words import LEFT_MODE, OF_A_LEFT_MODE, FaultText, NoticeFinder
from jointctl.tools.session.live_changes import LiveChanges, ViewerOrders
from jointctl.tools.session.loop_handle import LoopHandle
from jointctl.tools.session.plan import JointPlan, RunPlan
from jointctl.tools.session.session_drive import Guard, session_drive
from jointctl.tools.session.set_points import SetPointSources

# --- A SocketCAN interface: what its controller complains about, and why sending failed ---
# A socket of its own receives error frames and nothing else, so that it costs nothing on a healthy bus.  The program
# `ip` is asked only when the run is over: it may take longer than the supervisor may be silent.


_SOL_CAN_RAW = 101
_CAN_RAW_FILTER = 1
_FRAMES_AT_ONCE = 200
# faults that a sick bus explains
BUS_FAULTS = frozenset({
    Fault.BUS_ERROR, Fault.STALE_SAMPLE, Fault.NO_SAMPLES, Fault.SAMPLES_MISSING, Fault.DRIVE_FAULT,
    Fault.ENABLE_TIMEOUT,
})  # fmt: skip
_REMEDIES = {
    "bus-off": "a short, missing termination or a wrong bit rate",
    "error passive": "nobody acknowledges, or the bit rate is wrong: power of the drive, wiring, termination",
    "no acknowledge": "nobody else is on the bus: power of the drive, wiring, bit rate",
    "transmit time-out": "the bus is blocked: wiring, termination",
    "buffer overflow": "the adapter is too slow for this bus load",
    "bus error": "wiring, termination (60 ohm between H and L), bit rate",
}


class BusWatch:
    """`end` is a raw CAN socket, non-blocking; None on any other bus, where there is nothing to watch."""

    def __init__(self, config: Config, end: socket.socket | None) -> None:
        self._channel = config.bus.channel
        self._bitrate_bitps = config.bus.bitrate_bitps
        self._end = end
        self._told: set[str] = set()

    def news(self) -> list[str]:
        """Troubles that the controller has reported since the last call, each kind once in a run."""
        if self._end is None:
            return []
        news = []
        for _ in range(_FRAMES_AT_ONCE):
            try:
                identifier, _, data = FRAME_STRUCT.unpack(self._end.recv(FRAME_STRUCT.size))
            except (OSError, struct.error):  # nothing waits, or the interface has gone, which the loop sees as well
                break
            kind = trouble(identifier, data)
            if kind and kind not in self._told:
                self._told.add(kind)
                news.append(f"{self._channel}: {error_frame_text(identifier, data)} ({_REMEDIES[kind]})")
        return news

    def explained(self, fault: Fault, text: FaultText | None, last_errno: int) -> FaultText | None:
        """The text of a fault with the interface's own trouble as its cause, if it has any."""
        if self._end is None or text is None:
            return text
        link = link_state(self._channel)
        problem = link_problem(link, self._bitrate_bitps) if link is not None else None
        if problem is None and last_errno:
            problem = send_problem(self._channel, last_errno)
        if problem is None:
            return text
        # late or missing samples also look like a fast or a jumping joint
        cause = problem[0] if fault in BUS_FAULTS else f"{problem[0]}, so that samples were late; or {text.cause}"
        return replace(text, cause=cause, next_step=problem[1])


@contextmanager
def bus_watch(config: Config) -> Iterator[BusWatch]:
    """On SocketCAN a listening end; elsewhere, or where it cannot be opened, one that sees nothing."""
    with contextlib.ExitStack() as stack:
        end = None
        if config.bus.interface == "socketcan":
            with contextlib.suppress(BusError, OSError):  # the drive's own end is about to tell why
                end = stack.enter_context(socketcan.open_socket(config.bus.channel))
                end.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FILTER, b"")
        yield BusWatch(config, end)


# --- Listens to the bus while a run goes on, for the raw frames in its log (`log.frames`) ---
# It has an end of the bus of its own, so that it sees everybody's frames, ours as well.  A thread receives into a
# queue that is bounded: when the supervisor does not fetch, frames are dropped and counted, nothing grows and nothing
# waits.
#
# Time stamps are those of the adapter or kernel where they are of this computer's calendar clock, else the moment at
# which the thread saw the frame: then a burst may look later than it was, and frames closer than they were.


QUEUE_FRAMES = 1 << 16  # more than 20 s at 1 kHz
RECEIVE_S = 0.1  # how long the thread waits before it looks whether it is to end
FAILURE_PAUSE_S = 0.05
LAST_S = 0.5  # for frames that have arrived before the end, at most
SAME_CLOCK_S = 5.0


class FrameRecorder:
    """Receives from `bus` until `close`, which also closes the bus."""

    def __init__(self, bus: can.BusABC, queue_frames: int = QUEUE_FRAMES) -> None:
        self._bus = bus
        self._queue: deque[tuple[int, can.Message]] = deque()
        self._queue_frames = queue_frames
        self.dropped = 0
        self._calendar_ns = time.time_ns() - time.monotonic_ns()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._receive, name="frame recorder", daemon=True)
        self._thread.start()

    def _receive(self) -> None:
        until_s = math.inf
        while time.monotonic() < until_s:
            ended = self._ended.is_set()
            if ended and until_s == math.inf:
                until_s = time.monotonic() + LAST_S
            try:
                message = self._bus.recv(0.0 if ended else RECEIVE_S)
            except (can.CanError, OSError, ValueError):
                # the bus is down: the loop sees it as well and stops the joint, there is nothing to add
                if self._ended.wait(FAILURE_PAUSE_S):
                    return
                continue
            if message is None:
                if ended:
                    return
                continue
            if len(self._queue) >= self._queue_frames:
                self.dropped += 1
                continue
            self._queue.append((self._time_ns(message), message))

    def _time_ns(self, message: can.Message) -> int:
        """CLOCK_MONOTONIC of a message."""
        now_ns = time.monotonic_ns()
        stamp_ns = int(message.timestamp * 1e9) - self._calendar_ns
        return stamp_ns if abs(stamp_ns - now_ns) < SAME_CLOCK_S * 1e9 else now_ns

    def new_frames(self) -> list[tuple[int, Any]]:
        """(CLOCK_MONOTONIC in nanoseconds, message) of every frame since the last call."""
        return [self._queue.popleft() for _ in range(len(self._queue))]

    def end(self) -> None:
        """Nothing is received any more but what has arrived; it can still be fetched."""
        self._ended.set()
        self._thread.join(2.0)

    def close(self) -> None:
        self.end()
        self._bus.shutdown()


@contextmanager
def recording(config: Config) -> Iterator[FrameRecorder | None]:
    """A recorder on the configured bus if `log.frames` asks for one; closed at the end."""
    if not config.log.frames:
        yield None
        return
    bus = config.bus
    if not config.drive.sends_frames:
        raise ConfigurationError(f"{config.path}: log.frames (=true) must be false on a serial line, it has no frames")
    if bus.interface not in SHARED_INTERFACES:
        raise ConfigurationError(
            f"{config.path}: log.frames (=true) must be false over bus.interface (={bus.interface}): "
            "the loop needs the adapter for itself",
            f"these can be shared: {', '.join(SHARED_INTERFACES)}",
        )
    recorder = FrameRecorder(open_python_can(bus.interface, bus.channel, bus.bitrate_bitps))
    try:
        yield recorder
    finally:
        recorder.close()


# --- The drive's temperature during a run: readings into the log, the newest one for a viewer ---


STALE_S = 3.0  # three requests without a reading: what was read before is not the temperature any more


class TemperatureWatch:
    """`poll` it with the supervisor's other watches; a temperature that cannot be read is no reason to stop."""

    def __init__(
        self, thermometer: Thermometer | None = None, log: RunLogWriter | None = None, law: LawConstants | None = None
    ) -> None:
        """`law`: the `LawConstants` of the loop, whose friction feed-forward may go with the temperature."""
        self._thermometer, self._log = thermometer, log
        self._law, self._held = law, False
        self._told: set[str] = set()
        self.readings: list[tuple[int, float]] = []  # (CLOCK_MONOTONIC in ns, degC) of the whole run

    def poll(self) -> None:
        """Take what is new; why there is none goes into the log, each reason once."""
        reading = self._thermometer.poll() if self._thermometer is not None else None
        self._tell_held()
        if reading is None:
            return
        if reading.temperature_degC is not None:
            self.readings.append((reading.time_ns, reading.temperature_degC))
            if self._law is not None:
                self._law.temperature.degC[0] = reading.temperature_degC
                self._law.temperature.time_ns[0] = reading.time_ns
            if self._log is not None:
                self._log.write_temperature(reading.time_ns, reading.temperature_degC)
        elif reading.problem not in self._told and self._log is not None:
            self._told.add(reading.problem)
            self._log.write_event(WARNING, "drive", reading.problem, reading.time_ns)

    def _tell_held(self) -> None:
        """Once, when the law goes on with a temperature that is not that of now, and how old it is."""
        if self._law is None or not self.readings:
            return
        friction = self._law.friction
        if not (friction.temperature_coulomb_pK or friction.temperature_viscous_pK):
            return
        time_ns, degC = self.readings[-1]
        age_s = (time.monotonic_ns() - time_ns) * 1e-9
        if age_s <= STALE_S:
            self._held = False
        elif not self._held and self._log is not None:
            self._held = True
            text = f"no temperature for {age_s:.0f} s: the friction feed-forward holds that of {degC:.1f} °C"
            self._log.write_event(WARNING, "drive", text)

    @property
    def values_degC(self) -> list[float]:
        return [value for _, value in self.readings]

    @property
    def newest_degC(self) -> float | None:
        """The newest reading, unless it is stale."""
        if not self.readings or time.monotonic_ns() - self.readings[-1][0] > STALE_S * 1e9:
            return None
        return self.readings[-1][1]


GUARD_ENDED = "the guard of the line has ended: nobody switches the drive off if this program and the loop both die"
DELAY_CYCLES = 300  # how many cycles with the drive off the loop delay is measured over


# --- The watch itself ---


def beside(work: Callable[[], str]) -> Future[str]:
    """What `work` gives or raises, from a thread of its own: stop and sign of life do not wait for it.

    Neither does the end of this process.
    """
    future: Future[str] = Future()

    def carry_out() -> None:
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=carry_out, daemon=True).start()
    return future


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

    def __init__(self, plan: RunPlan, axis: AxisConstants, parts: RunParts, joint: JointPlan | None = None) -> None:
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
        self._margins: Future[str] | None = None  # with that delay, in words; None before it, and once they are there
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
        with contextlib.suppress(DataError):  # a full disk may be why this ends
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
        self.tell_stop(request)
        self.guard_settings(may_ask=self.delay_s is not None)  # reads lengthen the delay that is measured
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

    def tell_stop(self, request: StopRequest) -> None:
        """That a stop was asked for, or for more; the loop may have ended before the next `poll`."""
        if request <= self._asked:
            return
        self._asked = request
        if not self.around.signals.name:
            self._stopped_by_viewer = self.display.stop_reason()
        text = f"{in_words(request)} asked for by {self.stopped_by}"
        self._tell(Event(self.around.signals.commanded_ns or time.monotonic_ns(), WARNING, "supervisor", text))

    def guard_settings(self, *, may_ask: bool) -> None:
        """`DeviceError` or `BusError` where what stops the drive without us has been changed, or someone else commands.

        `may_ask`: whether it may read objects of the drive.
        """
        self._drive.refuse_others(self.loop.block.port)
        if self.settings_guard is None:
            return
        for text in self.settings_guard.poll(may_ask=may_ask):
            self.log.write_event(WARNING, "drive", text)
            self.display.note(text)

    def mode_explained(self, fault: Fault, text: FaultText) -> FaultText:
        """The text of a fault with the mode of the drive, which is off, if it has left it."""
        if fault not in OF_A_LEFT_MODE or self.settings_guard is None or not (left := self.settings_guard.mode_left()):
            return text
        self.log.write_event(ERROR, "drive", left)
        return FaultText(f"{text.happened}; {left}", "the drive, or another program, has changed its mode", LEFT_MODE)

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

    def _show(self, records: np.recarray) -> None:
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
        limits = self.config.limits
        self.display.show(Snapshot(
            records[-1], skipped, histograms, duration_s, drive, records, degC,
            torque_max_Nm=limits.torque_max_Nm, velocity_max_radps=limits.velocity_max_radps,
        ))  # fmt: skip

    def _keep(self, records: np.recarray) -> None:
        """Into the log, and kept for the summary at the end."""
        if len(records):
            self.kept.append(records)
            self.log.write_records(records)
            if self._arm_log is not None:
                self._arm_log.take_states(records, self.loop.block.axis)

    def check_delay(self) -> None:
        """Once enough cycles have run with the drive off, its margins are computed; they refuse the gains or not."""
        if self.delay_s is None:
            histograms = self.loop.block.histograms
            if self.loop.cycles < min(DELAY_CYCLES, self.config.loop.rate_Hz):
                return
            if not histograms[Histogram.ROUND_TRIP].any():
                return  # nothing has been heard: the loop ends that itself, and tells it
            if self.loop.block.whole.state.sample_age_cycles.any():
                return  # the wait for a drive that is silent is no loop delay of its neighbours; the loop may end it
            self.delay_s = delay_s = self._drive.loop_delay_s(self.config, histograms)
            self._margins = beside(lambda: self.margin_text(delay_s))
        if self._margins is None or not self._margins.done():
            return
        text = f"loop delay {self.delay_s * 1e3:.2f} ms measured, {self._margins.result()}"
        self._margins = None
        self.log.write_event(INFO, "supervisor", text)
        self.display.note(text)

    def _may_enable(self) -> None:
        """Once the delay allows the gains, and what stops the drive without us was read back."""
        guard, judged = self.settings_guard, self.delay_s is not None and self._margins is None
        if not self._allowed and judged and (guard is None or guard.confirmed):
            self.around.signals.begin()  # margins that have taken long: no one expects the motion any more
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
        found = self.joint.require_margin(delay_s, allow_low_margin=self._allow_low_margin)
        return f"phase margin {found.phase_margin_deg:.0f} deg"

    def _tell(self, event: Event, *, shown: bool = True) -> None:
        self.log.write_event(event.level, event.source, event.text, event.time_ns)
        if shown:
            self.display.event(event)
        self._orders.keep(event)

    def _tell_scope(self, level: int, text: str) -> None:
        self._tell(Event(time.monotonic_ns(), level, "scope", text))

    def _fault_words(self, fault: Fault, drive_error: int) -> str:
        """In the words that fit the drive, with the value that the loop has latched."""
        state = self.loop.block.state[0]
        value, encoder_error = float(state.fault_value), int(state.fault_encoder_error)
        return self._drive.fault_text(self.config, fault, value, drive_error, encoder_error).happened
