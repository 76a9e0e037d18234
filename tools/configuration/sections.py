"""The sections of a configuration file, each a frozen pydantic model; the unit of a quantity is in its key.

Ranges are wide on purpose: they catch a wrong unit or a slip of the finger, not a bold choice.  What only shows
between two sections is checked in `config_checks`; conversion to the controller's records is in `config_records`.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field
from pydantic_core import PydanticCustomError

from firmware_py.records import NEURONS


def interval_text(low: float, high: float, open_low: bool = False) -> str:
    return f"{'(' if open_low else '['}{low:g}..{high:g}]"


def between(low: float, high: float, *, open_low: bool = False) -> Any:
    """Validator of one number; `open_low` excludes the lower end."""

    def check(value: float) -> float:
        if value < low or value > high or (open_low and value == low):
            raise PydanticCustomError(
                "range", "must be in {interval}", {"interval": interval_text(low, high, open_low)}
            )
        return value

    return AfterValidator(check)


def _auto_or_number(low: float, high: float) -> Any:
    def check(value: Any) -> Any:
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if value == "auto" or (number and low <= value <= high):
            return value
        raise PydanticCustomError("range", 'must be "auto" or in {interval}', {"interval": interval_text(low, high)})

    return BeforeValidator(check)


def _numbers(name: str, *counts: int, low: float, high: float) -> Any:
    """One number or a list of as many as `counts` allows, each in (low..high]; a tuple afterwards."""

    def check(value: Any) -> tuple[float, ...]:
        items = value if isinstance(value, (list, tuple)) else [value]
        good = all(isinstance(x, (int, float)) and not isinstance(x, bool) and low < x <= high for x in items)
        if not good or len(items) not in counts:
            raise PydanticCustomError(
                "numbers",
                "must be {counts} {name}, each in {interval}",
                {"counts": " or ".join(map(str, counts)), "name": name, "interval": interval_text(low, high, True)},
            )
        return tuple(float(x) for x in items)

    return BeforeValidator(check)


def _centres(value: Any) -> Any:
    """15 numbers, taken for both inputs as the paper does, or 15 pairs [rad, rad/s]."""

    def number(x: Any) -> bool:
        return isinstance(x, (int, float)) and not isinstance(x, bool) and abs(x) <= 100.0

    if isinstance(value, (list, tuple)) and len(value) == NEURONS:
        if all(number(x) for x in value):
            return tuple((float(x), float(x)) for x in value)
        if all(isinstance(x, (list, tuple)) and len(x) == 2 and all(number(y) for y in x) for x in value):
            return tuple((float(x[0]), float(x[1])) for x in value)
    raise PydanticCustomError("centres", "must be 15 numbers or 15 pairs [rad, rad/s], each in [-100..100]")


Direction = Annotated[int, AfterValidator(lambda value: _direction(value))]
Node = Annotated[int, between(1, 127)]
Identity = Annotated[int, between(0, 0xFFFFFFFF)]
Angle = Annotated[float, between(-1000.0, 1000.0)]
Ampere = Literal["sine_amplitude", "rms"]


def _direction(value: int) -> int:
    if value not in (-1, 1):
        raise PydanticCustomError("direction", "must be 1 or -1")
    return value


class Section(BaseModel):
    """Frozen, no unknown keys, no conversion of types (1 and "1" differ), no nan and no inf."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Bus(Section):
    interface: Annotated[str, Field(min_length=1)]  # python-can's name; "jointctl" is the virtual bus
    channel: Annotated[str, Field(min_length=1)]
    bitrate_bitps: Annotated[int, between(10_000, 1_000_000)]


class Drive(Section):
    kind: Literal["canopen"]
    node: Node
    eds: Annotated[str, Field(min_length=1)]  # beside the configuration file, or the name of a shipped one
    mode: Literal["cst", "tq", "auto"]
    vendor_id: Identity | None = None  # expected; None = any
    product_code: Identity | None = None
    rated_current_A: Annotated[float, between(0.0, 1000.0, open_low=True)] | None = None  # compared with 6075
    rated_torque_Nm: Annotated[float, between(0.0, 10_000.0, open_low=True)] | None = None  # motor; compared with 6076
    rated_tolerance: Annotated[float, between(0.0, 0.2)] = 0.01  # of the two comparisons, relative
    torque_reference: Literal["rated_torque", "rated_current"]  # what 1000 permille of 6071 and 6077 mean
    ampere: Ampere = "sine_amplitude"  # of the drive's amperes
    max_torque_permille: Annotated[int, between(1, 10_000)] | None = None  # 6072; None = derived from torque_max_Nm
    torque_direction: Direction = 1  # -1: positive motor torque drives the joint to negative angles
    velocity_unit: Literal["counts/s", "r/min", "0.1 r/min"] = "counts/s"  # of 60FF; counts of 6064, r/min of the motor
    heartbeat_s: Annotated[float, between(0.01, 2.0)]  # the drive stops itself when our heartbeat is older
    master_node: Node = 126  # whose heartbeat the drive watches
    quick_stop_option: Annotated[int, between(0, 8)] = 2  # 605A
    rpdo_transmission_type: Annotated[int, between(0, 255)] = 1


class Encoder(Section):
    counts_per_turn: Annotated[int, between(4, 2**31 - 1)]
    side: Literal["joint", "motor"]
    direction: Direction
    zero_counts: Annotated[int, between(-(2**31), 2**31 - 1)]  # the drive's reading at joint angle 0


class Joint(Section):
    reduction_ratio: Annotated[float, between(1.0, 1000.0)]
    inertia_kgm2: Annotated[float, between(0.0, 10_000.0, open_low=True)]  # at the joint, motor included
    torque_constant_NmpA: Annotated[float, between(0.0, 100.0, open_low=True)]  # motor
    torque_constant_ampere: Ampere = "sine_amplitude"
    coriolis_Nmspr: Annotated[float, between(0.0, 10_000.0)] = 0.0
    gravity_Nm: Annotated[float, between(-10_000.0, 10_000.0)] = 0.0  # gravity_Nm sin(q - gravity_zero_rad)
    gravity_zero_rad: Angle = 0.0


class Limits(Section):
    position_min_rad: Angle
    position_max_rad: Angle
    velocity_max_radps: Annotated[float, between(0.0, 1000.0, open_low=True)]
    torque_max_Nm: Annotated[float, between(0.0, 100_000.0, open_low=True)]
    torque_rate_max_Nmps: Annotated[float, between(0.0, 1e8, open_low=True)]
    following_error_max_rad: Annotated[float, between(0.0, 10.0, open_low=True)]
    position_jump_max_rad: Annotated[float, between(0.0, 10.0, open_low=True)]
    sample_age_max_s: Annotated[float, between(0.0, 1.0, open_low=True)]
    saturation_max_s: Annotated[float, between(0.0, 60.0, open_low=True)]
    skipped_max_s: Annotated[float, between(0.0, 1.0, open_low=True)]
    standstill_radps: Annotated[float, between(0.0, 10.0, open_low=True)]


class Sequence(Section):
    approach_s: Annotated[float | Literal["auto"], _auto_or_number(0.0, 600.0)]  # 0 = start where the joint stands
    brake_radps2: Annotated[float, between(0.0, 10_000.0, open_low=True)]
    release_s: Annotated[float, between(0.0, 60.0)]
    settle_s: Annotated[float, between(0.0, 10.0, open_low=True)]  # good samples in a row before enabling
    wait_timeout_s: Annotated[float, between(0.0, 600.0, open_low=True)]
    enable_timeout_s: Annotated[float, between(0.0, 60.0, open_low=True)]
    stop_timeout_s: Annotated[float, between(0.0, 60.0, open_low=True)]
    off_timeout_s: Annotated[float, between(0.0, 60.0, open_low=True)]
    supervisor_timeout_s: Annotated[float, between(0.02, 60.0)]


class Loop(Section):
    rate_Hz: Annotated[float, between(10.0, 10_000.0)]  # narrower over CAN, see config_checks
    cpu: Annotated[int, between(0, 1023)] | None = None
    priority: Annotated[int, between(1, 98)] | None = None  # SCHED_FIFO; None = ordinary scheduling


class Learning(Section):
    """Iterative learning on a repeating trajectory, on top of computed_torque_observer."""

    gain: Annotated[float, between(0.0, 1.0, open_low=True)]
    error_gain_ps2: Annotated[float, between(0.0, 1e6)] = 0.0  # [1/s^2], weight of the error itself
    lead_cycles: Annotated[int, between(0, 100)]  # delay from command to measured effect
    half_width_cycles: Annotated[int, between(0, 100)]  # of the smoothing
    blend_s: Annotated[float, between(0.001, 100.0)] = 0.5


class Control(Section):
    kind: Literal["computed_torque", "computed_torque_rbf", "computed_torque_observer", "pid"]
    kp: Annotated[float, between(0.0, 1e6, open_low=True)]  # [1/s^2]
    kv: Annotated[float, between(0.0, 1e4, open_low=True)]  # [1/s]
    ki: Annotated[float, between(0.0, 1e8)] = 0.0  # [1/s^3], pid only
    integral_limit_rads: Annotated[float, between(0.0, 1e3)] = 0.0  # pid only, 0 = none
    observer_radps: Annotated[float, between(0.0, 2000.0)] = 0.0  # bandwidth, computed_torque_observer only
    observer_delay_cycles: Annotated[int, between(0, 15)] = 1  # from a command to its torque
    q: Annotated[tuple[float, ...], _numbers("numbers", 1, 2, low=0.0, high=1e12)]  # Q = q I, or diag(q1, q2)
    learning_rate: Annotated[float, between(0.0, 1e9)]
    initial_weight_Nm: Annotated[float, between(-1000.0, 1000.0)]
    widths: Annotated[tuple[float, ...], _numbers("widths", 1, NEURONS, low=0.0, high=1e4)]
    centres: Annotated[tuple[tuple[float, float], ...], BeforeValidator(_centres)] | None = None  # None = the paper's
    leakage_1ps: Annotated[float, between(0.0, 100.0)] = 0.0
    weight_limit_Nm: Annotated[float, between(0.0, 1e6)] = 0.0
    dead_zone_rad: Annotated[float, between(0.0, 1.0)] = 0.0
    feed_forward: Literal["none", "measured", "desired", "lugre_desired"]
    zero_rule: Literal["zero", "paper", "linear"]
    zero_band_radps: Annotated[float, between(0.0, 10.0)] = 0.0
    velocity_cutoff_Hz: Annotated[float, between(0.0, 2000.0)]  # 0 = no filter
    matched_filter: bool
    learning: Learning | None = None


class FrictionDirection(Section):
    """One column of Table 3, with the signs printed there."""

    tc_Nm: Annotated[float, between(0.0, 10_000.0)]
    ts_Nm: Annotated[float, between(0.0, 10_000.0)]
    ws: Annotated[float, between(0.0, 1e5, open_low=True)]
    tv: Annotated[float, between(-1e4, 1e4)]
    a0: Annotated[float, between(-1e4, 1e4)]
    a1: Annotated[float, between(-1e4, 1e4)]
    a2: Annotated[float, between(-1e4, 1e4)]
    a3: Annotated[float, between(-1e4, 1e4)]
    knee: Annotated[float, between(-1e5, 1e5)]
    max: Annotated[float, between(-1e5, 1e5)]


class LuGre(Section):
    """Bristles, at the joint."""

    stiffness_Nmprad: Annotated[float, between(0.0, 1e9, open_low=True)]
    damping_Nmspr: Annotated[float, between(0.0, 1e6)]


class Friction(Section):
    velocity_unit: Literal["deg/s", "rad/s", "r/min"]
    velocity_side: Literal["joint", "motor"]
    torque_side: Literal["motor", "joint"]
    positive: FrictionDirection
    negative: FrictionDirection
    lugre: LuGre | None = None


class Margin(Section):
    """What `check` computes with, and below what `run` refuses to enable."""

    min_phase_margin_deg: Annotated[float, between(0.0, 90.0)] = 20.0
    loop_delay_s: Annotated[float, between(0.0, 0.1)] | None = (
        None  # from the position sample to the torque; None = from the RPDO type
    )
    current_lag_s: Annotated[float, between(0.0, 0.1)] = 0.0005


class Log(Section):
    folder: Annotated[str, Field(min_length=1)] = "runs"
    keep: Annotated[int, between(0, 100_000)] = 0  # newest runs to keep; 0 = all
    frames: bool = False  # record every CAN frame as well
