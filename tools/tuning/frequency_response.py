"""Frequency response of a joint, torque command to the position of either encoder: its excitation, its estimate.

The motion is a multisine in torque on a slow triangle, whose legs differ in speed.  The joint slides all the time,
because friction that holds takes every resonance away.  The law that keeps it on the triangle is weak; the multisine is
the acceleration of the reference times the inertia that is believed, so that every limit and watchdog of a run is in
force, and a swing of the feedback is not taken for the excitation.  Position and velocity of the reference are those of
the triangle alone.  Each leg holds one period of the multisine at constant speed.  Legs of other speeds have their
ripple at other frequencies, so that a median over the legs is free of it.

Of each leg's period, without its trend and under a Hann window, the Fourier sums at the lines of the multisine:

    G = median over the legs of (Y / R) / median over the legs of (U / R)      R excitation, U command, Y position

Both medians are free of what friction ripple and noise do, because those know nothing of R, although the loop is
closed.  The interval comes from the spread of Y - G U over the legs; the coherence is that of position and excitation.
G is that of the sampled joint, from a command to a later sample, with delay and current loop, as `linear_loop` has it.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import signal, stats

from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import DataError, UsageError, text_Nm, text_radps
from jointctl.firmware_py.states import AxisPhase
from jointctl.tools.analysis.gains import LEAST_DAMPING
from jointctl.tools.analysis.linear_loop import two_masses
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.conversions import TWIST_SHARE, period_s, static_friction_Nm, turning_of
from jointctl.tools.configuration.records import table_constants
from jointctl.tools.drawing import BLUE, GREY, ORANGE, canvas
from jointctl.tools.session.plan import Placed, joint_lines, limits_line, remark_lines
from jointctl.tools.sweeping.carry_out import approach_time_s, with_mode
from jointctl.tools.sweeping.plan import position_margin_rad

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from jointctl.tools.tuning.joint_fit import JointFit


SPEED_radps = 0.2  # of the triangle: at 0.05 friction still hides what is looked for
USUAL_SPEED_radps = 0.1  # at least, where travel and limits.velocity_max_radps allow it
LEAST_SPEED_radps = 0.01  # of slow joints, with an excitation that is smaller in proportion and turns no leg round
SPEED_SPREAD = 0.2  # by which a pair of legs is faster or slower
VELOCITY_SHARE = 0.4  # of limits.velocity_max_radps: the excitation adds to the speed
ACCELERATION_SHARE = 0.5  # of sequence.brake_radps2
PERIOD_s, SHORT_PERIOD_s = 4.0, 2.0
SETTLE_s = 0.6  # of a leg, before its period
FADE_s = 0.5
LINES = 80
LOWEST_Hz = 1.0
# of loop.rate_Hz, the highest line; of a slow loop more, up to 250 Hz: a resonance beyond it is not seen
HIGHEST_SHARE, MOST_SHARE, SEEN_Hz = 0.25, 0.4, 250.0
LEAST_BINS = 2  # between two lines: the window of the analysis is that wide
FULL_FROM_Hz = 3.0  # lines below are smaller: they would turn the motion round
CRESTS = 200  # random phases that are tried for a low peak
TORQUE_SHARE = 0.15  # of limits.torque_max_Nm: peak of the multisine, unless the user allows less
LEAST_SHARE = 1.0 / 8.0  # of that peak: where it begins
SEED = 1
FRICTION_SPARE = 1.2  # of the static friction, which the excitation leaves room for

# that peak over the inertia, less below USUAL_SPEED_radps: more would turn the motion round, and its friction with it
LARGEST_radps2 = 8.0


class ResponseLaw(NamedTuple):
    """Computed torque with a disturbance observer, for the excitation alone."""

    kp_ps2: float
    kv_ps: float
    observer_radps: float
    link_cutoff_Hz: float  # of the velocity with an encoder behind the reducer, at most: not to excite its resonance


WEAK = ResponseLaw(100.0, 20.0, 15.0, 15.0)
# for much friction on little inertia, under which the weak one stands or swings
STIFF = ResponseLaw(1600.0, 80.0, 60.0, 120.0)
STIFFEST = ResponseLaw(3200.0, 120.0, 60.0, 200.0)  # where that one swings: the inertia is more than is believed


@dataclass(frozen=True)
class Multisine:
    """One period of a torque with a peak of 1, at the loop's rate."""

    frequency_Hz: np.ndarray  # (LINES,)
    bins: np.ndarray  # the same in whole periods
    wave: np.ndarray  # (N,)


@functools.lru_cache(maxsize=4)
def multisine(rate_Hz: float, length_s: float) -> Multisine:
    """Lines from LOWEST_Hz to a share of the rate, even steps of the logarithm, phases with a low peak."""
    samples = round(rate_Hz * length_s)
    highest = max(HIGHEST_SHARE * rate_Hz, min(MOST_SHARE * rate_Hz, SEEN_Hz))
    wanted = np.geomspace(LOWEST_Hz, highest, LINES) * length_s
    bins = [max(round(wanted[0]), LEAST_BINS)]
    for bin_wanted in wanted[1:]:
        bins.append(max(round(bin_wanted), bins[-1] + LEAST_BINS))
    kept = np.array([b for b in bins if b <= highest * length_s])
    frequency = kept / length_s
    size = np.minimum(1.0, frequency / FULL_FROM_Hz)
    random = np.random.default_rng(SEED)
    best = np.zeros(samples)
    lowest = math.inf
    for _ in range(CRESTS):
        spectrum = np.zeros(samples // 2 + 1, dtype=np.complex128)
        spectrum[kept] = size * np.exp(1j * random.uniform(0.0, math.tau, len(kept)))
        wave = np.fft.irfft(spectrum, samples)
        crest = float(np.max(np.abs(wave)) / np.std(wave))
        if crest < lowest:
            lowest, best = crest, wave
    return Multisine(frequency, kept, best / np.max(np.abs(best)))


@dataclass(frozen=True)
class Legs:
    """Velocity of the triangle, one value a cycle, and the cycle in which the period of each leg begins."""

    velocity_radps: np.ndarray  # (N,)
    starts: np.ndarray  # (legs,)
    width_rad: float


def room_rad(config: Config) -> float:
    """Width of the travel that the limits leave."""
    limits = config.limits
    return limits.position_max_rad - limits.position_min_rad - 2.0 * position_margin_rad(config)


def _turning(config: Config) -> tuple[float, float]:
    """(acceleration where the triangle turns round, time in which it changes)."""
    return turning_of(config, ACCELERATION_SHARE * config.sequence.brake_radps2)


def _length_rad(speed_radps: float, period_s_: float, turning: tuple[float, float]) -> float:
    acceleration, rounded_s = turning
    return speed_radps * (SETTLE_s + period_s_ + rounded_s + max(speed_radps / acceleration, rounded_s))


def speed_and_period(config: Config) -> tuple[float, float]:
    """(speed of the triangle, period of the multisine) that the travel allows; `UsageError` where it is too short."""
    turning = _turning(config)
    width = room_rad(config)
    fastest = min(SPEED_radps, VELOCITY_SHARE * config.limits.velocity_max_radps)
    wanted = ((PERIOD_s, 0.7 * SPEED_radps), (SHORT_PERIOD_s, USUAL_SPEED_radps), (SHORT_PERIOD_s, LEAST_SPEED_radps))
    for length_s, least in wanted:
        speed = fastest  # where it is less than wanted, this one alone is tried before the last
        while speed >= min(least, max(fastest, LEAST_SPEED_radps)):
            if _length_rad((1.0 + SPEED_SPREAD) * speed, length_s, turning) <= width:
                return speed, length_s
            speed *= 0.98
    needed = _length_rad((1.0 + SPEED_SPREAD) * LEAST_SPEED_radps, SHORT_PERIOD_s, turning)
    raise UsageError(
        f"the travel (={width:.4g} rad) must be at least {needed:.3g} rad, and {VELOCITY_SHARE:g} of "
        f"limits.velocity_max_radps (={VELOCITY_SHARE * config.limits.velocity_max_radps:.3g} rad/s) at least "
        f"{LEAST_SPEED_radps:g}: the joint has to slide; see limits.position_min_rad, position_max_rad"
    )


def legs_of(config: Config, pairs: int) -> Legs:
    """`pairs` of legs there and back, each pair at a speed of its own."""
    speed, length_s = speed_and_period(config)
    acceleration, rounded_s = _turning(config)
    rate = config.loop.rate_Hz
    rounded = round(rounded_s * rate)
    factors = 1.0 + SPEED_SPREAD * np.linspace(-1.0, 1.0, max(pairs, 2))[:pairs]
    np.random.default_rng(SEED).shuffle(factors)
    parts, starts, count, widths = [np.zeros(round(FADE_s * rate))], [], round(FADE_s * rate), []
    for factor in factors:
        top = float(factor * speed)
        ramp = max(round(top / acceleration * rate), rounded, 1)
        cruise = round((SETTLE_s + length_s) * rate) + rounded
        up = top * (np.arange(ramp) + 1.0) / ramp
        leg = np.concatenate((up, np.full(cruise, top), up[::-1] - top / ramp))
        if rounded:
            leg = np.convolve(leg, np.full(rounded, 1.0 / rounded))
        widths.append(float(np.sum(leg)) / rate)
        for side in (1.0, -1.0):
            starts.append(count + ramp + rounded + round(SETTLE_s * rate))
            parts.append(side * leg)
            count += len(leg)
    parts.append(np.zeros(round(FADE_s * rate)))
    return Legs(np.concatenate(parts), np.array(starts), max(widths))


@dataclass(frozen=True)
class ResponsePlan:
    """One stage: the same triangle and multisine, at one size."""

    legs: Legs
    sine: Multisine
    peak_Nm: float

    @property
    def samples(self) -> int:
        """Of one period."""
        return len(self.sine.wave)


def excitation_table(plan: ResponsePlan, inertia_kgm2: float, step_s: float) -> np.ndarray:
    """Rows of `reference_at`, one a cycle, which is in the middle of its row: rounding of the time changes nothing."""
    velocity = plan.legs.velocity_radps
    count = len(velocity)
    position = np.concatenate(([0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1])))) * step_s
    fade = round(FADE_s / step_s)
    size = np.minimum(1.0, np.minimum(np.arange(count), np.arange(count)[::-1]) / fade)
    torque = plan.peak_Nm * size * np.resize(plan.sine.wave, count)
    acceleration = np.gradient(velocity, step_s) + torque / inertia_kgm2
    half = 0.5 * step_s
    table = np.zeros((count + 1, 5))
    table[:-1, 0] = (np.arange(count) - 0.5) * step_s
    # so that position, velocity and acceleration are these in the middle
    table[:-1, 3] = 0.5 * acceleration
    table[:-1, 2] = velocity - acceleration * half
    table[:-1, 1] = position - table[:-1, 2] * half - table[:-1, 3] * half * half
    table[-1] = ((count - 0.5) * step_s, position[-1], 0.0, 0.0, 0.0)
    return table


def largest_peak_Nm(config: Config) -> float:
    """Of the multisine, within limits.torque_max_Nm, which the user may have lowered; `UsageError` if there is none."""
    limit = config.limits.torque_max_Nm
    holds = FRICTION_SPARE * (static_friction_Nm(config) or 0.0) + abs(config.joint.gravity_Nm)
    peak = min(TORQUE_SHARE * limit, 0.5 * (limit - holds))
    if peak < 0.01 * limit:
        raise UsageError(
            f"the torque (={limit:g} Nm) must be more than {holds * 1.05:.3g} Nm, what friction and gravity of the "
            "configuration take: --torque, limits.torque_max_Nm"
        )
    speed, length_s = speed_and_period(config)
    slower = min(speed / USUAL_SPEED_radps, 1.0)
    return min(peak, LARGEST_radps2 * slower * config.joint.inertia_kgm2, _peak_of_twist_Nm(config, length_s))


def _peak_of_twist_Nm(config: Config, length_s: float) -> float:
    """With which both encoders differ by TWIST_SHARE of what they may, where [reducer] is known; else inf.

        twist = torque / (J_m s^2 + (D s + K) (1 + J_m / J_l))

    At the ends of margin.payload_range and of the stiffness, by margin.stiffness_error.
    """
    reducer, second = config.reducer, config.joint_encoder
    if reducer is None or second is None:
        return math.inf
    sine, twist_radpNm = multisine(config.loop.rate_Hz, length_s), 0.0
    s = math.tau * 1j * np.arange(len(sine.wave) // 2 + 1) / length_s
    error = config.margin.stiffness_error
    for payload, factor in product({1.0, *config.margin.payload_range}, (1.0 - error, 1.0, 1.0 + error)):
        joint = two_masses(config, reducer, payload, factor, False)
        damping = max(joint.damping_Nmspr, LEAST_DAMPING * joint.critical_Nmspr)
        spring = (damping * s + joint.stiffness_Nmprad) * (1.0 + joint.motor_kgm2 / joint.link_kgm2)
        twist = np.fft.irfft(np.fft.rfft(sine.wave) / (joint.motor_kgm2 * s * s + spring), len(sine.wave))
        twist_radpNm = max(twist_radpNm, float(np.max(np.abs(twist))))
    return TWIST_SHARE * second.disagreement_max_rad / twist_radpNm


def config_of_response(config: Config, torque_Nm: float | None, law: ResponseLaw | None = WEAK) -> Config:
    """The configuration with the torque that the user allows, and this law, which the motor's encoder feeds.

    None: that of the configuration, without learning: for a joint that is known to be too soft for the weak one.
    """
    known = config.friction is not None and config.control.feed_forward != "none"
    keys: dict[str, Any] = {"learning": None, "adaptation": None, "feed_forward": "desired" if known else "none"}
    if law is not None:
        keys |= {
            "kind": "computed_torque_observer", "kp": law.kp_ps2, "kv": law.kv_ps, "observer_radps": law.observer_radps,
            "ki": 0.0, "integral_limit_rads": 0.0, "filtered_error_rate": True, "observer_paired": False,
        }  # fmt: skip
        if config.encoder.side == "joint":
            own_Hz = config.control.velocity_cutoff_Hz or law.link_cutoff_Hz
            keys["velocity_cutoff_Hz"] = min(own_Hz, law.link_cutoff_Hz)
    config = with_mode(with_torque_limit(config, torque_Nm), "torque")
    config = config.changed(control=keys)
    return config if law is None else motor_fed(config)


def with_torque_limit(config: Config, torque_Nm: float | None) -> Config:
    """With no more than the user allows; None: what the configuration does."""
    limits = config.limits
    if torque_Nm is None or torque_Nm == limits.torque_max_Nm:
        return config
    if not 0.0 < torque_Nm <= limits.torque_max_Nm:
        raise UsageError(f"--torque (={torque_Nm:g}) must be in (0..{limits.torque_max_Nm:g}], limits.torque_max_Nm")
    return config.changed(limits__torque_max_Nm=torque_Nm, drive=config.drive.free_of_torque_limit())


def motor_fed(config: Config) -> Config:
    """The configuration with a law that reads the motor's encoder, where there is one beside the link's."""
    if config.joint_encoder is None or config.encoder.side != "motor":
        return config
    return config.changed(joint_encoder__law="encoder")


@dataclass(frozen=True)
class ResponseMotion:
    """See `session.plan.Motion`; `config` is that of `config_of_response`; `most_Nm`: of it and later stages."""

    config: Config
    plan: ResponsePlan
    most_Nm: float

    @property
    def table(self) -> np.ndarray:
        return excitation_table(self.plan, self.config.joint.inertia_kgm2, period_s(self.config))

    def _start_rad(self, report: CommissioningReport) -> float:
        """Where the triangle begins: half a leg from where the joint stands, as far as the limits allow."""
        limits, margin = self.config.limits, position_margin_rad(self.config)
        lowest = limits.position_min_rad + margin
        highest = limits.position_max_rad - margin - self.plan.legs.width_rad
        return min(max(report.start_position_rad - 0.5 * self.plan.legs.width_rad, lowest), max(highest, lowest))

    def placed(self, report: CommissioningReport) -> Placed:
        config, start_rad = self.config, self._start_rad(report)
        table = self.table
        table[:, 1] += start_rad
        constants = table_constants(config, table, float(table[-2, 0]), report.start_position_rad)
        axis = constants[0]
        axis.sequence.approach_s = approach_time_s(config, report.start_position_rad, start_rad)
        return Placed(constants, table, tuple(self._envelope(report, start_rad, float(axis.sequence.approach_s))))

    def require_start(self, start_position_rad: float) -> None:
        """From everywhere within the limits."""

    def _envelope(self, report: CommissioningReport, start_rad: float, approach_s: float) -> list[str]:
        plan, config = self.plan, self.config
        top = float(np.max(np.abs(plan.legs.velocity_radps)))
        duration_s = len(plan.legs.velocity_radps) / config.loop.rate_Hz
        frequency, control = plan.sine.frequency_Hz, config.control
        excited = f"{text_Nm(plan.peak_Nm, 2)} on top of what the motion takes"
        if plan.peak_Nm < self.most_Nm:
            excited = (
                f"at first {excited}; the same again with more while the coherence is low, up to "
                f"{text_Nm(self.most_Nm, 2)}, about 2 minutes in all"
            )
        return [
            *joint_lines(report, config.limits),
            f"approach   to {start_rad:+.4f} rad in {approach_s:.1f} s",
            f"motion     {start_rad:+.3f} .. {start_rad + plan.legs.width_rad:+.3f} rad, back and forth at up to "
            f"{text_radps(top)}, {duration_s:.0f} s",
            f"excitation multisine of {len(frequency)} lines, {frequency[0]:g} .. {frequency[-1]:g} Hz, {excited}",
            f"law        kp {control.kp:g}, kv {control.kv:g}, observer {control.observer_radps:g} rad/s; "
            "a stiffer one follows where the weak one is too weak for the friction",
            limits_line(config.limits),
            *remark_lines(report.remarks),
        ]


# --- From the legs to the response ---

LEVEL = 0.95
GOOD_COHERENCE = 0.9
WORST_RELATIVE = 0.7  # of its interval: such a line says nothing
MEASURED_LEGS = 4
MOST_LOST = 0.01  # share of the cycles of a leg that were skipped
TO_SIGMA = 1.4826  # of a median of absolute values
MEDIAN_LOSS = 1.2533  # standard error of a median over that of a mean

ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Channel:
    """From the torque command to one position, arrays (lines,)."""

    response: ComplexArray  # [rad/Nm]
    half: np.ndarray  # of the 95 % interval, as a share of |response|
    coherence: np.ndarray


@dataclass(frozen=True)
class FrequencyResponse:
    """What one run tells; `motor` or `link` is None without that encoder."""

    frequency_Hz: np.ndarray
    motor: Channel | None
    link: Channel | None
    legs: int
    peak_Nm: float
    period_s: float  # of the loop

    @property
    def fed(self) -> Channel:
        """The motor's where there is one."""
        found = self.motor if self.motor is not None else self.link
        assert found is not None
        return found

    @property
    def coherence(self) -> float:
        """Median over the lines."""
        return float(np.median(self.fed.coherence))

    def to_dict(self) -> dict[str, Any]:
        """For --json and the file of a response."""
        found: dict[str, Any] = {
            "frequency_Hz": self.frequency_Hz.tolist(), "legs": self.legs, "peak_Nm": self.peak_Nm,
            "period_s": self.period_s,
        }  # fmt: skip
        for name in ("motor", "link"):
            channel: Channel | None = getattr(self, name)
            if channel is not None:
                found[name] = {
                    "magnitude_radpNm": np.abs(channel.response).tolist(),
                    "phase_deg": np.degrees(np.angle(channel.response)).tolist(),
                    "interval_share": channel.half.tolist(),
                    "coherence": channel.coherence.tolist(),
                }
        return found


def from_dict(found: dict[str, Any]) -> FrequencyResponse:
    """What `to_dict` made."""

    def channel(name: str) -> Channel | None:
        if name not in found:
            return None
        one = found[name]
        turned = np.exp(1j * np.radians(np.array(one["phase_deg"])))
        return Channel(
            np.array(one["magnitude_radpNm"]) * turned, np.array(one["interval_share"]), np.array(one["coherence"])
        )

    return FrequencyResponse(
        np.array(found["frequency_Hz"]), channel("motor"), channel("link"), found["legs"], found["peak_Nm"],
        found["period_s"],
    )  # fmt: skip


def fourier_sums(rows: np.ndarray, bins: np.ndarray) -> ComplexArray:
    """Fourier sums (legs, lines) of rows (legs, N), without their trend and windowed."""
    window = signal.get_window("hann", rows.shape[1])
    spectrum: ComplexArray = np.fft.rfft(signal.detrend(rows, axis=1) * window, axis=1)[:, bins]
    return spectrum


def median_of(values: ComplexArray) -> ComplexArray:
    """Over the legs, of real and imaginary part."""
    found: ComplexArray = np.median(values.real, axis=0) + 1j * np.median(values.imag, axis=0)
    return found


def _channel(y: ComplexArray, u: ComplexArray, r: ComplexArray) -> Channel:
    legs = len(y)
    of_torque = median_of(u / r)
    response = median_of(y / r) / of_torque
    left = (y - response * u) / r / of_torque
    spread = TO_SIGMA * np.median(np.abs(left), axis=0) / math.sqrt(math.log(4.0))  # of a complex normal value
    width = float(stats.t.ppf(0.5 + 0.5 * LEVEL, max(legs - 1, 1))) * MEDIAN_LOSS / math.sqrt(legs)
    power = np.sum(np.abs(y) ** 2, axis=0) * np.sum(np.abs(r) ** 2, axis=0)
    coherence = np.abs(np.sum(y * np.conj(r), axis=0)) ** 2 / np.maximum(power, 1e-300)
    return Channel(response, width * spread / np.maximum(np.abs(response), 1e-300), coherence)


def sides_of(config: Config) -> tuple[str, str | None]:
    """("motor" or "link" of the position that feeds the law, the other one or None)."""
    second = config.joint_encoder
    if second is None:
        return ("motor" if config.encoder.side == "motor" else "link"), None
    if second.law == "joint_encoder":
        return "link", "motor" if config.encoder.side == "motor" else None
    return ("motor" if config.encoder.side == "motor" else "link"), "link"


def response_of(config: Config, plan: ResponsePlan, records: np.recarray) -> FrequencyResponse:
    """Of the log of a `ResponseMotion`; `config` is that of `config_of_response`.  `DataError` with too few legs."""
    period_s = 1.0 / config.loop.rate_Hz
    rows = records[records.phase == AxisPhase.TRACKING]
    cycle = np.round(np.asarray(rows.trajectory_s) / period_s).astype(int)
    columns: dict[str, list[np.ndarray]] = {"u": [], "r": [], "y": [], "other": []}
    excitation = plan.peak_Nm * plan.sine.wave
    count = plan.samples
    for start in plan.legs.starts:
        first, last = np.searchsorted(cycle, (start, start + count))
        if last - first < (1.0 - MOST_LOST) * count or last - first < 2:
            continue
        part, at = rows[first:last], np.arange(start, start + count)
        for name, values in (
            ("u", part.command_torque_Nm), ("y", part.position_rad),
            ("other", part.second_position_rad),
        ):  # fmt: skip
            columns[name].append(np.interp(at, cycle[first:last], np.asarray(values)))
        columns["r"].append(excitation[at % count])
    if len(columns["u"]) < MEASURED_LEGS:
        raise DataError(
            f"legs that were measured (={len(columns['u'])}) must be at least {MEASURED_LEGS}", "run it again"
        )
    sums = {name: fourier_sums(np.array(values), plan.sine.bins) for name, values in columns.items()}
    law, other = sides_of(config)
    channels = {law: _channel(sums["y"], sums["u"], sums["r"])}
    if other is not None:
        channels[other] = _channel(sums["other"], sums["u"], sums["r"])
    return FrequencyResponse(
        plan.sine.frequency_Hz, channels.get("motor"), channels.get("link"), len(columns["u"]), plan.peak_Nm, period_s
    )


def grown(before: FrequencyResponse, after: FrequencyResponse) -> float:
    """The factor by which the highest peak of the acceleration is higher than with a smaller torque.

    Of the peaks and not line by line: with more torque hysteresis lets a resonance come down a little.  Of lines that
    both responses know: the lowest may have coherence by chance and an interval of ten times its value.
    """
    good = np.ones(len(before.frequency_Hz), bool)
    for channel in (before.fed, after.fed):
        good &= (channel.coherence > GOOD_COHERENCE) & (channel.half < WORST_RELATIVE)
    peaks = [
        np.max(np.abs(one.fed.response[good]) * one.frequency_Hz[good] ** 2, initial=0.0) for one in (before, after)
    ]
    return float(peaks[1] / peaks[0]) if peaks[0] > 0.0 else 1.0


# --- the picture ---


def bode_figure(found: FrequencyResponse, title: str, fit: JointFit | None = None) -> Figure:
    """Magnitude, phase and coherence; the bars are intervals of 95 %, the lines the model that was fitted."""
    with canvas(8.0, title) as figure:
        magnitude, phase, coherence = figure.subplots(3, 1, sharex=True, height_ratios=(3, 2, 1.2))
        for name, colour in (("motor", BLUE), ("link", ORANGE)):
            channel: Channel | None = getattr(found, name)
            if channel is None:
                continue
            size = np.abs(channel.response)
            share = np.minimum(channel.half, 0.95)
            bars = {"fmt": ".", "markersize": 4, "color": colour, "elinewidth": 0.8}
            label = f"torque to {name}"
            magnitude.errorbar(found.frequency_Hz, size, yerr=size * share, label=label, **bars)
            angle = _falling(np.degrees(np.unwrap(np.angle(channel.response))))
            phase.errorbar(found.frequency_Hz, angle, yerr=np.degrees(np.arcsin(share)), **bars)
            coherence.plot(found.frequency_Hz, channel.coherence, ".-", color=colour, markersize=3)
            if fit is not None:
                model = fit.response(found.frequency_Hz, name)
                magnitude.plot(found.frequency_Hz, np.abs(model), color=GREY, zorder=3)
                phase.plot(found.frequency_Hz, _falling(np.degrees(np.unwrap(np.angle(model)))), color=GREY, zorder=3)
        magnitude.set_yscale("log")
        magnitude.set_xscale("log")
        magnitude.set_ylabel("rad / Nm")
        magnitude.legend(loc="lower left")
        phase.set_ylabel("phase [deg]")
        coherence.set_ylim(0.0, 1.02)
        coherence.axhline(GOOD_COHERENCE, color=GREY, linewidth=0.6)
        coherence.set_ylabel("coherence")
        coherence.set_xlabel("frequency [Hz]")
        return figure


def _falling(angle_deg: np.ndarray) -> np.ndarray:
    """The first angle in (-360..0]."""
    return angle_deg - 360.0 * math.ceil(angle_deg[0] / 360.0)
