"""The sections of a configuration file, each a frozen pydantic model; the unit of a quantity is in its key.

Ranges are wide on purpose: they catch a wrong unit or a slip of the finger, not a bold choice.  What only shows
between two sections is checked in `checks`; conversion to the controller's records is in `records`.
The comment behind a key, or above it, is its meaning: docs/configuration.md is made from it (`reference`).
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeGuard

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field
from pydantic_core import PydanticCustomError

from jointctl.drivers.can.open import CYCLIC_INTERFACES, NAME, RESERVED, split_channel, with_options
from jointctl.firmware_py.records import HARMONICS, KNEES


def is_number(value: object) -> TypeGuard[float]:
    """Of TOML: true and false are none."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def interval_text(low: float, high: float, open_low: bool = False) -> str:
    return f"{'(' if open_low else '['}{low:g}..{high:g}]"


@dataclass(frozen=True)
class Rule:
    """What one value must be: a validator for pydantic, and in words for the reference."""

    allowed: str
    check: Callable[[Any], Any]

    def __call__(self, value: object) -> Any:
        return self.check(value)


def between(low: float, high: float, *, open_low: bool = False) -> Any:
    """Validator of one number; `open_low` excludes the lower end."""
    interval = interval_text(low, high, open_low)

    def check(value: float) -> float:
        if value < low or value > high or (open_low and value == low):
            raise PydanticCustomError("range", "must be in {interval}", {"interval": interval})
        return _not_vanishing(value)

    return AfterValidator(Rule(interval, check))


LEAST = 1e-18  # of a number that is not zero: with what is smaller nothing can be computed


def _not_vanishing(value: Any) -> Any:
    if 0.0 < abs(value) < LEAST:
        raise PydanticCustomError("range", "must not be nearer to 0 than {least}", {"least": LEAST})
    return value


def auto_or_number(low: float, high: float) -> Any:
    allowed = f'"auto" or in {interval_text(low, high)}'

    def check(value: object) -> Any:
        if value == "auto":
            return value
        if is_number(value) and low <= value <= high:
            return _not_vanishing(value)
        raise PydanticCustomError("range", "must be {allowed}", {"allowed": allowed})

    return BeforeValidator(Rule(allowed, check))


def numbers(name: str, *counts: int, low: float, high: float) -> Any:
    """One number or a list of as many as `counts` allows, each in (low..high]; a tuple afterwards."""
    allowed = f"{' or '.join(map(str, counts))} {name}, each in {interval_text(low, high, True)}"

    def check(value: object) -> tuple[float, ...]:
        items: list[Any] | tuple[Any, ...] = value if isinstance(value, (list, tuple)) else [value]
        if not all(is_number(x) and low < x <= high for x in items) or len(items) not in counts:
            raise PydanticCustomError("numbers", "must be {allowed}", {"allowed": allowed})
        return tuple(float(_not_vanishing(x)) for x in items)

    return BeforeValidator(Rule(allowed, check))


def _direction(value: int) -> int:
    if value not in (-1, 1):
        raise PydanticCustomError("direction", "must be 1 or -1")
    return value


Direction = Annotated[int, AfterValidator(Rule("1 or -1", _direction))]
Node = Annotated[int, between(1, 127)]
Identity = Annotated[int, between(0, 0xFFFFFFFF)]
Angle = Annotated[float, between(-1000.0, 1000.0)]
Ampere = Literal["sine_amplitude", "rms"]


class Section(BaseModel):
    """Frozen, no unknown keys, no conversion of types (1 and "1" differ), no nan and no inf."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


ALLOWED = "names of python-can with texts, numbers, true or false; none for socketcan and jointctl"


def checked_options(value: object) -> Any:
    """For pydantic: a table of names and plain values."""
    if value is None:
        return None
    if not isinstance(value, dict):
        raise PydanticCustomError("options", 'must be a table: {{ host = "...", port = 29536 }}')
    for name, option in value.items():
        if not NAME.fullmatch(str(name)) or name in RESERVED:
            raise PydanticCustomError("options", "{name} is no option of an interface", {"name": str(name)})
        if not isinstance(option, (str, int, float)) or (isinstance(option, float) and not math.isfinite(option)):
            raise PydanticCustomError("options", "{name} must be a text, a number, true or false", {"name": name})
    return value


class Bus(Section):
    interface: Annotated[str, Field(min_length=1)]  # python-can's name; "jointctl" is the virtual bus
    # as the interface names it: can0, PCAN_USBBUS1; the virtual bus' own name
    channel: Annotated[str, Field(min_length=1)]
    bitrate_bitps: Annotated[int, between(10_000, 1_000_000)]  # must be the drive's; 1 kHz needs 500 kbit/s or more
    # what the interface needs besides, such as `{ host = "192.168.1.5", port = 29536 }` for socketcand
    options: Annotated[dict[str, Any], BeforeValidator(Rule(ALLOWED, checked_options))] | None = None


def whole_channel(bus: Bus) -> Bus:
    """The bus with its options in `channel`, which then names it completely.

    What stands in the channel already (from the command line) goes before `options`.
    """
    channel, given = split_channel(bus.channel)
    options = {**(bus.options or {}), **given}
    if options and bus.interface in CYCLIC_INTERFACES:
        raise PydanticCustomError("options", "options must be absent for the interface {name}", {"name": bus.interface})
    return bus.model_copy(update={"channel": with_options(channel, options), "options": options or None})


class Encoder(Section):
    counts_per_turn: Annotated[int, between(4, 2**31 - 1)]  # counts of 6064 for one turn of the shaft that it sits on
    side: Literal["joint", "motor"]  # the shaft that it sits on
    direction: Direction  # of the counts against the joint angle
    kind: Literal["absolute", "incremental"] = "absolute"  # incremental: with [joint_encoder] it takes that one's angle
    zero_counts: Annotated[int, between(-(2**31), 2**31 - 1)]  # the drive's reading at joint angle 0


class Joint(Section):
    reduction_ratio: Annotated[float, between(1.0, 1000.0)]  # turns of the motor for one of the joint
    inertia_kgm2: Annotated[float, between(0.0, 10_000.0, open_low=True)]  # at the joint, motor included
    torque_constant_NmpA: Annotated[float, between(0.0, 100.0, open_low=True)]  # of the motor
    torque_constant_ampere: Ampere = "sine_amplitude"  # of the data sheet's ampere
    coriolis_Nmspr: Annotated[float, between(0.0, 10_000.0)] = 0.0  # C of equation (1): torque per joint speed
    gravity_Nm: Annotated[float, between(-10_000.0, 10_000.0)] = 0.0  # m g l: gravity_Nm sin(q - gravity_zero_rad)
    gravity_zero_rad: Angle = 0.0  # joint angle at which gravity has no lever


class Limits(Section):
    position_min_rad: Angle  # inside the end stops by the stopping distance at least
    position_max_rad: Angle  # the same
    # faster: quick stop; little above what the trajectory needs
    velocity_max_radps: Annotated[float, between(0.0, 1000.0, open_low=True)]
    # the command is limited to it; the drive's 6072 follows from it
    torque_max_Nm: Annotated[float, between(0.0, 100_000.0, open_low=True)]
    torque_rate_max_Nmps: Annotated[float, between(0.0, 1e8, open_low=True)]  # limit of the command's slope
    # further from the reference: quick stop
    following_error_max_rad: Annotated[float, between(0.0, 10.0, open_low=True)]
    # between two samples a period apart; more is not believed
    position_jump_max_rad: Annotated[float, between(0.0, 10.0, open_low=True)]
    # without a new position for longer, or so much longer than with one: fault
    sample_age_max_s: Annotated[float, between(0.0, 1.0, open_low=True)]
    # at the torque limit for longer means blocked
    saturation_max_s: Annotated[float, between(0.0, 60.0, open_low=True)]
    # periods lost in one overrun, or so many more lost than kept: more is a fault
    skipped_max_s: Annotated[float, between(0.0, 1.0, open_low=True)]
    standstill_radps: Annotated[float, between(0.0, 10.0, open_low=True)]  # slower counts as standing
    # of the range from -torque_max_Nm to torque_max_Nm: a torque that reverses by more, four times in a row, is a fault
    swing_torque_share: Annotated[float, between(0.2, 1.0)] = 0.5
    # of following_error_max_rad, from peak to peak: an error that swings by more, six times in a row, is the same fault
    swing_error_share: Annotated[float, between(0.01, 1.0)] = 0.05
    swing_slowest_s: Annotated[float, between(0.01, 2.0)] = 0.3  # that half a swing takes; what is slower is a motion
    torque_noise_share: Annotated[float, between(0.01, 1.0)] = 0.2  # of torque_max_Nm; more change a cycle is a warning
    learning_growth: Annotated[float, between(1.0, 10.0)] = 1.05  # of the error, three repetitions long: learning ends


class Sequence(Section):
    # time to the start of the trajectory; 0 = none, the joint must stand there
    approach_s: Annotated[float | Literal["auto"], auto_or_number(0.0, 600.0)]
    brake_radps2: Annotated[float, between(0.0, 10_000.0, open_low=True)]  # of a controlled stop
    release_s: Annotated[float, between(0.0, 60.0)]  # torque to zero at standstill
    settle_s: Annotated[float, between(0.0, 10.0, open_low=True)]  # good samples in a row before enabling
    # for the first good samples; as long a silence of the supervisor
    wait_timeout_s: Annotated[float, between(0.0, 600.0, open_low=True)]
    # for the drive to switch on, its brake included
    enable_timeout_s: Annotated[float, between(0.0, 60.0, open_low=True)]
    stop_timeout_s: Annotated[float, between(0.0, 60.0, open_low=True)]  # for a stop, then the power goes
    # for the drive to say that it is off, its brake included
    off_timeout_s: Annotated[float, between(0.0, 60.0, open_low=True)]
    # the loop stops the joint when its supervisor is silent for longer
    supervisor_timeout_s: Annotated[float, between(0.02, 60.0)]


class Loop(Section):
    rate_Hz: Annotated[float, between(10.0, 10_000.0)]  # over CAN [100..4000], and what the bus carries
    cpu: Annotated[int, between(0, 1023)] | None = None  # processor of the loop, left by its supervisor; none = any
    priority: Annotated[int, between(1, 98)] | None = None  # SCHED_FIFO; none = ordinary scheduling


class FrictionDirection(Section):
    """One column of Table 3, with the signs printed there."""

    tc_Nm: Annotated[float, between(0.0, 10_000.0)]  # Coulomb
    ts_Nm: Annotated[float, between(0.0, 10_000.0)]  # static
    ws: Annotated[float, between(0.0, 1e5, open_low=True)]  # Stribeck speed
    tv: Annotated[float, between(-1e4, 1e4)]  # viscous, per unit of velocity
    a0: Annotated[float, between(-1e4, 1e4)]  # cubic beyond the knee, a0 + a1 v + a2 v² + a3 v³
    a1: Annotated[float, between(-1e4, 1e4)]  # of the cubic
    a2: Annotated[float, between(-1e4, 1e4)]  # of the cubic
    a3: Annotated[float, between(-1e4, 1e4)]  # of the cubic
    knee: Annotated[float, between(-1e5, 1e5)]  # speed from which on the cubic holds
    max: Annotated[float, between(-1e5, 1e5)]  # end of the measured range


class LuGre(Section):
    """Bristles, at the joint."""

    stiffness_Nmprad: Annotated[float, between(0.0, 1e9, open_low=True)]  # of the bristles, at the joint
    damping_Nmspr: Annotated[float, between(0.0, 1e6)]  # of the bristles, at the joint


class FrictionLoad(Section):
    """Friction that goes with the torque that the reducer transmits, at the joint."""

    coulomb: Annotated[float, between(0.0, 2.0)] = 0.0  # Coulomb friction per transmitted torque, its sign ignored
    viscous_spr: Annotated[float, between(0.0, 2.0)] = 0.0  # viscous friction per transmitted torque, joint rad/s


class FrictionTemperature(Section):
    """Friction times exp(-k (T - reference_degC)), T the drive's temperature."""

    reference_degC: Annotated[float, between(-50.0, 200.0)]  # at which the curve holds as it stands
    coulomb_pK: Annotated[float, between(-0.2, 0.2)] = 0.0  # k of Coulomb, static and load friction
    viscous_pK: Annotated[float, between(-0.2, 0.2)] = 0.0  # k of the rest of the curve
    lowest_degC: Annotated[float, between(-50.0, 200.0)] | None = None  # held below; none: reference - 40
    highest_degC: Annotated[float, between(-50.0, 200.0)] | None = None  # held above; none: reference + 40


def _list_of(most: int) -> Any:
    """Validator of a list of TOML: a tuple afterwards, which a frozen model needs."""
    allowed = f"a list of up to {most} numbers"

    def check(value: object) -> tuple[float, ...]:
        if isinstance(value, (list, tuple)) and len(value) <= most and all(is_number(x) for x in value):
            return tuple(float(x) for x in value)
        raise PydanticCustomError("numbers", "must be {allowed}", {"allowed": allowed})

    return BeforeValidator(Rule(allowed, check))


Numbers = Annotated[tuple[float, ...], _list_of(HARMONICS)]
PerKnee = Annotated[tuple[float, ...], _list_of(KNEES)]


class FrictionAngle(Section):
    """Friction times 1 + a sum of sines of the motor's angle, with the direction of the motion; see `identify`."""

    share: Numbers  # amplitudes, four at most, together at most 0.9
    per_motor_turn: Numbers  # periods of each; those of a joint turn divided by the ratio
    phase_rad: Numbers  # of each, at joint angle 0
    direction: Direction | None = None  # encoder.direction when it was measured; none = not checked
    zero_counts: Annotated[int, between(-(2**31), 2**31 - 1)] | None = None  # encoder.zero_counts, likewise


class Friction(Section):
    velocity_unit: Literal["deg/s", "rad/s", "r/min"]  # of ws, tv, a0..a3, knee and max
    velocity_side: Literal["joint", "motor"]  # of the velocity
    torque_side: Literal["motor", "joint"]  # of the torques
    positive: FrictionDirection
    negative: FrictionDirection
    lugre: LuGre | None = None
    load: FrictionLoad | None = None
    temperature: FrictionTemperature | None = None
    angle: FrictionAngle | None = None


class Margin(Section):
    """What `check` computes with, and below what `run` refuses to enable."""

    min_phase_margin_deg: Annotated[float, between(0.0, 90.0)] = 20.0  # run refuses to enable below it
    # from the position sample to the torque; none = from the RPDO type
    loop_delay_s: Annotated[float, between(0.0, 0.1)] | None = None
    current_lag_s: Annotated[float, between(0.0, 0.1)] = 0.0005  # of the drive's current loop, first order
    # with [reducer]: the loop must bear these factors on the link's inertia, lightest and heaviest
    payload_range: Annotated[tuple[float, ...], numbers("factors", 2, low=0.0, high=100.0)] = (0.7, 1.4)
    # with [reducer]: by this share the stiffness may be less or more
    stiffness_error: Annotated[float, between(0.0, 0.9)] = 0.3
    max_sensitivity: Annotated[float, between(1.0, 100.0)] = 3.0  # with [reducer]: run refuses above this peak of |S|


class Live(Section):
    """What the live page may change while the joint moves."""

    gain_factor: Annotated[float, between(1.0, 10.0)] = 2.0  # gains: configured / factor .. configured * factor
    ramp_s: Annotated[float, between(0.05, 60.0)] = 0.5  # duration of a change of gains


class Stream(Section):
    """Set-points that a program sends while the joint moves (`jointctl.Joint.command`)."""

    delay_s: Annotated[float, between(0.002, 1.0)] = 0.03  # by which the joint follows behind them
    timeout_s: Annotated[float, between(0.002, 10.0)] = 0.1  # between two of them, after which the next is a new start
    client_timeout_s: Annotated[float, between(0.05, 3600.0)] = 1.0  # silence of the program that ends the run
    # "auto": half of what limits.torque_max_Nm gives the inertia beside joint.gravity_Nm
    acceleration_max_radps2: Annotated[float | Literal["auto"], auto_or_number(1e-6, 1e9)] = "auto"
    # from one to the next; "auto": limits.following_error_max_rad
    jump_max_rad: Annotated[float | Literal["auto"], auto_or_number(1e-9, 100.0)] = "auto"
    # on top of the law's; "auto": a fifth of limits.torque_max_Nm
    torque_max_Nm: Annotated[float | Literal["auto"], auto_or_number(0.0, 1e6)] = "auto"
    # of that torque; "auto": a tenth of limits.torque_rate_max_Nmps
    torque_rate_max_Nmps: Annotated[float | Literal["auto"], auto_or_number(1e-6, 1e9)] = "auto"


class Log(Section):
    folder: Annotated[str, Field(min_length=1)] = "runs"  # of the run logs, from where jointctl is started
    keep: Annotated[int, between(0, 100_000)] = 0  # newest runs to keep; 0 = all
    frames: bool = False  # record every CAN frame as well
    picture: bool = True  # of each run, beside its log; takes a second


def _checked(value: str) -> str:
    match = re.fullmatch(r"([0-9A-Fa-f]{4})(?::([0-9]{1,3}))?", value)
    if match is None or int(match[1], 16) < 0x2000 or int(match[2] or 0) > 254:
        raise PydanticCustomError("object", 'must be an object such as "60E4:1" (index in hexadecimal, sub-index)')
    return value


ObjectPlace = Annotated[str, AfterValidator(_checked)]


def _checked_limit(value: str) -> str:
    """No other object of CiA 402: what is written there may enable or move."""
    with contextlib.suppress(PydanticCustomError):
        index, sub = index_and_sub(_checked(value))
        if index < 0x6000 or (index, sub) == (0x6073, 0):
            return value
    raise PydanticCustomError("object", 'must be an object of the maker, 2000 to 5FFF, such as "3001:2", or "6073"')


LimitPlace = Annotated[str, AfterValidator(_checked_limit)]


def index_and_sub(place: str) -> tuple[int, int]:
    """(60E4h, 1) of "60E4:1"; sub-index 0 where none is named."""
    index, _, sub = place.partition(":")
    return int(index, 16), int(sub or 0)


# --- [joint_encoder]: a second encoder of the joint, on the drive or as a node of its own ---
# The comment behind a key is its meaning, as in `sections`.


class JointEncoder(Section):
    """A second encoder of the joint; [encoder] is the drive's own (6064)."""

    source: Literal["drive", "node"]  # another object of the drive, or an encoder node (CiA 406) on the bus
    object: ObjectPlace = "60E4:1"  # of the drive
    node: Node | None = None  # of the encoder node
    eds: Annotated[str, Field(min_length=1)] = "joint_encoder.eds"  # of the encoder node
    counts_per_turn: Annotated[int, between(4, 2**31 - 1)]  # of the joint
    direction: Direction  # of its counts against the joint angle
    zero_counts: Annotated[int, between(-(2**31), 2**32 - 1)]  # its reading at joint angle 0
    kind: Literal["absolute", "incremental"] = "absolute"  # incremental: it takes the angle of [encoder] at the start
    law: Literal["encoder", "joint_encoder"] = "joint_encoder"  # which of the two feeds the law
    limits: Literal["encoder", "joint_encoder", "both"] = "both"  # which one the position limits are checked with
    disagreement_max_rad: Annotated[float, between(0.0, 1.0, open_low=True)]  # between the two, at the joint
    # of the reducer between them: torque / stiffness is allowed in addition
    stiffness_Nmprad: Annotated[float, between(0.0, 1e9, open_low=True)] | None = None


# --- [reducer]: of a joint that is not rigid ---


class ReducerMap(Section):
    """Errors of the reducer and of the motor as sines of the motor angle, good for one mounting of its encoder."""

    direction: Direction  # encoder.direction when it was made
    zero_counts: Annotated[int, between(-(2**31), 2**31 - 1)]  # encoder.zero_counts when it was made
    kinematic_error_rad: Numbers = ()  # amplitudes, at the joint, by which the reducer's output is ahead
    kinematic_error_per_motor_turn: Numbers = ()  # periods of each
    kinematic_error_phase_rad: Numbers = ()  # of each
    torque_ripple_Nm: Numbers = ()  # amplitudes, at the joint, positive towards positive angle
    torque_ripple_per_motor_turn: Numbers = ()  # periods of each
    torque_ripple_phase_rad: Numbers = ()  # of each


class Ripple(Section):
    """Torque of motor and reducer that goes with the angle alone, for a law without [reducer]; see `map`."""

    direction: Direction  # encoder.direction when it was measured
    zero_counts: Annotated[int, between(-(2**31), 2**31 - 1)]  # encoder.zero_counts when it was measured
    torque_Nm: Numbers  # amplitudes, at the joint, positive towards positive angle, four at most
    per_motor_turn: Numbers  # periods of each; those of a joint turn divided by the ratio
    phase_rad: Numbers  # of each


class Reducer(Section):
    """What twists between motor and link; every value at the joint."""

    motor_inertia_kgm2: Annotated[float, between(0.0, 10_000.0, open_low=True)]  # of joint.inertia_kgm2
    stiffness_Nmprad: Annotated[float, between(0.0, 1e9, open_low=True)]  # under a steady torque, up to the first knee
    knees_Nm: PerKnee = ()  # transmitted torques beyond which it is stiffer
    stiffness_beyond_Nmprad: PerKnee = ()  # beyond each knee
    # of a small motion, which hysteresis makes stiffer; none = stiffness_Nmprad
    loop_stiffness_Nmprad: Annotated[float, between(0.0, 1e9, open_low=True)] | None = None
    damping_Nmspr: Annotated[float, between(0.0, 1e6)] = 0.0  # of a small motion
    link_friction_share: Annotated[float, between(0.0, 1.0)] = 0.0  # of [friction], that acts behind the reducer
    map: ReducerMap | None = None


# --- The [trajectory] section: one model per kind of motion; which keys exist depends on `kind` ---


Duration = Annotated[float, between(0.0, 1e6)]  # 0 = until stopped
Frequency = Annotated[float, between(0.0, 100.0, open_low=True)]
Time = Annotated[float, between(-1e6, 1e6)]
Move = Annotated[float, between(0.001, 1e5)]


class SineSwitch(Section):
    """The second sine, from at_s on."""

    at_s: Annotated[float, between(0.0, 1e6, open_low=True)]  # trajectory time
    amplitude_rad: Angle  # from then on
    frequency_Hz: Frequency  # from then on
    shift_s: Time  # from then on
    offset_rad: Angle  # from then on


class Sine(Section):
    kind: Literal["sine"]  # offset_rad + amplitude_rad sin(2 pi frequency_Hz (t + shift_s))
    duration_s: Duration  # 0 = until stopped
    amplitude_rad: Angle  # to each side of the offset
    frequency_Hz: Frequency  # of the sine
    shift_s: Time = 0.0  # earlier by this time
    offset_rad: Angle = 0.0  # middle of the motion
    switch: SineSwitch | None = None


class MinJerk(Section):
    kind: Literal["min_jerk"]  # from start to target without jerk at the ends
    duration_s: Duration  # 0 = until stopped
    start_rad: Angle  # where it begins
    target_rad: Angle  # where it ends
    move_s: Move  # of one move
    dwell_s: Annotated[float, between(0.0, 1e5)] = 0.0  # rest at each end
    repeat: bool = False  # back and forth


class Trapezoid(Section):
    kind: Literal["trapezoid"]  # from start to target at constant acceleration, speed, deceleration
    duration_s: Duration  # 0 = until stopped
    start_rad: Angle  # where it begins
    target_rad: Angle  # where it ends
    speed_radps: Annotated[float, between(0.0, 1000.0, open_low=True)]  # on the level part
    acceleration_radps2: Annotated[float, between(0.0, 1e5, open_low=True)]  # also of the deceleration
    # at most, over ten cycles at least; "auto": the acceleration jumps, with [reducer] over a period of the link on it
    jerk_radps3: Annotated[float | Literal["auto"], auto_or_number(1e-6, 1e9)] = "auto"
    dwell_s: Annotated[float, between(0.0, 1e5)] = 0.0  # rest at each end
    repeat: bool = False  # back and forth


class Table(Section):
    kind: Literal["table"]  # a cubic spline through the rows of a file
    duration_s: Duration  # 0 = until stopped
    file: Annotated[str, Field(min_length=1)]  # CSV beside the configuration: time_s,position_rad
    column: Annotated[str, Field(min_length=1)] = "position_rad"  # of the file, with the positions
    repeat: bool = False  # start again at the end, which must meet the beginning


class Hold(Section):
    kind: Literal["hold"]  # stand still
    duration_s: Duration  # 0 = until stopped
    position_rad: Angle = 0.0  # where to stand


Trajectory = Annotated[Sine | MinJerk | Trapezoid | Table | Hold, Field(discriminator="kind")]


# --- The [virtual] section: the true values of the virtual joint, which the controller does not know ---
# What is not repeated here (reduction ratio, torque constant, encoder) is taken from the other sections; inertia and
# friction are those of the controller times a scale: the difference is the model error under study.  With a table of
# its own, [virtual.friction], the joint has friction of which the controller knows nothing.  Keys have the names of
# `hil.plant_records.PlantSettings`, whose checks apply too.


OWN_KEYS = ("friction_kind", "inertia_scale", "friction", "faults", "brake")
MAX_FAULTS = 8
# by their names in `hil.faults`, which a run on hardware does not load
FAULT_KINDS = (
    "frames_lost", "sync_lost", "rpdo_lost", "tpdo_lost", "controller_heartbeat_lost", "drive_heartbeat_lost",
    "rpdo_delayed", "tpdo_delayed", "rpdo_duplicated", "tpdo_duplicated", "rpdo_reordered", "tpdo_reordered",
    "rpdo_corrupted", "tpdo_corrupted", "rpdo_length", "tpdo_length", "foreign_frames", "bus_off",
    "drive_reboot", "drive_fault", "encoder_stuck", "encoder_jump", "encoder_drift", "encoder_reversed",
    "torque_reversed", "torque_saturated", "current_loop_dead", "load_jump",
)  # fmt: skip
FAULT_KINDS_TEXT = "one of " + ", ".join(FAULT_KINDS)


def _kind(value: object) -> Any:
    if value not in FAULT_KINDS:
        raise PydanticCustomError("fault_kind", "must be {kinds}", {"kinds": FAULT_KINDS_TEXT})
    return value


class VirtualFault(Section):
    """One fault on purpose; what `magnitude` means for each kind is explained in `hil.faults`."""

    kind: Annotated[str, BeforeValidator(Rule(FAULT_KINDS_TEXT, _kind))]  # what goes wrong
    at_s: Annotated[float, between(0.0, 1e6)]  # after the power stage is on for the first time
    duration_s: Annotated[float, between(0.0, 1e6, open_low=True)] = 1e6  # how long
    magnitude: Annotated[float, between(-1e6, 1e6)] = 1.0  # its meaning for each kind is in hil/faults.py
    seed: Annotated[int, between(1, 2**31 - 1)] = 1  # of random ones


FAULTS_TEXT = f"a list of at most {MAX_FAULTS} faults"


def _faults(value: object) -> Any:
    """A list of tables as a tuple, which a frozen model needs."""
    if not isinstance(value, (list, tuple)) or len(value) > MAX_FAULTS:
        raise PydanticCustomError("faults", f"must be {FAULTS_TEXT}")
    return tuple(value)


class Virtual(Section):
    step_s: Annotated[float, between(1e-6, 1e-3)] = 50e-6  # of the plant's integration
    initial_position_rad: Annotated[float, between(-1000.0, 1000.0)] = 0.0  # where the joint stands at the start
    inertia_scale: Annotated[float, between(0.1, 10.0)] = 1.0  # true inertia over joint.inertia_kgm2
    brake: bool = True  # in an arm: one that is closed while the drive has no power; a single joint has none
    current_limit_A: Annotated[float, between(0.001, 10_000.0)] = 100.0  # of the motor
    current_lag_s: Annotated[float, between(0.0, 1.0)] = 0.0  # of the drive's current loop, first order
    command_delay_s: Annotated[float, between(0.0, 1.0)] = 0.0  # on top of the period that the synchronous RPDO takes
    torque_ripple_Nm: Numbers = ()  # amplitudes, at the joint
    torque_ripple_per_motor_turn: Numbers = ()  # periods of each
    torque_ripple_phase_rad: Numbers = ()  # of each
    friction_kind: Literal["none", "sign", "stick_slip", "lugre"]  # how it behaves around standstill
    friction_positive_scale: Annotated[float, between(0.0, 10.0)] = 1.0  # true friction over that of [friction]
    friction_negative_scale: Annotated[float, between(0.0, 10.0)] = 1.0  # the same, in the negative direction
    friction_ripple: Annotated[float, between(0.0, 0.9)] = 0.0  # relative amplitude
    friction_ripple_per_joint_turn: Annotated[float, between(0.0, 1e5)] = 18.0  # its periods
    bristle_stiffness_Nmprad: Annotated[float, between(1.0, 1e7)] = 8e4  # of friction_kind lugre
    bristle_damping_Nmspr: Annotated[float, between(0.0, 1e5)] = 200.0  # of friction_kind lugre
    flexible: bool = False  # motor and joint as two masses with the reducer between
    motor_side_inertia_kgm2: Annotated[float, between(1e-6, 1e4)] = 1.2  # at the joint; of joint.inertia_kgm2
    reducer_stiffness_Nmprad: Annotated[float, between(1.0, 1e8)] = 1.3e4  # with flexible = true
    reducer_damping_Nmspr: Annotated[float, between(0.0, 1e5)] = 5.0  # with flexible = true
    reducer_knees_Nm: PerKnee = ()  # transmitted torques beyond which the reducer is stiffer
    reducer_stiffness_beyond_Nmprad: PerKnee = ()  # beyond each knee
    hysteresis_width_rad: Annotated[float, between(0.0, 0.1)] = 0.0  # of the reducer's loop, twist at no torque
    kinematic_error_rad: Numbers = ()  # amplitudes, at the joint, by which the reducer's output is ahead
    kinematic_error_per_motor_turn: Numbers = ()  # periods of each
    kinematic_error_phase_rad: Numbers = ()  # of each
    link_friction_share: Annotated[float, between(0.0, 1.0)] = 0.0  # of the friction that acts behind the reducer
    load_torque_Nm: Annotated[float, between(-1e5, 1e5)] = 0.0  # constant, at the joint
    load_step_Nm: Annotated[float, between(-1e5, 1e5)] = 0.0  # a load from load_step_at_s on
    load_step_at_s: Annotated[float, between(0.0, 1e9)] = 80.0  # of the plant's own time
    gravity_Nm: Annotated[float, between(0.0, 1e5)] = 0.0  # m g l of m g l sin(q - gravity_zero_rad)
    gravity_zero_rad: Angle = 0.0  # joint angle at which gravity has no lever
    end_stops: bool = False  # springs at end_stop_min_rad and end_stop_max_rad
    end_stop_min_rad: Annotated[float, between(-1e4, 1e4)] = -3.0  # lower end stop
    end_stop_max_rad: Annotated[float, between(-1e4, 1e4)] = 3.0  # upper end stop
    end_stop_stiffness_Nmprad: Annotated[float, between(1.0, 1e8)] = 2e5  # of both springs
    end_stop_damping_Nmspr: Annotated[float, between(0.0, 1e5)] = 200.0  # of both springs
    thermal: bool = False  # friction falls as the joint warms up
    ambient_degC: Annotated[float, between(-60.0, 100.0)] = 25.0  # around the joint
    heating_KpA2: Annotated[float, between(0.0, 1e3)] = 0.5  # final warming per squared current
    thermal_time_s: Annotated[float, between(1.0, 1e6)] = 900.0  # time constant
    friction_per_kelvin: Annotated[float, between(-0.05, 0.05)] = -0.005  # relative change
    encoder_noise_counts: Annotated[float, between(0.0, 1e6)] = 0.0  # standard deviation
    encoder_seed: Annotated[int, between(1, 2**31 - 1)] = 1  # of the noise
    # an encoder on the motor reads a sine too much, once a turn: radians of the motor
    motor_encoder_eccentricity_rad: Annotated[float, between(0.0, 0.1)] = 0.0
    motor_encoder_eccentricity_phase_rad: Annotated[float, between(-100.0, 100.0)] = 0.0  # of that sine
    joint_encoder_eccentricity_rad: Annotated[float, between(0.0, 0.1)] = 0.0  # the same of one on the joint
    joint_encoder_eccentricity_phase_rad: Annotated[float, between(-100.0, 100.0)] = 0.0  # of that sine
    friction: Friction | None = None  # The true curve, if it is not that of [friction].
    faults: Annotated[tuple[VirtualFault, ...], BeforeValidator(Rule(FAULTS_TEXT, _faults))] = ()
