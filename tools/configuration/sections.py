"""The sections of a configuration file, each a frozen pydantic model; the unit of a quantity is in its key.

Ranges are wide on purpose: they catch a wrong unit or a slip of the finger, not a bold choice.  What only shows
between two sections is checked in `checks`; conversion to the controller's records is in `records`.
The comment behind a key, or above it, is its meaning: docs/configuration.md is made from it (`reference`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field
from pydantic_core import PydanticCustomError

from jointctl.firmware_py.records import NEURONS
from jointctl.tools.configuration.bus_options import ALLOWED, checked_options
from jointctl.tools.configuration.object_place import ObjectPlace


def interval_text(low: float, high: float, open_low: bool = False) -> str:
    return f"{'(' if open_low else '['}{low:g}..{high:g}]"


@dataclass(frozen=True)
class Rule:
    """What one value must be: a validator for pydantic, and in words for the reference."""

    allowed: str
    check: Callable[[Any], Any]

    def __call__(self, value: Any) -> Any:
        return self.check(value)


def between(low: float, high: float, *, open_low: bool = False) -> Any:
    """Validator of one number; `open_low` excludes the lower end."""
    interval = interval_text(low, high, open_low)

    def check(value: float) -> float:
        if value < low or value > high or (open_low and value == low):
            raise PydanticCustomError("range", "must be in {interval}", {"interval": interval})
        return value

    return AfterValidator(Rule(interval, check))


def _auto_or_number(low: float, high: float) -> Any:
    allowed = f'"auto" or in {interval_text(low, high)}'

    def check(value: Any) -> Any:
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if value == "auto" or (number and low <= value <= high):
            return value
        raise PydanticCustomError("range", "must be {allowed}", {"allowed": allowed})

    return BeforeValidator(Rule(allowed, check))


def _numbers(name: str, *counts: int, low: float, high: float) -> Any:
    """One number or a list of as many as `counts` allows, each in (low..high]; a tuple afterwards."""
    allowed = f"{' or '.join(map(str, counts))} {name}, each in {interval_text(low, high, True)}"

    def check(value: Any) -> tuple[float, ...]:
        items = value if isinstance(value, (list, tuple)) else [value]
        good = all(isinstance(x, (int, float)) and not isinstance(x, bool) and low < x <= high for x in items)
        if not good or len(items) not in counts:
            raise PydanticCustomError("numbers", "must be {allowed}", {"allowed": allowed})
        return tuple(float(x) for x in items)

    return BeforeValidator(Rule(allowed, check))


CENTRES = "15 numbers or 15 pairs [rad, rad/s], each in [-100..100]"


def _centres(value: Any) -> Any:
    """15 numbers, taken for both inputs as the paper does, or 15 pairs [rad, rad/s]."""

    def number(x: Any) -> bool:
        return isinstance(x, (int, float)) and not isinstance(x, bool) and abs(x) <= 100.0

    if isinstance(value, (list, tuple)) and len(value) == NEURONS:
        if all(number(x) for x in value):
            return tuple((float(x), float(x)) for x in value)
        if all(isinstance(x, (list, tuple)) and len(x) == 2 and all(number(y) for y in x) for x in value):
            return tuple((float(x[0]), float(x[1])) for x in value)
    raise PydanticCustomError("centres", "must be {allowed}", {"allowed": CENTRES})


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


class Bus(Section):
    interface: Annotated[str, Field(min_length=1)]  # python-can's name; "jointctl" is the virtual bus
    # as the interface names it: can0, PCAN_USBBUS1; the virtual bus' own name
    channel: Annotated[str, Field(min_length=1)]
    bitrate_bitps: Annotated[int, between(10_000, 1_000_000)]  # must be the drive's; 1 kHz needs 500 kbit/s or more
    # what the interface needs besides, such as `{ host = "192.168.1.5", port = 29536 }` for socketcand
    options: Annotated[dict[str, Any], BeforeValidator(Rule(ALLOWED, checked_options))] | None = None


class Drive(Section):
    kind: Literal["canopen"]  # a CiA 402 drive on CANopen
    node: Node  # CANopen node of the drive
    eds: Annotated[str, Field(min_length=1)]  # beside the configuration file, or the name of a shipped one
    mode: Literal["cst", "tq", "auto"]  # torque mode: cyclic synchronous, profile, or what 6502 offers
    vendor_id: Identity | None = None  # expected in 1018:1; none = any
    product_code: Identity | None = None  # expected in 1018:2; none = any
    rated_current_A: Annotated[float, between(0.0, 1000.0, open_low=True)] | None = None  # compared with 6075
    rated_torque_Nm: Annotated[float, between(0.0, 10_000.0, open_low=True)] | None = None  # motor; compared with 6076
    rated_tolerance: Annotated[float, between(0.0, 0.2)] = 0.01  # of the comparisons with 6075 and 6076, relative
    torque_reference: Literal["rated_torque", "rated_current"]  # what 1000 permille of 6071 and 6077 mean
    ampere: Ampere = "sine_amplitude"  # of the drive's amperes
    max_torque_permille: Annotated[int, between(1, 10_000)] | None = None  # 6072; none = derived from torque_max_Nm
    torque_direction: Direction = 1  # -1: positive motor torque drives the joint to negative angles
    velocity_unit: Literal["counts/s", "r/min", "0.1 r/min"] = "counts/s"  # of 60FF; counts of 6064, r/min of the motor
    heartbeat_s: Annotated[float, between(0.01, 2.0)]  # the drive stops itself when our heartbeat is older
    master_node: Node = 126  # whose heartbeat the drive watches
    boot_timeout_s: Annotated[float, between(0.0, 60.0)] = 3.0  # for the first answer, and for leaving Not Ready
    sdo_timeout_s: Annotated[float, between(0.02, 10.0)] | None = None  # of one SDO request (three times); None = 0.3 s
    quick_stop_option: Annotated[int, between(0, 8)] = 2  # 605A: 2 = brake on the quick stop ramp, then power off
    # 1 = the torque is taken over at the next SYNC, 254/255 = at once
    rpdo_transmission_type: Annotated[int, between(0, 255)] = 1
    temperature_object: ObjectPlace | None = None  # the drive's own, "2103"; read once a second, to be shown and logged
    temperature_unit_degC: Annotated[float, between(0.0, 1000.0, open_low=True)] = 1.0  # of one count of it
    temperature_offset_degC: Annotated[float, between(-1000.0, 1000.0)] = 0.0  # at 0 counts; -273.15 for kelvin


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
    sample_age_max_s: Annotated[float, between(0.0, 1.0, open_low=True)]  # without a new position for longer: fault
    # at the torque limit for longer means blocked
    saturation_max_s: Annotated[float, between(0.0, 60.0, open_low=True)]
    skipped_max_s: Annotated[float, between(0.0, 1.0, open_low=True)]  # periods lost in one overrun: more is a fault
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
    approach_s: Annotated[float | Literal["auto"], _auto_or_number(0.0, 600.0)]
    brake_radps2: Annotated[float, between(0.0, 10_000.0, open_low=True)]  # of a controlled stop
    release_s: Annotated[float, between(0.0, 60.0)]  # torque to zero at standstill
    settle_s: Annotated[float, between(0.0, 10.0, open_low=True)]  # good samples in a row before enabling
    wait_timeout_s: Annotated[float, between(0.0, 600.0, open_low=True)]  # for the first good samples
    # for the drive to switch on, its brake included
    enable_timeout_s: Annotated[float, between(0.0, 60.0, open_low=True)]
    stop_timeout_s: Annotated[float, between(0.0, 60.0, open_low=True)]  # for a stop, then the power goes
    off_timeout_s: Annotated[float, between(0.0, 60.0, open_low=True)]  # for the drive to say that it is off
    # the loop stops the joint when its supervisor is silent for longer
    supervisor_timeout_s: Annotated[float, between(0.02, 60.0)]


class Loop(Section):
    rate_Hz: Annotated[float, between(10.0, 10_000.0)]  # over CAN [100..4000], and what the bus carries
    cpu: Annotated[int, between(0, 1023)] | None = None  # processor of the loop (isolcpus); none = any
    priority: Annotated[int, between(1, 98)] | None = None  # SCHED_FIFO; none = ordinary scheduling


class Learning(Section):
    """Iterative learning on a repeating trajectory, on top of computed_torque_observer."""

    # share of the remaining error torque taken over in each repetition
    gain: Annotated[float, between(0.0, 1.0, open_low=True)]
    error_gain_ps2: Annotated[float, between(0.0, 1e6)] = 0.0  # weight of the error itself
    lead_cycles: Annotated[int, between(0, 100)]  # delay from command to measured effect
    half_width_cycles: Annotated[int, between(0, 100)]  # of the smoothing
    blend_s: Annotated[float, between(0.001, 100.0)] = 0.5  # over which what has been learned comes in


class Control(Section):
    kind: Literal["computed_torque", "computed_torque_rbf", "computed_torque_observer", "pid"]  # docs/law.md
    kp: Annotated[float, between(0.0, 1e6, open_low=True)]  # [1/s²] of the position error
    kv: Annotated[float, between(0.0, 1e4, open_low=True)]  # [1/s] of the velocity error
    ki: Annotated[float, between(0.0, 1e8)] = 0.0  # [1/s³] of the error's integral, pid only
    integral_limit_rads: Annotated[float, between(0.0, 1e3)] = 0.0  # pid only, 0 = none
    observer_radps: Annotated[float, between(0.0, 2000.0)] = 0.0  # bandwidth, computed_torque_observer only
    observer_delay_cycles: Annotated[int, between(0, 15)] = 1  # from a command to its torque
    # of the Lyapunov equation: Q = q I, or diag(q1, q2)
    q: Annotated[tuple[float, ...], _numbers("numbers", 1, 2, low=0.0, high=1e12)]
    learning_rate: Annotated[float, between(0.0, 1e9)]  # of the network's weights
    initial_weight_Nm: Annotated[float, between(-1000.0, 1000.0)]  # of each of the 15 neurons
    widths: Annotated[tuple[float, ...], _numbers("widths", 1, NEURONS, low=0.0, high=1e4)]  # of the Gaussians
    centres: Annotated[tuple[tuple[float, float], ...], BeforeValidator(Rule(CENTRES, _centres))] | None = (
        None  # none = the paper's
    )
    leakage_1ps: Annotated[float, between(0.0, 100.0)] = 0.0  # pulls the weights to zero: bounded under noise
    weight_limit_Nm: Annotated[float, between(0.0, 1e6)] = 0.0  # of each weight; 0 = none
    dead_zone_rad: Annotated[float, between(0.0, 1.0)] = 0.0  # no learning at smaller errors
    # friction compensation by measured or desired velocity
    feed_forward: Literal["none", "measured", "desired", "lugre_desired"]
    zero_rule: Literal["zero", "paper", "linear"]  # friction compensation at exactly zero velocity
    zero_band_radps: Annotated[float, between(0.0, 10.0)] = 0.0  # half width of the linear zero rule
    velocity_cutoff_Hz: Annotated[float, between(0.0, 2000.0)]  # 0 = no filter
    matched_filter: bool  # filter the velocity error as a whole: no bias from the filter's lag
    learning: Learning | None = None


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


class Friction(Section):
    velocity_unit: Literal["deg/s", "rad/s", "r/min"]  # of ws, tv, a0..a3, knee and max
    velocity_side: Literal["joint", "motor"]  # of the velocity
    torque_side: Literal["motor", "joint"]  # of the torques
    positive: FrictionDirection
    negative: FrictionDirection
    lugre: LuGre | None = None


class Margin(Section):
    """What `check` computes with, and below what `run` refuses to enable."""

    min_phase_margin_deg: Annotated[float, between(0.0, 90.0)] = 20.0  # run refuses to enable below it
    loop_delay_s: Annotated[float, between(0.0, 0.1)] | None = (
        None  # from the position sample to the torque; none = from the RPDO type
    )
    current_lag_s: Annotated[float, between(0.0, 0.1)] = 0.0005  # of the drive's current loop, first order


class Live(Section):
    """What the live page may change while the joint moves."""

    gain_factor: Annotated[float, between(1.0, 10.0)] = 2.0  # gains: configured / factor .. configured * factor
    ramp_s: Annotated[float, between(0.05, 60.0)] = 0.5  # duration of a change of gains


class Log(Section):
    folder: Annotated[str, Field(min_length=1)] = "runs"  # of the run logs, from where jointctl is started
    keep: Annotated[int, between(0, 100_000)] = 0  # newest runs to keep; 0 = all
    frames: bool = False  # record every CAN frame as well
    picture: bool = True  # of each run, beside its log; takes a second
