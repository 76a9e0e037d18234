"""What commissioning has to know about one CANopen joint, in the units of the configuration."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from jointctl.drivers.errors import DeviceError

DRIVE_RANGE_COUNTS = 1 << 32  # of an object of the drive: a signed 32 bit number that runs over
LONGEST_PERIOD = 255  # of 60C2:1


def interpolation_period(rate_Hz: float) -> tuple[int, int]:
    """(60C2:1, 60C2:2): the period as value x 10^exponent s; `DeviceError` where there is no such value."""
    value, exponent = round(1e6 / rate_Hz), -6
    while value % 10 == 0 and exponent < 0:
        value //= 10
        exponent += 1
    if value > LONGEST_PERIOD:
        raise DeviceError(f"loop.rate_Hz (={rate_Hz:g}) has no 60C2 value: the period must be 1..255 x 10^n s")
    return value, exponent


@dataclass(frozen=True)
class JointEncoderSettings:
    """An encoder node of its own (`node`), else the object of the drive that holds its position."""

    counts_per_turn: int  # of the joint
    direction: int
    zero_counts: int
    incremental: bool  # it takes the angle of the other encoder when a run begins
    feeds_law: bool
    node: int | None = None
    eds_path: Path | None = None  # of the node
    index: int = 0x60E4
    sub: int = 1

    @property
    def rad_per_count(self) -> float:
        """Joint angle of one count, direction included."""
        return self.direction * math.tau / self.counts_per_turn


@dataclass(frozen=True)
class TemperatureObject:
    """Which object holds the temperature: `unit_degC` times its value, and `offset_degC`."""

    index: int
    sub: int = 0
    unit_degC: float = 1.0
    offset_degC: float = 0.0


@dataclass(frozen=True)
class TorqueLimitObject:
    """The maker's own object that limits torque or current: it holds `rated_counts` where 6071 holds 1000 permille."""

    index: int
    sub: int
    rated_counts: float


@dataclass(frozen=True)
class CanopenSettings:
    """See the sections [drive], [encoder] and [joint] of the configuration."""

    node: int
    eds_path: Path
    mode: str  # a key of `commissioning.MODES`
    rate_Hz: float
    heartbeat_s: float
    master_node: int
    quick_stop_option: int
    rpdo_transmission_type: int
    torque_reference: str  # "rated_torque" or "rated_current"
    torque_direction: int
    torque_max_Nm: float  # at the joint
    torque_constant_NmpA: float  # motor torque per ampere as the drive counts amperes
    reduction_ratio: float
    counts_per_turn: int
    encoder_on_motor: bool
    encoder_direction: int
    zero_counts: int
    vendor_id: int | None = None
    product_code: int | None = None
    rated_current_A: float | None = None
    rated_torque_Nm: float | None = None
    rated_torque_unit: str = "mNm"  # of 6076: a key of `pdo.RATED_TORQUE_UNITS_mNm`
    rated_tolerance: float = 0.01
    max_torque_permille: int | None = None
    velocity_unit: str = "counts/s"  # of 60FF: a key of `pdo.VELOCITY_UNITS`
    torque_rate_max_Nmps: float = 0.0  # of the loop, at the joint; what a torque slope (6087) must follow
    boot_timeout_s: float = 0.0  # how long a drive may take to answer and to leave Not Ready to Switch On
    joint_encoder: JointEncoderSettings | None = None
    encoder_incremental: bool = False
    sdo_timeout_s: float | None = None  # of one SDO request; None: `switch_off.SDO_TIMEOUT_S`
    velocity_max_radps: float | None = None  # at the joint, also for the drive's own limit in the velocity modes
    torque_offset: bool = False  # 60B2 beside the target of a drive that closes its own loop
    velocity_offset: bool = False  # 60B1 beside 607A
    velocity_share: float = 1.0  # of the target's velocity that goes into 60B1
    following_error_max_rad: float = 0.0  # at the joint, for the drive's own window in CSP
    holds_alone: bool = False  # a run in which the drive would hold the joint by itself if no one stopped it
    temperature: TemperatureObject | None = None  # the object that holds it, if any
    stop_timeout_s: float = 0.0  # how long the drive may brake by itself until its power is taken
    off_timeout_s: float = 0.0  # how long it may take then until it is off, its brake included
    brake_radps2: float = 0.0  # at the joint, of the loop's controlled stop; the drive's own is compared with it
    position_min_rad: float = -math.inf
    position_max_rad: float = math.inf
    torque_limit: TorqueLimitObject | None = None  # where the drive has no 6072, or beside it
