"""One picture of a run over time: trajectory, error, torque in its parts, the network's output where there is one.

The approach is shaded, the time of a fault is marked, stopping is shaded in another tone.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jointctl.drivers.errors import DataError
from jointctl.firmware_py.states import AxisPhase, fault_name
from jointctl.tools.drawing import BLUE, COLOURS, GREEN, GREY, INK, ORANGE, RED, TEAL, VIOLET, canvas, save_png

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
    axes[1].set_ylabel("error q - q$_d$ [mrad]")
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
