"""The figures of one run: trajectory, error, torque in its parts, network, observer, friction map, times, temperature;
and those of several beside each other.

`records` is an array of LogRecord, shape (N,), everywhere.  Times are seconds since the first record.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from jointctl.firmware_py.input_file import parse_toml
from jointctl.firmware_py.states import AxisPhase, Fault, fault_name
from jointctl.tools.drawing import (
    BLUE,
    COLOURS,
    EITHER_WAY,
    GREEN,
    GREY,
    INK,
    MID_BLUE,
    ORANGE,
    RED,
    SERIES,
    SOFT,
    TEAL,
    VIOLET,
)
from jointctl.tools.recording.report_page import Block, Figure, Paragraph, Table, draw
from jointctl.tools.recording.run_log_reader import RunLog, began_at, event_rows, missing_in
from jointctl.tools.recording.run_summary import (
    TIMES,
    Range,
    RunSummary,
    TimeSummary,
    drawn_indices,
    powered,
    seconds,
    torques_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Picture


LEAST_READINGS = 10  # of the temperature; fewer are in the table only
POINTS = 1600  # more than the page is wide; least and greatest of each bucket, so that no peak is lost
_PARTS = (
    ("friction", "friction", ORANGE),
    ("inertia", "inertia", GREEN),
    ("feedback", "feedback", BLUE),
    ("gravity", "gravity", GREY),
    ("network", "network (subtracted)", RED),
    ("observer", "observer", VIOLET),
    ("learned", "learned", TEAL),
)
_CLOUD_POINTS = 20_000
_ROW_CHARACTERS, _HANDLE_CHARACTERS = 125, 6  # of a legend: wider, and nothing is left of the axes
_LEAST_SPEED_radps = 1e-3
_BINS = 25  # of speed, in each direction
_LEAST_IN_BIN = 10


def line(axes: Axes, time_s: np.ndarray, values: np.ndarray, color: str, label: str = "", **style: Any) -> None:
    """A line with at most POINTS points."""
    keep = drawn_indices(values, POINTS)
    axes.plot(time_s[keep], values[keep], color=color, label=label or None, **style)


def _finish(axes: Axes, records: np.ndarray, ylabel: str, *, legend: bool = True, xlabel: bool = True) -> None:
    axes.set_ylabel(ylabel)
    if xlabel:
        axes.set_xlabel("time [s]")
    _mark(axes, records)
    if legend:
        legend_above(axes)


def legend_above(axes: Axes) -> None:
    """Outside, and not at the side: the time axes of all figures are then equally wide."""
    widths = [len(label) + _HANDLE_CHARACTERS for label in axes.get_legend_handles_labels()[1]]
    if widths:
        in_one_row = sum(widths) <= _ROW_CHARACTERS
        columns = len(widths) if in_one_row else max(1, _ROW_CHARACTERS // max(widths))
        axes.legend(loc="lower left", bbox_to_anchor=(-0.01, 1.0), ncols=columns, columnspacing=1.4, handlelength=1.6)


def _mark(axes: Axes, records: np.ndarray) -> None:
    """Shade what is not tracking; a red line where the fault came."""
    phase, time_s = records["phase"], seconds(records)
    edges = [0, *(np.flatnonzero(np.diff(phase)) + 1).tolist(), len(phase) - 1]
    for begin, end in pairwise(edges):
        value = int(phase[begin])
        if value == AxisPhase.TRACKING or end <= begin:
            continue
        tone = "wash-1" if value == AxisPhase.APPROACH else "wash-2" if value > AxisPhase.TRACKING else "wash-3"
        axes.axvspan(time_s[begin], time_s[end], color=COLOURS[tone], linewidth=0.0, zorder=0)
    found = np.flatnonzero(records["fault"])
    if len(found):
        axes.axvline(time_s[found[0]], color=RED, linewidth=1.4)


def trajectory_figure(records: np.ndarray) -> Figure:
    time_s, on = seconds(records), powered(records)

    def paint(figure: Picture) -> None:
        axes = figure.subplots()
        line(axes, time_s, records["position_rad"], BLUE, "measured", linewidth=1.8)
        desired = np.where(on, records["desired_position_rad"], np.nan)
        line(axes, time_s, desired, ORANGE, "desired", linestyle="--")
        _finish(axes, records, "joint angle [rad]")

    caption = "Shaded: blue approach, amber stopping, grey power off; red line: fault." + _fault_words(records)
    return draw(2.9, paint, "Measured and desired joint angle over time", caption)


def _fault_words(records: np.ndarray) -> str:
    found = np.flatnonzero(records["fault"])
    if not len(found):
        return ""
    return f" {fault_name(int(records['fault'][found[0]]))} at {float(seconds(records)[found[0]]):.3f} s."


def error_figure(records: np.ndarray) -> Figure:
    """e = q - q_d while the law is at work."""

    def paint(figure: Picture) -> None:
        axes = figure.subplots()
        error = np.where(powered(records), records["error_rad"] * 1e3, np.nan)
        line(axes, seconds(records), error, BLUE)
        axes.axhline(0.0, color=SOFT, linewidth=0.7)
        _finish(axes, records, "error [mrad]", legend=False)

    return draw(2.6, paint, "Tracking error over time", "Tracking error e = q - q_d at the joint.")


def torque_figure(records: np.ndarray) -> Figure:
    """The command and the parts that the law adds up."""
    time_s, on = seconds(records), powered(records)

    def paint(figure: Picture) -> None:
        above, below = figure.subplots(2, 1, sharex=True)
        line(above, time_s, records["measured_torque_Nm"], ORANGE, "measured", linewidth=0.8)
        line(above, time_s, records["command_torque_Nm"], INK, "command")
        _finish(above, records, "torque [Nm]", xlabel=False)
        for name, label, color in _PARTS:
            values = records[f"{name}_torque_Nm"]
            if np.any(values[on] != 0.0):
                line(below, time_s, np.where(on, values, np.nan), color, label, linewidth=0.9)
        _finish(below, records, "its parts [Nm]", legend=bool(below.get_lines()))

    caption = "At the joint. Above: commanded and measured; below: the parts of the command that are not zero."
    return draw(4.6, paint, "Torque over time, whole and in its parts", caption)


def network_figure(records: np.ndarray) -> Figure | None:
    """Output and weights of the RBF network; None if it was not at work."""
    on, time_s = powered(records), seconds(records)
    if not np.any(records["network_torque_Nm"][on]):
        return None

    def paint(figure: Picture) -> None:
        above, below = figure.subplots(2, 1, sharex=True)
        line(above, time_s, np.where(on, records["network_torque_Nm"], np.nan), RED)
        _finish(above, records, "output [Nm]", legend=False, xlabel=False)
        weights = records["weights"]
        for i in range(weights.shape[1]):
            line(below, time_s, np.where(on, weights[:, i], np.nan), BLUE, linewidth=0.7, alpha=0.6)
        _finish(below, records, "weights [Nm]", legend=False)

    spread = float(np.ptp(records["weights"][on][-1]))
    caption = (
        f"Network output, subtracted from the command, and its 15 weights; at the end they differ by {spread:.3g} Nm."
    )
    return draw(4.0, paint, "Network output and weights over time", caption)


def estimator_figure(records: np.ndarray) -> Figure | None:
    """Disturbance observer and iterative learning; None if neither was at work."""
    on, time_s = powered(records), seconds(records)
    used = [
        part for part in _PARTS if part[0] in ("observer", "learned") and np.any(records[f"{part[0]}_torque_Nm"][on])
    ]
    if not used:
        return None

    def paint(figure: Picture) -> None:
        axes = figure.subplots()
        for name, label, color in used:
            line(axes, time_s, np.where(on, records[f"{name}_torque_Nm"], np.nan), color, label)
        _finish(axes, records, "torque [Nm]")

    caption = "What the disturbance observer and the iterative learning add to the command."
    return draw(2.6, paint, "Observer and learned torque over time", caption)


def friction_points(records: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(velocity [rad/s], friction [Nm]) at the joint, in motion while TRACKING.

    Friction = measured torque - inertia x desired acceleration - gravity: as good as the drive's torque reading, the
    believed inertia, and the tracking; load torques count as friction.
    """
    moving = (records["phase"] == AxisPhase.TRACKING) & (np.abs(records["desired_velocity_radps"]) > _LEAST_SPEED_radps)
    rows = records[moving]
    friction = rows["measured_torque_Nm"] - rows["inertia_torque_Nm"] - rows["gravity_torque_Nm"]
    return np.asarray(rows["velocity_radps"]), np.asarray(friction)


def binned(velocity: np.ndarray, torque: np.ndarray) -> list[np.ndarray]:
    """One array a direction, of the bins of speed that hold enough points: (velocity, 5 %, median, 95 %), (M, 4)."""
    found = []
    for sign in (-1.0, 1.0):
        inside = sign * velocity > 0.0
        speed, friction = np.abs(velocity[inside]), torque[inside]
        if not len(speed):
            continue
        edges = np.linspace(0.0, speed.max(), _BINS + 1)
        at = np.clip(np.digitize(speed, edges) - 1, 0, _BINS - 1)
        rows = [
            (sign * 0.5 * (edges[i] + edges[i + 1]), *np.percentile(friction[at == i], (5.0, 50.0, 95.0)))
            for i in range(_BINS)
            if np.count_nonzero(at == i) >= _LEAST_IN_BIN
        ]
        if rows:
            found.append(np.array(rows))
    return found


def friction_figure(records: np.ndarray) -> Figure | None:
    """Friction over velocity, measured and believed; None without motion."""
    velocity, torque = friction_points(records)
    if len(velocity) < 100:
        return None
    directions = binned(velocity, torque)
    model = records[(records["phase"] == AxisPhase.TRACKING) & (records["friction_torque_Nm"] != 0.0)]

    def paint(figure: Picture) -> None:
        axes = figure.subplots()
        axes.set_xmargin(0.02)
        step = -(-len(velocity) // _CLOUD_POINTS)
        axes.plot(velocity[::step], torque[::step], ".", color=MID_BLUE, markersize=1.5, alpha=0.25, rasterized=True)
        for i, rows in enumerate(directions):
            label = "median" if i == 0 else None
            axes.plot(rows[:, 0], rows[:, 2], color=BLUE, label=label, linewidth=1.6)
            band = "5 to 95 %" if i == 0 else None
            axes.fill_between(rows[:, 0], rows[:, 1], rows[:, 3], color=BLUE, alpha=0.18, linewidth=0.0, label=band)
        if len(model):
            order = np.argsort(model["desired_velocity_radps"], kind="stable")
            order = order[:: -(-len(order) // POINTS)]
            axes.plot(
                model["desired_velocity_radps"][order], model["friction_torque_Nm"][order], ".",
                color=ORANGE, markersize=2.0, label="feed-forward",
            )  # fmt: skip
        axes.set_xlabel("joint velocity [rad/s]")
        axes.set_ylabel("friction at the joint [Nm]")
        legend_above(axes)

    caption = (
        "Friction map: measured torque less the believed inertia and gravity, over the measured velocity; "
        "a load torque counts as friction. Feed-forward: what the controller compensates, over the desired velocity."
    )
    return draw(3.6, paint, "Friction torque over velocity", caption)


def times_figure(records: np.ndarray) -> Figure:
    """How late the loop woke up, how long a round trip and the work took."""

    def paint(figure: Picture) -> None:
        axes = figure.subplots()
        axes.set_xmargin(0.02)
        for name, label, color in (
            ("wake_late_ns", "wake-up late", BLUE),
            ("round_trip_ns", "round trip", ORANGE),
            ("work_ns", "work", GREEN),
        ):
            values = records[name] / 1000.0
            values = values[values > 0.0]
            if len(values):
                edges = np.geomspace(max(values.min(), 0.5), max(values.max(), 1.0) * 1.001, 80).tolist()
                axes.hist(values, edges, histtype="step", color=color, label=label, linewidth=1.3)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel("duration [us]")
        axes.set_ylabel("cycles")
        legend_above(axes)

    caption = (
        "Histogram of every logged cycle, both axes logarithmic. The right end of the blue line is the worst wake-up."
    )
    return draw(2.9, paint, "Histogram of wake-up delay, round trip and work", caption)


def run_figures(records: np.ndarray) -> list[Figure]:
    """All that apply, in the order of the report."""
    found = (
        trajectory_figure(records),
        error_figure(records),
        torque_figure(records),
        network_figure(records),
        estimator_figure(records),
        friction_figure(records),
        times_figure(records),
    )
    return [figure for figure in found if figure is not None]


def temperature_figure(log: RunLog) -> list[Figure]:
    """The drive's temperature over the run, where it reports one: one figure, or none."""
    if len(log.temperatures) < LEAST_READINGS:
        return []
    time_s = (log.temperatures["time_ns"] - log.records["time_ns"][0]) * 1e-9

    def paint(figure: Picture) -> None:
        axes = figure.subplots()
        axes.plot(time_s, log.temperatures["temperature_degC"], color=RED, drawstyle="steps-post")
        axes.set_ylabel("temperature [°C]")
        axes.set_xlabel("time [s]")

    return [draw(2.2, paint, "Temperature of the drive over time", "As the drive tells it, once a second.")]


# --- runs beside each other: what was tracked at the same trajectory time, and the difference to the first run ---

SAME_MOTION_rad = 1e-3
_SHORTEST = 10  # samples in common


def first_motion(records: np.ndarray) -> np.ndarray:
    """bool[N]: TRACKING, and the motion has not been changed yet (that sets the trajectory time back)."""
    tracking: np.ndarray = records["phase"] == AxisPhase.TRACKING
    rows = np.flatnonzero(tracking)
    back = np.flatnonzero(np.diff(records["trajectory_s"][rows]) < 0.0)
    if len(back):
        tracking = tracking & (np.arange(len(records)) <= rows[back[0]])
    return tracking


def aligned(first: np.ndarray, second: np.ndarray) -> tuple[Any, np.ndarray]:
    """(rows of `first` while TRACKING within the time common to both, bool[N] of `second`'s TRACKING rows)."""
    a, in_b = first[first_motion(first)], first_motion(second)
    if not len(a) or not np.any(in_b):
        return a[:0], in_b
    time_b = second["trajectory_s"][in_b]
    time_a = a["trajectory_s"]
    return a[(time_a >= time_b[0]) & (time_a <= time_b[-1])], in_b


def at_times(records: np.ndarray, chosen: np.ndarray, name: str, time_s: np.ndarray) -> np.ndarray:
    """A field of the chosen records at these trajectory times, linear between the samples."""
    return np.interp(time_s, records["trajectory_s"][chosen], records[name][chosen])


def _drawn(i: int) -> dict[str, Any]:
    """How the line of run i differs from the others."""
    colours = (*SERIES, *EITHER_WAY)
    return {"color": colours[i % len(colours)], "linestyle": "-" if i < len(colours) else "--"}


def _lines_of(axes: Axes, names: Sequence[str], runs: Sequence[Any], field: str, scale: float) -> None:
    for i, (name, records) in enumerate(zip(names, runs, strict=True)):
        rows = records[first_motion(records)]
        if len(rows):
            line(axes, rows["trajectory_s"], rows[field] * scale, label=name, linewidth=1.0, **_drawn(i))


def _overlay(
    names: Sequence[str], runs: Sequence[Any], field: str, scale: float, unit: str, alt: str, caption: str
) -> Figure:
    def paint(figure: Picture) -> None:
        above, below = figure.subplots(2, 1, sharex=True)
        _lines_of(above, names, runs, field, scale)
        for i, records in enumerate(runs[1:], 1):
            rows, chosen = aligned(runs[0], records)
            if len(rows) < _SHORTEST:
                continue
            time_s = rows["trajectory_s"]
            difference = (at_times(records, chosen, field, time_s) - rows[field]) * scale
            style = {"color": INK} if len(runs) == 2 else _drawn(i)
            line(below, time_s, difference, label=f"{names[i]} less {names[0]}", linewidth=0.9, **style)
        below.axhline(0.0, color=SOFT, linewidth=0.7)
        above.set_ylabel(unit)
        below.set_ylabel(f"difference {unit.partition(' ')[2]}")
        below.set_xlabel("trajectory time [s]")
        for axes in (above, below):
            legend_above(axes)

    return draw(4.6, paint, alt, caption)


def _friction(names: Sequence[str], runs: Sequence[Any]) -> Figure:
    def paint(figure: Picture) -> None:
        axes = figure.subplots()
        axes.set_xmargin(0.02)
        for i, (name, records) in enumerate(zip(names, runs, strict=True)):
            for number, rows in enumerate(binned(*friction_points(records))):
                label = name if number == 0 else None
                axes.plot(rows[:, 0], rows[:, 2], label=label, linewidth=1.5, **_drawn(i))
        axes.set_xlabel("joint velocity [rad/s]")
        axes.set_ylabel("friction at the joint [Nm]")
        legend_above(axes)

    return draw(3.4, paint, "Friction over velocity of each run", "Friction map, medians in bins of velocity.")


def comparison(names: Sequence[str], runs: Sequence[Any]) -> list[Block]:
    """Error, torque and friction of the runs, aligned by trajectory time; two runs or more."""
    blocks: list[Block] = []
    for name, records in zip(names[1:], runs[1:], strict=True):
        rows, chosen = aligned(runs[0], records)
        if len(rows) < _SHORTEST:
            blocks.append(Paragraph(f"{name} and {names[0]} have no trajectory time in common: no difference."))
            continue
        desired = at_times(records, chosen, "desired_position_rad", rows["trajectory_s"])
        apart = float(np.max(np.abs(desired - rows["desired_position_rad"])))
        if apart > SAME_MOTION_rad:
            text = f"{name} and {names[0]} follow different motions, up to {apart * 1e3:.3g} mrad apart: "
            blocks.append(Paragraph(text + "their difference tells little."))
    return [
        *blocks,
        _overlay(names, runs, "error_rad", 1e3, "error [mrad]", "Tracking errors and their difference",
                 "Tracking errors at the same trajectory time; below, each less the first."),
        _overlay(names, runs, "command_torque_Nm", 1.0, "torque [Nm]", "Command torques and their difference",
                 "Command torques at the same trajectory time; below, each less the first."),
        _friction(names, runs),
    ]  # fmt: skip


def together(names: Sequence[str], runs: Sequence[Any]) -> list[Block]:
    """The same of the joints of one arm, which move differently: no differences."""

    def figure_of(field: str, scale: float, label: str, title: str) -> Figure:
        def paint(figure: Picture) -> None:
            axes = figure.subplots()
            _lines_of(axes, names, runs, field, scale)
            axes.set_ylabel(label)
            axes.set_xlabel("trajectory time [s]")
            legend_above(axes)

        return draw(3.4, paint, f"{title} of each joint", f"{title} of each joint.")

    return [
        figure_of("position_rad", 1.0, "joint angle [rad]", "Measured angle"),
        figure_of("error_rad", 1e3, "error [mrad]", "Tracking error"),
        figure_of("command_torque_Nm", 1.0, "torque [Nm]", "Command torque"),
        _friction(names, runs),
    ]


# --- Tables: what ran, the figures of the run side by side with their difference, the events ---


Figures = list[tuple[str, float | None, int]]
_EVENTS_SHOWN = 300


def _configuration(log: RunLog) -> dict[str, Any]:
    try:
        return parse_toml(log.metadata.get("run", {}).get("configuration", ""))
    except tomllib.TOMLDecodeError:
        return {}


def _law(settings: Mapping[str, Any]) -> tuple[str, str, str]:
    """Which one, its gains and its friction; a drive that closes its own loops has its own gains."""
    control, cascade = settings.get("control", {}), settings.get("drive", {}).get("cascade")
    kind, friction = str(control.get("kind", "")), str(control.get("feed_forward", ""))
    if cascade is None:
        return kind, f"{control['kp']}, {control['kv']}" if "kp" in control and "kv" in control else "", friction
    if cascade.get("torque_offset", True):
        return f"the drive's, {kind} fed forward", "", friction
    return "the drive's alone", "", "none"


def what_ran(names: Sequence[str], logs: Sequence[RunLog]) -> Table:
    """One column a log."""
    rows: list[list[object]] = []
    settings = [_configuration(log) for log in logs]
    drives = [log.metadata.get("drive", {}) for log in logs]
    versions = [log.metadata.get("versions", {}) for log in logs]
    clean = {"": "-"}

    def add(name: str, values: Sequence[object]) -> None:
        if any(value not in ("", None) for value in values):
            rows.append([name, *(clean.get(str(value), value) for value in values)])

    def setting(section: str, key: str) -> list[object]:
        return [found.get(section, {}).get(key, "") for found in settings]

    add("began", [began_at(log) for log in logs])
    add("configuration", [log.metadata.get("run", {}).get("path", "") for log in logs])
    add("drive", [" ".join(filter(None, (d.get("name"), d.get("product")))) for d in drives])
    add("serial number", [d.get("serial", "") for d in drives])
    add("mode", [d.get("mode", "") for d in drives])
    laws = [_law(found) for found in settings]
    for at, name in enumerate(("controller", "kp [1/s²], kv [1/s]", "friction feed-forward")):
        add(name, [law[at] for law in laws])
    add("trajectory", setting("trajectory", "kind"))
    add("rate [Hz]", setting("loop", "rate_Hz"))
    add("friction model, SHA-256", [log.metadata.get("friction", {}).get("sha256", "")[:16] for log in logs])
    add("jointctl", [v.get("jointctl", "") for v in versions])
    add("log complete", ["yes" if log.complete else "no, cut off" for log in logs])
    return Table(["", *names], rows)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{round(value, digits) + 0.0:.{digits}f}"  # never -0.00


def _ends(name: str, found: Range | None, unit: str, scale: float, digits: int) -> Figures:
    low = None if found is None else found.least * scale
    high = None if found is None else found.greatest * scale
    return [(f"{name}, least [{unit}]", low, digits), (f"{name}, greatest [{unit}]", high, digits)]


def _times(name: str, found: TimeSummary | None) -> Figures:
    keys = (("p50", "p50_us"), ("p99", "p99_us"), ("p99.9", "p99_9_us"), ("max", "max_us"))
    return [(f"{name}, {word} [us]", None if found is None else float(getattr(found, key)), 0) for word, key in keys]


def motion_of(summary: RunSummary) -> Figures:
    """(name with unit, value or None, digits) of what was tracked with which torque."""
    error, late = summary.error, summary.late_error
    rows: Figures = [
        ("duration [s]", summary.duration_s, 2),
        ("tracked [s]", summary.tracked_s, 2),
        *_ends("error", error.range_rad if error else None, "mrad", 1e3, 3),
        ("error, RMSE [mrad]", error.rmse_rad * 1e3 if error else None, 3),
        *_ends("error in the second half", late.range_rad if late else None, "mrad", 1e3, 3),
        ("error in the second half, RMSE [mrad]", late.rmse_rad * 1e3 if late else None, 3),
        ("within 1 mrad for good after [s]", summary.settling_s, 2),
    ]
    for name, torque, digits in torques_of(summary):
        rows += _ends(name, torque, "Nm", 1.0, digits)
    rows += _ends("temperature of the drive", summary.temperature_degC, "°C", 1.0, 1)
    return rows


def deadlines_of(summary: RunSummary, missing: int | None) -> Figures:
    """How well the loop kept its time, in the same form."""
    rows = [row for name, key in TIMES.items() for row in _times(name, getattr(summary, key))]
    rows += [
        ("cycles", float(summary.cycles), 0),
        ("cycles skipped", float(summary.skipped_cycles), 0),
        ("oldest sample [cycles]", float(summary.oldest_sample_cycles), 0),
        ("records missing in the log", None if missing is None else float(missing), 0),
    ]
    return rows


def figure_tables(
    names: Sequence[str], logs: Sequence[RunLog], summaries: Sequence[RunSummary], *, of_one_arm: bool = False
) -> list[Table]:
    """Motion and deadlines of each run; of two runs, but not of two joints, also the second less the first."""
    faults = [s.fault for s in summaries]
    ended = "" if all(fault == Fault.NONE.name for fault in faults) else f"Ended by a fault: {', '.join(faults)}."
    deadlines = [deadlines_of(s, missing_in(log)) for s, log in zip(summaries, logs, strict=True)]
    motion = [motion_of(s) for s in summaries]
    two = len(names) == 2 and not of_one_arm
    return [_side_by_side("motion", names, motion, ended, two), _side_by_side("deadlines", names, deadlines, "", two)]


def _side_by_side(title: str, names: Sequence[str], listed: Sequence[Figures], caption: str, two: bool) -> Table:
    rows: list[list[object]] = []
    for row in zip(*listed, strict=True):
        name, digits = row[0][0], max(digits for _, _, digits in row)
        values = [value for _, value, _ in row]
        if all(value is None for value in values):
            continue
        cells: list[object] = [name, *(_number(value, digits) for value in values)]
        if two:
            first, second = values
            known = first is not None and second is not None
            cells.append(f"{round(second - first, digits) + 0.0:+.{digits}f}" if known else "-")
        rows.append(cells)
    return Table([title, *names, *(["difference"] if two else [])], rows, caption)


def events_table(log: RunLog) -> Table:
    """Time since the first record, level, source, text."""
    rows = event_rows(log)
    tones = {i: row[1] for i, row in enumerate(rows[:_EVENTS_SHOWN]) if row[1] in ("error", "warning")}
    left_out = len(rows) - _EVENTS_SHOWN
    caption = f"and {left_out} more; jointctl log info tells them all" if left_out > 0 else ""
    return Table(["time [s]", "level", "source", "text"], rows[:_EVENTS_SHOWN], caption, tones)
