"""The gate before enabling: a loop without enough phase margin is refused, with what would bring it there.

The remedies change one setting at a time, each with the number found by search.  A search starts at the present value
and looks for the nearest one that meets the margin; what it returns has been rounded to three digits towards the safe
side and computed again.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from jointctl.drivers.errors import MarginError, text_Nm
from jointctl.firmware_py.states import CommandKind, ControllerKind, Encoders
from jointctl.tools.analysis.linear_loop import CONTROLLERS, LoopSettings, TwoMasses, loop_settings
from jointctl.tools.analysis.margins import (
    OBSERVING,
    Convergence,
    Margins,
    largest_sensitivity,
    learning_convergence,
    margins,
    phase_margin_deg,
    worst_case,
)
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import free_torque_Nm, joint_rad_per_count, law_resolution_rad
from jointctl.tools.configuration.records import encoders_of_law

if TYPE_CHECKING:
    from jointctl.tools.configuration.canopen import CanopenSection, Cascade

# --- remedies ---

_STEPS = 60  # of a scan, each a few per cent
_BISECTIONS = 14
_SCAN_RATIO = 1.04
_HIGHEST_CUTOFF = 0.49  # of the rate; the configuration allows less than half


@dataclass(frozen=True)
class Remedy:
    """One change that reaches the margin."""

    text: str  # what to write into the configuration, and instead of what
    settings: LoopSettings
    phase_margin_deg: float


def _rounded(value: float, upwards: bool) -> float:
    if value == 0.0:
        return 0.0
    unit = 10.0 ** (math.floor(math.log10(abs(value))) - 2)
    count = math.ceil(value / unit) if upwards else math.floor(value / unit)
    return float(f"{count * unit:.3g}")


def _boundary(bad: float, good: float, meets: Callable[[float], bool]) -> float:
    """The value next to `bad` that meets the margin; `good` does."""
    for _ in range(_BISECTIONS):
        middle = 0.5 * (bad + good)
        if meets(middle):
            good = middle
        else:
            bad = middle
    return good


def _enough(settings: LoopSettings, minimum_deg: float) -> bool:
    """Phase margin and, of joints that are not rigid, the peak of |S|."""
    if phase_margin_deg(settings) < minimum_deg:
        return False
    return not settings.joints or largest_sensitivity(settings)[0] <= settings.largest_s


def _search(
    minimum_deg: float, start: float, end: float, change: Callable[[float], LoopSettings]
) -> tuple[float, LoopSettings, float] | None:
    """(value, settings, phase margin) nearest to `start` on the way to `end` (both > 0, a scan by ratio)."""

    def meets(value: float) -> bool:
        return _enough(change(value), minimum_deg)

    steps = min(_STEPS, max(1, math.ceil(abs(math.log(end / start)) / math.log(_SCAN_RATIO))))
    bad = start
    for i in range(1, steps + 1):
        value = start * (end / start) ** (i / steps)
        if meets(value):
            value = _rounded(_boundary(bad, value, meets), end > start)
            reached = change(value)
            return (value, reached, phase_margin_deg(reached)) if _enough(reached, minimum_deg) else None
        bad = value
    return None


def remedies(settings: LoopSettings, minimum_deg: float) -> list[Remedy]:
    """Changes that each reach `minimum_deg`, the mildest for the tracking error first; empty if none does alone.

    Of several joints each is searched with the worst one, and then must do for all.
    """
    s = worst_case(settings)
    if _enough(s, minimum_deg):
        s = largest_sensitivity(settings)[2]
    network = s.kind == ControllerKind.COMPUTED_TORQUE_RBF and s.learning_rate > 0.0
    found = []

    def add(text: str, result: tuple[float, LoopSettings, float] | None) -> None:
        if result is not None and s.joints:
            everywhere = replace(result[1], joints=settings.joints)
            enough = _enough(everywhere, minimum_deg)
            result = (result[0], everywhere, phase_margin_deg(everywhere)) if enough else None
        if result is not None:
            found.append(Remedy(text.format(value=result[0], changed=result[1]), result[1], result[2]))

    highest = _HIGHEST_CUTOFF / s.period_s
    if 0.0 < s.cutoff_Hz < highest:
        result = _search(minimum_deg, s.cutoff_Hz, highest, lambda v: replace(s, cutoff_Hz=v))
        add(f"control.velocity_cutoff_Hz = {{value:g}} (now {s.cutoff_Hz:g})", result)
    if network:
        q1, q2 = s.q
        if q1 == q2:
            result = _search(minimum_deg, q1, q1 * 1e-3, lambda v: replace(s, q=(v, v)))
            add(f"control.lyapunov_q = {{value:g}} (now {q1:g}; adaptation in proportion)", result)
        result = _search(minimum_deg, s.learning_rate, s.learning_rate * 1e-3, lambda v: replace(s, learning_rate=v))
        add(f"control.learning_rate = {{value:g}} (now {s.learning_rate:g})", result)
    if s.kind == ControllerKind.PID and s.ki > 0.0:
        result = _search(minimum_deg, s.ki, s.ki * 1e-3, lambda v: replace(s, ki=v))
        add(f"control.ki = {{value:g}} (now {s.ki:g})", result)
    if s.kind in OBSERVING and s.observer_radps > 0.0:
        result = _search(minimum_deg, s.observer_radps, s.observer_radps * 1e-3, lambda v: replace(s, observer_radps=v))
        add(f"control.observer_radps = {{value:g}} (now {s.observer_radps:g})", result)
    result = _search(minimum_deg, s.kv, s.kv * 6.0, lambda v: replace(s, kv=v))
    add(f"control.kv = {{value:g}} (now {s.kv:g})", result)
    if result is None:
        result = _search(minimum_deg, s.kv, s.kv / 6.0, lambda v: replace(s, kv=v))
        add(f"control.kv = {{value:g}} (now {s.kv:g})", result)
    result = _search(minimum_deg, 1.0, 0.03, lambda v: slower(s, v))
    add("a slower loop: control.kp = {changed.kp:.4g}, kv = {changed.kv:.4g}" + _rest_text(s, network), result)
    return found


def slower(settings: LoopSettings, factor: float) -> LoopSettings:
    """Every closed-loop mode of the theory `factor` times as fast: kp, kv, and Q, ki or the observer, scaled together.

    s^3 + kv s^2 + (kp + a P22) s + a P12 needs P22 ~ factor^2 and P12 ~ factor^3: q2 ~ factor^3 and q1 ~ factor^5.
    Q = q I keeps its shape with factor^3; its slow mode is slow anyway.
    """
    q1, q2 = settings.q
    scaled = (q1 * factor ** (3 if q1 == q2 else 5), q2 * factor**3)
    return replace(
        settings,
        kp=settings.kp * factor**2,
        kv=settings.kv * factor,
        q=scaled,
        ki=settings.ki * factor**3,
        observer_radps=settings.observer_radps * factor,
    )


def _rest_text(settings: LoopSettings, network: bool) -> str:
    if settings.kind == ControllerKind.PID:
        return ", ki = {changed.ki:.4g}"
    if settings.kind in OBSERVING:
        return ", observer_radps = {changed.observer_radps:.4g}"
    if not network:
        return ""
    if settings.q[0] == settings.q[1]:
        return ", lyapunov_q = {changed.q[0]:.4g}"
    return ", lyapunov_q = [{changed.q[0]:.4g}, {changed.q[1]:.4g}]"


def longest_delay_s(settings: LoopSettings, minimum_deg: float) -> float | None:
    """The longest loop delay up to the present one that still leaves the margin; None if even no delay does not."""

    def meets(delay_s: float) -> bool:
        return _enough(replace(settings, delay_s=delay_s), minimum_deg)

    if not meets(0.0):
        return None
    if meets(settings.delay_s):
        return settings.delay_s
    return _rounded(_boundary(settings.delay_s, 0.0, meets), False)


# --- the gate ---


def require_margin(config: Config, delay_s: float | None = None, *, allow_low_margin: bool = False) -> Margins:
    """For `run`, before enabling: `MarginError` if the margin is too small with this measured loop delay.

    `allow_low_margin` is the user's explicit override; it never lets an unstable loop pass.
    """
    return require_loop(config, loop_settings(config, delay_s)[0], allow_low_margin=allow_low_margin)


def require_loop(
    config: Config, settings: LoopSettings, found: Margins | None = None, *, allow_low_margin: bool = False
) -> Margins:
    """See `require_margin`, with the loop's settings, and its margins where they are known already."""
    minimum_deg = config.margin.min_phase_margin_deg
    found = margins(settings) if found is None else found
    if not allow_low_margin:
        refuse_chatter(config, settings)
    refuse_diverging_learning(learning_of(config, settings))
    if not meets(found, minimum_deg) and not (found.stable and allow_low_margin):
        raise refusal(settings, found, minimum_deg, remedies(settings, minimum_deg))
    return found


def learning_of(config: Config, settings: LoopSettings) -> Convergence | None:
    """How iterative learning converges; None where there is none."""
    learning = config.control.learning
    return None if learning is None else learning_convergence(settings, learning)


def refuse_diverging_learning(found: Convergence | None) -> None:
    if found is not None and not found.worst_factor < 1.0:
        raise MarginError(
            f"iterative learning would diverge: factor {found.worst_factor:.2f} from one repetition to the next "
            f"at {found.worst_Hz:.1f} Hz, below 1 is needed",
            "lower control.learning.gain or error_gain_ps2, or raise half_width_cycles",
        )


def coarsest(config: Config, settings: LoopSettings) -> tuple[float, str, str]:
    """(step [Nm], the counts of that encoder by their key, what lowers it); of two encoders the one with the greater.

    The step is by how much the law moves the torque, in that cycle, when the encoder counts one on.
    """
    second, resolution_rad = config.joint_encoder, law_resolution_rad(config)
    own = f"encoder.counts_per_turn (={config.encoder.counts_per_turn})"
    law = own
    if second is not None and second.law == "joint_encoder":
        law = f"joint_encoder.counts_per_turn (={second.counts_per_turn})"
    steps_Nm = np.abs(CONTROLLERS[settings.kind](settings).d[0])
    if settings.kind != ControllerKind.FLEXIBLE_JOINT:
        remedy = 'control.velocity_filter = "kalman" (of computed_torque_observer), or lower control.velocity_cutoff_Hz'
        return float(np.max(steps_Nm) * resolution_rad), law, f"{remedy}, kv and observer_radps"
    of_law = "lower control.observer_radps and velocity_cutoff_Hz"
    if settings.encoders == Encoders.BOTH:
        of_law = "lower control.observer_radps and link_cutoff_Hz"
        of_motor_Nm = float(steps_Nm[1] * abs(joint_rad_per_count(config)))
        if of_motor_Nm > steps_Nm[0] * resolution_rad:
            return of_motor_Nm, own, "lower control.kv, observer_radps and velocity_cutoff_Hz"
    return float(np.max(steps_Nm[0]) * resolution_rad), law, of_law


OVERLOADED = "a greater limits.torque_max_Nm; or [friction] and joint.gravity_Nm are of another joint"


def refuse_chatter(config: Config, settings: LoopSettings) -> None:
    """`MarginError` where the torque that moves the joint and one count on top of it reach the limit."""
    (step_Nm, counts, remedy), limit_Nm = coarsest(config, settings), config.limits.torque_max_Nm
    holding_Nm = limit_Nm - free_torque_Nm(config)
    if holding_Nm >= limit_Nm:
        raise MarginError(
            f"friction and gravity need {holding_Nm:.3g} Nm, limits.torque_max_Nm (={limit_Nm:g}) must be more",
            OVERLOADED,
        )
    if step_Nm + holding_Nm >= limit_Nm:
        raise MarginError(
            f"the torque would chatter at its limit: one count of {counts} moves it by {text_Nm(step_Nm)}, friction "
            f"and gravity need {text_Nm(holding_Nm)}; together they must be below limits.torque_max_Nm (={limit_Nm:g})",
            f"an encoder with more counts, {remedy}",
        )


def chatters(config: Config) -> bool:
    """Whether one count of an encoder takes what friction and gravity leave of the torque, if they leave any."""
    return 0.0 < free_torque_Nm(config) <= coarsest(config, loop_settings(config)[0])[0]


def meets(found: Margins, minimum_deg: float) -> bool:
    return found.stable and found.phase_margin_deg >= minimum_deg and found.sensitivity_accepted


def passes(config: Config) -> bool:
    """Whether the gate before enabling will let this loop be closed, as far as its delay is known."""
    return meets(margins(loop_settings(config)[0]), config.margin.min_phase_margin_deg)


def refusal(settings: LoopSettings, found: Margins, minimum_deg: float, changes: list[Remedy]) -> MarginError:
    filtered = f"{settings.cutoff_Hz:g} Hz filter" if settings.cutoff_Hz > 0.0 else "no filter"
    where = (
        f"at {1.0 / settings.period_s:g} Hz with {settings.delay_s * 1e3:g} ms loop delay, "
        f"{settings.lag_s * 1e3:g} ms current lag, {filtered}"
    )
    too_sensitive = found.stable and found.phase_margin_deg >= minimum_deg
    if too_sensitive:
        where += f"; worst case: {found.sensitivity_joint}"
    elif found.joint:
        where += f"; worst case: {found.joint}"
    if too_sensitive:
        what = (
            f"peak of the sensitivity |S| (={found.sensitivity_peak:.2f} at {found.sensitivity_peak_Hz:.1f} Hz) must "
            f"be at most {settings.largest_s:g} (margin.max_sensitivity)"
        )
    elif found.stable:
        what = f"phase margin (={found.phase_margin_deg:.1f} deg) must be at least {minimum_deg:g} deg"
    else:
        what = f"the control loop is unstable; a phase margin of at least {minimum_deg:g} deg is required"
    texts = [f"{r.text} gives {r.phase_margin_deg:.1f} deg" for r in changes]
    worst = largest_sensitivity(settings)[2] if too_sensitive else worst_case(settings)
    longest_s = longest_delay_s(worst, minimum_deg)
    if longest_s is not None and longest_s > 0.0:
        texts.append(f"a loop delay of {longest_s * 1e3:g} ms or less")
    hint = "any one of: " + "; ".join(texts)
    if not texts:
        rest = {ControllerKind.PID: "ki", ControllerKind.COMPUTED_TORQUE_RBF: "lyapunov_q"}.get(settings.kind, "filter")
        gains = f"kp, kv and {'observer_radps' if settings.kind in OBSERVING else rest}"
        hint = f"no single setting reaches it: `jointctl check CONFIG --choose-gains` searches {gains} together"
    return MarginError(f"{what}: {where}", hint)


# --- Margins of the loops that a drive closes itself (CSP, CSV), where the configuration gives its gains ---
#
#     velocity loop   Lv = (Kv + Ki/s) s P e^(-s Tv) / (1 + s Tl)       PI, Tv = 1.5 drive periods, Tl current lag
#     position loop   Lp = Kp/s  Lv / (1 + Lv)  R e^(-s Tp)             P; CSP: Tp = 0, the drive computes both at once
#                                                                       CSV: it is closed on the PC, Tp is our delay
#
# P is the shaft that the drive's encoder sits on over torque, 1 / (J s^2) of a rigid joint.  With [reducer] it is that
# of two masses, for each of the joints that the margins of a law are worked out for, and R is the shaft that feeds the
# law over that of the drive's encoder (CSV; else 1): the worst joint counts.  In CSP with both encoders the target has
# what the twist is away from the expected one taken off, on the PC and twist_radps = wb quick:
#
#     twist correction   Lt = wb / (s + wb)  (link / motor - 1)  Lp / (1 + Lp) e^(-s Tt)     Tt: our delay and a period
#
# Without the offsets, which are outside the loops; a rigid joint also without friction, which only adds damping.
# Not modelled: the drive's filters and its estimation of the velocity.

_LOWEST_radps, _POINTS = 1e-2, 20_000
_LEAST_DAMPING = 0.002  # of the critical one, of a reducer: a resonance without any falls between two points
TWIST, POSITION_LOOP = "twist correction", "position loop"
SAMPLES_LATE = 1.5  # of a sampled loop: one to compute, half for holding


@dataclass(frozen=True)
class LoopMargin:
    """Of one loop of the cascade, closed around the inner ones."""

    name: str
    phase_margin_deg: float
    crossover_Hz: float
    gain_margin_up: float  # inf: no gain makes it unstable
    stable: bool
    joint: str = ""  # the worst one, of several

    def phase_text(self, digits: int) -> str:
        """The phase margin in words; of a loop whose gain stays below 1 there is none."""
        if math.isinf(self.phase_margin_deg):
            return "a gain below 1"
        return f"{self.phase_margin_deg:.{digits}f} deg phase margin"


def _margin(name: str, omega: np.ndarray, response: np.ndarray, inner_stable: bool = True) -> LoopMargin:
    """The crossover nearest to -180 deg, and the least gain that comes to -1; a resonance may have several of each.

    Only an inner loop can be unstable in the open loop: where it is not, the loop is stable if -1 is not encircled.
    """
    size, away_deg = np.abs(response), np.degrees(np.angle(-response))  # from -180 deg
    turned = np.unwrap(np.angle(1.0 + response))
    if turned[0] > 0.5 * math.pi:  # two integrators begin at -180 deg, with more lag than lead just beyond
        turned -= math.tau
    stable = inner_stable and bool(abs(turned[-1]) < 0.5 * math.pi)
    crossings = np.flatnonzero((size[:-1] >= 1.0) != (size[1:] >= 1.0))
    if not len(crossings):
        return LoopMargin(name, math.inf if stable else -math.inf, math.nan, math.inf, stable)
    worst = crossings[np.argmin(np.abs(away_deg[crossings]))]
    through = np.flatnonzero((np.diff(np.sign(away_deg)) != 0.0) & (np.abs(away_deg[1:]) < 90.0) & (size[1:] < 1.0))
    gain = 1.0 / float(np.max(size[through + 1])) if len(through) else math.inf
    margin_deg = abs(float(away_deg[worst]))
    return LoopMargin(name, margin_deg if stable else -margin_deg, float(omega[worst]) / math.tau, gain, stable)


def _shafts(joint: TwoMasses, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angles of (motor, link) over the motor's torque [rad/Nm]."""
    reducer = joint.stiffness_Nmprad + max(joint.damping_Nmspr, _LEAST_DAMPING * joint.critical_Nmspr) * s
    motor, link = (
        inertia * s**2 + damping * s + held + reducer
        for inertia, damping, held in zip(
            (joint.motor_kgm2, joint.link_kgm2), joint.bristle_damping_Nmspr, joint.bristle_Nmprad, strict=True
        )
    )
    together = motor * link - reducer**2
    return link / together, reducer / together


def _section(config: Config) -> CanopenSection:
    from jointctl.tools.configuration.canopen import canopen_section  # not loaded for another drive

    return canopen_section(config)


def cascade_of(config: Config) -> Cascade:
    """[drive.cascade] of a configuration whose drive closes its own loop."""
    cascade = _section(config).cascade
    assert cascade is not None
    return cascade


def cascade_margins(config: Config, delay_s: float) -> list[LoopMargin]:
    """Of the loops whose gains are known, inner one first, each with its worst joint.

    `delay_s` is that of the loop on the PC.
    """
    soft = [joint for joint in loop_settings(config, delay_s)[0].joints if isinstance(joint, TwoMasses)]
    joints: list[TwoMasses | None] = [*soft] or [None]
    of_each = [_cascade_margins(config, delay_s, joint) for joint in joints]
    return [
        min(loops, key=lambda loop: (loop.stable, loop.phase_margin_deg, loop.gain_margin_up))
        for loops in zip(*of_each, strict=True)
    ]


def _cascade_margins(config: Config, delay_s: float, joint: TwoMasses | None) -> list[LoopMargin]:
    """Of one joint; None is a rigid one."""
    cascade, kind = cascade_of(config), config.drive.own_loop()
    omega = np.geomspace(_LOWEST_radps, math.pi * cascade.loop_rate_Hz, _POINTS)
    s = 1j * omega
    if joint is None:
        own = fed = 1.0 / (config.joint.inertia_kgm2 * s**2)
    else:
        shafts = dict(zip(("motor", "joint"), _shafts(joint, s), strict=True))
        second = config.joint_encoder
        own = fed = shafts[config.encoder.side]
        if kind is CommandKind.VELOCITY and second is not None and second.law == "joint_encoder":
            fed = shafts["joint"]
    drive_s = SAMPLES_LATE / cascade.loop_rate_Hz
    late_s = 0.0 if kind is CommandKind.POSITION else delay_s + 0.5 / config.loop.rate_Hz
    found, closed = [], np.ones_like(s)
    if cascade.velocity_gain_Nmspr is not None and cascade.velocity_integral_Nmprad is not None:
        gain = cascade.velocity_gain_Nmspr + cascade.velocity_integral_Nmprad / s
        lag = np.exp(-s * drive_s) / (1.0 + s * config.margin.current_lag_s)
        velocity = gain * s * own * lag
        found.append(_margin("velocity loop", omega, velocity))
        closed = velocity / (1.0 + velocity)
    elif kind is CommandKind.POSITION:
        return []  # nothing is known of what the position loop is closed around
    if cascade.position_gain_ps is not None:
        position = cascade.position_gain_ps / s * closed * (fed / own) * np.exp(-s * late_s)
        found.append(_margin(POSITION_LOOP, omega, position, all(loop.stable for loop in found)))
        corrects_twist = config.control.kind == "flexible_joint" and encoders_of_law(config) == Encoders.BOTH
        if kind is CommandKind.POSITION and joint is not None and corrects_twist:
            twist = shafts["joint"] / shafts["motor"] - 1.0  # of the link against a motor that follows its target
            late = np.exp(-s * (delay_s + 1.0 / config.loop.rate_Hz))  # the drive goes to a target within a period
            correction = config.control.twist_radps / (s + config.control.twist_radps) * twist * late
            correction *= position / (1.0 + position)
            found.append(_margin(TWIST, omega, correction, all(loop.stable for loop in found)))
    return found if joint is None else [replace(loop, joint=joint.name) for loop in found]


def cascade_unknowns(config: Config) -> list[str]:
    """What the figures leave out, in words."""
    cascade, found = cascade_of(config), []
    if cascade.velocity_gain_Nmspr is None:
        found.append("the drive's velocity loop: drive.cascade.velocity_gain_Nmspr and velocity_integral_Nmprad")
    if cascade.position_gain_ps is None:
        found.append("the drive's position loop: drive.cascade.position_gain_ps")
    rest = "the drive's filters, its estimation of the velocity"
    return [*found, rest if config.reducer is not None else f"{rest}, and a reducer that is not rigid"]


def require_cascade(config: Config, delay_s: float, *, allow_low_margin: bool = False) -> list[LoopMargin]:
    """`cascade_margins`; `MarginError` where one is below the minimum.  Gains that are not given are not judged."""
    found, minimum_deg = cascade_margins(config, delay_s), config.margin.min_phase_margin_deg
    for loop in found:
        enough = loop.stable and loop.phase_margin_deg >= minimum_deg
        if not enough and not (loop.stable and allow_low_margin):
            raise MarginError(
                f"drive.mode (={_section(config).mode}): the phase margin of the {loop.name} "
                f"(={loop.phase_margin_deg:.1f} deg{'' if loop.stable else ', unstable'}) must be at least "
                f"{minimum_deg:g} deg{f'; worst case: {loop.joint}' if loop.joint else ''}",
                _cascade_remedy(config, loop),
            )
    return found


def _cascade_remedy(config: Config, loop: LoopMargin) -> str:
    """What changes the margin of this loop."""
    cascade = cascade_of(config)
    if loop.name == TWIST:
        return f"a lower control.twist_radps (now {config.control.twist_radps:g})"
    if config.drive.own_loop() is not CommandKind.VELOCITY or loop.name != POSITION_LOOP:
        return "correct the gains in [drive.cascade], and those of the drive with its maker's software"
    remedy = f"a lower drive.cascade.position_gain_ps (now {cascade.position_gain_ps:g})"
    if cascade.velocity_gain_Nmspr is None or cascade.velocity_integral_Nmprad is None:
        remedy += "; or the drive's velocity_gain_Nmspr and velocity_integral_Nmprad: without both its velocity loop "
        remedy += "is taken for one that is infinitely quick"
    return remedy


def cascade_text(config: Config, delay_s: float, *, allow_low_margin: bool = False) -> str:
    """For a run, before enabling; as `require_cascade`."""
    found = require_cascade(config, delay_s, allow_low_margin=allow_low_margin)
    if not found:
        return "the drive closes its own loops, whose gains are not given"
    return ", ".join(f"{loop.name} with {loop.phase_text(0)}" for loop in found)
