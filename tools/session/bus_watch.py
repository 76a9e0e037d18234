"""What is only looked at while a run goes on: the controller of the bus, raw frames, the drive's temperature."""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import can

from jointctl.drivers.can import socketcan
from jointctl.drivers.can.frames import FRAME_STRUCT
from jointctl.drivers.can.open import SHARED_INTERFACES, open_python_can
from jointctl.drivers.can.socketcan import error_frame_text, link_problem, link_state, send_problem, trouble
from jointctl.drivers.drive import Thermometer
from jointctl.drivers.errors import BusError, ConfigurationError
from jointctl.firmware_py.states import Fault
from jointctl.tools.configuration.config import Config
from jointctl.tools.recording.run_log import WARNING, RunLogWriter
from jointctl.tools.session.fault_words import FaultText

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
        self, thermometer: Thermometer | None = None, log: RunLogWriter | None = None, law: Any = None
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
