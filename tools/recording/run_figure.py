"""One picture of a run over time: trajectory, error, torque in its parts, the network's output where there is one.

The approach is shaded, the time of a fault is marked, stopping is shaded in another tone.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import DataError
from firmware_py.states import AxisPhase, Fault

POINTS = 4000  # a bucket of samples is drawn by its least and greatest value, so that no peak is lost
_BLUE, _ORANGE, _GREEN, _RED, _GREY = "#1f5fa8", "#d9822b", "#3a8f4d", "#b3282d", "#555555"
_PARTS = {
    "friction": _ORANGE, "inertia": _GREEN, "feedback": _BLUE, "gravity": _GREY, "observer": "#7b4fa3",
    "learned": "#3b8ea5",
}  # fmt: skip


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


def save_run_figure(records: Any, path: str | Path, title: str = "") -> Path:
    """Draw `records` (array of LogRecord, shape (N,)) into a PNG at `path`; returns the path."""
    path = Path(path)
    if len(records) < 2:
        raise DataError(f"{path}: nothing to draw, the run has {len(records)} records")
    # slow to import, and only wanted here; no display is needed
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    time_s = (records["time_ns"] - records["time_ns"][0]) * 1e-9
    # while RELEASING the law rests and its parts keep their last values
    powered = (records["phase"] >= AxisPhase.APPROACH) & (records["phase"] <= AxisPhase.RAMPING)
    with_network = bool(np.any(records["network_torque_Nm"][powered] != 0.0))
    heights = (3.0, 3.0, 4.0, 2.4) if with_network else (3.0, 3.0, 4.0)
    figure = Figure(figsize=(10.0, 0.77 * sum(heights)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)

    def draw(axis: Any, values: np.ndarray, label: str, color: str, **style: Any) -> None:
        values = np.where(powered, values, np.nan) if style.pop("powered", True) else values
        keep = drawn_indices(values)
        axis.plot(time_s[keep], values[keep], color=color, label=label, **{"linewidth": 1.1, **style})

    draw(axes[0], records["position_rad"], "measured", _BLUE, powered=False, linewidth=1.6)
    draw(axes[0], records["desired_position_rad"], "desired", _ORANGE, linestyle="--")
    axes[0].set_ylabel("joint angle [rad]")
    draw(axes[1], records["error_rad"] * 1e3, "error", _BLUE)
    axes[1].set_ylabel("error q - q$_d$ [mrad]")
    draw(axes[2], records["command_torque_Nm"], "command", "black", powered=False, linewidth=1.4)
    for name, color in _PARTS.items():
        values = records[f"{name}_torque_Nm"]
        if np.any(values[powered] != 0.0):
            draw(axes[2], values, name, color, linewidth=0.9)
    axes[2].set_ylabel("joint torque [Nm]")
    if with_network:
        draw(axes[3], records["network_torque_Nm"], "network", _RED)
        axes[3].set_ylabel("network output,\nsubtracted [Nm]")
    axes[-1].set_xlabel("time [s]")

    _mark_phases(axes, records["phase"], time_s)
    _mark_fault(axes, records["fault"], time_s)
    for axis in axes:
        axis.grid(True, color="#dddddd", linewidth=0.6)
        axis.margins(x=0.0)
        axis.spines[["top", "right"]].set_visible(False)
        axis.set_axisbelow(True)
    for axis in (axes[0], axes[2]):
        axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=9)
    axes[1].text(1.015, 0.98, _error_text(records), transform=axes[1].transAxes, va="top", fontsize=9, color=_GREY)
    axes[0].set_title(title or "Run", loc="left", fontsize=12, fontweight="bold")
    figure.align_ylabels(axes)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110, format="png")
    except OSError as error:
        raise DataError(f"{path}: cannot be written: {error.strerror or error}") from None
    return path


def _error_text(records: Any) -> str:
    error = records["error_rad"][records["phase"] == AxisPhase.TRACKING] * 1e3
    error = error[np.isfinite(error)]
    if not len(error):
        return "no tracking"
    rmse = np.sqrt(np.mean(np.square(error)))
    return f"while tracking\nmin {error.min():.3g}\nmax {error.max():.3g}\nRMSE {rmse:.3g}"


def _mark_phases(axes: Any, phase: np.ndarray, time_s: np.ndarray) -> None:
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
    tones = {"approach": "#e3edf8", "stop": "#f6ead9", "off": "#eeeeee"}
    for name, begin, end in stretches:
        left, right = time_s[begin], time_s[min(end, len(time_s) - 1)]
        for axis in axes:
            axis.axvspan(left, right, color=tones[name], linewidth=0.0, zorder=0)
        if right - left > 0.04 * time_s[-1]:
            axes[0].annotate(
                name, ((left + right) / 2, 0.97), xycoords=("data", "axes fraction"), ha="center", va="top",
                fontsize=8.5, color=_GREY,
            )  # fmt: skip


def _mark_fault(axes: Any, fault: np.ndarray, time_s: np.ndarray) -> None:
    found = np.flatnonzero(fault)
    if not len(found):
        return
    code, at_s = int(fault[found[0]]), float(time_s[found[0]])
    name = Fault(code).name.replace("_", " ").lower() if code in list(Fault) else f"fault {code}"
    for axis in axes:
        axis.axvline(at_s, color=_RED, linewidth=1.2)
    left = at_s > 0.5 * time_s[-1]
    axes[1].annotate(
        name, (at_s, 0.96), xycoords=("data", "axes fraction"), xytext=(-5 if left else 5, 0), fontsize=9,
        textcoords="offset points", ha="right" if left else "left", va="top", color=_RED, fontweight="bold",
    )  # fmt: skip
