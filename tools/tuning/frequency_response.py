"""Frequency response of a joint from a multisine run: torque command to the position of either encoder.

Of each leg's period, without its trend and under a Hann window, the Fourier sums at the lines of the multisine:

    G = median over the legs of (Y / R) / median over the legs of (U / R)      R excitation, U command, Y position

Both medians are free of what friction ripple and noise do, because those know nothing of R, although the loop is
closed.  The interval comes from the spread of Y - G U over the legs; the coherence is that of position and excitation.
G is that of the sampled joint, from a command to a later sample, with delay and current loop, as `linear_loop` has it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal, stats

from jointctl.drivers.errors import DataError
from jointctl.firmware_py.states import AxisPhase
from jointctl.tools.configuration.config import Config
from jointctl.tools.drawing import BLUE, GREY, ORANGE, canvas
from jointctl.tools.tuning.excitation import ResponsePlan

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from jointctl.tools.tuning.joint_fit import JointFit

LEVEL = 0.95
GOOD_COHERENCE = 0.9
WORST_RELATIVE = 0.7  # of its interval: such a line says nothing
LEAST_LEGS = 4
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
            ("u", part.command_torque_Nm), ("y", part.position_rad - part.desired_position_rad),
            ("other", part.second_position_rad - part.desired_position_rad),
        ):  # fmt: skip
            columns[name].append(np.interp(at, cycle[first:last], np.asarray(values)))
        columns["r"].append(excitation[at % count])
    if len(columns["u"]) < LEAST_LEGS:
        raise DataError(f"legs that were measured (={len(columns['u'])}) must be at least {LEAST_LEGS}", "run it again")
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
