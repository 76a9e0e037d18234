"""Maps of a reducer from one slow motion both ways: kinematic error, eccentricity and torque ripple as Fourier series.

Where the motor goes at constant speed, every whole motor turn gives one estimate: least squares of an offset and sines
of 1 to HIGHEST periods a turn, of the difference of both encoders and of the torque. The offset takes what hysteresis
and friction do; what changes slowly, by the means of the turns before and after, is taken off. Where the joint swings
instead of being held, its inertia and the slope of the friction against the speed have taken part of the torque, and
the link's inertia has twisted the reducer: that is added. The mean over the turns of both directions is the result.
What friction, hysteresis and counts do to one turn they do to the next in much the same way, so that the mean is not
known better than one turn: the interval of 95 % has the spread of single turns, and that what was added is known to
the shares STIFFNESS_ERROR, INERTIA_ERROR and FRICTION_ERROR.

    eps(theta) = sum a_k sin(k n theta + phi_k)    by which the link is ahead of the motor, both as their encoders read
    r(theta)   = sum c_k sin(k n theta + phi_k)    torque that the motor gets besides, positive towards positive angle

theta is the reading of the motor's encoder divided by the ratio n, so that its own eccentricity, once a motor turn, is
part of eps.  That of the joint's encoder, once a joint turn, is not found: the slope takes it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from jointctl.drivers.errors import DataError
from jointctl.firmware_py.records import HARMONICS, LogRecord
from jointctl.firmware_py.states import AxisPhase
from jointctl.tools.drawing import BLUE, GREY, ORANGE, canvas

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

HIGHEST = 12  # periods a motor turn that are looked for
LEAST_TURNS = 4  # of the motor at constant speed, both directions together
LEAST_ROWS = 8 * HIGHEST  # of a turn: fewer do not tell its sines apart
LEVEL = 0.95
STIFFNESS_ERROR = 0.5  # share by which it is known: hysteresis up to doubles it for a swing
INERTIA_ERROR = 0.15
FRICTION_ERROR = 0.8  # of its slope: bristles follow a quick swing with as much less of it, and the later
_STEADY = 1e-3  # share of the speed by which a row of constant speed may be off
_LARGEST_SPREAD = 3.0  # amplitudes below this many standard errors are no part of a map


@dataclass(frozen=True)
class MapRun:
    """What a motion left, rows (N,): readings at the joint, torque as it acted."""

    motor_rad: np.ndarray
    link_rad: np.ndarray | None  # None: only the motor's encoder is there
    torque_Nm: np.ndarray
    desired_radps: np.ndarray
    ratio: float
    motor_kgm2: float
    link_kgm2: float
    friction_Nmspr: tuple[float, float] = (0.0, 0.0)  # slope against speed at this speed, forwards and backwards
    stiffness_Nmprad: float = math.inf  # of the reducer for a small motion


@dataclass(frozen=True)
class Wave:
    """One sine of a series; the half widths are those of the 95 % interval."""

    per_motor_turn: int
    amplitude: float
    amplitude_half: float
    phase_rad: float
    phase_half_rad: float
    found: bool  # more than its interval, and each half of the turns is better predicted from the other with it


@dataclass(frozen=True)
class FoundMap:
    """Both series, every order that was looked for; `kinematic` is empty with one encoder."""

    kinematic_rad: tuple[Wave, ...]
    ripple_Nm: tuple[Wave, ...]
    turns: tuple[int, int]  # of the motor, forwards and backwards
    speed_radps: float

    def values(self, direction: int, zero_counts: int) -> dict[str, Any]:
        """Keys of [reducer.map]: the largest sines that were found, in the order of their periods."""
        found: dict[str, Any] = {"direction": direction, "zero_counts": zero_counts}
        for name, unit, waves in (
            ("kinematic_error", "rad", self.kinematic_rad),
            ("torque_ripple", "Nm", self.ripple_Nm),
        ):
            kept = kept_waves(waves)
            found[f"{name}_{unit}"] = [float(f"{wave.amplitude:.4g}") for wave in kept]
            found[f"{name}_per_motor_turn"] = [float(wave.per_motor_turn) for wave in kept]
            found[f"{name}_phase_rad"] = [float(f"{wave.phase_rad:.4g}") for wave in kept]
        return found

    def ripple_values(self, direction: int, zero_counts: int) -> dict[str, Any]:
        """Keys of [ripple], of a joint that is taken as rigid."""
        values = self.values(direction, zero_counts)
        names = {"torque_Nm": "torque_ripple_Nm", "per_motor_turn": "torque_ripple_per_motor_turn",
                 "phase_rad": "torque_ripple_phase_rad"}  # fmt: skip
        head = {key: values[key] for key in ("direction", "zero_counts")}
        return head | {name: values[key] for name, key in names.items()}


def kept_waves(waves: Sequence[Wave]) -> list[Wave]:
    """Those that a map holds: found, the largest HARMONICS of them."""
    largest = sorted((wave for wave in waves if wave.found), key=lambda wave: -wave.amplitude)[:HARMONICS]
    return sorted(largest, key=lambda wave: wave.per_motor_turn)


def _turns(run: MapRun) -> list[tuple[int, slice]]:
    """(direction, rows) of every whole motor turn at constant speed."""
    top = float(np.max(np.abs(run.desired_radps), initial=0.0))
    steady = np.abs(np.abs(run.desired_radps) - top) <= _STEADY * top
    side = np.where(steady, np.sign(run.desired_radps), 0.0)
    edges = [0, *(np.flatnonzero(np.diff(side)) + 1), len(side)]
    found = []
    for begin, end in itertools.pairwise(edges):
        direction = int(side[begin])
        if direction == 0:
            continue
        # the first part of a stroke is left to friction and hysteresis, to settle
        turn = direction * run.ratio * (run.motor_rad[begin:end] - run.motor_rad[begin]) / math.tau
        starts = np.searchsorted(np.maximum.accumulate(turn), np.arange(0.5, float(np.max(turn, initial=0.0)) + 1e-9))
        found += [
            (direction, slice(begin + a, begin + b)) for a, b in itertools.pairwise(starts) if b - a >= LEAST_ROWS
        ]
    return found


def _sines(angle_rad: np.ndarray, *values: np.ndarray) -> np.ndarray:
    """Complex amplitudes c of Im(c exp(i k angle)), k = 1..HIGHEST, of each of the values; shape (HIGHEST, values)."""
    orders = np.arange(1, HIGHEST + 1)
    waves = angle_rad[:, None] * orders
    columns = np.hstack((np.ones((len(angle_rad), 1)), np.sin(waves), np.cos(waves)))
    fitted = np.linalg.lstsq(columns, np.column_stack(values), rcond=None)[0]
    return np.asarray(fitted[1 : 1 + HIGHEST] + 1j * fitted[1 + HIGHEST :])


def _level(values: np.ndarray, turns: Sequence[tuple[int, slice]], index: int) -> np.ndarray:
    """The values of a turn without their slope, which is that of the means of its neighbours in the same stroke.

    Within one turn a slope is nearly a sum of the sines: what has more than HIGHEST periods would go into all of them.
    """
    direction, rows = turns[index]
    first, last = rows, rows
    for other, others in turns[max(index - 1, 0) : index + 2]:
        if other == direction and others.stop == rows.start:
            first = others
        elif other == direction and others.start == rows.stop:
            last = others
    length = rows.stop - rows.start
    apart = 0.5 * (last.start + last.stop - first.start - first.stop)
    slope = (values[last].mean() - values[first].mean()) / apart if apart else 0.0
    return np.asarray(values[rows] - slope * (np.arange(length) - 0.5 * length))


def _waves(parts: np.ndarray, *errors: float) -> tuple[Wave, ...]:
    """Mean and interval of complex amplitudes, shape (turns, 1 + models, HIGHEST): what was seen, what models added.

    `errors`: shares by which each of these may be wrong.
    """
    from scipy.stats import t  # here: only a map waits for it

    estimates, count = parts.sum(axis=1), len(parts)
    doubt = np.hypot.reduce(np.array(errors)[:, None] * np.abs(parts[:, 1:].mean(axis=0)))
    width = float(t.ppf(0.5 + 0.5 * LEVEL, count - 1)) / math.sqrt(count)
    waves = []
    for k, mean in enumerate(estimates.mean(axis=0)):
        amplitude = abs(mean)
        turned = estimates[:, k] * np.exp(-1j * np.angle(mean))
        along, across = np.std(turned.real, ddof=1), np.std(turned.imag, ddof=1)
        turn = math.hypot(along, across)
        along_half, across_half = (math.hypot(max(width * float(one), turn), doubt[k]) for one in (along, across))
        half = across_half / amplitude if amplitude > 0.0 else math.pi
        least = max(_LARGEST_SPREAD * turn / math.sqrt(count), along_half)
        waves.append(
            Wave(
                k + 1, float(amplitude), along_half, float(np.angle(mean)), min(half, math.pi),
                bool(amplitude > least and _predicts(estimates[:, k])),
            )
        )  # fmt: skip
    return tuple(waves)


def _predicts(estimates: np.ndarray) -> bool:
    """Whether the mean of each half of the turns lowers the error on the other half."""
    halves = estimates[::2], estimates[1::2]
    left = sum(float(np.sum(np.abs(mine - other.mean()) ** 2)) for mine, other in (halves, halves[::-1]))
    return left < float(np.sum(np.abs(estimates) ** 2))


def found_map(run: MapRun) -> FoundMap:
    """The series; `DataError` where the motion has too few motor turns at constant speed in either direction."""
    turns = _turns(run)
    counts = tuple(sum(1 for direction, _ in turns if direction == side) for side in (1, -1))
    if min(counts) < LEAST_TURNS // 2:
        raise DataError(
            f"motor turns at constant speed (={counts[0]} forwards, {counts[1]} backwards) must be "
            f"{LEAST_TURNS // 2} each way at least",
            "a longer travel",
        )
    speed = float(np.max(np.abs(run.desired_radps)))
    orders_radps = np.arange(1, HIGHEST + 1) * run.ratio * speed
    kinematic, ripple = [], []  # what is seen, and what the swing adds
    all_link = run.motor_rad if run.link_rad is None else run.link_rad
    for index, (direction, rows) in enumerate(turns):
        motor, link = run.motor_rad[rows], all_link[rows]
        # what the joint swings about its even motion: the angle itself is the abscissa, so that of time is taken
        even = np.linspace(motor[0], motor[-1], len(motor))
        levels = (_level(values, turns, index) for values in (all_link - run.motor_rad, run.torque_Nm))
        found = _sines(run.ratio * motor, *levels, motor - even, link - even)
        # tau + r = friction + J q''; of a wave over the angle, q' = +-i w and q'' = -w^2 times it
        link_Nm = -(orders_radps**2) * run.link_kgm2 * found[:, 3]
        inertia_Nm = link_Nm - orders_radps**2 * run.motor_kgm2 * found[:, 2]
        slope = run.friction_Nmspr[0 if direction > 0 else 1]
        friction_Nm = slope * 1j * direction * orders_radps * found[:, 2]
        kinematic.append((found[:, 0], link_Nm / run.stiffness_Nmprad))
        ripple.append((-found[:, 1], inertia_Nm, friction_Nm))
    return FoundMap(
        () if run.link_rad is None else _waves(np.array(kinematic), STIFFNESS_ERROR),
        _waves(np.array(ripple), INERTIA_ERROR, FRICTION_ERROR),
        (counts[0], counts[1]), speed,
    )  # fmt: skip


def late_torque_Nm(command_Nm: np.ndarray, period_s: float, late_s: float) -> np.ndarray:
    """The torque that acts when a position is sampled: the command so much earlier."""
    cycles = np.arange(len(command_Nm)) - late_s / period_s
    return np.interp(cycles, np.arange(len(command_Nm)), command_Nm)


def tracked(records: np.recarray) -> Any:
    """The rows of a log in which the trajectory is followed."""
    rows: LogRecord = records[records.phase == AxisPhase.TRACKING]
    return rows


# --- the picture ---


def map_figure(found: FoundMap, title: str) -> Figure:
    """Amplitudes with their intervals, and what both series are over a motor turn."""
    parts = [("torque ripple [Nm]", found.ripple_Nm, 1.0)]
    if found.kinematic_rad:
        parts.insert(0, ("link ahead of motor [mrad]", found.kinematic_rad, 1e3))
    with canvas(2.6 * len(parts) + 0.8, title) as figure:
        rows = figure.subplots(len(parts), 2, squeeze=False)
        for (label, waves, scale), (left, right) in zip(parts, rows, strict=True):
            _bars(left, waves, scale, label)
            _over_a_turn(right, waves, scale)
        for axis, text in zip(rows[-1], ("periods a motor turn", "motor angle [turns]"), strict=True):
            axis.set_xlabel(text)
        return figure


def _bars(axis: Axes, waves: Sequence[Wave], scale: float, label: str) -> None:
    kept = kept_waves(waves)
    axis.bar(
        [wave.per_motor_turn for wave in waves],
        [scale * wave.amplitude for wave in waves],
        yerr=[scale * wave.amplitude_half for wave in waves],
        color=[BLUE if wave in kept else GREY for wave in waves],
        ecolor=ORANGE,
    )
    axis.set_xmargin(0.02)
    axis.set_ylim(bottom=0.0)
    axis.set_ylabel(label)


def _over_a_turn(axis: Axes, waves: Sequence[Wave], scale: float) -> None:
    turn = np.linspace(0.0, 1.0, 721)
    total = np.zeros_like(turn)
    for wave in kept_waves(waves):
        total += scale * wave.amplitude * np.sin(math.tau * wave.per_motor_turn * turn + wave.phase_rad)
    axis.plot(turn, total, color=BLUE)
