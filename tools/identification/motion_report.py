"""What comes out of an identification from any motion: tables, figures, and the [friction] section."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Column, Table
from rich.text import Text

from jointctl.firmware_py.records import HARMONICS
from jointctl.tools.drawing import BLUE, GREY, ORANGE, SERIES, canvas
from jointctl.tools.identification.identification_report import section_values
from jointctl.tools.identification.models import SIGNS, Samples, unit_of
from jointctl.tools.identification.motion_fit import MotionFit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SHOWN = 6000  # samples in a picture at most
_WINDOW_s, _MOST_WINDOWS = 5.0, 8  # of a motion that is shown in parts; shorter ones are shown whole
_FAMILY = 4  # curves
_SPEEDS = 200

# --- tables and the section ---


def motion_tables(found: MotionFit) -> list[Table]:
    """Parameters with intervals, and the terms that were tried."""
    parameters = Table(title="At the joint", title_justify="left")
    for title in ("", "value", "95 % interval", "unit", "weak"):
        parameters.add_column(title, justify="right" if title in ("value", "95 % interval") else "left")
    for name, p in found.parameters.items():
        parameters.add_row(name, f"{p.value:.4g}", f"{p.low:.4g} .. {p.high:.4g}", unit_of(name), p.weak)
    gravity = found.to_dict()["gravity"]
    if gravity is not None:
        parameters.add_row("gravity", f"{gravity['amplitude_Nm']:.4g}", "", "Nm", "")
        parameters.add_row("its zero", f"{gravity['zero_rad']:.4g}", "", "rad", "")
    steps = Table(
        "term", Column("held out, Nm", justify="right"), "", title="Terms as they came in", title_justify="left"
    )
    for step in found.steps:
        steps.add_row(step.name, f"{step.held_out_rmse_Nm:.4g}", "taken" if step.taken else "")
    return [parameters, steps]


def motion_lines(found: MotionFit) -> list[str]:
    """The errors in words, with their conditions."""
    used = int(found.motion.used(found.settings).sum())
    mean = found.settings.mean_samples
    smoothed = f"mean of {mean} samples" if mean else f"band of {found.motion.band_Hz:.4g} Hz"
    if found.motion.plateaus:
        smoothed = "each the mean of a plateau"
    slow = f"{used} of {len(found.motion.time_s)} samples: above {found.settings.speed_min_radps:g} rad/s"
    if np.isfinite(found.settings.acceleration_max_radps2):
        slow += f", below {found.settings.acceleration_max_radps2:g} rad/s2"
    return [
        f"RMSE {found.rmse_Nm(odd=True):.4g} Nm at the joint on the odd of {found.blocks} blocks of time, fitted to "
        f"the even ones ({found.rmse_Nm(odd=False):.4g} Nm there); {slow}; {smoothed}",
        f"RMSE {found.rmse_Nm(odd=True, every=True):.4g} Nm over all samples of the odd blocks, standstill and "
        "reversals included",
    ]


def motion_report(found: MotionFit) -> RenderableType:
    lines = [*motion_lines(found), *(f"open: {line}" for line in found.untold)]
    return Group(*motion_tables(found), Text("\n".join([*lines, f"data SHA-256 {found.motion.sha256}"])))


def _measured_statics(found: MotionFit) -> dict[str, float]:
    """By direction, the static friction of the slowest speed used, at the motor, where the rise may be none.

    Below that speed nothing was measured: a curve that rises further would be fed forward at every reversal.
    """
    slowest_radps, least = found.settings.speed_min_radps, {}
    for word, one in found.branches().items():
        rise = found.parameters.get(f"rise {word}") or found.parameters.get(f"rise {found.model.directions[0]}")
        if rise is not None and rise.low <= 0.0:
            share = float(np.exp(-slowest_radps / one.stribeck_radps))
            least[word] = one.coulomb_Nm + share * (one.static_Nm - one.coulomb_Nm)
    return least


def motion_section(found: MotionFit) -> dict[str, Any]:
    """The [friction] section, with what depends on load and temperature where it was found."""
    branches, value = found.branches(), found.value
    for word, static_Nm in _measured_statics(found).items():
        branches[word] = replace(branches[word], static_Nm=static_Nm)
    values = section_values(branches["positive"], branches["negative"])
    load = {"coulomb": value.get("load_coulomb", 0.0), "viscous_spr": value.get("load_viscous", 0.0)}
    warm = {"coulomb_pK": value.get("temperature_coulomb", 0.0), "viscous_pK": value.get("temperature_viscous", 0.0)}
    if any(load.values()):
        values["load"] = {key: float(f"{number:.9g}") for key, number in load.items()}
    if any(warm.values()):
        numbers = {key: float(f"{number:.9g}") for key, number in warm.items()}
        seen = np.asarray(found.motion.temperature_degC)
        ends = {"lowest_degC": round(float(seen.min()), 2), "highest_degC": round(float(seen.max()), 2)}
        values["temperature"] = {"reference_degC": found.reference_degC, **numbers, **ends}
    waves = found.model.waves(value, "angle", found.motion.reduction_ratio)[:HARMONICS]
    if waves:
        values["angle"] = _wave_lists("share", waves) | (found.motion.mounting or {})
    return values


def _wave_lists(name: str, waves: list[tuple[float, float, float]]) -> dict[str, list[float]]:
    keys = (name, "per_motor_turn", "phase_rad")
    return {
        key: [float(f"{each:.6g}") for each in column] for key, column in zip(keys, np.transpose(waves), strict=True)
    }


def motion_remarks(found: MotionFit) -> list[str]:
    """Comment lines above the section: where the numbers come from, and what [joint] could take over."""
    result = found.to_dict()
    lines = [
        f"{found.motion.path.name}, SHA-256 {found.motion.sha256}",
        f"model {result['model']}, terms {', '.join(result['terms']) or 'none'}; "
        f"held out {result['held_out_rmse_Nm']:.4g} Nm at the joint",
    ]
    joint = []
    if "inertia" in found.parameters and found.motion.load_Nm is None:
        joint.append(f"inertia_kgm2 = {found.parameters['inertia'].value:.4g}")
    if result["gravity"] is not None:
        joint.append(f"gravity_Nm = {result['gravity']['amplitude_Nm']:.4g}")
        joint.append(f"gravity_zero_rad = {result['gravity']['zero_rad']:.4g}")
    if joint:
        lines.append(f"for [joint]: {', '.join(joint)}")
    for word in _measured_statics(found):
        slowest = f"{found.settings.speed_min_radps:g} rad/s"
        lines.append(f"ts_Nm {word}: that of {slowest}, slower than which nothing was used; its rise may be none")
    ripple = found.model.waves(found.value, "ripple", found.motion.reduction_ratio)[:HARMONICS]
    if ripple:
        keys = _wave_lists("torque_Nm", ripple) | (found.motion.mounting or {})
        lines.append(f"for [ripple]: {', '.join(f'{key} = {each}' for key, each in keys.items())}")
    return lines


# --- figures ---


def motion_figures(found: MotionFit) -> dict[str, tuple[Any, str]]:
    """(figure, what it shows) by the end of its file's name."""
    return {
        "": (prediction_figure(found), "Measured torque, and what the fit to the even blocks predicts"),
        ".residuals": (residual_figure(found), "Residual on the odd blocks against each regressor"),
        ".families": (family_figure(found), "Friction over speed by load and by temperature, with 95 % bands"),
    }


def prediction_figure(found: MotionFit) -> Any:
    """Measured and predicted torque, the fitted blocks shaded, and the error below.

    Of a motion that is too long to be read as a whole the upper pictures are three windows of held-out blocks: those
    where the fit is best, usual and worst.
    """
    motion = found.motion
    windows = _windows(found)
    with canvas(6.4, f"{motion.path.name}: predicted on held-out blocks") as figure:
        names = [f"window {number}" for number in range(max(1, len(windows)))]
        axes = figure.subplot_mosaic([[*names], ["error"] * len(names)], height_ratios=(3, 2))
        lower = axes["error"]
        style: dict[str, Any] = {}
        if motion.plateaus:
            style = {"linestyle": "", "marker": "o", "markersize": 3.0}
        whole = slice(0, len(motion.time_s))
        for name, (words, part) in zip(names, windows or [("", whole)], strict=True):
            _torques(axes[name], found, part, style)
            axes[name].set_title(words, loc="left", fontsize="small")
            axes[name].sharey(axes[names[0]])
            axes[name].tick_params(labelleft=name == names[0])
        shown = _decimated(whole)
        time = _abscissa(found, shown)
        error = np.where(motion.used(found.settings)[shown], found.errors_Nm[shown], np.nan)
        lower.plot(time, found.errors_Nm[shown], color=GREY, linewidth=0.6, label="standstill, reversal, not used")
        lower.plot(time, error, color=BLUE, label="used", **{"linewidth": 0.8, **style})
        _shade(lower, found, shown)
        for _, part in windows:
            lower.axvspan(*_abscissa(found, part)[[0, -1]], color=ORANGE, alpha=0.5, linewidth=0.0)
        worst = np.nanpercentile(np.abs(error), 99.5) if np.isfinite(error).any() else 1.0
        lower.set_ylim(-2.0 * worst, 2.0 * worst)
        axes[names[0]].set_ylabel("torque at the joint [Nm]")
        lower.set_ylabel("measured - predicted [Nm]")
        lower.set_xlabel("plateau" if motion.plateaus else "time [s]")
        if not windows:
            _legend_above(axes[names[0]])
            axes[names[0]].set_xlim(lower.get_xlim())
        else:
            axes[names[0]].legend(loc="best", fontsize="small")
        _legend_above(lower)
        return figure


def _windows(found: MotionFit) -> list[tuple[str, slice]]:
    """(what it is, samples) of the best, a usual and the worst window of held-out blocks; none of a short motion."""
    motion = found.motion
    length = round(_WINDOW_s * motion.rate_Hz)
    count = len(motion.time_s) // length
    if motion.plateaus or count < _MOST_WINDOWS:
        return []
    used = (motion.used(found.settings) & (found.block % 2 == 1))[: count * length].reshape(count, length)
    squared = found.errors_Nm[: count * length].reshape(count, length) ** 2
    samples = used.sum(axis=1)
    enough = np.flatnonzero(samples >= 0.3 * max(samples))
    rmse_Nm = np.sqrt((squared * used).sum(axis=1)[enough] / samples[enough])
    order = np.argsort(rmse_Nm)
    chosen = {"best": order[0], "usual": order[len(order) // 2], "worst": order[-1]}
    return [
        (f"{word} window: RMSE {rmse_Nm[at]:.3g} Nm", slice(int(enough[at]) * length, (int(enough[at]) + 1) * length))
        for word, at in chosen.items()
    ]


def _decimated(part: slice) -> slice:
    return slice(part.start, part.stop, max(1, (part.stop - part.start) // _SHOWN))


def _abscissa(found: MotionFit, part: slice) -> np.ndarray:
    """Time [s], or the number of each plateau."""
    motion = found.motion
    return np.arange(len(motion.time_s))[part] if motion.plateaus else motion.time_s[part] - motion.time_s[0]


def _torques(axis: Axes, found: MotionFit, part: slice, style: dict[str, Any]) -> None:
    """Measured and predicted torque over a part of the samples."""
    shown = _decimated(part)
    time, measured = _abscissa(found, shown), found.motion.torque_Nm[shown]
    axis.plot(time, measured, color=BLUE, label="measured", **style)
    smaller = {**style, "markersize": 1.5} if style else {"linewidth": 1.0}
    words = "predicted by the fit to the shaded blocks"
    predicted = np.where(found.motion.used(found.settings)[shown], measured - found.errors_Nm[shown], np.nan)
    axis.plot(time, predicted, color=ORANGE, label=words, **smaller)
    axis.set_xmargin(0.01)
    axis.locator_params(axis="x", nbins=6)
    if part == slice(0, len(found.motion.time_s)):
        _shade(axis, found, shown)


def _shade(axis: Axes, found: MotionFit, shown: slice) -> None:
    """The even blocks, which the prediction was fitted to."""
    time, margin = _abscissa(found, shown), 0.5 if found.motion.plateaus else 0.0
    for number in range(0, found.blocks, 2):
        inside = time[found.block[shown] == number]
        axis.axvspan(inside[0] - margin, inside[-1] + margin, color=GREY, alpha=0.15, linewidth=0.0)


def _legend_above(axis: Axes) -> None:
    axis.legend(loc="lower left", bbox_to_anchor=(-0.01, 1.0), ncols=3)


def residual_figure(found: MotionFit) -> Any:
    """One small picture for each quantity that the torque may depend on, with the mean over tenths of its range."""
    motion = found.motion
    chosen = motion.used(found.settings) & (found.block % 2 == 1)
    samples = found.samples()
    regressors = {
        "velocity [rad/s]": motion.velocity_radps,
        "acceleration [rad/s²]": motion.acceleration_radps2,
        "position [rad]": motion.position_rad,
        "transmitted torque [Nm]": found.model.transmitted_Nm(found.value, samples),
        "time [s]": motion.time_s - motion.time_s[0],
    }
    if motion.temperature_degC is not None:
        regressors["temperature [°C]"] = motion.temperature_degC
    regressors = {name: values for name, values in regressors.items() if np.ptp(values[chosen]) > 0.0}
    rows = -(-len(regressors) // 3)
    with canvas(2.9 * rows + 0.6, "Residual on held-out blocks") as figure:
        axes = figure.subplots(rows, 3, sharey=True, squeeze=False).ravel()
        error = found.errors_Nm[chosen]
        every = max(1, len(error) // _SHOWN)
        for axis, (name, values) in zip(axes, regressors.items(), strict=False):
            x = values[chosen]
            axis.plot(
                x[::every],
                error[::every],
                ".",
                color=BLUE,
                rasterized=True,
                **{"markersize": 5.0} if motion.plateaus else {"markersize": 1.5, "alpha": 0.3},
            )
            edges = np.unique(np.percentile(x, np.linspace(0.0, 100.0, 11)))
            if len(edges) < 6:  # it stays at few values, such as a cold and a warm temperature
                edges = np.linspace(x.min(), x.max(), 11)
            place = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
            means = [(x[place == k].mean(), error[place == k].mean()) for k in np.unique(place)]
            axis.plot(*np.transpose(means), "o-", color=ORANGE, markersize=4.0, linewidth=1.6)
            axis.axhline(0.0, color=GREY, linewidth=0.8)
            axis.set_xlabel(name)
            axis.set_xmargin(0.02)
            axis.locator_params(axis="x", nbins=4)
        for axis in axes[len(regressors) :]:
            axis.set_visible(False)
        for axis in axes[::3]:
            axis.set_ylabel("measured - predicted [Nm]")
        worst = float(np.percentile(np.abs(error), 99.5)) or 1.0
        axes[0].set_ylim(-1.5 * worst, 1.5 * worst)
        return figure


def _friction_Nm(found: MotionFit, speeds: np.ndarray, tau_Nm: float, warming_K: float) -> tuple[np.ndarray, ...]:
    """Friction at the joint over speed, and the ends of its 95 % band."""
    zero = np.zeros(len(speeds))
    warm = None if found.reference_degC is None else np.full(len(speeds), warming_K)
    samples, tau = Samples(speeds, zero, zero, None, warm), np.full(len(speeds), tau_Nm)
    names = found.model.names
    curve = found.model.friction_Nm(found.value, samples, tau)
    drawn = [found.model.friction_Nm(dict(zip(names, v, strict=True)), samples, tau) for v in found.resampled]
    low, high = np.percentile(drawn, (2.5, 97.5), axis=0)
    return curve, low, high


def family_figure(found: MotionFit) -> Any:
    """Friction over speed at several loads, and, where temperature varied, at several temperatures."""
    motion, used = found.motion, found.motion.used(found.settings)
    tau = np.abs(found.model.transmitted_Nm(found.value, found.samples())[used])
    loads = _spread(tau) if _has(found, "load") else np.array([np.median(tau)])
    families = [("by load", [(f"{load:.3g} Nm transmitted", float(load), 0.0) for load in loads])]
    if _has(found, "temperature") and motion.temperature_degC is not None and found.reference_degC is not None:
        degrees = _spread(motion.temperature_degC[used])
        middle = float(np.median(tau))
        families.append((
            f"by temperature, at {middle:.3g} Nm",
            [(f"{each:.3g} °C", middle, float(each) - found.reference_degC) for each in degrees],
        ))  # fmt: skip
    top = found.model.top_radps
    least = max(found.settings.speed_min_radps, 1e-3 * top)
    speeds = np.linspace(least, top, _SPEEDS)
    with canvas(4.6, f"{motion.path.name}: friction at the joint") as figure:
        axes = figure.subplots(1, len(families), sharey=True, squeeze=False)[0]
        for axis, (title, family) in zip(axes, families, strict=True):
            for (label, load, warming), color in zip(family, SERIES, strict=False):
                for sign in [SIGNS[word] for word in found.model.directions]:
                    curve, low, high = _friction_Nm(found, sign * speeds, load, warming)
                    axis.plot(sign * speeds, curve, color=color, label=label if sign == _first(found) else None)
                    axis.fill_between(sign * speeds, low, high, color=color, alpha=0.2, linewidth=0.0)
            axis.axhline(0.0, color=GREY, linewidth=0.8)
            axis.set_title(title if _has(found, "load") or len(families) > 1 else "")
            axis.set_xlabel("joint velocity [rad/s]")
            axis.legend(loc="best")
            axis.set_xmargin(0.02)
        axes[0].set_ylabel("friction at the joint [Nm]")
        return figure


def _spread(values: np.ndarray) -> np.ndarray:
    low, high = np.percentile(values, (1, 99))
    return np.linspace(float(low), float(high), _FAMILY)


def _first(found: MotionFit) -> int:
    return SIGNS[found.model.directions[0]]


def _has(found: MotionFit, kind: str) -> bool:
    return any(term.startswith(f"{kind}-") and term != "load-scale" for term in found.model.terms)
