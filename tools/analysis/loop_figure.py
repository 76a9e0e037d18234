"""One picture of the linear loop: Bode plot with its margins, sensitivity, closed-loop poles."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import DataError
from tools.analysis.linear_loop import LoopSettings, linear_loop
from tools.analysis.margins import Margins, frequencies_radps, margins

_BLUE, _ORANGE, _RED, _GREY = "#1f5fa8", "#d9822b", "#b3282d", "#555555"
_LOWEST_HZ = 0.1
_DAMPING_LINES = (0.1, 0.3, 0.5, 0.7)


def save_loop_figure(
    settings: LoopSettings, path: str | Path, title: str = "", minimum_deg: float | None = None
) -> Path:
    """Draw the loop into a PNG at `path`; an unstable one is drawn too, without margins."""
    path = Path(path)
    # slow to import, and only wanted here; no display is needed
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 7.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2, width_ratios=(1.15, 1.0))
    found = margins(settings)
    omega = frequencies_radps(settings.period_s)
    omega = omega[omega >= math.tau * _LOWEST_HZ]
    response = linear_loop(settings).open_loop(omega)
    frequency_Hz = omega / math.tau
    _magnitude(axes[0, 0], frequency_Hz, np.abs(response), found)
    _phase(axes[1, 0], frequency_Hz, np.degrees(np.unwrap(np.angle(response))), found, minimum_deg)
    _sensitivity(axes[0, 1], frequency_Hz, 1.0 / np.abs(1.0 + response), found)
    _poles(axes[1, 1], found, settings.period_s)
    for axis in axes.flat:
        axis.grid(True, color="#dddddd", linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
        axis.set_axisbelow(True)
    state = "stable" if found.stable else "UNSTABLE"
    figure.suptitle(f"{title or 'Linear loop'}: {state}", x=0.01, ha="left", fontweight="bold")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110, format="png")
    except OSError as error:
        raise DataError(f"{path}: cannot be written: {error.strerror or error}") from None
    return path


def _frequency_axis(axis: Any, frequency_Hz: Any) -> None:
    axis.set_xscale("log")
    axis.set_xlim(frequency_Hz[0], frequency_Hz[-1])
    axis.set_xlabel("frequency [Hz]")


def _magnitude(axis: Any, frequency_Hz: Any, magnitude: Any, found: Margins) -> None:
    axis.loglog(frequency_Hz, magnitude, color=_BLUE)
    axis.axhline(1.0, color=_GREY, linewidth=0.8)
    if found.stable and math.isfinite(found.crossover_Hz):
        axis.plot([found.crossover_Hz], [1.0], "o", color=_RED)
        up = "any factor up" if math.isinf(found.gain_margin_up) else f"x {found.gain_margin_up:.3g} up"
        down = "any down" if found.gain_margin_down == 0.0 else f"x {found.gain_margin_down:.2g} down"
        text = f"gain margins {up}, {down}\ncrossover {found.crossover_Hz:.3g} Hz"
        axis.text(0.97, 0.95, text, transform=axis.transAxes, ha="right", va="top", color=_RED, fontsize=9)
    axis.set_ylabel("open loop |L|")
    _frequency_axis(axis, frequency_Hz)


def _phase(axis: Any, frequency_Hz: Any, phase_deg: Any, found: Margins, minimum_deg: float | None) -> None:
    # counted so that the crossover lies in the turn around -180 deg
    near = np.argmin(np.abs(frequency_Hz - (found.crossover_Hz if found.stable else 10.0)))
    phase_deg = phase_deg - 360.0 * round((phase_deg[near] + 180.0) / 360.0)
    axis.plot(frequency_Hz, phase_deg, color=_BLUE)
    axis.axhline(-180.0, color=_GREY, linewidth=0.8)
    if found.stable and math.isfinite(found.crossover_Hz):
        at_crossover = float(np.interp(found.crossover_Hz, frequency_Hz, phase_deg))
        axis.plot([found.crossover_Hz] * 2, [-180.0, at_crossover], color=_RED, linewidth=2.0)
        wanted = "" if minimum_deg is None else f", at least {minimum_deg:g} wanted"
        text = f"phase margin {found.phase_margin_deg:.1f} deg{wanted}\n"
        text += f"delay margin {found.delay_margin_s * 1e3:.2f} ms more"
        axis.text(0.03, 0.05, text, transform=axis.transAxes, va="bottom", color=_RED, fontsize=9)
    axis.set_ylim(-370.0, max(-80.0, min(float(phase_deg.max()), 100.0) + 10.0))
    axis.set_yticks(range(-360, -60, 45))
    axis.set_ylabel("phase of L [deg]")
    _frequency_axis(axis, frequency_Hz)


def _sensitivity(axis: Any, frequency_Hz: Any, sensitivity: Any, found: Margins) -> None:
    axis.semilogy(frequency_Hz, sensitivity, color=_BLUE)
    axis.axhline(1.0, color=_GREY, linewidth=0.8)
    if found.stable:
        axis.plot([found.sensitivity_peak_Hz], [found.sensitivity_peak], "o", color=_RED)
        text = f"Ms {found.sensitivity_peak:.3g} at {found.sensitivity_peak_Hz:.3g} Hz"
        axis.text(0.03, 0.95, text, transform=axis.transAxes, va="top", color=_RED, fontsize=9)
    axis.set_ylim(bottom=max(float(sensitivity.min()), 1e-4))
    axis.set_ylabel("sensitivity |1 / (1 + L)|")
    _frequency_axis(axis, frequency_Hz)


def _poles(axis: Any, found: Margins, period_s: float) -> None:
    """The slower poles as s = ln z / T; those beyond a third of the Nyquist frequency are left out."""
    reach = math.pi / period_s / 3.0
    poles = [z for z in found.poles if abs(z) > 1e-6]
    s = [complex(math.log(abs(z)), math.atan2(z.imag, z.real)) / period_s for z in poles]
    shown = [x for x in s if abs(x) <= reach]
    widest = max((abs(x) for x in shown), default=1.0) * 1.15
    for damping in _DAMPING_LINES:
        x, y = -widest * damping, widest * math.sqrt(1.0 - damping**2)
        axis.plot([x, 0.0, x], [y, 0.0, -y], color="#cccccc", linewidth=0.8, linestyle=":")
        axis.annotate(f"{damping:g}", (x, y), fontsize=8, color=_GREY, ha="center", va="bottom")
    axis.axvline(0.0, color=_GREY, linewidth=0.8)
    for pole in shown:
        color = _RED if pole.real >= 0.0 else _ORANGE
        axis.plot([pole.real], [pole.imag], "x", color=color, markersize=8, markeredgewidth=2)
    if found.stable:
        text = f"slowest {found.slowest_time_constant_s:.3g} s"
        if math.isfinite(found.oscillation_Hz):
            text += f"\noscillation {found.oscillation_Hz:.3g} Hz, damping {found.oscillation_damping:.2f}"
        axis.text(0.03, 0.04, text, transform=axis.transAxes, fontsize=9, color=_RED)
    hidden = len(found.poles) - len(shown)
    axis.set_title(f"closed-loop poles; dotted: damping ratio; {hidden} fast ones not shown", fontsize=9, color=_GREY)
    axis.set_xlim(-widest, max(0.15 * widest, *(1.2 * pole.real for pole in shown)))
    axis.set_xlabel("real part [1/s]")
    axis.set_ylabel("imaginary part [rad/s]")
