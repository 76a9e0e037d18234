"""Runs beside each other: what was tracked at the same trajectory time, and the difference to the first run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jointctl.firmware_py.states import AxisPhase
from jointctl.tools.drawing import INK, SERIES, SOFT
from jointctl.tools.recording.report_figures import binned, friction_points, legend_above, line
from jointctl.tools.recording.report_page import Block, Figure, Paragraph, draw

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

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


def _overlay(
    names: Sequence[str], runs: Sequence[Any], field: str, scale: float, unit: str, alt: str, caption: str
) -> Figure:
    def paint(figure: Picture) -> None:
        above, below = figure.subplots(2, 1, sharex=True)
        for i, (name, records) in enumerate(zip(names, runs, strict=True)):
            rows = records[first_motion(records)]
            if len(rows):
                line(above, rows["trajectory_s"], rows[field] * scale, SERIES[i % len(SERIES)], name, linewidth=1.0)
        for i, records in enumerate(runs[1:], 1):
            rows, chosen = aligned(runs[0], records)
            if len(rows) < _SHORTEST:
                continue
            time_s = rows["trajectory_s"]
            difference = (at_times(records, chosen, field, time_s) - rows[field]) * scale
            color = INK if len(runs) == 2 else SERIES[i % len(SERIES)]
            line(below, time_s, difference, color, f"{names[i]} less {names[0]}", linewidth=0.9)
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
                axes.plot(rows[:, 0], rows[:, 2], color=SERIES[i % len(SERIES)], label=label, linewidth=1.5)
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
