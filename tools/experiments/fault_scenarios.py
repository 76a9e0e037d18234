"""Random scenarios: a plant, a motion, one fault or its harmless twin, or two.  Number and seed decide everything.

`FAULT_CLASSES` says what each kind of fault may do: its sizes, harmful and harmless, and the causes that the loop may
then name.  A harmless size is just inside what the limits of `configs/virtual.toml` allow: it must not stop the joint.
Five kinds have none: a drive that restarts or is in fault is off, a corrupted frame may say anything, and a single
sample counted the wrong way is a leap at any speed worth a trajectory.  Causes are those of the fault itself;
`LATE_CAUSES` may follow any fault that begins when the joint is already being stopped.

Of a pair the second fault begins 0.5 ms to 2 s after the first, as often in each tenfold of that time: within a cycle,
in the reaction, in the stop, after it.  A stop by the user and the death of the loop are events of pairs as well.  What
is harmless alone may not be so beside another one: no pair is a twin, and either one's causes may be named.

The motion is a trajectory of `jointctl run`, or a few plateaus of constant speed as of `jointctl sweep`, in the mode in
which a sweep runs: the drive closes the velocity loop where it can (CSV, else PV), else the law that a sweep uses.
Or a program sends the same trajectories as set-points, some 2 to 20 ms apart, and may fail as well.
Or it is a step of a tune: the soft spring of the direction, a pair of legs of the response with a part of its largest
multisine, plateaus as of the friction, or a trajectory as of the verification.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np

from jointctl.firmware_py.motion_records import Reference
from jointctl.firmware_py.observers import low_pass_gain
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import Fault
from jointctl.firmware_py.trajectory import reference_at
from jointctl.hil.faults import FaultConstants, FaultKind
from jointctl.hil.lockstep import POINT_VALUES, POINT_TIME_s
from jointctl.hil.plant import plant
from jointctl.hil.plant_records import FrictionKind
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.records import trajectory_constants
from jointctl.tools.configuration.sections import Hold, MinJerk, Sine, Trapezoid
from jointctl.tools.lockstep import LockstepJoint
from jointctl.tools.sweeping.carry_out import middle_rad, sweep_constants, with_tracking_law
from jointctl.tools.sweeping.options import SweepPoint
from jointctl.tools.sweeping.plan import ACCELERATION_SHARE, PlanSettings, plan_motion, position_margin_rad, shifted
from jointctl.tools.virtual_joint import plant_settings

During = Literal["run", "sweep", "program", "tune"]

# --- kinds of fault ---

LONG_s = 30.0  # longer than any scenario
MOTION = frozenset(
    {
        Fault.POSITION_LIMIT, Fault.VELOCITY_LIMIT, Fault.FOLLOWING_ERROR, Fault.POSITION_JUMP, Fault.POSITION_FROZEN,
        Fault.TORQUE_SATURATED, Fault.LIMIT_CYCLE, Fault.STOP_TIMEOUT,
    }
)  # fmt: skip
# of a reading that is false: where there are two encoders, the other one contradicts it
READING = MOTION | {Fault.POSITION_DISAGREEMENT}
# what a joint that seems to move, or does, shows before it is enabled
NOT_STARTED = frozenset({Fault.NOT_AT_STANDSTILL, Fault.MOVED_BEFORE_START})
DRIVE = frozenset({Fault.DRIVE_FAULT, Fault.DRIVE_NOT_ENABLED, Fault.DRIVE_RESTARTED})
# before the joint is enabled, or after it was asked to stop, a fault of the wire shows as one of these
LATE_CAUSES = frozenset(
    {
        Fault.NO_SAMPLES, Fault.STALE_SAMPLE, Fault.SAMPLES_MISSING, Fault.ENABLE_TIMEOUT, Fault.STOP_TIMEOUT,
        Fault.OFF_TIMEOUT,
    }
)  # fmt: skip


@dataclass(frozen=True)
class Sizes:
    """Ranges that a scenario draws from, evenly: duration [s] and magnitude (see `FaultKind`)."""

    duration_s: tuple[float, float]
    magnitude: tuple[float, float] = (1.0, 1.0)  # of what is only there or not
    log_duration: bool = False


@dataclass(frozen=True)
class FaultClass:
    """`certain`: a harmful fault that begins while the joint tracks must be noticed, whatever the motion.

    `emergency`: the drive's own error code that must be reported with DRIVE_NOT_ENABLED; 0: any.
    """

    kind: FaultKind
    harmful: Sizes | None
    harmless: Sizes | None
    causes: frozenset[Fault] = frozenset()
    certain: bool = False
    on_wire: bool = False
    emergency: int = 0


def _lost(
    kind: FaultKind, causes: frozenset[Fault], *, certain: bool, harmless_s: float = 0.045, emergency: int = 0
) -> FaultClass:
    return FaultClass(
        kind, Sizes((0.06, LONG_s), log_duration=True), Sizes((0.001, harmless_s)), causes, certain, True,
        emergency,
    )  # fmt: skip


RPDO_DEADLINE = 0x8250  # EMCY of a drive whose RPDOs stay away
_ALWAYS = (0.001, LONG_s)
_STALE = frozenset({Fault.STALE_SAMPLE})
_CLASSES = (
    _lost(FaultKind.FRAMES_LOST, MOTION | _STALE | {Fault.DRIVE_NOT_ENABLED}, certain=True),
    _lost(FaultKind.SYNC_LOST, MOTION | _STALE, certain=True),
    _lost(
        FaultKind.RPDO_LOST, MOTION | _STALE | {Fault.DRIVE_NOT_ENABLED}, certain=False, harmless_s=0.01,
        emergency=RPDO_DEADLINE,
    ),
    _lost(FaultKind.TPDO_LOST, _STALE | MOTION, certain=True),
    _lost(FaultKind.BUS_OFF, _STALE | {Fault.BUS_ERROR}, certain=True, harmless_s=0.015),
    FaultClass(
        FaultKind.CONTROLLER_HEARTBEAT_LOST, Sizes((0.4, LONG_s)), Sizes((0.001, 0.06)),
        _STALE | {Fault.DRIVE_NOT_ENABLED}, True, on_wire=True,
    ),
    FaultClass(
        FaultKind.DRIVE_HEARTBEAT_LOST, Sizes((0.85, LONG_s)), Sizes((0.001, 0.35), (0.0, 1.0)),
        frozenset({Fault.DRIVE_SILENT}), True, on_wire=True,
    ),
    FaultClass(
        FaultKind.RPDO_DELAYED, Sizes((0.01, 5.0), (0.003, 0.05)), Sizes(_ALWAYS, (0.0001, 0.001)), MOTION,
        on_wire=True,
    ),
    FaultClass(
        FaultKind.TPDO_DELAYED, Sizes((0.01, 5.0), (0.003, 0.05)), Sizes(_ALWAYS, (0.0001, 0.001)), READING | _STALE,
        on_wire=True,
    ),
    FaultClass(FaultKind.RPDO_DUPLICATED, None, Sizes(_ALWAYS, (0.0, 1.0)), on_wire=True),
    FaultClass(FaultKind.TPDO_DUPLICATED, None, Sizes(_ALWAYS, (0.0, 1.0)), on_wire=True),
    FaultClass(
        FaultKind.RPDO_REORDERED, Sizes(_ALWAYS, (0.3, 1.0)), Sizes(_ALWAYS, (0.0, 0.3)), MOTION, on_wire=True
    ),
    FaultClass(
        # before enabling, settle_s of good samples in a row are asked for
        FaultKind.TPDO_REORDERED, Sizes(_ALWAYS, (0.3, 1.0)), Sizes(_ALWAYS, (0.0, 0.05)), READING, on_wire=True
    ),
    FaultClass(FaultKind.RPDO_CORRUPTED, Sizes((0.0005, 0.003), (0.3, 1.0)), None, MOTION | DRIVE, on_wire=True),
    FaultClass(
        FaultKind.TPDO_CORRUPTED, Sizes((0.0015, 0.05), (0.3, 1.0)), None,
        READING | DRIVE | NOT_STARTED | {Fault.DRIVE_STAYS_ENABLED}, on_wire=True,
    ),
    FaultClass(
        FaultKind.RPDO_LENGTH, Sizes((0.06, LONG_s), (0.0, 3.99)), Sizes((0.001, 0.01), (0.0, 8.99)),
        MOTION | _STALE | {Fault.DRIVE_NOT_ENABLED}, on_wire=True, emergency=RPDO_DEADLINE,
    ),
    FaultClass(
        FaultKind.TPDO_LENGTH, Sizes((0.06, LONG_s), (0.0, 7.99)), Sizes((0.001, 0.045), (0.0, 8.99)),
        _STALE | MOTION, True, on_wire=True,
    ),
    FaultClass(FaultKind.FOREIGN_FRAMES, None, Sizes(_ALWAYS, (1.0, 16.0)), on_wire=True),
    FaultClass(FaultKind.DRIVE_REBOOT, Sizes(_ALWAYS), None, frozenset({Fault.DRIVE_RESTARTED}), True),
    FaultClass(FaultKind.DRIVE_FAULT, Sizes((0.01, LONG_s)), None, frozenset({Fault.DRIVE_FAULT}), True),
    FaultClass(FaultKind.ENCODER_STUCK, Sizes((0.05, LONG_s)), Sizes((0.001, 0.002)), READING | NOT_STARTED),
    FaultClass(
        FaultKind.ENCODER_JUMP, Sizes(_ALWAYS, (0.0205, 1.0)), Sizes(_ALWAYS, (0.00001, 0.0005)),
        READING | NOT_STARTED, True,
    ),
    FaultClass(
        FaultKind.ENCODER_DRIFT, Sizes(_ALWAYS, (0.05, 1.0)), Sizes((0.001, 1.0), (0.0001, 0.01)),
        READING | NOT_STARTED | {Fault.REFERENCE_LIMIT},
    ),
    FaultClass(FaultKind.ENCODER_REVERSED, Sizes((0.3, LONG_s)), None, READING | NOT_STARTED),
    FaultClass(FaultKind.TORQUE_REVERSED, Sizes((0.3, LONG_s)), Sizes((0.001, 0.002)), MOTION),
    FaultClass(
        FaultKind.TORQUE_SATURATED, Sizes((0.05, LONG_s), (0.0, 30.0)), Sizes(_ALWAYS, (58.0, 100.0)), MOTION
    ),
    FaultClass(FaultKind.CURRENT_LOOP_DEAD, Sizes((0.05, LONG_s)), Sizes((0.001, 0.002)), MOTION),
    FaultClass(
        FaultKind.LOAD_JUMP, Sizes((0.01, 0.2), (15.0, 40.0)), Sizes(_ALWAYS, (0.5, 4.0)),
        MOTION | NOT_STARTED,
    ),
    FaultClass(
        FaultKind.LOOP_HELD_UP, Sizes((0.06, 1.0)), Sizes((0.001, 0.025)),
        MOTION | _STALE | {Fault.OVERRUN, Fault.DRIVE_NOT_ENABLED}, True, on_wire=True,
    ),
    FaultClass(
        FaultKind.CLOCK_STEP, Sizes((0.01, 0.01), (0.06, 100.0)), Sizes((0.01, 0.01), (0.001, 0.045)),
        frozenset({Fault.OVERRUN}), True,
    ),
    FaultClass(
        FaultKind.SUPERVISOR_SILENT, Sizes((1.05, LONG_s)), Sizes((0.01, 0.95)), frozenset({Fault.SUPERVISOR_LOST}),
    ),
)  # fmt: skip
_OF_A_PROGRAM = (
    FaultClass(
        # harmful: longer than stream.client_timeout_s
        FaultKind.PROGRAM_SILENT, Sizes((1.1, LONG_s)), Sizes((0.001, 0.9)), frozenset({Fault.CLIENT_SILENT}),
    ),
    FaultClass(FaultKind.PROGRAM_WILD, None, Sizes((0.002, 1.0), (0.05, 100.0))),  # nothing of it is followed
)  # fmt: skip
_OF_A_PAIR = (
    FaultClass(FaultKind.STOP_REQUESTED, None, Sizes((LONG_s, LONG_s), (1.0, 3.99))),
    FaultClass(FaultKind.LOOP_KILLED, None, Sizes((LONG_s, LONG_s)), on_wire=True),  # reported by no one
)
FAULT_CLASSES = {item.kind: item for item in (*_CLASSES, *_OF_A_PROGRAM, *_OF_A_PAIR)}
EMERGENCY_CODES = (0x2311, 0x3120, 0x3310, 0x4310, 0x5441, 0x7121, 0x7300, 0x8480, 0x8611)
SIGNED = frozenset({FaultKind.ENCODER_JUMP, FaultKind.ENCODER_DRIFT, FaultKind.LOAD_JUMP, FaultKind.PROGRAM_WILD})


# --- the motion of a sweep ---

SLOWEST_SHARE, FASTEST_SHARE = 0.03, 0.5  # of limits.velocity_max_radps; a real sweep goes up to 0.9 of it
SETTLE_s = 0.1
LONGEST_s = 8.0  # of such a motion, about


@dataclass(frozen=True)
class SweepStrokes:
    """Plateaus in their order: speeds as signed shares of the velocity limit, and the time of measuring wanted."""

    shares: tuple[float, ...]
    dwell_s: float


def draw_strokes(random: np.random.Generator) -> SweepStrokes:
    """One or two speeds, each in both directions."""
    shares = [float(random.uniform(SLOWEST_SHARE, FASTEST_SHARE)) for _ in range(int(random.integers(1, 3)))]
    return SweepStrokes(
        tuple(signed for share in shares for signed in (share, -share)), float(random.uniform(0.1, 0.3))
    )


@dataclass(frozen=True)
class PlacedSweep:
    """What a lockstep run needs of it, or of a step of a tune."""

    constants: Any  # AxisConstants, a record array of one
    table: np.ndarray
    start_rad: float
    duration_s: float


def placed_sweep(config: Config, joint: LockstepJoint, strokes: SweepStrokes, start_offset_rad: float) -> PlacedSweep:
    """The motion about the middle of the travel; the joint stands `start_offset_rad` beside it."""
    limits = config.limits
    width_rad = limits.position_max_rad - limits.position_min_rad - 2.0 * position_margin_rad(config)
    speeds = [share * limits.velocity_max_radps for share in strokes.shares]
    settings = PlanSettings(
        width_rad, ACCELERATION_SHARE * config.sequence.brake_radps2, max(map(abs, speeds)), strokes.dwell_s, SETTLE_s,
        config.joint.reduction_ratio,
    )  # fmt: skip
    motion = plan_motion([SweepPoint(i, speed, 0) for i, speed in enumerate(speeds)], settings)
    middle = middle_rad(config, motion, 0.5 * (limits.position_min_rad + limits.position_max_rad))
    placed = shifted(motion, middle)
    start_rad = middle + start_offset_rad
    if not joint.report.commands_velocity:
        config = with_tracking_law(config)
    constants = sweep_constants(config, dataclasses.replace(joint.report, start_position_rad=start_rad), placed)
    return PlacedSweep(constants, placed.table, start_rad, placed.duration_s)


# --- a step of a tune ---

STEPS_THAT_MOVE = ("direction", "response", "friction", "verification", "bristles")


@dataclass(frozen=True)
class TuneStep:
    """One of `STEPS_THAT_MOVE` but the verification, whose motion is that of a run."""

    name: str
    share: float  # of the response's largest multisine
    strokes: SweepStrokes  # of the friction


PlaceStep = Callable[[Config, LockstepJoint, TuneStep, float], PlacedSweep]
"""The motion of a step for a joint that stands so far from its first point; `verbs.fault_campaign` has it."""


def draw_step(random: np.random.Generator) -> TuneStep | None:
    """None: a trajectory, as a verification runs one.

    The bristles take half of what were directions: the other scenarios of a seed stay what they were.
    """
    name = STEPS_THAT_MOVE[int(random.integers(len(STEPS_THAT_MOVE) - 1))]
    share, strokes = float(random.uniform(0.125, 1.0)), draw_strokes(random)
    if name == "direction" and share > 0.5625:
        name = "bristles"
    return None if name == "verification" else TuneStep(name, share, strokes)


# --- the set-points of a program ---

SOFT_s = 0.2  # in which the clock of a program's trajectory comes up to its rate, and in which it slows down again


@dataclass(frozen=True)
class Program:
    """A trajectory as set-points, `every_s` apart."""

    trajectory: Any
    every_s: float


def set_points_of(program: Program, config: Config, table: np.ndarray) -> np.ndarray:
    """Rows of `hil.lockstep.Scenario.set_points`: at rest for `BEFORE_s`, then the trajectory, from rest to rest."""
    shown = config.changed(trajectory=program.trajectory)
    trajectory, at = trajectory_constants(shown, table), new(Reference)[0]
    lasts_s = program.trajectory.duration_s
    times_s = np.arange(0.0, BEFORE_s + lasts_s, program.every_s)
    points = np.zeros((len(times_s), 5))
    points[:, POINT_TIME_s] = times_s
    up, down = np.clip([(times_s - BEFORE_s) / SOFT_s, (BEFORE_s + lasts_s - times_s) / SOFT_s], 0.0, 1.0)
    rates = up * up * (3.0 - 2.0 * up) * down * down * (3.0 - 2.0 * down)
    begun, left = (SOFT_s * share**3 * (1.0 - 0.5 * share) for share in (up, down))  # integrals of the rate
    between = np.clip(times_s - BEFORE_s - SOFT_s, 0.0, lasts_s - 2.0 * SOFT_s)
    gone_s = begun + between + 0.5 * SOFT_s - left
    for row, rate, t in zip(points, rates, gone_s, strict=True):
        reference_at(trajectory, table, 0, float(t), at)
        row[POINT_VALUES : POINT_VALUES + 3] = at.position_rad, rate * at.velocity_radps, math.nan
    return points


# --- the scenario ---

HARMLESS_SHARE = 0.35
REACH_RAD = 0.4  # of the trajectories; the limits are at 0.7
TOP_SPEED_RADPS = 0.6  # of the trajectories; the limit is 1
FILTER_OF_SWAPS = (100.0, 0.001)  # cutoff [Hz] and period [s] with which every reordering of a twin is harmless
BEFORE_s = 1.8  # until the trajectory begins, at most
SECOND_AFTER_s = (0.0005, 2.0)


@dataclass(frozen=True)
class Event:
    """A fault, or its harmless twin."""

    kind: FaultKind
    harmless: bool
    at_s: float  # after the start of the run
    duration_s: float
    magnitude: float

    def describe(self) -> dict[str, Any]:
        return {**asdict(self), "kind": self.kind.name.lower()}

    def then(self, second: Event | None) -> str:
        """`drive_reboot 1.5 ms later`, empty without a second one."""
        if second is None:
            return ""
        twin = "harmless " if second.harmless else ""
        return f"{twin}{second.kind.name.lower()} {1e3 * (second.at_s - self.at_s):.1f} ms later"


@dataclass(frozen=True)
class Scenario(Event):
    """What happens: this event, and maybe a second one; `plant` holds what differs from the configuration's."""

    number: int
    seed: int
    trajectory: Any
    start_offset_rad: float  # of the joint from the first point of the trajectory
    plant: dict[str, Any]
    second: Event | None = None

    @property
    def events(self) -> tuple[Event, ...]:
        """What goes wrong with this joint, in the order of time."""
        first = () if self.kind is FaultKind.NONE else (self,)
        return first if self.second is None else (*first, self.second)

    @property
    def twin(self) -> bool:
        """Whether it must not stop the joint."""
        return self.harmless and self.second is None

    def faults(self) -> Any:
        """`FaultConstants`, a record array of the events."""
        faults = new(FaultConstants, len(self.events))
        for record, event in zip(faults, self.events, strict=True):
            record.kind, record.start_s, record.duration_s = event.kind, event.at_s, event.duration_s
            record.magnitude, record.seed = event.magnitude, self.number + 1
        return faults

    def describe(self) -> dict[str, Any]:
        trajectory, every = self.trajectory, {}
        if isinstance(trajectory, Program):
            trajectory, every = trajectory.trajectory, {"set_point_every_s": trajectory.every_s}
        strokes = isinstance(trajectory, SweepStrokes | TuneStep)
        return {
            **{k: v for k, v in super().describe().items() if k not in ("trajectory", "second")},
            **({} if self.second is None else {"second": self.second.describe()}),
            "trajectory": asdict(trajectory) if strokes else {**trajectory.model_dump(exclude_none=True), **every},
            "plant": {k: (v.name.lower() if isinstance(v, FrictionKind) else v) for k, v in self.plant.items()},
        }


def draw_trajectory(
    random: np.random.Generator, duration_s: float, reach_rad: float = REACH_RAD, top_radps: float = TOP_SPEED_RADPS
) -> Any:
    """A hold, a sine, or moves there and back; within `reach_rad` of zero, not faster than `top_radps`."""
    kind = random.integers(4)
    if kind == 0:
        return Hold(kind="hold", duration_s=duration_s, position_rad=float(random.uniform(-reach_rad, reach_rad)))
    if kind == 1:
        amplitude = random.uniform(0.02, reach_rad)
        highest = min(0.5, top_radps / (amplitude * math.tau))
        return Sine(
            kind="sine", duration_s=duration_s, amplitude_rad=float(amplitude),
            frequency_Hz=float(random.uniform(0.05, highest)), shift_s=float(random.uniform(0.0, 3.0)),
        )  # fmt: skip
    start, target = (float(x) for x in random.uniform(-reach_rad, reach_rad, 2))
    way = max(abs(target - start), 1e-3)
    if kind == 2:
        move_s = max(1.875 * way / random.uniform(0.1, top_radps), 0.4)
        return MinJerk(
            kind="min_jerk", duration_s=duration_s, start_rad=start, target_rad=target, move_s=float(move_s),
            dwell_s=float(random.uniform(0.0, 0.3)), repeat=True,
        )  # fmt: skip
    return Trapezoid(
        kind="trapezoid", duration_s=duration_s, start_rad=start, target_rad=target,
        speed_radps=float(random.uniform(0.1, top_radps)), acceleration_radps2=float(random.uniform(0.5, 3.0)),
        dwell_s=float(random.uniform(0.0, 0.3)), repeat=True,
    )  # fmt: skip


def draw_plant(random: np.random.Generator) -> dict[str, Any]:
    """Settings of `plant_of`."""
    sticks = random.random() < 0.25
    return {
        "friction_kind": FrictionKind.STICK_SLIP if sticks else FrictionKind.LUGRE,
        "friction_positive_scale": float(random.uniform(0.9, 1.15)),
        "friction_negative_scale": float(random.uniform(0.9, 1.15)),
        "bristle_stiffness_Nmprad": float(np.exp(random.uniform(math.log(3e4), math.log(2e5)))),
        "current_lag_s": float(random.uniform(0.3e-3, 0.8e-3)),
        "command_delay_s": float(random.uniform(0.0, 0.5e-3)),
        "torque_ripple_Nm": (float(random.uniform(0.0, 1.0)), float(random.uniform(0.0, 0.4))),
        "inertia_kgm2": float(2.1 * random.uniform(0.95, 1.05)),
        "encoder_noise_counts": float(random.choice([0.0, random.uniform(0.1, 1.0)])),
    }


def _size(random: np.random.Generator, sizes: Sizes) -> tuple[float, float]:
    low, high = sizes.duration_s
    if sizes.log_duration:
        duration = math.exp(random.uniform(math.log(low), math.log(high)))
    else:
        duration = random.uniform(low, high)
    return float(duration), float(random.uniform(*sizes.magnitude))


def kinds_during(during: During, *, pairs: bool = False) -> list[FaultKind]:
    """The kinds of fault of a campaign, in their order."""
    more = (*(_OF_A_PROGRAM if during == "program" else ()), *(_OF_A_PAIR if pairs else ()))
    return [item.kind for item in (*_CLASSES, *more)]


def _draw_sizes(random: np.random.Generator, chosen: FaultClass) -> tuple[bool, float, float]:
    """(harmless, duration [s], magnitude)."""
    harmless = chosen.harmful is None or (chosen.harmless is not None and random.random() < HARMLESS_SHARE)
    sizes = chosen.harmless if harmless else chosen.harmful
    assert sizes is not None
    duration, magnitude = _size(random, sizes)
    if chosen.kind in SIGNED and random.random() < 0.5:
        magnitude = -magnitude
    if chosen.kind is FaultKind.DRIVE_FAULT:
        magnitude = float(random.choice(EMERGENCY_CODES))
    return harmless, duration, magnitude


def _draw_second(seed: int, number: int, kinds: list[FaultKind], first_s: float) -> Event:
    random = np.random.default_rng([seed, number, 2])
    chosen = FAULT_CLASSES[kinds[int(random.integers(len(kinds)))]]
    harmless, duration, magnitude = _draw_sizes(random, chosen)
    at_s = first_s + math.exp(random.uniform(*np.log(SECOND_AFTER_s)))
    return Event(chosen.kind, harmless, at_s, duration, magnitude)


def draw_scenario(seed: int, number: int, during: During = "run", *, pairs: bool = False) -> Scenario:
    """Scenario `number` of the campaign with this seed."""
    random = np.random.default_rng([seed, number])
    kinds = kinds_during(during, pairs=pairs)
    chosen = FAULT_CLASSES[kinds[number % len(kinds)]]  # in turn: every kind gets its share
    harmless, duration, magnitude = _draw_sizes(random, chosen)
    tracking_s = float(random.uniform(0.5, 2.5))
    step = draw_step(random) if during == "tune" else None
    latest_s = BEFORE_s + (LONGEST_s if during == "sweep" or step is not None else tracking_s)
    at_s = float(random.uniform(0.0, latest_s))
    trajectory: Any = step or (draw_strokes(random) if during == "sweep" else draw_trajectory(random, tracking_s))
    if during == "program":
        trajectory = Program(trajectory, float(random.uniform(0.002, 0.02)))
    return Scenario(
        chosen.kind, harmless, at_s, duration, magnitude, number, seed,
        trajectory=trajectory,
        start_offset_rad=float(random.uniform(-0.1, 0.1)),
        plant=draw_plant(random),
        second=_draw_second(seed, number, kinds, at_s) if pairs else None,
    )  # fmt: skip


def fitted(config: Config, scenario: Scenario) -> Scenario:
    """The scenario with a harmless size that is harmless with this configuration's velocity filter and encoders.

    A swapped sample reads as half the speed and the next one as twice that.  The filter of configs/virtual.toml lets
    any number of swaps pass for harmless; one that passes more reads two in a row as 1.8 times the speed, and 0.6 rad/s
    as more than the limit: there a harmless reordering is one swap.  So it is with a reading that stands still for two
    samples and then leaps by three: there it stands still for one.  A drift that one encoder has beside another one is
    harmless within half of what the two may differ by.
    """
    if scenario.kind is FaultKind.ENCODER_DRIFT and scenario.harmless and config.joint_encoder is not None:
        longest_s = 0.5 * config.joint_encoder.disagreement_max_rad / abs(scenario.magnitude)
        return replace(scenario, duration_s=min(scenario.duration_s, longest_s))
    if scenario.kind not in (FaultKind.TPDO_REORDERED, FaultKind.ENCODER_STUCK) or not scenario.harmless:
        return scenario
    period_s = 1.0 / config.loop.rate_Hz
    if low_pass_gain(config.control.velocity_cutoff_Hz, period_s) <= low_pass_gain(*FILTER_OF_SWAPS):
        return scenario
    cycles = 1.5 if scenario.kind is FaultKind.TPDO_REORDERED else 0.5
    return replace(scenario, duration_s=cycles * period_s, magnitude=1.0)


def plant_of(config: Config, scenario: Scenario, position_rad: float) -> tuple[Any, Any]:
    """Constants and state of the scenario's plant, at this start position."""
    settings = {**plant_settings(config), **scenario.plant, "initial_position_rad": position_rad}
    return plant(**settings)
