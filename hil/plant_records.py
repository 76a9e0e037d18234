"""Records of the virtual joint: what the plant is made of, before any of it moves.

Every torque is at the joint (low-velocity side) unless the name says otherwise.  What a person writes is
`PlantSettings`; `PlantConstants` is what the kernels read (reciprocals and factors worked out once).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from enum import IntEnum
from numbers import Integral, Real
from typing import Annotated, Any

import numpy as np

from jointctl.firmware_py.records import HARMONICS, KNEES, FrictionConstants, HarmonicSeries
from jointctl.firmware_py.schema import array_of, dtype_of, f8, i4, i8, record

DELAY_SLOTS = 1024  # the command delay is below this many substeps

u8 = Annotated[int, np.dtype("<u8")]


class FrictionKind(IntEnum):
    """How the sliding curve (11) becomes a friction torque."""

    NONE = 0
    SIGN = 1  # the curve at the present velocity, zero at exactly zero velocity
    STICK_SLIP = 2  # set-valued at zero velocity: holds up to the static friction
    LUGRE = 3  # bristle deflection


class EncoderSide(IntEnum):
    """Which shaft the encoder sits on."""

    JOINT = 0
    MOTOR = 1


# --- What a person writes: physical values, each with its range, checked once ---


SELF_LOCKING = 0.9  # Coulomb friction for each Nm that the reducer transmits


def _allowed(name: str, value: object, allowed: str) -> ValueError:
    shown = list(value) if isinstance(value, tuple) else value  # as TOML has it
    return ValueError(f"{name} (={shown}) must be {allowed}")


def number(default: float, low: float, high: float) -> Any:
    """Field of a number in [low..high]."""
    return field(default=default, metadata={"range": (Real, low, high)})


def whole(default: int, low: int, high: int) -> Any:
    """The same of a whole number."""
    return field(default=default, metadata={"range": (Integral, low, high)})


@dataclass(frozen=True, kw_only=True)
class PlantSettings:
    """A virtual joint in physical values; the default is an ideal one: no friction, lag, ripple, load or noise.

    Torque ripple i is ``torque_ripple_Nm[i] sin(torque_ripple_per_motor_turn[i] theta_m + torque_ripple_phase_rad[i])``
    (phases may be left out), and so is the kinematic error of a flexible joint's reducer.  `friction` is a
    FrictionConstants record, None meaning the paper's Table 3.  `inertia_kgm2` is the whole joint's; a flexible joint
    has `motor_side_inertia_kgm2` of it before the reducer, and the share `link_friction_share` of the friction behind.
    The reducer's stiffness is `reducer_stiffness_Nmprad` up to the first of `reducer_knees_Nm`, then each of
    `reducer_stiffness_beyond_Nmprad`; `hysteresis_width_rad` is that of its loop at no torque.
    """

    step_s: float = number(50e-6, 1e-6, 1e-3)
    initial_position_rad: float = number(0.0, -1e4, 1e4)
    inertia_kgm2: float = number(2.1, 1e-6, 1e4)
    reduction_ratio: float = number(121.0, 1.0, 1000.0)
    torque_constant_NmpA: float = number(0.1, 1e-4, 100.0)  # motor side; not given in the paper
    current_limit_A: float = number(100.0, 1e-3, 1e4)
    current_lag_s: float = number(0.0, 0.0, 1.0)
    command_delay_s: float = number(0.0, 0.0, 1.0)
    torque_ripple_Nm: tuple[float, ...] = ()
    torque_ripple_per_motor_turn: tuple[float, ...] = ()
    torque_ripple_phase_rad: tuple[float, ...] = ()
    friction_kind: FrictionKind = FrictionKind.NONE
    friction: Any = None
    friction_positive_scale: float = number(1.0, 0.0, 10.0)
    friction_negative_scale: float = number(1.0, 0.0, 10.0)
    friction_ripple: float = number(0.0, 0.0, 0.9)  # relative amplitude
    friction_ripple_per_joint_turn: float = number(18.0, 0.0, 1e5)
    bristle_stiffness_Nmprad: float = number(8e4, 1.0, 1e7)
    bristle_damping_Nmspr: float = number(200.0, 0.0, 1e5)
    flexible: bool = False
    motor_side_inertia_kgm2: float = number(1.2, 1e-6, 1e4)
    reducer_stiffness_Nmprad: float = number(1.3e4, 1.0, 1e8)
    reducer_damping_Nmspr: float = number(5.0, 0.0, 1e5)
    reducer_knees_Nm: tuple[float, ...] = ()
    reducer_stiffness_beyond_Nmprad: tuple[float, ...] = ()
    hysteresis_width_rad: float = number(0.0, 0.0, 0.1)
    kinematic_error_rad: tuple[float, ...] = ()
    kinematic_error_per_motor_turn: tuple[float, ...] = ()
    kinematic_error_phase_rad: tuple[float, ...] = ()
    link_friction_share: float = number(0.0, 0.0, 1.0)
    load_torque_Nm: float = number(0.0, -1e5, 1e5)
    load_step_Nm: float = number(0.0, -1e5, 1e5)
    load_step_at_s: float = number(80.0, 0.0, 1e9)
    gravity_Nm: float = number(0.0, 0.0, 1e5)  # m g l of m g l sin(q - gravity_zero_rad)
    gravity_zero_rad: float = number(0.0, -1e3, 1e3)
    end_stops: bool = False
    end_stop_min_rad: float = number(-3.0, -1e4, 1e4)
    end_stop_max_rad: float = number(3.0, -1e4, 1e4)
    end_stop_stiffness_Nmprad: float = number(2e5, 1.0, 1e8)
    end_stop_damping_Nmspr: float = number(200.0, 0.0, 1e5)
    thermal: bool = False
    ambient_degC: float = number(25.0, -60.0, 100.0)
    heating_KpA2: float = number(0.5, 0.0, 1e3)
    thermal_time_s: float = number(900.0, 1.0, 1e6)
    friction_per_kelvin: float = number(-0.005, -0.05, 0.05)
    encoder_side: EncoderSide = EncoderSide.JOINT
    encoder_counts_per_turn: int = whole(2**19, 2, 2**40)  # of the shaft that the encoder sits on
    encoder_direction: int = whole(1, -1, 1)
    encoder_offset_counts: int = whole(0, -(2**40), 2**40)  # reported at joint position 0
    encoder_noise_counts: float = number(0.0, 0.0, 1e6)  # standard deviation
    encoder_seed: int = whole(1, 1, 2**63)
    # of an encoder on that shaft, and in radians of it
    motor_encoder_eccentricity_rad: float = number(0.0, 0.0, 0.1)
    motor_encoder_eccentricity_phase_rad: float = number(0.0, -100.0, 100.0)
    joint_encoder_eccentricity_rad: float = number(0.0, 0.0, 0.1)
    joint_encoder_eccentricity_phase_rad: float = number(0.0, -100.0, 100.0)

    def __post_init__(self) -> None:
        for item in fields(self):
            if not item.metadata:
                continue
            accepted, low, high = item.metadata["range"]
            value, kind = getattr(self, item.name), "a whole number" if accepted is Integral else "a number"
            if isinstance(value, bool) or not isinstance(value, accepted) or not low <= float(value) <= high:
                raise _allowed(item.name, value, f"{kind} in [{low:.13g}..{high:.13g}]")
        self._check_choices()
        self._check_waves("torque_ripple", "Nm", 1e4)
        self._check_waves("kinematic_error", "rad", 0.01)
        self._check_reducer()
        self._check_stability()

    def _check_choices(self) -> None:
        for name in ("flexible", "end_stops", "thermal"):
            if not isinstance(getattr(self, name), bool):
                raise _allowed(name, getattr(self, name), "true or false")
        for name, enumeration in (("friction_kind", FrictionKind), ("encoder_side", EncoderSide)):
            if getattr(self, name) not in list(enumeration):
                members = ", ".join(f"{item.value} {item.name}" for item in enumeration)
                raise _allowed(name, getattr(self, name), f"one of {members}")
        if self.friction is not None and getattr(self.friction, "dtype", None) != dtype_of(FrictionConstants):
            raise _allowed("friction", self.friction, "a FrictionConstants record, or None for Table 3 of the paper")
        if self.friction is not None and self.friction.load_coulomb > SELF_LOCKING:
            allowed = f"at most {SELF_LOCKING}: a joint that locks itself is not modelled"
            raise _allowed("friction.load.coulomb", float(self.friction.load_coulomb), allowed)
        if self.encoder_direction == 0:
            raise _allowed("encoder_direction", 0, "1 or -1")
        if self.end_stop_max_rad <= self.end_stop_min_rad:
            raise _allowed("end_stop_max_rad", self.end_stop_max_rad, f"above end_stop_min_rad={self.end_stop_min_rad}")
        if self.flexible and self.motor_side_inertia_kgm2 >= self.inertia_kgm2:
            allowed = f"below inertia_kgm2={self.inertia_kgm2}"
            raise _allowed("motor_side_inertia_kgm2", self.motor_side_inertia_kgm2, allowed)
        longest_s = (DELAY_SLOTS - 1) * self.step_s
        if self.command_delay_s > longest_s * (1.0 + 1e-9):
            raise _allowed("command_delay_s", self.command_delay_s, f"in [0..{longest_s:g}] at step_s={self.step_s:g}")

    def _check_list(self, name: str, low: float, high: float) -> None:
        values = getattr(self, name)
        if not isinstance(values, tuple | list):
            raise _allowed(name, values, "a list of numbers")
        for value in values:
            if isinstance(value, bool) or not isinstance(value, Real) or not low <= float(value) <= high:
                raise _allowed(name, values, f"numbers in [{low:g}..{high:g}]")

    def _check_waves(self, name: str, unit: str, largest: float) -> None:
        """Amplitudes, orders and phases of a sum of sines of the motor angle."""
        names = f"{name}_{unit}", f"{name}_per_motor_turn", f"{name}_phase_rad"
        for item, low, high in zip(names, (0.0, 0.0, -100.0), (largest, 1e4, 100.0), strict=True):
            self._check_list(item, low, high)
        amplitudes, orders, phases = (getattr(self, item) for item in names)
        if len(amplitudes) > HARMONICS:
            raise _allowed(names[0], amplitudes, f"at most {HARMONICS} amplitudes")
        if len(orders) != len(amplitudes):
            raise _allowed(names[1], orders, f"{len(amplitudes)} orders, one per amplitude")
        if len(phases) not in (0, len(amplitudes)):
            raise _allowed(names[2], phases, f"left out, or {len(amplitudes)} phases")

    def _check_reducer(self) -> None:
        knees, beyond = self.reducer_knees_Nm, self.reducer_stiffness_beyond_Nmprad
        self._check_list("reducer_knees_Nm", 0.0, 1e5)
        self._check_list("reducer_stiffness_beyond_Nmprad", 1.0, 1e8)
        if len(knees) > KNEES or list(knees) != sorted(set(knees)):
            raise _allowed("reducer_knees_Nm", knees, f"at most {KNEES} torques in ascending order")
        if len(beyond) != len(knees):
            raise _allowed("reducer_stiffness_beyond_Nmprad", beyond, f"{len(knees)} stiffnesses, one beyond each knee")
        if not self.flexible:
            for name in ("kinematic_error_rad", "hysteresis_width_rad", "link_friction_share", "reducer_knees_Nm"):
                value = getattr(self, name)
                if value:
                    raise _allowed(name, value, "left out unless flexible is true")
        slope = sum(
            2.0 * amplitude * order * self.reduction_ratio
            for amplitude, order in zip(self.kinematic_error_rad, self.kinematic_error_per_motor_turn, strict=True)
        )
        if slope > 1.0:
            raise _allowed(
                "kinematic_error_rad", self.kinematic_error_rad, "so small that the joint never turns against the motor"
            )

    def _check_stability(self) -> None:
        """Explicit steps need stiffness h^2 / inertia and damping h / inertia well below 1."""
        driven = self.motor_side_inertia_kgm2 if self.flexible else self.inertia_kgm2
        link = self.inertia_kgm2 - self.motor_side_inertia_kgm2 if self.flexible else self.inertia_kgm2
        springs = []
        if self.friction_kind == FrictionKind.LUGRE:
            springs += [("bristle_stiffness_Nmprad", driven, 2), ("bristle_damping_Nmspr", driven, 1)]
            if self.link_friction_share > 0.0:
                of_link = link / self.link_friction_share
                springs += [("bristle_stiffness_Nmprad", of_link, 2), ("bristle_damping_Nmspr", of_link, 1)]
        if self.flexible:
            reduced = driven * link / (driven + link)
            springs += [("reducer_stiffness_Nmprad", reduced, 2), ("reducer_damping_Nmspr", reduced, 1)]
            springs += [("reducer_stiffness_beyond_Nmprad", reduced, 2)] if self.reducer_knees_Nm else []
        if self.end_stops:
            springs += [("end_stop_stiffness_Nmprad", link, 2), ("end_stop_damping_Nmspr", link, 1)]
        for name, inertia, power in springs:
            value, largest = getattr(self, name), 0.25 * inertia / self.step_s**power
            if np.max(value) > largest:
                allowed = f"at most {largest:.6g}, or the step of step_s={self.step_s:g} is too long for it"
                raise _allowed(name, value, allowed)


def decay(step_s: float, time_constant_s: float) -> float:
    """Factor of an exact first-order step; 0 without a time constant."""
    return math.exp(-step_s / time_constant_s) if time_constant_s > 0.0 else 0.0


# --- What the kernels read ---


@record
class EccentricityConstants:
    """Of the disc of an encoder."""

    joint_rad: f8  # amplitude at the joint; 0 = it is centred
    turns_prad: f8  # of the disc, per joint radian
    phase_turns: f8


@record
class PlantConstants:
    """Fixed during a run; built by `hil.plant.plant`."""

    step_s: f8
    inverse_step_Hz: f8
    # inertia: the mass that friction acts on is the whole joint, or the motor side of a flexible one
    driven_inertia_kgm2: f8
    inverse_driven_inertia: f8
    inverse_link_inertia: f8
    flexible: i4
    reducer_stiffness_Nmprad: f8
    reducer_damping_Nmspr: f8
    reducer_stiffening_Nmprad: Annotated[np.ndarray, array_of(f8, KNEES)]  # by how much the slope rises at each knee
    reducer_knee_rad: Annotated[np.ndarray, array_of(f8, KNEES)]  # twist of the knee
    hysteresis_slide_rad: f8  # deflection at which the bristle slides; 0 = no hysteresis
    kinematic_error: HarmonicSeries  # [rad]
    # actuator
    current_per_torque_ApNm: f8  # 1 / (n K_m)
    torque_per_current_NmpA: f8  # n K_m
    current_limit_A: f8
    current_decay: f8  # exp(-step / lag), 0 without lag
    delay_substeps: i4
    torque_ripple: HarmonicSeries  # [Nm]
    # friction
    friction_kind: i4  # FrictionKind
    friction_modulated: i4  # friction ripple or temperature in use
    friction: FrictionConstants
    inverse_ratio: f8
    friction_load_gain: f8  # of one substep
    positive_factor: f8  # n times the scale of the direction: motor-side curve to joint torque
    negative_factor: f8
    friction_ripple: f8
    friction_ripple_turns_prad: f8
    bristle_stiffness_Nmprad: f8
    bristle_damping_Nmspr: f8
    motor_friction_share: f8  # of a flexible joint, the rest is on the link's side
    # heating
    thermal: i4
    ambient_degC: f8
    heating_KpA2: f8  # steady temperature rise per squared ampere
    thermal_gain: f8  # 1 - exp(-step / time constant)
    friction_per_kelvin: f8  # relative change of friction
    # load
    load_torque_Nm: f8
    load_step_Nm: f8
    load_step_substep: i8
    gravity_Nm: f8  # m g l
    gravity_zero_rad: f8
    end_stops: i4
    end_stop_min_rad: f8
    end_stop_max_rad: f8
    end_stop_stiffness_Nmprad: f8
    end_stop_damping_Nmspr: f8
    # encoder
    encoder_motor_side: i4
    counts_prad: f8  # per joint radian, with the sign of the direction
    encoder_offset_counts: f8
    encoder_noise_counts: f8
    motor_eccentricity: EccentricityConstants
    joint_eccentricity: EccentricityConstants


@record
class PlantState:
    """Where the joint is; `added_load_torque_Nm` may be written from outside (a hand on the joint, a jam)."""

    substep: i8
    time_s: f8
    joint_position_rad: f8
    joint_velocity_radps: f8
    motor_position_rad: f8  # motor angle / n: equals the joint's unless it is flexible
    motor_velocity_radps: f8
    current_A: f8
    actuator_torque_Nm: f8  # delivered, ripple included
    friction_torque_Nm: f8  # positive against positive motion
    load_torque_Nm: f8  # constant, step and added load; positive against positive motion
    gravity_torque_Nm: f8
    reducer_torque_Nm: f8  # through the flexible element; 0 for a rigid joint
    friction_load_Nm: f8  # torque through the reducer, of a rigid one too, as friction takes it
    twist_rad: f8  # up to which the hysteresis has come
    hysteresis_rad: f8  # deflection of its bristle
    bristle_deflection_rad: f8  # on the motor's side of a flexible joint
    link_bristle_deflection_rad: f8
    motor_temperature_degC: f8
    added_load_torque_Nm: f8
    # faults, written by `hil.faults`; all zero = none
    encoder_stuck: i4
    encoder_reversed: i4
    current_capped: i4
    encoder_stuck_rad: f8
    encoder_pivot_rad: f8  # a reversed encoder counts backwards from here
    encoder_error_rad: f8  # jump and drift
    current_cap_A: f8
    noise_state: u8  # xorshift64, never 0
    delay_slot: i4
    delayed_current_A: Annotated[np.ndarray, array_of(f8, DELAY_SLOTS)]
