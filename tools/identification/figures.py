"""Pictures of an identification: fit and errors as in Fig. 7 of the paper, and how the swarm converged."""

from __future__ import annotations

from typing import Any

import numpy as np

from jointctl.firmware_py.friction import DEGREE
from jointctl.tools.drawing import BLUE, GREY, ORANGE, RED, canvas
from jointctl.tools.identification.friction_data import FrictionData, relative_errors
from jointctl.tools.identification.models import Branch
from jointctl.tools.identification.result import DIRECTIONS, Identification

_CURVE_POINTS = 600
_FLOOR = 1e-5  # [%] drawn at least, on a logarithmic axis


def _curve_speeds(found: Branch) -> np.ndarray:
    """Denser near zero, where the curve bends, and with a gap of one double at the knee, where it may jump."""
    share = np.linspace(0.0, 1.0, _CURVE_POINTS) ** 2
    knee = found.knee_radps
    return np.sort(np.concatenate([share * found.max_radps, [knee, np.nextafter(knee, np.inf)]]))


def fit_figure(
    data: FrictionData,
    branches: dict[str, Branch],
    used: dict[str, np.ndarray],
    title: str,
    *,
    outliers: np.ndarray | None = None,
    identified: Identification | None = None,
) -> Any:
    """Data and curve, error, relative error over joint velocity; `used` holds the indices of each direction.

    With `identified` the 95 % band is drawn, and the weak parameters are named.
    """
    with canvas(9.6) as figure:
        _paint_fit(figure, data, branches, used, outliers, identified)
        figure.axes[0].set_title(title, fontsize=12, fontweight="bold")
        return figure


def _paint_fit(
    figure: Any,
    data: FrictionData,
    branches: dict[str, Branch],
    used: dict[str, np.ndarray],
    outliers: np.ndarray | None,
    identified: Identification | None,
) -> None:
    axes = figure.subplots(3, 1, sharex=True, height_ratios=(4, 2, 2))
    unsettled = np.flatnonzero(~data.settled)
    _points(axes[0], data, np.concatenate(list(used.values())), "measured", BLUE, "o")
    worst = 0.0
    for word, sign in DIRECTIONS:
        if word not in used or not len(used[word]):
            continue
        found, chosen = branches[word], used[word]
        speeds = _curve_speeds(found)
        curve = sign * found.torque_Nm(speeds)
        label = "model" if sign > 0 else None
        axes[0].plot(sign * speeds / DEGREE, curve, color=ORANGE, linewidth=1.8, label=label, zorder=3)
        if identified is not None:
            direction = identified.directions[word]
            inside = speeds[speeds >= direction.fit.problem.x[0] * found.max_radps]
            half = direction.uncertainty.band_Nm(direction.fit, inside / direction.fit.problem.top_radps)
            axes[1].fill_between(
                sign * inside / DEGREE, -1e3 * half, 1e3 * half, color=ORANGE, alpha=0.3, linewidth=0.0,
                label="95 % band of the curve" if sign > 0 else None, zorder=1,
            )  # fmt: skip
        velocity = data.velocity_radps[chosen]
        error = data.motor_torque_Nm[chosen] - sign * found.torque_Nm(np.abs(velocity))
        relative = 100.0 * np.abs(relative_errors(error, data.motor_torque_Nm[chosen]))
        there = relative[np.isfinite(relative)]
        # one point near zero torque must not flatten all the others
        if len(there):
            worst = max(worst, min(float(there.max()), 2.0 * float(np.percentile(there, 99))))
        axes[1].vlines(velocity / DEGREE, 0.0, 1e3 * error, color=BLUE, linewidth=0.7, alpha=0.5)
        axes[1].plot(velocity / DEGREE, 1e3 * error, "o", color=BLUE, markersize=2.6)
        axes[2].plot(velocity / DEGREE, relative, "o", color=BLUE, markersize=2.6)
        axes[2].vlines(velocity / DEGREE, 0.0, relative, color=BLUE, linewidth=0.7, alpha=0.5)
    if outliers is not None and len(outliers):
        _points(axes[0], data, outliers, "outlier, not used", RED, "x")
    if len(unsettled):
        _points(axes[0], data, unsettled, "never settled, not used", GREY, "^")
    for axis in axes[1:]:
        axis.axhline(0.0, color=GREY, linewidth=0.8)
    axes[0].set_ylabel("friction at the motor [Nm]")
    axes[1].set_ylabel("measured - model [mNm]")
    axes[2].set_ylabel("relative error [%]")
    axes[2].set_ylim(0.0, 1.08 * worst if worst > 0.0 else 1.0)
    axes[2].set_xlabel("joint velocity [deg/s]")
    ratio = data.reduction_ratio
    joint = axes[0].secondary_yaxis("right", functions=(lambda y: y * ratio, lambda y: y / ratio))
    joint.set_ylabel("at the joint [Nm]")
    joint.grid(False)
    joint.spines["right"].set_visible(True)
    for axis in axes:
        for word, sign in DIRECTIONS:
            found = branches[word]
            if found.knee_radps < found.max_radps:
                axis.axvline(sign * found.knee_radps / DEGREE, color=GREY, linewidth=0.8, linestyle=":", zorder=0)
        axis.set_xmargin(0.02)
    axes[0].legend(loc="upper left")
    if identified is not None:
        axes[1].legend(loc="lower left", bbox_to_anchor=(-0.01, 1.0))
    axes[0].text(
        0.99, 0.04, _summary_text(data, branches, used), transform=axes[0].transAxes, ha="right", va="bottom",
        fontsize=9, color=GREY,
    )  # fmt: skip
    figure.align_ylabels(axes)


def _points(axis: Any, data: FrictionData, chosen: np.ndarray, label: str, color: str, marker: str) -> None:
    size = 3.0 if marker == "o" else 7.0
    axis.plot(
        data.velocity_radps[chosen] / DEGREE, data.motor_torque_Nm[chosen], marker, color=color, markersize=size,
        label=f"{label} ({len(chosen)})", zorder=2 if marker == "o" else 4,
    )  # fmt: skip


def _summary_text(data: FrictionData, branches: dict[str, Branch], used: dict[str, np.ndarray]) -> str:
    errors = np.concatenate([
        data.motor_torque_Nm[chosen]
        - (1 if word == "positive" else -1) * branches[word].torque_Nm(np.abs(data.velocity_radps[chosen]))
        for word, chosen in used.items()
    ])  # fmt: skip
    rmse, worst = 1e3 * np.sqrt(np.mean(errors**2)), 1e3 * np.max(np.abs(errors))
    return f"RMSE {rmse:.3g} mNm\nmax. error {worst:.3g} mNm"


def convergence_figure(identified: Identification) -> Any | None:
    """Excess of the swarm's best RMSE over the least one, over the iterations; None for a model without a swarm."""
    swarms = {word: found for word, found in identified.directions.items() if found.swarm is not None}
    if not swarms:
        return None
    swarm = identified.options.swarm
    with canvas(4.4) as figure:
        axis = figure.subplots()
        for (word, found), color in zip(swarms.items(), (BLUE, ORANGE), strict=True):
            assert found.swarm is not None
            least = found.projected_rmse_Nm
            excess = 100.0 * (found.swarm.curve_Nm / max(least, 1e-12) - 1.0)
            label = f"{word} velocity, least possible {1e3 * least:.4g} mNm"
            axis.plot(
                np.arange(1, len(excess) + 1), np.maximum(excess, _FLOOR), color=color, linewidth=1.6, label=label
            )
        axis.axhline(1.0, color=GREY, linewidth=0.8, linestyle=":")
        axis.annotate(
            "1 %", (1.0, 1.0), xycoords=("axes fraction", "data"), xytext=(-4, 3), textcoords="offset points",
            ha="right", fontsize=9, color=GREY,
        )  # fmt: skip
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.set_xlabel("iteration")
        axis.set_ylabel("best RMSE above the least possible [%]")
        axis.set_ylim(bottom=0.5 * _FLOOR)
        axis.legend()
        title = f"Particle swarm: {swarm.particles} particles, seed {swarm.seed}"
        axis.set_title(title, fontsize=12, fontweight="bold")
        return figure
