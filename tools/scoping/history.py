"""What the scope remembers: the newest records in a ring, the newest events, and what to draw of them."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from jointctl.drivers.errors import printable
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of, new
from jointctl.tools.recording.ros_messages import JOINT_NAMES
from jointctl.tools.recording.run_log import Event
from jointctl.tools.recording.run_summary import drawn_indices, powered

RING_RECORDS = 1 << 16  # 65 s at 1 kHz
EVENTS = 50
GAP_s = 0.1  # far above what the loop skips and what a sweep's log leaves out
POINTS = 1000  # of one signal on the page

# name on the page -> (field of LogRecord, factor)
SIGNALS: dict[str, tuple[str, float]] = {
    "error [mrad]": ("error_rad", 1e3),
    "angle [rad]": ("position_rad", 1.0),
    "desired angle [rad]": ("desired_position_rad", 1.0),
    "velocity [rad/s]": ("velocity_radps", 1.0),
    "desired velocity [rad/s]": ("desired_velocity_radps", 1.0),
    "command torque [Nm]": ("command_torque_Nm", 1.0),
    "measured torque [Nm]": ("measured_torque_Nm", 1.0),
    "friction feed-forward [Nm]": ("friction_torque_Nm", 1.0),
    "network torque [Nm]": ("network_torque_Nm", 1.0),
    "observer torque [Nm]": ("observer_torque_Nm", 1.0),
    "learned torque [Nm]": ("learned_torque_Nm", 1.0),
    "wake-up late [us]": ("wake_late_ns", 1e-3),
    "round trip [us]": ("round_trip_ns", 1e-3),
}
# without meaning while the law rests
_OF_THE_LAW = ("error_rad", "desired_position_rad", "desired_velocity_radps")


def printable_values(value: object) -> Any:
    """Every text in a message of the supervisor as it may be shown."""
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, Mapping):
        return {printable(key): printable_values(item) for key, item in value.items()}
    return [printable_values(item) for item in value] if isinstance(value, list) else value


class History:
    """Filled by one thread, read by others; its memory never grows.

    Of an arm it is that of the first joint, with events and settings of all; `of` has the records of the others.
    """

    def __init__(self, ring_records: int = RING_RECORDS, joints: Sequence[str] = JOINT_NAMES) -> None:
        self.joints = tuple(joints)
        self._others = [History(ring_records) for _ in joints[1:]]
        self._ring = new(LogRecord, ring_records)
        self._head = 0
        self._start_ns = 0
        self._lock = threading.Lock()
        self.skipped = 0
        self.events: deque[Event] = deque(maxlen=EVENTS)
        self.settings: dict[str, Any] = {}  # what the supervisor tells: gains, motion, stage, ...
        self.ended = False
        self.heard_s = time.monotonic()  # of the last message of the supervisor

    def take_event(self, event: Event) -> None:
        """One more event; a page shows whatever is in it and obeys none of it."""
        self.events.append(replace(event, source=printable(event.source), text=printable(event.text)))

    def take_settings(self, found: Mapping[str, Any]) -> None:
        """What the supervisor tells besides, likewise."""
        self.settings.update(printable_values(found))

    def take(self, records: np.ndarray) -> None:
        """Append records, shape (N,), in order of time."""
        if not len(records):
            return
        with self._lock:
            if self._head == 0:
                self._start_ns = int(records["time_ns"][0])
            index = np.arange(self._head, self._head + len(records)) % len(self._ring)
            self._ring[index[-len(self._ring) :]] = records[-len(self._ring) :]
            self._head += len(records)
            self.skipped += int(records["skipped"].sum())

    def of(self, joint: int) -> History:
        """The records of a joint."""
        return self if joint == 0 else self._others[joint - 1]

    def begin(self) -> None:
        """A new run: what was seen of the one before goes."""
        for other in self._others:
            other.begin()
        with self._lock:
            self._head = 0
            self._start_ns = 0
            self.skipped = 0
        self.events.clear()

    def take_bytes(self, body: bytes, axis: int = 0) -> None:
        """As `take`, of records as they came through the socket."""
        if axis < len(self.joints):
            self.of(axis).take(np.frombuffer(body, dtype_of(LogRecord)))

    def newest(self, span_s: float, before_s: float | None = None) -> Any:
        """A copy of the records of the last `span_s`, up to `before_s` since the start if that is given."""
        with self._lock:
            count = min(self._head, len(self._ring))
            index = np.arange(self._head - count, self._head) % len(self._ring)
            if not count:
                return self._ring[index]
            time_s = (self._ring["time_ns"][index] - self._start_ns) * 1e-9
            end_s = float(time_s[-1]) if before_s is None else before_s
            return self._ring[index[(time_s > end_s - span_s) & (time_s <= end_s)]]

    def second(self, time_ns: int) -> float:
        """Seconds since the first record ever taken."""
        return (time_ns - self._start_ns) * 1e-9 if self._start_ns else 0.0

    def seconds(self, records: np.ndarray) -> np.ndarray:
        """float64[N] since the first record ever taken."""
        since: np.ndarray = (records["time_ns"] - self._start_ns) * 1e-9
        return since

    def values(self, records: np.ndarray, signal: str) -> np.ndarray:
        """float64[N] of a signal in its unit; nan where it has no meaning."""
        field, factor = SIGNALS[signal]
        values: np.ndarray = np.asarray(records[field], float) * factor
        return np.where(powered(records), values, np.nan) if field in _OF_THE_LAW else values

    def series(self, records: np.ndarray, signal: str) -> list[list[float | None]]:
        """[seconds, value] of a signal, at most about POINTS of them, least and greatest of each stretch.

        Where records are missing for GAP_s the value is None: a line across them would show a motion that was not.
        """
        values = self.values(records, signal)
        keep = drawn_indices(values, POINTS)
        keep = keep[np.isfinite(values[keep])]
        time_s = self.seconds(records)
        pairs: list[list[float | None]] = np.round(np.stack([time_s[keep], values[keep]], axis=1), 6).tolist()
        for before in np.flatnonzero(np.diff(records["time_ns"]) > GAP_s * 1e9)[::-1].tolist():
            at = int(np.searchsorted(keep, before, side="right"))
            if 0 < at < len(pairs):
                pairs.insert(at, [round(float(time_s[before]), 6), None])
        return pairs


def crossing_s(time_s: np.ndarray, values: np.ndarray, level: float, *, rising: bool) -> float | None:
    """When the signal last crossed the level in that direction; None if it did not."""
    above = values > level if rising else values < level
    found = np.flatnonzero(above[1:] & ~above[:-1])
    return float(time_s[found[-1] + 1]) if len(found) else None


def percentiles_us(records: np.ndarray) -> dict[str, str]:
    """p50 / p99 / max of wake-up, round trip and work [us] in these records."""
    found = {}
    for name, field in (("wake-up late", "wake_late_ns"), ("round trip", "round_trip_ns"), ("work", "work_ns")):
        values = records[field] / 1000.0
        if field == "round_trip_ns":
            values = values[values > 0.0]
        if len(values):
            p50, p99 = np.percentile(values, (50.0, 99.0))
            found[name] = f"{p50:.0f} / {p99:.0f} / {values.max():.0f} us"
    return found
