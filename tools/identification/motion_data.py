"""Time series of a joint that moves in any way: from a run log or a table of time, position, velocity and torque.

What comes out is on a uniform grid of time, at the joint: rad, rad/s, rad/s2, Nm.  What is differentiated passes
through a zero-phase low-pass before (Butterworth of second order, forwards and backwards: -6 dB at `band_Hz`).  Torques
and velocities pass through the same one, or through a running mean of `mean_samples`, which has no phase either.
Samples near a gap of the clock, at the ends, near a reversal, and where the current is saturated are not used.  Every
problem is one `DataError` that names the column and what was seen.
"""

from __future__ import annotations

import hashlib
import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from scipy.ndimage import maximum_filter1d, median_filter, uniform_filter1d
from scipy.signal import butter, sosfiltfilt

from jointctl.drivers.errors import DataError, UsageError
from jointctl.firmware_py.input_file import LARGEST_LOG_BYTES, open_input
from jointctl.firmware_py.states import AxisPhase
from jointctl.tools.identification.friction_data import (
    MIN_PER_DIRECTION,
    OF_SWEEP,
    check_given,
    read_sidecar,
    refuse_unused,
)
from jointctl.tools.identification.tables import ForeignFormat, read_table

BAND_Hz, BAND_SHARE = 20.0, 0.2  # default: at most this share of the rate; with a running mean its first zero
LEAST_SAMPLES = 200
_LEAST_STEP_s, _MOST_STEP_s = 1e-5, 0.1
_GAP = 3.0  # times the usual step of time
_FACTOR_TOLERANCE = 0.05  # of velocity over slope of position: gears and filters give some per cent
_SATURATED_SHARE = 0.005  # of the samples at the greatest torque: more is a limit, not a peak
_TWICE_SHARE = 0.2  # of the samples: more at the time of the one before are a clock that is too coarse
_SAME = 1e-9
_SAME_RATE = 0.01
_TOP_SPEED_radps, _DIRECT = 100.0, 2.0  # of a joint behind a reducer; with a ratio below it is that of a motor
_DIRECT_SPEED_radps = 1000.0
_MOST_rad = 4.0 * math.pi  # of a joint: farther gets a note
_NEIGHBOURS = 5  # samples whose median a sample is compared with
_WILD_SHARES = {"position": 0.05, "velocity": 0.5, "torque": 1.0}  # of a column's range: farther off it is no motion
_WILD = 12.0  # times the usual distance from the median
_EVEN = 0.6  # of the usual step: of a clock that was set or of several motions some are shorter
_MOST_OF_LOAD = 3.0  # times the known load a torque may go
_LEVELS = 4.0  # times as often as the value before it a limit is reached; the end of a coarse range is not
_SIDE_TOLERANCE = 0.5  # of the logarithm of a factor that is near the ratio


@dataclass(frozen=True)
class MotionSettings:
    """Which band is looked at, and which samples are used."""

    band_Hz: float | None = None  # None: see BAND_Hz
    speed_min_radps: float = 0.05  # slower, friction is set-valued
    acceleration_max_radps2: float = math.inf
    mean_samples: int | None = None  # of a running mean that takes the low-pass's place where nothing is differentiated
    also: tuple[Path, ...] = ()  # further files of the same joint, that are fitted together with the first

    def check(self) -> None:
        for flag, value, low, high in (
            ("--band", 1.0 if self.band_Hz is None else self.band_Hz, 0.01, 1e4),
            ("--speed-min", self.speed_min_radps, 0.0, 100.0),
            ("--acceleration-max", min(self.acceleration_max_radps2, 1e6), 1e-6, 1e6),
            ("--mean-samples", 1 if self.mean_samples is None else self.mean_samples, 1, 10_000),
        ):  # fmt: skip
            if not low <= value <= high:
                raise UsageError(f"{flag} (={value:g}) must be in [{low:g}..{high:g}]")


@dataclass(frozen=True)
class Motion:
    """Samples (N,) at the joint on a uniform grid of time, filtered."""

    path: Path
    sha256: str
    rate_Hz: float
    band_Hz: float
    time_s: np.ndarray
    position_rad: np.ndarray
    velocity_radps: np.ndarray
    acceleration_radps2: np.ndarray
    torque_Nm: np.ndarray  # of the motor, times the ratio
    load_Nm: np.ndarray | None  # known torque of the load, positive where it needs a positive motor torque
    temperature_degC: np.ndarray | None
    whole: np.ndarray  # bool: no gap, no end and no saturation near
    reversing: np.ndarray  # bool: so near to a reversal that the low-pass smears the jump of the friction
    reduction_ratio: float
    torque_name: str  # of the column
    speed_name: str  # of the velocity's column, or of the position's where there is none
    notes: tuple[str, ...] = ()
    placed: bool = True  # the position is that of a column, not of an integral
    mounting: dict[str, int] | None = None  # direction and zero_counts of the encoder, where they are known
    plateaus: bool = False  # a sample is the mean over a plateau of constant speed

    def used(self, settings: MotionSettings) -> np.ndarray:
        """Samples (N,) that the model is to describe."""
        moving = np.abs(self.velocity_radps) > settings.speed_min_radps
        return (
            self.whole
            & ~self.reversing
            & moving
            & (np.abs(self.acceleration_radps2) < settings.acceleration_max_radps2)
        )


@dataclass
class RawMotion:
    """Columns as they were read, in SI at the joint, with the names under which problems are reported."""

    path: Path
    sha256: str
    time_s: np.ndarray
    torque_Nm: np.ndarray
    ratio: float
    names: dict[str, str]
    position_rad: np.ndarray | None = None
    velocity_radps: np.ndarray | None = None
    load_Nm: np.ndarray | None = None
    temperature_degC: np.ndarray | None = None
    mounting: dict[str, int] | None = None
    notes: list[str] = field(default_factory=list)

    def keep(self, chosen: np.ndarray) -> None:
        """Leave the other samples out."""
        for name in ("time_s", "torque_Nm", "position_rad", "velocity_radps", "load_Nm", "temperature_degC"):
            values = getattr(self, name)
            setattr(self, name, None if values is None else values[chosen])

    def keep_known(self) -> None:
        """Leave out samples without a value; a temperature, which is read more rarely, is followed in between."""
        known = np.ones(len(self.time_s), bool)
        columns = {"time": self.time_s, "position": self.position_rad, "velocity": self.velocity_radps,
                   "torque": self.torque_Nm, "load": self.load_Nm}  # fmt: skip
        for name, values in columns.items():
            missing = np.zeros(len(known), bool) if values is None else ~np.isfinite(values)
            if missing.all():
                raise self.problem(name, "has no value")
            if missing.any():
                self.notes.append(f"{self.names[name]}: {np.count_nonzero(missing)} samples without a value: left out")
            known &= ~missing
        if not known.all():
            self.keep(known)
        warm = self.temperature_degC
        if warm is not None and not np.isfinite(warm).all():
            there = np.isfinite(warm)
            seen = (
                f"{np.count_nonzero(there)} readings: followed in between" if there.any() else "has no value: not used"
            )
            self.notes.append(f"{self.names['temperature']}: {seen}")
            self.temperature_degC = np.interp(self.time_s, self.time_s[there], warm[there]) if there.any() else None

    def keep_near(self) -> None:
        """Leave out samples that jump off and back, as a lost message or a value that stands for none does."""
        kept = np.ones(len(self.time_s), bool)
        columns = {"position": self.position_rad, "velocity": self.velocity_radps, "torque": self.torque_Nm}
        for name, share in _WILD_SHARES.items():
            values = columns[name]
            if values is None or len(values) < LEAST_SAMPLES:
                continue
            near = median_filter(values, _NEIGHBOURS, mode="nearest")
            off = np.abs(values - near)
            usual = 1.4826 * float(np.median(off[off > 0.0])) if off.any() else 0.0
            wild = off > max(share * float(np.ptp(near)), _WILD * usual)
            if wild.any():
                self.notes.append(
                    f"{self.names[name]}: {np.count_nonzero(wild)} samples far off their neighbours: left out"
                )
            kept &= ~wild
        if not kept.all():
            self.keep(kept)

    def in_order(self) -> None:
        """Lines that stand twice are left out; lines out of order are sorted, where their times are an even clock's."""
        same = np.append(False, np.diff(self.time_s) == 0.0)
        for values in (self.position_rad, self.velocity_radps, self.torque_Nm):
            same[1:] &= True if values is None else np.diff(values) == 0.0
        order = np.argsort(self.time_s, kind="stable")
        steps = np.diff(self.time_s[order])
        if np.any(np.diff(self.time_s) < 0.0) and len(steps) and steps.min() > _EVEN * np.median(steps):
            moved = np.count_nonzero(order != np.arange(len(order)))
            self.notes.append(f"{self.names['time']}: {moved} lines out of order: sorted")
            self.keep(order)
        elif same.any():
            self.notes.append(f"{self.names['time']}: {np.count_nonzero(same)} lines that stand twice: left out")
            self.keep(~same)

    def problem(self, which: str, seen: str, hint: str = "") -> DataError:
        return DataError(f"{self.path}: {self.names[which]}: {seen}", hint)


# --- reading ---


def is_series(path: Path, given: ForeignFormat) -> bool:
    """Whether a file holds a time series: a run log, or a table whose column of time or rate the user gives."""
    timed = given.time_column is not None or given.sample_rate_Hz is not None
    return path.suffix.lower() == ".mcap" or timed


def motion_of_plateaus(path: Path, given: ForeignFormat) -> Motion | None:
    """A sweep under known loads or while the joint warmed up, a sample a plateau; None for any other file."""
    if path.suffix.lower() != ".csv" or given.mapped or given.delimiter != "auto":
        return None
    table = read_table(path)
    if not {"load_Nm", "velocity_radps", "motor_torque_Nm", "temperature_degC"} <= set(table.columns):
        return None
    refuse_unused(given, (), OF_SWEEP)
    ratio = float(read_sidecar(path)["reduction_ratio"])
    settled = table.numbers("settled") == 1.0
    notes = [f"{np.count_nonzero(~settled)} points never settled: not used"] if not settled.all() else []
    warm_index = table.column("temperature_degC")
    degC = np.array([table.number(row, warm_index, empty=math.nan) for row in table.rows])[settled]

    def column(name: str) -> np.ndarray:
        return table.numbers(name)[settled]

    velocity, load = column("velocity_radps"), column("load_Nm")
    if len(velocity) < 2 * MIN_PER_DIRECTION:
        raise DataError(f"{path}: {len(velocity)} settled points: at least {2 * MIN_PER_DIRECTION} are needed")
    nothing = np.zeros(len(velocity))
    return Motion(
        path, table.sha256, 1.0, 1.0, column("time_s"),
        0.5 * (column("position_min_rad") + column("position_max_rad")), velocity, nothing,
        column("motor_torque_Nm") * ratio + load, load, degC if np.isfinite(degC).all() else None,
        nothing == 0.0, nothing != 0.0, ratio, "motor_torque_Nm", "velocity_radps", tuple(notes), plateaus=True,
    )  # fmt: skip


class LoggedRun(Protocol):
    """What is used of a run log."""

    @property
    def records(self) -> Any: ...  # record array of LogRecord
    @property
    def temperatures(self) -> Any: ...  # array of time_ns, temperature_degC
    @property
    def metadata(self) -> dict[str, dict[str, str]]: ...
    @property
    def complete(self) -> bool: ...


def motion_of_log(path: Path, log: LoggedRun, given: ForeignFormat, settings: MotionSettings) -> Motion:
    """A run log: check, filter."""
    settings.check()
    check_given(given)
    return prepared_motion(_run_log(path, log, given), settings)


def _run_log(path: Path, log: LoggedRun, given: ForeignFormat) -> RawMotion:
    """Measured position and torque of the phases in which the law moves the joint."""
    records = log.records
    records = records[(records.phase >= AxisPhase.APPROACH) & (records.phase <= AxisPhase.RAMPING)]
    ratio = given.ratio
    if ratio is None:
        try:
            joint = tomllib.loads(log.metadata["run"]["configuration"])["joint"]
            ratio = float(joint["reduction_ratio"])
        except (KeyError, ValueError, TypeError):
            raise DataError(f"{path}: the log names no reduction ratio", "give --ratio") from None
    if len(records) < LEAST_SAMPLES:
        raise DataError(f"{path}: {len(records)} cycles in motion: at least {LEAST_SAMPLES} are needed")
    time_ns = np.asarray(records.time_ns, np.int64)
    names = {
        "time": "time_ns",
        "position": "position_rad",
        "torque": "measured_torque_Nm",
        "temperature": "/temperature",
    }
    with open_input(path, LARGEST_LOG_BYTES) as file:
        sha256 = hashlib.sha256(file.read()).hexdigest()
    raw = RawMotion(
        path, sha256, (time_ns - time_ns[0]) * 1e-9,
        np.asarray(records.measured_torque_Nm, float), ratio, names, np.asarray(records.position_rad, float),
    )  # fmt: skip
    if len(log.temperatures):
        at_s = (log.temperatures["time_ns"] - time_ns[0]) * 1e-9
        raw.temperature_degC = np.interp(raw.time_s, at_s, log.temperatures["temperature_degC"])
    raw.mounting = _mounting(log)
    if not log.complete:
        raw.notes.append("the log was cut off: its tail is missing")
    return raw


def _mounting(log: LoggedRun) -> dict[str, int] | None:
    """How the encoder was mounted, as the log's configuration has it."""
    try:
        encoder = tomllib.loads(log.metadata["run"]["configuration"])["encoder"]
        return {key: int(encoder[key]) for key in ("direction", "zero_counts")}
    except (KeyError, ValueError, TypeError):
        return None


def joined(motions: Sequence[Motion], *, named: bool = True) -> Motion:
    """Several motions of one joint, one after the other; `DataError` where they do not go together.

    `named`: notes begin with the name of the file.
    """
    first = motions[0]
    if len(motions) == 1:
        return first
    for other in motions[1:]:
        for name, one, two in (
            ("reduction ratio", first.reduction_ratio, other.reduction_ratio), ("rate", first.rate_Hz, other.rate_Hz),
        ):  # fmt: skip
            if abs(two / one - 1.0) > _SAME_RATE:
                raise DataError(f"{other.path}: {name} (={two:.6g}) must be that of {first.path} (={one:.6g})")
        if (other.load_Nm is None) != (first.load_Nm is None):
            raise DataError(f"{other.path}: a known load in one file and none in another do not go together")
    starts = np.cumsum([0.0, *(each.time_s[-1] - each.time_s[0] + 1.0 / first.rate_Hz for each in motions[:-1])])

    def together(name: str) -> Any:
        parts = [getattr(each, name) for each in motions]
        return None if any(part is None for part in parts) else np.concatenate(parts)

    notes = [f"{each.path.name}: {note}" if named else note for each in motions for note in each.notes]
    warm = together("temperature_degC")
    if warm is None and any(each.temperature_degC is not None for each in motions):
        notes.append("temperature: not in every file, so in none is it used")
    names = ("position_rad", "velocity_radps", "acceleration_radps2", "torque_Nm", "load_Nm", "whole", "reversing")
    times = [start + each.time_s - each.time_s[0] for start, each in zip(starts, motions, strict=True)]
    return replace(
        first, time_s=np.concatenate(times), temperature_degC=warm, notes=tuple(notes),
        sha256=" ".join(dict.fromkeys(each.sha256 for each in motions)),
        **{name: together(name) for name in names},
    )  # fmt: skip


# --- what is wrong with the data, before anything is fitted ---


def clock_step_s(raw: RawMotion) -> float:
    """The usual step of time [s]; `DataError` where the clock does not go on."""
    twice = np.append(False, np.diff(raw.time_s) == 0.0)
    if 0 < np.count_nonzero(twice) <= _TWICE_SHARE * len(twice):
        raw.notes.append(
            f"{raw.names['time']}: {np.count_nonzero(twice)} samples at the time of the one before: left out"
        )
        raw.keep(~twice)
    steps = np.diff(raw.time_s)
    if len(steps) < LEAST_SAMPLES:
        raise raw.problem("time", f"{len(raw.time_s)} samples: at least {LEAST_SAMPLES} are needed")
    back = np.flatnonzero(steps <= 0.0)
    step = float(np.median(steps))
    if len(back):
        at = int(back[0])
        raise raw.problem(
            "time", f"does not go on at sample {at + 2}: {raw.time_s[at]:.6g} s, then {raw.time_s[at + 1]:.6g} s"
            + (f", and {len(back) - 1} times more" if len(back) > 1 else ""),
            "the clock was set, or is too coarse (--sample-rate), or motions are joined (--motion-column)",
        )  # fmt: skip
    if not _LEAST_STEP_s <= step <= _MOST_STEP_s:
        raise raw.problem(
            "time", f"usual step is {step:.3g} s: must be in [{_LEAST_STEP_s:g}..{_MOST_STEP_s:g}] s",
            "--time-unit: s, ms, us or ns",
        )  # fmt: skip
    gaps = np.flatnonzero(steps > _GAP * step)
    if len(gaps):
        raw.notes.append(
            f"{raw.names['time']}: {len(gaps)} gaps of up to {steps.max():.3g} s (usual step {step:.3g} s): samples "
            "near them are not used"
        )
    if float(np.sum(steps[gaps])) > 0.5 * (raw.time_s[-1] - raw.time_s[0]):
        raise raw.problem("time", f"more than half of it is gaps longer than {_GAP * step:.3g} s")
    return step


def _check_units(raw: RawMotion, position: np.ndarray, velocity: np.ndarray, slope: np.ndarray) -> None:
    """Velocity against the slope of position: a wrong unit or side shows as a known factor."""
    moving = np.abs(slope) > 0.1 * np.max(np.abs(slope))
    if not moving.any() or float(np.ptp(position)) == 0.0:
        raise raw.problem("position", "does not move")
    if float(np.ptp(velocity)) <= _SAME * float(np.max(np.abs(velocity))):
        raise raw.problem("velocity", f"is {velocity[0]:.4g} rad/s throughout, {raw.names['position']} moves otherwise")
    factor = float(np.median(velocity[moving] / slope[moving]))
    if abs(factor - 1.0) <= _FACTOR_TOLERANCE:
        return
    causes = {
        math.degrees(1.0): "one of them is in degrees, the other in radians",
        raw.ratio: "one of them is of the motor, the other of the joint",
        math.tau: "one of them is in turns, the other in radians",
        60.0 / math.tau: "the velocity is in r/min",
        360.0 / 60.0: "r/min and deg/s are mixed up",
    }
    for size, cause in causes.items():
        for known in (size, 1.0 / size):
            if abs(abs(factor) / known - 1.0) <= _FACTOR_TOLERANCE:
                sign = "" if factor > 0.0 else ", and the signs differ"
                raise raw.problem(
                    "velocity", f"is {factor:.4g} times the slope of {raw.names['position']}: {cause}{sign}"
                )
    if factor < 0.0 or not 0.8 < factor < 1.25:
        raise raw.problem(
            "velocity", f"is {factor:.4g} times the slope of {raw.names['position']}: must be near 1",
            "--reverse velocity, or --reverse position" if factor < 0.0 else "",
        )  # fmt: skip
    raw.notes.append(f"{raw.names['velocity']} is {factor:.3f} times the slope of {raw.names['position']}")


def _saturated(raw: RawMotion) -> np.ndarray:
    """Samples (N,) at the greatest or least torque, where that is a limit: reached often, in runs, and to the digit."""
    found = np.zeros(len(raw.torque_Nm), bool)
    if not raw.torque_Nm.any():
        raise raw.problem("torque", "is zero throughout")
    for word, end_Nm in (("greatest", float(raw.torque_Nm.max())), ("least", float(raw.torque_Nm.min()))):
        there = np.abs(raw.torque_Nm - end_Nm) <= _SAME * abs(end_Nm)
        share, held = float(np.mean(there)), np.count_nonzero(there[1:] & there[:-1])
        if share < _SATURATED_SHARE or held < 0.5 * np.count_nonzero(there):
            continue
        inside = raw.torque_Nm[~there]
        if len(inside):
            nearest = inside[np.argmin(np.abs(inside - end_Nm))]
            if _LEVELS * np.mean(np.abs(raw.torque_Nm - nearest) <= _SAME * abs(end_Nm)) > share:
                continue
        found |= there
        raw.notes.append(
            f"{raw.names['torque']}: at its {word} value ({end_Nm:.4g} Nm at the joint) in {share:.1%} of the samples: "
            "saturated; they are not used"
        )
    if np.mean(found) > 0.5:
        raise raw.problem(
            "torque", f"is at its greatest or least value in {np.mean(found):.0%} of the samples: saturated"
        )
    return found


def prepared_motion(raw: RawMotion, settings: MotionSettings) -> Motion:
    """One motion by itself: `filtered_motion` at its own rate, and checked."""
    motion = filtered_motion(raw, settings, clock_step_s(raw))
    require_motion(raw, motion, settings)
    return motion


def filtered_motion(raw: RawMotion, settings: MotionSettings, step: float) -> Motion:
    """On a uniform grid of `step` [s], filtered, with the samples marked that nothing spoils."""
    saturated = _saturated(raw)
    rate_Hz = 1.0 / step
    window = settings.mean_samples
    usual_Hz = BAND_Hz if window is None else rate_Hz / window
    band_Hz = settings.band_Hz or min(usual_Hz, BAND_SHARE * rate_Hz)
    if not band_Hz < 0.45 * rate_Hz:
        raise UsageError(
            f"--band (={band_Hz:g} Hz) must be below {0.45 * rate_Hz:.4g} Hz at {rate_Hz:.4g} samples a second"
        )
    time_s = np.arange(raw.time_s[0], raw.time_s[-1] + 0.5 * step, step)

    def at_grid(values: np.ndarray) -> np.ndarray:
        return np.interp(time_s, raw.time_s, values)

    def smooth(values: np.ndarray) -> np.ndarray:
        return _smooth(values, rate_Hz, band_Hz)

    def mean(values: np.ndarray) -> np.ndarray:
        return smooth(values) if window is None else uniform_filter1d(values, window)

    torque = at_grid(raw.torque_Nm)
    if raw.position_rad is not None:
        position = at_grid(raw.position_rad)
        slope = np.gradient(smooth(position), step)
        given = None if raw.velocity_radps is None else at_grid(raw.velocity_radps)
        banded = slope if given is None else smooth(given)
        velocity = slope if given is None else mean(given)
        _check_units(raw, position, banded, slope)
        position = smooth(position)
    else:
        assert raw.velocity_radps is not None
        given = at_grid(raw.velocity_radps)
        banded, velocity = smooth(given), mean(given)
        position = np.concatenate([[0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1])) * step])
        raw.notes.append("no column of position: gravity cannot be found from the angle")
    margin = max(math.ceil(0.5 * rate_Hz / band_Hz), (window or 1) // 2) + 1
    spoiled = np.zeros(len(time_s), bool)
    for at in np.flatnonzero(np.diff(raw.time_s) > _GAP * step):
        spoiled |= (time_s > raw.time_s[at]) & (time_s < raw.time_s[at + 1])
    spoiled |= at_grid(saturated.astype(float)) > 0.0
    spoiled[[0, -1]] = True
    near = maximum_filter1d(spoiled, 2 * margin + 1)
    turns = np.zeros(len(time_s), bool)
    turns[1:] = np.signbit(velocity[1:]) != np.signbit(velocity[:-1])
    return Motion(
        raw.path, raw.sha256, rate_Hz, band_Hz, time_s, position, velocity,
        mean(np.gradient(banded, step)) if window else np.gradient(banded, step), mean(torque),
        None if raw.load_Nm is None else mean(at_grid(raw.load_Nm)),
        None if raw.temperature_degC is None else at_grid(raw.temperature_degC), ~near,
        maximum_filter1d(turns, 4 * margin + 1), raw.ratio,
        raw.names["torque"], raw.names.get("velocity") or raw.names["position"],
        (*raw.notes, *_far(raw, position), *_constant_load(raw)),
        placed=raw.position_rad is not None, mounting=raw.mounting,
    )  # fmt: skip


def _smooth(values: np.ndarray, rate_Hz: float, band_Hz: float) -> np.ndarray:
    return np.asarray(sosfiltfilt(butter(2, band_Hz, fs=rate_Hz, output="sos"), values))


def filtered(values: np.ndarray, motion: Motion, settings: MotionSettings) -> np.ndarray:
    """(N,) through the filter that the torque of a motion has passed."""
    if settings.mean_samples is not None:
        return np.asarray(uniform_filter1d(values, settings.mean_samples))
    return _smooth(values, motion.rate_Hz, motion.band_Hz)


def _far(raw: RawMotion, position_rad: np.ndarray) -> list[str]:
    """A line where a joint behind a reducer turns farther than most can."""
    span = float(np.ptp(position_rad))
    if raw.position_rad is None or raw.ratio <= _DIRECT or span <= _MOST_rad:
        return []
    return [f"{raw.names['position']}: covers {span:.4g} rad of the joint, {span / math.tau:.3g} turns: is the unit "
            "another, or the side the motor's?"]  # fmt: skip


def _constant_load(raw: RawMotion) -> list[str]:
    """A line where the column of the load leaves nothing to gravity and tells nothing of load friction."""
    if raw.load_Nm is None or raw.position_rad is None or float(np.ptp(raw.load_Nm)) > 0.0:
        return []
    return [f"{raw.names['load']}: is {raw.load_Nm[0]:.4g} Nm throughout: gravity is not looked for"]


def require_motion(raw: RawMotion, motion: Motion, settings: MotionSettings) -> None:
    """`DataError` where too little moves, or a size shows that a unit or a side is wrong."""
    used = motion.used(settings)
    if np.count_nonzero(used) < LEAST_SAMPLES:
        raise DataError(
            f"{raw.path}: {motion.speed_name}: {np.count_nonzero(used)} of {len(used)} samples are faster than "
            f"{settings.speed_min_radps:g} rad/s and otherwise usable: at least {LEAST_SAMPLES} are needed",
            "--speed-min, --acceleration-max; or unit or side is another",
        )
    top = float(np.max(np.abs(motion.velocity_radps[used])))
    if top > (_TOP_SPEED_radps if motion.reduction_ratio > _DIRECT else _DIRECT_SPEED_radps):
        raise DataError(f"{raw.path}: {motion.speed_name}: reaches {top:.4g} rad/s of the joint: unit or side is wrong")
    if motion.load_Nm is None or float(np.ptp(motion.load_Nm[used])) == 0.0:
        return
    load = motion.load_Nm[used] - np.mean(motion.load_Nm[used])
    factor = float(load @ motion.torque_Nm[used] / (load @ load))
    # friction spoils the factor; where the load decides on the torque it is small against the ratio
    share = float(np.corrcoef(load, motion.torque_Nm[used])[0, 1] ** 2)
    if share > 0.5 and factor < 0.0:
        raise raw.problem(
            "torque", f"goes against {raw.names['load']} ({factor:.4g} times): the sign of one is the other way round",
            "--reverse load, or --reverse torque if it does not oppose the motion either",
        )  # fmt: skip
    if share <= 0.5 or 1.0 / _MOST_OF_LOAD < factor < _MOST_OF_LOAD:
        return
    near = any(abs(np.log(factor / wrong)) < _SIDE_TOLERANCE for wrong in (raw.ratio, 1.0 / raw.ratio))
    why = f", near the ratio (={raw.ratio:g}) or its inverse: one of them is at the motor, the other at the joint"
    raise raw.problem(
        "torque", f"goes with {factor:.4g} times {raw.names['load']}"
        + (why if near else f": must be in [{1.0 / _MOST_OF_LOAD:.2g}..{_MOST_OF_LOAD:g}]"),
        "--torque-unit, --torque-side" + (", --torque-constant" if not near else ""),
    )  # fmt: skip
