"""What happened in a run, in numbers and a picture: tracking error, torques, how well the loop kept its deadlines.

Errors and torques are those of the TRACKING phase (e = q - q_d, at the joint); deadlines are those of the whole run.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Column, Table

from jointctl.drivers.errors import DataError, decimals_of
from jointctl.firmware_py.cycle import Histogram
from jointctl.firmware_py.motion_records import TrajectoryConstants
from jointctl.firmware_py.records import LogRecord
from jointctl.firmware_py.schema import dtype_of
from jointctl.firmware_py.states import AxisPhase, Fault, fault_name
from jointctl.firmware_py.trajectory import repetition
from jointctl.tools.drawing import BLUE, COLOURS, GREEN, GREY, INK, ORANGE, RED, TEAL, VIOLET, canvas, save_png
from jointctl.tools.recording.run_log import IN_MEMORY
from jointctl.tools.written_file import writing

if TYPE_CHECKING:
    from matplotlib.axes import Axes


SETTLED_RAD = 1e-3
STARTING_s = 1.0
# fields of the summary by their names for people; LogRecord has the times with _ns, the loop a histogram of each
TORQUES = {
    "command torque": "command_torque_Nm", "measured torque": "measured_torque_Nm",
    "friction feed-forward": "friction_torque_Nm", "network torque": "network_torque_Nm",
}  # fmt: skip
TIMES = {"wake-up late": "wake_late", "round trip": "round_trip", "work": "work"}


@dataclass(frozen=True)
class Range:
    least: float
    greatest: float

    @property
    def peak(self) -> float:
        return max(abs(self.least), abs(self.greatest))


@dataclass(frozen=True)
class ErrorSummary:
    """Tracking error of one stretch of the run."""

    from_s: float  # trajectory time
    to_s: float
    range_rad: Range
    rmse_rad: float


@dataclass(frozen=True)
class TimeSummary:
    """Durations in microseconds; from a histogram each one is the upper edge of its bin, so never too small."""

    count: int
    p50_us: float
    p99_us: float
    p99_9_us: float
    max_us: float
    over_range: int  # how many lie beyond the histogram; then the percentiles may be too small


@dataclass(frozen=True)
class RunSummary:
    """`None` where there is nothing to tell, such as errors of a run that never tracked."""

    cycles: int
    duration_s: float
    tracked_s: float
    fault: str
    error: ErrorSummary | None
    late_error: ErrorSummary | None  # in the second half
    settling_s: float | None  # from then on |e| stays within 1 mrad; None = never
    command_torque_Nm: Range | None
    measured_torque_Nm: Range | None
    friction_torque_Nm: Range | None
    network_torque_Nm: Range | None
    wake_late: TimeSummary | None
    round_trip: TimeSummary | None
    work: TimeSummary | None
    skipped_cycles: int
    oldest_sample_cycles: int
    temperature_degC: Range | None = None  # of the drive, as it tells it
    sync_spread: TimeSummary | None = None  # between the SYNCs of several buses, of an arm

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and texts for JSON; the unit of each is in its key."""
        return asdict(self)


def summarise(
    records: np.ndarray, histograms: np.ndarray | None = None, *, temperatures_degC: Sequence[float] | np.ndarray = ()
) -> RunSummary:
    """Summary of `records` (array of LogRecord, shape (N,)).

    `histograms` int64[4, bins of 1 us], rows as of `Histogram`, the last bin open: where given, the deadline
    statistics come from it, because the loop counts every cycle there even if the log lost some.
    `temperatures_degC` is what the drive has reported.
    """
    chosen = records["phase"] == AxisPhase.TRACKING
    # of these fields only: of a long run the records are a file of gigabytes
    tracking = {name: records[name][chosen] for name in ("time_ns", "trajectory_s", "error_rad", *TORQUES.values())}
    time_s, error_rad = tracking_time_s(tracking), tracking["error_rad"]
    late = time_s >= (0.5 * time_s[-1] if len(time_s) else 0.0)
    faults = records["fault"][records["fault"] != 0]
    duration_ns = int(records["time_ns"][-1]) - int(records["time_ns"][0]) if len(records) else 0
    named: dict[str, Any] = {key: _range(tracking[key]) for key in TORQUES.values()}
    for row, key in enumerate(TIMES.values()):
        named[key] = _times(records, None if histograms is None else histograms[row], key)
    return RunSummary(
        cycles=len(records),
        duration_s=duration_ns * 1e-9,
        tracked_s=float(time_s[-1] - time_s[0]) if len(time_s) else 0.0,
        fault=fault_name(int(faults[0])) if len(faults) else Fault.NONE.name,
        error=_error(error_rad, time_s),
        late_error=_error(error_rad[late], time_s[late]),
        settling_s=_settling_s(error_rad, time_s),
        **named,
        skipped_cycles=int(records["skipped"].sum()),
        oldest_sample_cycles=int(records["sample_age_cycles"].max()) if len(records) else 0,
        temperature_degC=_range(np.asarray(temperatures_degC, float)),
        sync_spread=None if histograms is None else histogram_times(histograms[Histogram.SYNC_SPREAD]),
    )


def tracking_time_s(tracking: Mapping[str, np.ndarray]) -> np.ndarray:
    """Trajectory time [s] of TRACKING records; goes on where a change of the motion has set the loop's own back."""
    time_s = tracking["trajectory_s"]
    if len(time_s) < 2 or np.all(np.diff(time_s) >= 0.0):
        return time_s
    since: np.ndarray = (tracking["time_ns"] - tracking["time_ns"][0]) * 1e-9
    return since + time_s[0]


def _range(values: np.ndarray) -> Range | None:
    values = values[np.isfinite(values)]
    return Range(float(values.min()), float(values.max())) if len(values) else None


def _error(error_rad: np.ndarray, time_s: np.ndarray) -> ErrorSummary | None:
    found = _range(error_rad)
    if found is None:
        return None
    rmse = float(np.sqrt(np.mean(np.square(error_rad[np.isfinite(error_rad)]))))
    return ErrorSummary(float(time_s[0]), float(time_s[-1]), found, rmse)


def learning_factor(trajectory: TrajectoryConstants, table: np.ndarray, rows: Any) -> float | None:
    """RMS error while learning adds torque, over that of the first period at the same places in it.

    Of the records of TRACKING; None where the motion does not repeat in them, or nothing was learned.  The start of
    each period is left out: the first one has the transient of observer and adaptation there.
    """
    squares_rad2, adds = np.asarray(rows.error_rad) ** 2, np.asarray(rows.learned_torque_Nm) != 0.0
    if not np.any(adds):
        return None
    first_rad2 = later_rad2 = 0.0
    switch_s = float(trajectory.switch_s) if repetition(trajectory, table, trajectory.switch_s).epoch else math.inf
    for begin_s, end_s in ((0.0, switch_s), (switch_s, math.inf)):
        same = (rows.trajectory_s >= begin_s) & (rows.trajectory_s < end_s)
        period_s = repetition(trajectory, table, begin_s).period_s
        if not (np.any(same) and period_s > 0.0):
            continue
        since_s = rows.trajectory_s - rows.trajectory_s[same][0]
        started, over = same & (since_s % period_s >= STARTING_s), since_s >= period_s
        first, later = started & ~over, started & over & adds
        if np.any(first) and np.any(later):
            first_rad2 += np.sum(np.interp(since_s[later] % period_s, since_s[first], squares_rad2[first]))
            later_rad2 += np.sum(squares_rad2[later])
    return float(np.sqrt(later_rad2 / first_rad2)) if first_rad2 > 0.0 else None


def learning_harms(factor: float | None) -> bool:
    """Whether that factor says that the motion is better off without learning."""
    return factor is not None and factor >= 1.0


def _settling_s(error_rad: np.ndarray, time_s: np.ndarray) -> float | None:
    outside = np.flatnonzero(~(np.abs(error_rad) <= SETTLED_RAD))
    if len(error_rad) == 0 or (len(outside) and outside[-1] == len(error_rad) - 1):
        return None
    return float(time_s[outside[-1] + 1 if len(outside) else 0])


def _times(records: np.ndarray, histogram: np.ndarray | None, key: str) -> TimeSummary | None:
    if histogram is not None:
        found = histogram_times(histogram)
        # what lies beyond the histogram is in the records, unless they were lost
        beyond_us = float(records[f"{key}_ns"].max()) / 1000.0 if len(records) else 0.0
        return replace(found, max_us=max(found.max_us, beyond_us)) if found is not None and found.over_range else found
    values = records[f"{key}_ns"] / 1000.0
    if key == "round_trip":
        values = values[values > 0.0]  # 0 = no sample in this cycle
    if not len(values):
        return None
    p50, p99, p99_9 = np.percentile(values, (50.0, 99.0, 99.9), method="higher")
    return TimeSummary(len(values), float(p50), float(p99), float(p99_9), float(values.max()), 0)


def histogram_times(histogram: np.ndarray) -> TimeSummary | None:
    """Percentiles of one row of 1 us bins; bin i holds durations in [i, i + 1) us, the last one all beyond."""
    total = int(histogram.sum())
    if total == 0:
        return None
    running = np.cumsum(histogram)

    def edge_us(share: float) -> float:
        # the smallest bin edge that at least this share lies below
        return float(np.searchsorted(running, np.ceil(share * total - 1e-9)) + 1)

    greatest = float(np.flatnonzero(histogram)[-1] + 1)
    return TimeSummary(total, edge_us(0.5), edge_us(0.99), edge_us(0.999), greatest, int(histogram[-1]))


def torques_of(summary: RunSummary) -> Iterator[tuple[str, Range | None, int]]:
    """Name, range [Nm] and decimals of each part; None where the law has no such part, which was zero all the time."""
    for name, key in TORQUES.items():
        torque: Range | None = getattr(summary, key)
        if torque is not None and torque.peak == 0.0:
            torque = None
        yield name, torque, 2 if torque is None else decimals_of(torque.peak, 2)


def summary_table(summary: RunSummary) -> Table:
    """The summary for a terminal; angles in mrad."""
    table = Table(Column(style="bold"), Column(justify="right"), title="Run", show_header=False, title_justify="left")
    fault = "none" if summary.fault == Fault.NONE.name else summary.fault
    table.add_row("duration", f"{summary.duration_s:.2f} s, {summary.tracked_s:.2f} s of it tracking")
    table.add_row("fault", fault, style=None if fault == "none" else "red")
    for name, error in (("tracking error", summary.error), ("tracking error, late part", summary.late_error)):
        if error is not None:
            low, high = error.range_rad.least * 1e3, error.range_rad.greatest * 1e3
            span = f"{error.from_s:z.1f}..{error.to_s:z.1f} s"
            digits = decimals_of(max(-low, high), 3)
            values = f"{low:.{digits}f} .. {high:.{digits}f} mrad, RMSE {error.rmse_rad * 1e3:.{digits}f}"
            table.add_row(f"{name} ({span})", values)
    table.add_row("within 1 mrad for good", _settled_text(summary))
    for name, torque, digits in torques_of(summary):
        if torque is not None:
            table.add_row(name, f"{torque.least:.{digits}f} .. {torque.greatest:.{digits}f} Nm")
    for name, key in (*TIMES.items(), ("SYNC of all buses", "sync_spread")):
        times: TimeSummary | None = getattr(summary, key)
        if times is not None:
            table.add_row(f"{name}, p50/p99/p99.9/max", _times_text(times))
    table.add_row("cycles, skipped", f"{summary.cycles}, {summary.skipped_cycles}")
    oldest = summary.oldest_sample_cycles
    table.add_row("oldest sample", "1 cycle" if oldest == 1 else f"{oldest} cycles")
    if summary.temperature_degC is not None:
        low_degC, high_degC = summary.temperature_degC.least, summary.temperature_degC.greatest
        table.add_row("temperature", f"{low_degC:.1f} .. {high_degC:.1f} °C")
    return table


def _settled_text(summary: RunSummary) -> str:
    if summary.settling_s is None:
        return "not reached"
    inside = summary.error is not None and summary.settling_s <= summary.error.from_s
    return "from the start" if inside else f"after {summary.settling_s:.2f} s"


def _times_text(times: TimeSummary) -> str:
    values = " / ".join(f"{v:.0f}" for v in (times.p50_us, times.p99_us, times.p99_9_us, times.max_us))
    return f"{values} us" + (f" ({times.over_range} beyond the range)" if times.over_range else "")


# --- One picture of a run over time: trajectory, error, torque in its parts, the output of a network ---
# The approach is shaded, the time of a fault is marked, stopping is shaded in another tone.


POINTS = 4000  # a bucket of samples is drawn by its least and greatest value, so that no peak is lost
_PARTS = {
    "friction": ORANGE, "inertia": GREEN, "feedback": BLUE, "gravity": GREY, "observer": VIOLET, "learned": TEAL,
}  # fmt: skip
_TONES = {"approach": COLOURS["wash-1"], "stop": COLOURS["wash-2"], "off": COLOURS["wash-3"]}


def drawn_indices(values: np.ndarray, points: int = POINTS) -> np.ndarray:
    """Which samples to draw: all, or of each bucket the least and the greatest, in order of time."""
    count = len(values)
    if count <= points:
        return np.arange(count)
    size = -(-count // (points // 2))
    whole = count // size * size
    finite = np.where(np.isfinite(values), values, 0.0)
    buckets = finite[:whole].reshape(-1, size)
    start = np.arange(len(buckets)) * size
    chosen = np.concatenate([start + buckets.argmin(1), start + buckets.argmax(1), [0, count - 1]])
    return np.unique(chosen)


def save_run_figure(records: np.ndarray, path: Path, title: str) -> Path:
    """Draw `records` (array of LogRecord, shape (N,)) into a PNG at `path`; returns the path.

    `DataError` if there are fewer than two, or if it cannot be written.
    """
    if len(records) < 2:
        raise DataError(f"{path}: nothing to draw, the run has {len(records)} records")
    with_network = bool(np.any(records["network_torque_Nm"][powered(records)] != 0.0))
    heights = (3.0, 3.0, 4.0, 2.4) if with_network else (3.0, 3.0, 4.0)
    with canvas(0.77 * sum(heights), title) as figure:
        _draw(figure.subplots(len(heights), 1, sharex=True, height_ratios=heights), records, with_network)
    return save_png(figure, path)


def seconds(records: np.ndarray) -> np.ndarray:
    """float64[N] since the first record."""
    since: np.ndarray = (records["time_ns"] - records["time_ns"][0]) * 1e-9
    return since


def powered(records: np.ndarray) -> np.ndarray:
    """bool[N]: the law is at work (while RELEASING its parts keep their last values)."""
    at_work: np.ndarray = (records["phase"] >= AxisPhase.APPROACH) & (records["phase"] <= AxisPhase.RAMPING)
    return at_work


def _draw(axes: np.ndarray, records: np.ndarray, with_network: bool) -> None:
    on, time_s = powered(records), seconds(records)

    def draw(axis: Axes, values: np.ndarray, label: str, color: str, **style: Any) -> None:
        values = np.where(on, values, np.nan) if style.pop("powered", True) else values
        keep = drawn_indices(values)
        axis.plot(time_s[keep], values[keep], color=color, label=label, **style)

    draw(axes[0], records["position_rad"], "measured", BLUE, powered=False, linewidth=1.6)
    draw(axes[0], records["desired_position_rad"], "desired", ORANGE, linestyle="--")
    axes[0].set_ylabel("joint angle [rad]")
    draw(axes[1], records["error_rad"] * 1e3, "error", BLUE)
    axes[1].set_ylabel("error q - q_d [mrad]")
    if not np.any(records["feedback_torque_Nm"][on]):  # the drive closes the loop: its torque is not the command
        draw(axes[2], records["measured_torque_Nm"], "measured", RED, powered=False, linewidth=0.8)
    draw(axes[2], records["command_torque_Nm"], "command", INK, powered=False, linewidth=1.4)
    for name, color in _PARTS.items():
        values = records[f"{name}_torque_Nm"]
        if np.any(values[on] != 0.0):
            draw(axes[2], values, name, color, linewidth=0.9)
    axes[2].set_ylabel("joint torque [Nm]")
    if with_network:
        draw(axes[3], records["network_torque_Nm"], "network", RED)
        axes[3].set_ylabel("network output,\nsubtracted [Nm]")
    axes[-1].set_xlabel("time [s]")

    _mark_phases(axes, records["phase"], time_s)
    _mark_fault(axes, records["fault"], time_s)
    for axis in (axes[0], axes[2]):
        axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    axes[1].text(1.015, 0.98, _error_text(records), transform=axes[1].transAxes, va="top", fontsize=9, color=GREY)
    axes[0].figure.align_ylabels(axes)


def _error_text(records: np.ndarray) -> str:
    error = records["error_rad"][records["phase"] == AxisPhase.TRACKING] * 1e3
    error = error[np.isfinite(error)]
    if not len(error):
        return "no tracking"
    rmse = np.sqrt(np.mean(np.square(error)))
    return f"while tracking\nmin {error.min():.3g}\nmax {error.max():.3g}\nRMSE {rmse:.3g}"


def _mark_phases(axes: np.ndarray, phase: np.ndarray, time_s: np.ndarray) -> None:
    """Shade everything that is not tracking, with a word at the top."""
    edges = [0, *(np.flatnonzero(np.diff(phase)) + 1), len(phase)]
    stretches: list[tuple[str, int, int]] = []
    for begin, end in pairwise(edges):
        value = int(phase[begin])
        name = "approach" if value == AxisPhase.APPROACH else "stop" if value > AxisPhase.TRACKING else "off"
        if value == AxisPhase.TRACKING:
            continue
        if stretches and stretches[-1][0] == name and stretches[-1][2] == begin:
            stretches[-1] = (name, stretches[-1][1], end)
        else:
            stretches.append((name, begin, end))
    for name, begin, end in stretches:
        left, right = time_s[begin], time_s[min(end, len(time_s) - 1)]
        for axis in axes:
            axis.axvspan(left, right, color=_TONES[name], linewidth=0.0, zorder=0)
        if right - left > 0.04 * time_s[-1]:
            axes[0].annotate(
                name, ((left + right) / 2, 0.97), xycoords=("data", "axes fraction"), ha="center", va="top",
                fontsize=8.5, color=GREY,
            )  # fmt: skip


def _mark_fault(axes: np.ndarray, fault: np.ndarray, time_s: np.ndarray) -> None:
    found = np.flatnonzero(fault)
    if not len(found):
        return
    name, at_s = fault_name(int(fault[found[0]])), float(time_s[found[0]])
    for axis in axes:
        axis.axvline(at_s, color=RED, linewidth=1.2)
    left = at_s > 0.5 * time_s[-1]
    axes[1].annotate(
        name, (at_s, 0.96), xycoords=("data", "axes fraction"), xytext=(-5 if left else 5, 0), fontsize=9,
        textcoords="offset points", ha="right" if left else "left", va="top", color=RED, fontweight="bold",
    )  # fmt: skip


class KeptRecords(AbstractContextManager["KeptRecords"]):
    """Takes arrays of LogRecord in order of time, gives them back as one.  The file is gone when this is closed."""

    def __init__(self, folder: Path, in_memory: int = IN_MEMORY) -> None:
        self._folder, self._in_memory = folder, in_memory
        self._parts: list[Any] = []
        self._count, self._in_file = 0, False
        with writing(folder):  # now: the folder may be removed or fill before it is needed
            self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 closed in close()

    def __len__(self) -> int:
        return self._count

    def append(self, records: np.ndarray) -> None:
        """Keep `records` (array of LogRecord, shape (N,)); `DataError` if the disk is full."""
        self._count += len(records)
        self._parts.append(records)
        self._in_file = self._count > self._in_memory
        if not self._in_file:
            return
        with writing(self._folder):
            for part in self._parts:
                self._file.write(np.ascontiguousarray(part).tobytes())
        self._parts.clear()

    def records(self) -> Any:
        """All of them: record array of LogRecord, shape (N,); of a long run a view of the file, read-only."""
        if not self._in_file:
            kept = np.concatenate(self._parts) if self._parts else np.zeros(0, dtype_of(LogRecord))
            return kept.view(np.recarray)
        with writing(self._folder):
            self._file.flush()
        return np.memmap(self._file, dtype_of(LogRecord), mode="r", shape=(self._count,)).view(np.recarray)

    def close(self) -> None:
        """Let go of the file; arrays that `records` has given stay valid."""
        with suppress(OSError):  # what is buffered for a disk that is full is of no use any more
            self._file.close()

    def __exit__(self, *_: object) -> None:
        self.close()
