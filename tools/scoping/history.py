"""What the scope remembers: the newest records in a ring, the newest events, and what to draw of them."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
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
        self.runs = 0  # that have begun
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
            self.runs += 1
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


# --- What the scope's picture can show of the chosen signals: over time, one against another, or as spectra ---
#
# A view is columns of numbers: the picture draws few of its points, cursors and CSV take all.

TIME, AGAINST, SPECTRUM = "time", "x-y", "spectrum"
TIME_NAME = "time [s]"
VIEWS = (TIME, AGAINST, SPECTRUM)
LEAST_SAMPLES = 16  # of a spectrum
LEAST_AMPLITUDE = 1e-8  # a logarithmic axis has no zero


@dataclass(frozen=True)
class Seen:
    """`x`, shape (N,), and one column of that length for each signal; nan where a signal has no meaning."""

    x_name: str
    x: np.ndarray
    columns: Mapping[str, np.ndarray]

    def drawn(self, name: str) -> list[list[float]]:
        """[x, value] of a signal, at most about POINTS: the least and the greatest of each stretch."""
        values = self.columns[name]
        keep = drawn_indices(values, POINTS)
        keep = keep[np.isfinite(values[keep]) & np.isfinite(self.x[keep])]
        pairs: list[list[float]] = np.stack([self.x[keep], values[keep]], axis=1).tolist()
        return pairs

    def at(self, x: float, name: str) -> float:
        """A signal's value there, between two samples on the line through them; nan outside of them."""
        if len(self.x) == 0:
            return float("nan")
        return float(np.interp(x, self.x, self.columns[name], left=np.nan, right=np.nan))

    def csv(self, low: float, high: float) -> str:
        """Rows with x from `low` to `high`, under the names of the columns; nothing where there is no value."""
        chosen = (self.x >= low) & (self.x <= high)
        table = np.column_stack([self.x, *self.columns.values()])[chosen]
        rows = (",".join("" if np.isnan(value) else f"{value:.9g}" for value in row) for row in table)
        return "\n".join([",".join([self.x_name, *self.columns]), *rows, ""])


def seen(view: str, history: History, rows: np.ndarray, names: Sequence[str]) -> Seen:
    """The records as a view shows them."""
    columns = {name: history.values(rows, name) for name in names}
    time_s = history.seconds(rows)
    if view == AGAINST and len(names) > 1:
        first = names[0]
        return Seen(first, columns.pop(first), columns)
    if view == SPECTRUM:
        return spectra(time_s, columns)
    return Seen(TIME_NAME, time_s, columns)


def spectra(time_s: np.ndarray, columns: Mapping[str, np.ndarray]) -> Seen:
    """Amplitudes over frequency [Hz], without the mean: a sine's peak is its amplitude (Hann window).

    Of the longest stretch without a gap in which every signal has a meaning; frequencies up to half the mean rate.
    """
    fine = np.all([np.ones(len(time_s), bool), *(np.isfinite(values) for values in columns.values())], axis=0)
    changes = np.flatnonzero((np.diff(time_s) > GAP_s) | (fine[1:] != fine[:-1])) + 1
    ends = [0, *changes.tolist(), len(time_s)]
    stretches = [slice(a, b) for a, b in pairwise(ends) if b > a and fine[a]]
    chosen = max(stretches, key=lambda part: part.stop - part.start, default=slice(0, 0))
    time_s = time_s[chosen]
    count = len(time_s)
    if count < LEAST_SAMPLES:
        return Seen("frequency [Hz]", np.zeros(0), {name: np.zeros(0) for name in columns})
    even_s = np.linspace(time_s[0], time_s[-1], count)  # a skipped cycle is bridged
    window = np.hanning(count)
    scale = 2.0 / np.sum(window)

    def amplitudes(values: np.ndarray) -> np.ndarray:
        even = np.interp(even_s, time_s, values[chosen])
        return np.maximum(np.abs(np.fft.rfft((even - even.mean()) * window)) * scale, LEAST_AMPLITUDE)

    frequency_Hz = np.fft.rfftfreq(count, (even_s[-1] - even_s[0]) / (count - 1))
    return Seen("frequency [Hz]", frequency_Hz, {name: amplitudes(values) for name, values in columns.items()})


def readings(found: Seen, a: float, b: float) -> str:
    """Both cursors and their difference in each signal, as lines of a table."""
    unit = found.x_name[found.x_name.index("[") + 1 : -1]
    inverse = f"   1/(B - A) = {1.0 / (b - a):.5g} Hz" if unit == "s" and a != b else ""
    lines = [f"{'':28}{'A':>12}{'B':>12}{'B - A':>12}", f"{found.x_name:28}{a:12.5g}{b:12.5g}{b - a:12.5g}{inverse}"]
    for name in found.columns:
        at_a, at_b = found.at(a, name), found.at(b, name)
        lines.append(f"{name:28}{_shown(at_a)}{_shown(at_b)}{_shown(at_b - at_a)}")
    return "\n".join(lines)


def _shown(value: float) -> str:
    return f"{'-':>12}" if np.isnan(value) else f"{value:12.5g}"
