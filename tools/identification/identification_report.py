"""What comes out of an identification: tables, figures, and the values of [friction] in a configuration.

The numbers are written as (11) prints them: joint deg/s and motor Nm, with the signs of Table 3.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Column, Table
from rich.text import Text

from jointctl.firmware_py.friction import DEGREE
from jointctl.tools.drawing import BLUE, GREY, ORANGE, RED, canvas
from jointctl.tools.identification.fit import NAMES
from jointctl.tools.identification.friction_data import FrictionData, relative_errors, relative_figures
from jointctl.tools.identification.identification import DIRECTIONS, Identification
from jointctl.tools.identification.models import FORMS, Branch

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# --- tables ---

_UNITS = {
    "tc": "Nm", "ts": "Nm", "ws": "deg/s", "tv": "Nm s/deg",
    "a0": "Nm", "a1": "Nm s/deg", "a2": "Nm s2/deg2", "a3": "Nm s3/deg3",
}  # fmt: skip
_EXPONENT = {"ws": -1, "tv": 1, "a1": 1, "a2": 2, "a3": 3}


def in_degrees(name: str, value: float, sign: int) -> float:
    """A mirrored SI parameter as (11) prints it: speeds in deg/s, signs of the direction."""
    mirrored = sign if name in ("a0", "a2") else 1
    return mirrored * value * DEGREE ** _EXPONENT.get(name, 0)


def parameter_table(found: Identification) -> Table:
    """Parameters as (11) prints them, with 95 % intervals, one direction below the other."""
    table = Table(title="Friction at the motor, joint velocity in deg/s", title_justify="left")
    table.add_column("", no_wrap=True)
    table.add_column("value", justify="right", no_wrap=True)
    table.add_column("95 % interval", justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    table.add_column("weak")
    for word, sign in DIRECTIONS:
        mark = "+" if sign > 0 else "-"
        for name in NAMES:
            interval = found.directions[word].uncertainty.intervals.get(name)
            if interval is None:
                continue
            value, low, high = (in_degrees(name, v, sign) for v in (interval.value, interval.low, interval.high))
            low, high = min(low, high), max(low, high)
            table.add_row(f"{name}{mark}", f"{value:.5g}", f"{low:.4g} .. {high:.4g}", _UNITS[name], interval.weak)
        model = found.directions[word].fit.branch()
        if model.knee_radps < model.max_radps:
            knee = sign * model.knee_radps / DEGREE
            table.add_row(
                f"knee{mark}", f"{knee:.4g}", "searched" if found.options.search_knee else "given", "deg/s", ""
            )
        table.add_section()
    return table


def model_table(found: Identification) -> Table:
    """The models side by side; `held out` is the error on points that the fit did not see."""
    numbers = (Column(title, justify="right") for title in ("RMSE, mNm", "held out, mNm", "parameters"))
    table = Table("model", *numbers, title="Models", title_justify="left")
    for name, rmse in found.rmse_by_model_Nm.items():
        from_swarm = found.rmse_Nm if name == found.model else rmse
        mark = " (chosen)" if name == found.model else ""
        count = len(found.directions) * FORMS[name].parameters
        table.add_row(
            name + mark, f"{1e3 * from_swarm:.4g}", f"{1e3 * found.held_out_by_model_Nm[name]:.4g}", str(count)
        )
    return table


def error_table(errors_Nm: np.ndarray, measured_Nm: np.ndarray, ratio: float) -> Table:
    """Error of a curve on data: motor, joint, relative."""
    numbers = (Column(title, justify="right") for title in ("motor, mNm", "joint, Nm", "relative"))
    table = Table("", *numbers, title="Error", title_justify="left")
    rms, greatest, mean = relative_figures(errors_Nm, measured_Nm)
    for word, value, share in (
        ("RMSE", np.sqrt(np.mean(errors_Nm**2)), rms),
        ("greatest", np.max(np.abs(errors_Nm)), greatest),
        ("mean", np.mean(errors_Nm), mean),
    ):
        # a fit's mean error is rounding noise: zero, in the digits that mean something
        motor_mNm, joint_Nm = round(1e3 * value, 9), round(ratio * value, 9)
        table.add_row(word, f"{motor_mNm:z.4g}", f"{joint_Nm:z.4g}", f"{share:z.2%}")
    return table


def left_out_text(found: Identification) -> str:
    """What the fit did not see and its share of the error, one line."""
    out = found.left_out
    if not out.outliers + out.unsettled:
        return "no measured point was left out"
    return (
        f"left out: {out.outliers} outliers, {out.unsettled} not settled, {out.error_share:.0%} of the squared "
        f"error; RMSE {1e3 * found.rmse_Nm:.4g} mNm without them, {1e3 * out.rmse_with_Nm:.4g} with them"
    )


def identification_report(found: Identification) -> RenderableType:
    table = error_table(found.errors_Nm, found.measured_Nm, found.data.reduction_ratio)
    lines = [left_out_text(found), *_origin(found)]
    return Group(parameter_table(found), table, model_table(found), Text("\n".join(lines)))


def _origin(found: Identification) -> list[str]:
    swarm = found.options.swarm
    lines = [f"data SHA-256 {found.data.sha256}"]
    if any(d.swarm is not None for d in found.directions.values()):
        lines.append(f"particle swarm: {swarm.particles} particles x {swarm.iterations} iterations, seed {swarm.seed}")
    weighted = ", weighted" if found.noise_exponent else ""
    for word, d in found.directions.items():
        swarm_text = f"swarm alone {1e3 * d.swarm.fit.weighted_rmse_Nm:.4g}, " if d.swarm is not None else ""
        lines.append(
            f"{word}: {len(d.index)} points, RMSE {1e3 * d.fit.rmse_Nm:.4g} mNm from {d.source} "
            f"({swarm_text}least possible {1e3 * d.projected_rmse_Nm:.4g}{weighted})"
        )
    return lines


# --- figures: fit and errors as in Fig. 7 of the paper, and how the swarm converged ---

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
                ends = direction.uncertainty.band_Nm(direction.fit, inside / direction.fit.problem.top_radps)
                low, high = (1e3 * sign * (end - found.torque_Nm(inside)) for end in ends)
                axes[1].fill_between(
                    sign * inside / DEGREE, low, high, color=ORANGE, alpha=0.3, linewidth=0.0,
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
            _points(axes[0], data, unsettled, "not settled, not used", GREY, "^")
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
        axes[0].set_title(title, fontsize=12, fontweight="bold")
        return figure


def _points(axis: Axes, data: FrictionData, chosen: np.ndarray, label: str, color: str, marker: str) -> None:
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


# --- the [friction] section ---


def direction_values(found: Branch, *, negative: bool) -> dict[str, float]:
    """One direction under the keys of the configuration: deg/s at the joint, Nm at the motor, signs of (11)."""
    sign = -1.0 if negative else 1.0
    values = {
        "tc_Nm": found.coulomb_Nm,
        "ts_Nm": max(found.static_Nm, found.coulomb_Nm),
        "ws": found.stribeck_radps / DEGREE,
        "tv": found.viscous_Nmspr * DEGREE,
    }
    for power, a in enumerate(found.cubic):
        # mirrored f(u) = -F(-u): the even powers change their sign
        values[f"a{power}"] = (sign if power % 2 == 0 else 1.0) * a * DEGREE**power
    values["knee"] = sign * found.knee_radps / DEGREE
    values["max"] = sign * found.max_radps / DEGREE
    return {key: float(f"{value:.9g}") + 0.0 for key, value in values.items()}


def section_values(positive: Branch, negative: Branch) -> dict[str, Any]:
    return {
        "velocity_unit": "deg/s",
        "velocity_side": "joint",
        "torque_side": "motor",
        "positive": direction_values(positive, negative=False),
        "negative": direction_values(negative, negative=True),
    }
