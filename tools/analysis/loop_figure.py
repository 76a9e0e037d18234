"""One picture of the linear loop: Bode plot with its margins, sensitivity, closed-loop poles."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jointctl.tools.analysis.linear_loop import LoopSettings, linear_loop
from jointctl.tools.analysis.margins import Margins, frequencies_radps, margins, worst_case
from jointctl.tools.drawing import BLUE, GREY, ORANGE, RED, SOFT, canvas, save_png

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LOWEST_HZ = 0.1
_DAMPING_LINES = (0.1, 0.3, 0.5, 0.7)


def save_loop_figure(settings: LoopSettings, path: Path, title: str, minimum_deg: float) -> Path:
    """Draw the loop into a PNG at `path`; an unstable one is drawn too, without margins."""
    settings = worst_case(settings)
    found = margins(settings)
    with canvas(6.8, f"{title}: {'stable' if found.stable else 'UNSTABLE'}") as figure:
        _draw(figure, settings, found, minimum_deg)
    return save_png(figure, path)


def _draw(figure: Figure, settings: LoopSettings, found: Margins, minimum_deg: float) -> None:
    axes = figure.subplots(2, 2, width_ratios=(1.15, 1.0))
    omega = frequencies_radps(settings.period_s)
    omega = omega[omega >= math.tau * _LOWEST_HZ]
    response = linear_loop(settings).open_loop(omega)
    frequency_Hz = omega / math.tau
    _magnitude(axes[0, 0], frequency_Hz, np.abs(response), found)
    for joint in settings.joints:
        axes[0, 0].axvline(joint.resonance_Hz, color=ORANGE, linewidth=0.8, linestyle="--")
        text = f"resonance {joint.resonance_Hz:.3g} Hz\n{joint.name}"
        axes[0, 0].text(0.03, 0.05, text, transform=axes[0, 0].transAxes, va="bottom", color=ORANGE, fontsize=9)
    _phase(axes[1, 0], frequency_Hz, np.degrees(np.unwrap(np.angle(response))), found, minimum_deg)
    _sensitivity(axes[0, 1], frequency_Hz, 1.0 / np.abs(1.0 + response), found)
    _poles(axes[1, 1], found, settings.period_s)


def _frequency_axis(axis: Axes, frequency_Hz: np.ndarray) -> None:
    axis.set_xscale("log")
    axis.set_xlim(frequency_Hz[0], frequency_Hz[-1])
    axis.set_xlabel("frequency [Hz]")


def _magnitude(axis: Axes, frequency_Hz: np.ndarray, magnitude: np.ndarray, found: Margins) -> None:
    axis.loglog(frequency_Hz, magnitude, color=BLUE)
    axis.axhline(1.0, color=GREY, linewidth=0.8)
    if found.stable and math.isfinite(found.crossover_Hz):
        axis.plot([found.crossover_Hz], [1.0], "o", color=RED)
        up = "any factor up" if math.isinf(found.gain_margin_up) else f"x {found.gain_margin_up:.3g} up"
        down = "any down" if found.gain_margin_down == 0.0 else f"x {found.gain_margin_down:.2g} down"
        text = f"gain margins {up}, {down}\ncrossover {found.crossover_Hz:.3g} Hz"
        axis.text(0.97, 0.95, text, transform=axis.transAxes, ha="right", va="top", color=RED, fontsize=9)
    axis.set_ylabel("open loop |L|")
    _frequency_axis(axis, frequency_Hz)


def _phase(axis: Axes, frequency_Hz: np.ndarray, phase_deg: np.ndarray, found: Margins, minimum_deg: float) -> None:
    # counted so that the crossover lies in the turn around -180 deg
    near = np.argmin(np.abs(frequency_Hz - (found.crossover_Hz if found.stable else 10.0)))
    phase_deg = phase_deg - 360.0 * round((phase_deg[near] + 180.0) / 360.0)
    axis.plot(frequency_Hz, phase_deg, color=BLUE)
    axis.axhline(-180.0, color=GREY, linewidth=0.8)
    if found.stable and math.isfinite(found.crossover_Hz):
        at_crossover = float(np.interp(found.crossover_Hz, frequency_Hz, phase_deg))
        axis.plot([found.crossover_Hz] * 2, [-180.0, at_crossover], color=RED, linewidth=2.0)
        text = f"phase margin {found.phase_margin_deg:.1f} deg, at least {minimum_deg:g} wanted\n"
        text += f"delay margin {found.delay_margin_s * 1e3:.2f} ms more"
        axis.text(0.03, 0.05, text, transform=axis.transAxes, va="bottom", color=RED, fontsize=9)
    axis.set_ylim(-370.0, max(-80.0, min(float(phase_deg.max()), 100.0) + 10.0))
    axis.set_yticks(range(-360, -60, 45))
    axis.set_ylabel("phase of L [deg]")
    _frequency_axis(axis, frequency_Hz)


def _sensitivity(axis: Axes, frequency_Hz: np.ndarray, sensitivity: np.ndarray, found: Margins) -> None:
    axis.semilogy(frequency_Hz, sensitivity, color=BLUE)
    axis.axhline(1.0, color=GREY, linewidth=0.8)
    if found.stable:
        axis.plot([found.sensitivity_peak_Hz], [found.sensitivity_peak], "o", color=RED)
        text = f"Ms {found.sensitivity_peak:.3g} at {found.sensitivity_peak_Hz:.3g} Hz"
        axis.text(0.03, 0.95, text, transform=axis.transAxes, va="top", color=RED, fontsize=9)
    axis.set_ylim(bottom=max(float(sensitivity.min()), 1e-4))
    axis.set_ylabel("sensitivity |1 / (1 + L)|")
    _frequency_axis(axis, frequency_Hz)


def _poles(axis: Axes, found: Margins, period_s: float) -> None:
    """The slower poles as s = ln z / T; those beyond a third of the Nyquist frequency are left out."""
    reach = math.pi / period_s / 3.0
    poles = [z for z in found.poles if abs(z) > 1e-6]
    s = [complex(math.log(abs(z)), math.atan2(z.imag, z.real)) / period_s for z in poles]
    shown = [x for x in s if abs(x) <= reach]
    widest = max((abs(x) for x in shown), default=1.0) * 1.15
    for damping in _DAMPING_LINES:
        x, y = -widest * damping, widest * math.sqrt(1.0 - damping**2)
        axis.plot([x, 0.0, x], [y, 0.0, -y], color=SOFT, linewidth=0.8, linestyle=":")
        axis.annotate(f"{damping:g}", (x, y), fontsize=8, color=GREY, ha="center", va="bottom")
    axis.axvline(0.0, color=GREY, linewidth=0.8)
    for pole in shown:
        color = RED if pole.real >= 0.0 else ORANGE
        axis.plot([pole.real], [pole.imag], "x", color=color, markersize=8, markeredgewidth=2)
    if found.stable:
        text = f"slowest {found.slowest_time_constant_s:.3g} s"
        if math.isfinite(found.oscillation_Hz):
            text += f"\noscillation {found.oscillation_Hz:.3g} Hz, damping {found.oscillation_damping:.2f}"
        axis.text(0.03, 0.04, text, transform=axis.transAxes, fontsize=9, color=RED)
    hidden = len(found.poles) - len(shown)
    axis.set_title(f"closed-loop poles, {hidden} fast ones not shown; dotted: damping", fontsize=9, color=GREY)
    axis.set_xlim(-widest, max(0.15 * widest, *(1.2 * pole.real for pole in shown)))
    axis.set_xlabel("real part [1/s]")
    axis.set_ylabel("imaginary part [rad/s]")
