"""What `check` reports besides margins: what is not modelled, constants that do not fit together, one picture."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jointctl.drivers.errors import text_Nm
from jointctl.firmware_py.states import CommandKind
from jointctl.tools.analysis.gains import LEAST_DAMPING
from jointctl.tools.analysis.linear_loop import LoopSettings, RigidJoint, linear_loop, loop_settings, two_masses
from jointctl.tools.analysis.margin_gate import cascade_of, coarsest
from jointctl.tools.analysis.margins import Margins, frequencies_radps, margins, phase_margin_deg, worst_case
from jointctl.tools.configuration.conversions import (
    free_torque_Nm,
    law_resolution_rad,
    most_twist_s2,
    static_friction_Nm,
    torque_constant_NmpA,
    velocity_of_a_count_radps,
)
from jointctl.tools.configuration.records import FROZEN_SHARE
from jointctl.tools.drawing import BLUE, GREY, ORANGE, RED, SOFT, canvas, save_png

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from jointctl.tools.configuration.config import Config

# --- What the linear loop does not know ---


STEP_SHARE = 0.25  # of the torque limit; `precise` with 17 bit is below, with 16 bit, where it is noisy, above
SOFT_STEP_SHARE = 0.05  # of a flexible joint's law; `realistic` with 15 bit at the link, 1.8 Nm a cycle, is above
OUTSIDE = (0.5, 2.0)  # factors on the link's inertia that are looked at beyond what must hold


def outside_payload_range(config: Config, settings: LoopSettings) -> list[str]:
    """What happens with lighter and heavier links than `margin.payload_range` says, in words."""
    found = []
    for payload in OUTSIDE if config.reducer is not None else ():
        if config.margin.payload_range[0] <= payload <= config.margin.payload_range[1]:
            continue
        assert config.reducer is not None
        joint = two_masses(config, config.reducer, payload, 1.0, False)
        phase_deg = phase_margin_deg(replace(settings, joints=(joint,)))
        text = f"phase margin {phase_deg:.1f} deg" if phase_deg > 0.0 else "the control loop is UNSTABLE"
        found.append(f"outside margin.payload_range, link inertia x {payload:g}: {text}")
    return found


def not_modelled(config: Config) -> list[str]:
    """Configured things that the linear loop does not know, in words."""
    control, joint, found = config.control, config.joint, []
    if control.feed_forward == "measured":
        found.append('control.feed_forward = "measured": takes back the damping that friction gives')
    if joint.gravity_Nm:
        found.append(f"joint.gravity_Nm (={joint.gravity_Nm:g}): taken as compensated exactly")
    if joint.coriolis_Nmspr:
        found.append(f"joint.coriolis_Nmspr (={joint.coriolis_Nmspr:g}): taken as compensated exactly")
    if control.kind == "computed_torque_rbf" and control.dead_zone_rad:
        found.append(f"control.dead_zone_rad (={control.dead_zone_rad:g}): taken as if the error were outside")
    virtual = config.virtual
    if config.reducer is not None:
        found.append("hysteresis of the reducer beyond what margin.stiffness_error covers, and sliding friction")
    elif virtual is None:
        found.append("flexibility of the reducer: a soft one resonates and takes margin that is not counted here")
    elif virtual.flexible:
        motor_kgm2 = virtual.motor_side_inertia_kgm2
        other_kgm2 = max(joint.inertia_kgm2 * virtual.inertia_scale - motor_kgm2, 1e-9)
        stiffness = virtual.reducer_stiffness_Nmprad
        resonance_Hz = math.sqrt(stiffness * (1.0 / motor_kgm2 + 1.0 / other_kgm2)) / math.tau
        found.append(
            f"virtual.flexible (=true): the reducer resonates at {resonance_Hz:.1f} Hz, "
            "which takes margin that is not counted here"
        )
    step_Nm, counts, remedy = coarsest(config, loop_settings(config)[0])
    share = SOFT_STEP_SHARE if control.kind == "flexible_joint" else STEP_SHARE
    if step_Nm > share * config.limits.torque_max_Nm:
        found.append(
            f"{counts}: one count moves the torque by {text_Nm(step_Nm)}, more than {share:.0%} of "
            f"limits.torque_max_Nm: it will chatter; {remedy}"
        )
    return found


# --- Constants that are each in range and do not fit together: the user is warned, nothing is refused ---


DOUBTFUL_FACTOR = 1.25  # motors are rated at a speed, where losses take part of the torque
MOST_RATED, LEAST_RATED = 10.0, 0.02  # of the motor's rated current, that the torque limit asks for
MOST_A, LEAST_A = 300.0, 0.02  # where no rated current is configured
FRICTION_ERROR = 0.1  # share by which friction is often wrong
BEGINS_S = 0.1  # in which a motion begins
OVERSHOOT = 2.0  # of the twist of a reducer that is hardly damped, over the steady one
LEAST_STEPS = 2.0  # counts of an encoder in a swing that is not of its own making


def contradictions(config: Config) -> list[str]:
    """One line for each; every one names the keys, and what follows from them."""
    return [
        *rated_contradiction(config), *_current_contradiction(config), *_inertia_contradictions(config),
        *_standstill_contradiction(config), *_friction_contradiction(config), *_stiffness_contradiction(config),
        *_braking_contradictions(config), *_swing_contradiction(config), *config.drive.coarse_numbers(config),
    ]  # fmt: skip


def rated_contradiction(config: Config) -> list[str]:
    """Torque constant, rated current and rated torque."""
    found = config.drive.constants_factor(config)
    if found is None or 1.0 / DOUBTFUL_FACTOR <= found[0] <= DOUBTFUL_FACTOR:
        return []
    return [found[1]]


def _current_contradiction(config: Config) -> list[str]:
    """The current that the torque limit asks of the motor."""
    joint, limit_Nm = config.joint, config.limits.torque_max_Nm
    current_A = limit_Nm / (torque_constant_NmpA(config) * joint.reduction_ratio)
    rated = config.drive.motor_current()
    low_A, high_A = (LEAST_A, MOST_A) if rated is None else (LEAST_RATED * rated[1], MOST_RATED * rated[1])
    if low_A <= current_A <= high_A:
        return []
    compared = "" if rated is None else f", {current_A / rated[1]:.3g} times {rated[0]} (={rated[1]:g})"
    return [
        f"limits.torque_max_Nm (={limit_Nm:g}) is {current_A:.3g} A of the motor{compared}: check "
        f"joint.torque_constant_NmpA (={joint.torque_constant_NmpA:g}) and joint.reduction_ratio "
        f"(={joint.reduction_ratio:g})"
    ]


def beyond_torque(config: Config, name: str, acceleration_radps2: float) -> list[str]:
    """One line where the joint's inertia needs more torque for this acceleration than the limit leaves."""
    inertia, limit_Nm = config.joint.inertia_kgm2, config.limits.torque_max_Nm
    free_Nm = limit_Nm - abs(config.joint.gravity_Nm)
    if inertia * acceleration_radps2 <= free_Nm:
        return []
    return [
        f"joint.inertia_kgm2 (={inertia:g}) times {name} (={acceleration_radps2:.3g} rad/s2) is "
        f"{inertia * acceleration_radps2:.3g} Nm: limits.torque_max_Nm (={limit_Nm:g}) leaves {free_Nm:.3g} Nm beside "
        "gravity"
    ]


def _inertia_contradictions(config: Config) -> list[str]:
    """Inertia against torque: too much of it for braking, or too little to be true."""
    inertia, limits = config.joint.inertia_kgm2, config.limits
    found = beyond_torque(config, "sequence.brake_radps2", config.sequence.brake_radps2)
    step = limits.torque_max_Nm / inertia / config.loop.rate_Hz
    if step > limits.velocity_max_radps:
        found.append(
            f"joint.inertia_kgm2 (={inertia:g}): limits.torque_max_Nm (={limits.torque_max_Nm:g}) speeds it up by "
            f"{step:.3g} rad/s in one period, more than limits.velocity_max_radps (={limits.velocity_max_radps:g}): "
            "is it that of the motor, without the ratio squared?"
        )
    return found


def _standstill_contradiction(config: Config) -> list[str]:
    """A reading that flickers by one count."""
    standstill, settle_s = config.limits.standstill_radps, config.sequence.settle_s
    of_a_count, count_rad = velocity_of_a_count_radps(config), law_resolution_rad(config)
    if of_a_count <= standstill or count_rad <= standstill * settle_s:
        return []
    return [
        f"limits.standstill_radps (={standstill:g}) is less than {of_a_count:.3g}, what one count of the encoder reads "
        f"behind control.velocity_cutoff_Hz (={config.control.velocity_cutoff_Hz:g}), and than "
        f"{count_rad / settle_s:.3g}, one count in sequence.settle_s (={settle_s:g}): a joint whose reading "
        "flickers is never taken to stand (STOP_TIMEOUT)"
    ]


def _friction_contradiction(config: Config) -> list[str]:
    """Friction that is a little more than believed, against what the law pushes with where the joint stays behind."""
    control, static_Nm = config.control, static_friction_Nm(config)
    behind_rad = FROZEN_SHARE * config.limits.following_error_max_rad
    if static_Nm is not None and config.drive.own_loop() is not CommandKind.TORQUE:
        return [*_overloaded(config), *_soft_cascade(config, static_Nm, behind_rad)]
    if static_Nm is None or control.feed_forward == "none":
        return []
    wrong_Nm = FRICTION_ERROR * static_Nm
    pushes_Nm = config.joint.inertia_kgm2 * control.kp * behind_rad * (1.0 + control.observer_radps * BEGINS_S)
    if pushes_Nm >= wrong_Nm:
        return []
    return [
        f"control.kp (={control.kp:g}) and observer_radps (={control.observer_radps:g}) push a joint that is "
        f"{behind_rad:g} rad behind with {pushes_Nm:.3g} Nm: friction that is {FRICTION_ERROR:.0%} more than "
        f"[friction] ({wrong_Nm:.3g} Nm) holds it there (POSITION_FROZEN)"
    ]


def _overloaded(config: Config) -> list[str]:
    """In torque mode the gate refuses it."""
    limit_Nm, left_Nm = config.limits.torque_max_Nm, free_torque_Nm(config)
    if left_Nm > 0.0:
        return []
    return [
        f"friction and gravity need {limit_Nm - left_Nm:.3g} Nm, limits.torque_max_Nm (={limit_Nm:g}) must be more: "
        "where the joint has to lift that, the drive stays at its limit (TORQUE_SATURATED)"
    ]


def _soft_cascade(config: Config, static_Nm: float, behind_rad: float) -> list[str]:
    """The same of a drive's own loop: where friction reverses, its integral still holds the torque of before."""
    cascade = cascade_of(config)
    gain, integral = cascade.velocity_gain_Nmspr, cascade.velocity_integral_Nmprad
    if gain is None or integral is None or cascade.position_gain_ps is None:
        return []
    pushes_Nm = cascade.position_gain_ps * behind_rad * (gain + integral * BEGINS_S)
    if pushes_Nm >= static_Nm:
        return []
    return [
        f"drive.cascade: position_gain_ps (={cascade.position_gain_ps:g}), velocity_gain_Nmspr (={gain:g}) and "
        f"velocity_integral_Nmprad (={integral:g}) push a joint that is {behind_rad:g} rad behind with "
        f"{pushes_Nm:.3g} Nm, less than [friction] at rest ({static_Nm:.3g} Nm): it may stick (POSITION_FROZEN) or "
        "slip back and forth (LIMIT_CYCLE)"
    ]


def _stiffness_contradiction(config: Config) -> list[str]:
    reducer = config.reducer
    if reducer is None or (reducer.loop_stiffness_Nmprad or reducer.stiffness_Nmprad) >= reducer.stiffness_Nmprad:
        return []
    return [
        f"reducer.loop_stiffness_Nmprad (={reducer.loop_stiffness_Nmprad:g}) is less than reducer.stiffness_Nmprad "
        f"(={reducer.stiffness_Nmprad:g}): hysteresis makes a small motion stiffer, not softer"
    ]


def _braking_contradictions(config: Config) -> list[str]:
    """A controlled stop against a soft reducer, for the heaviest link and the softest reducer that the gate looks at.

    Braking begins and ends with a jump of the acceleration: the twist comes to twice the steady one, and the link
    swings afterwards.  Neither gravity nor what the law damps is counted.
    """
    reducer, second, sequence = config.reducer, config.joint_encoder, config.sequence
    if reducer is None:
        return []
    brake_radps2, standstill_radps = sequence.brake_radps2, config.limits.standstill_radps
    twist_s2, found = most_twist_s2(config, reducer), []
    brakes = f"sequence.brake_radps2 (={brake_radps2:g})"
    if second is not None and (twist_rad := OVERSHOOT * twist_s2 * brake_radps2) > second.disagreement_max_rad:
        most_radps2 = 0.99 * second.disagreement_max_rad / (OVERSHOOT * twist_s2)  # room for rounding
        found.append(
            f"{brakes} twists the reducer by up to {1e3 * twist_rad:.3g} mrad, more than "
            f"joint_encoder.disagreement_max_rad (={second.disagreement_max_rad:g}): a stop may end by "
            f"POSITION_DISAGREEMENT; {most_radps2:.3g} rad/s2 do not twist it by more"
        )
    decay_ps = max(0.5 * reducer.damping_Nmspr / (config.margin.payload_range[1] * config.link_kgm2),
                   LEAST_DAMPING / math.sqrt(twist_s2))  # fmt: skip
    swings_radps = brake_radps2 * math.sqrt(twist_s2)
    swings_s = math.log(max(swings_radps / standstill_radps, 1.0)) / decay_ps
    left_s = sequence.stop_timeout_s - config.limits.velocity_max_radps / brake_radps2
    if swings_s > left_s:
        found.append(
            f"{brakes} leaves the link swinging on its reducer at {swings_radps:.2g} rad/s, and above "
            f"limits.standstill_radps (={standstill_radps:g}) for {swings_s:.2g} s: sequence.stop_timeout_s "
            f"(={sequence.stop_timeout_s:g}) leaves {left_s:.2g} s after braking (STOP_TIMEOUT): "
            "allow more time"
        )
    return found


def _swing_contradiction(config: Config) -> list[str]:
    """The swing of the error that is a fault, against the steps in which an encoder reads a joint that moves slowly."""
    limits, step_rad = config.limits, law_resolution_rad(config)
    swing_rad = limits.swing_error_share * limits.following_error_max_rad
    if swing_rad >= LEAST_STEPS * step_rad:
        return []
    share = math.ceil(100.0 * LEAST_STEPS * step_rad / limits.following_error_max_rad) / 100.0
    remedy = f"a share of {share:g} is" if share <= 1.0 else f"{LEAST_STEPS * step_rad:.2g} rad of error are"
    return [
        f"limits.swing_error_share (={limits.swing_error_share:g}) of following_error_max_rad "
        f"(={limits.following_error_max_rad:g}) is {1e3 * swing_rad:.3g} mrad, and a count of the encoder "
        f"{1e3 * step_rad:.3g} mrad: its steps alone look like an error that swings (LIMIT_CYCLE); "
        f"{remedy} {LEAST_STEPS:g} counts"
    ]


# --- Bode plot with its margins, sensitivity, closed-loop poles ---


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
        if isinstance(joint, RigidJoint):
            continue
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
    axis.set_title(f"closed-loop poles but {hidden} fast ones, lines of damping", fontsize=9, color=GREY)
    axis.set_xlim(-widest, max(0.15 * widest, *(1.2 * pole.real for pole in shown)))
    axis.set_xlabel("real part [1/s]")
    axis.set_ylabel("imaginary part [rad/s]")
