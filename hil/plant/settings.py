"""What a person writes about the virtual joint: physical values, each with its range, checked once."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from numbers import Integral, Real
from typing import Any

from jointctl.firmware_py.records import FrictionConstants
from jointctl.firmware_py.schema import dtype_of
from jointctl.hil.plant.records import DELAY_SLOTS, RIPPLES, EncoderSide, FrictionKind


def _allowed(name: str, value: object, allowed: str) -> ValueError:
    return ValueError(f"{name} (={value}) must be {allowed}")


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
    (phases may be left out).  `friction` is a FrictionConstants record, None meaning the paper's Table 3.
    `inertia_kgm2` is the whole joint's; a flexible joint has `motor_side_inertia_kgm2` of it before the reducer.
    """

    step_s: float = number(50e-6, 1e-6, 1e-3)
    initial_position_rad: float = number(0.0, -1e4, 1e4)
    inertia_kgm2: float = number(2.1, 1e-3, 1e4)
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
    motor_side_inertia_kgm2: float = number(1.2, 1e-3, 1e4)
    reducer_stiffness_Nmprad: float = number(1.3e4, 1.0, 1e8)
    reducer_damping_Nmspr: float = number(5.0, 0.0, 1e5)
    load_torque_Nm: float = number(0.0, -1e5, 1e5)
    load_step_Nm: float = number(0.0, -1e5, 1e5)
    load_step_at_s: float = number(80.0, 0.0, 1e9)
    gravity_Nm: float = number(0.0, 0.0, 1e5)  # m g l of m g l sin(q)
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

    def __post_init__(self) -> None:
        for item in fields(self):
            if not item.metadata:
                continue
            accepted, low, high = item.metadata["range"]
            value, kind = getattr(self, item.name), "a whole number" if accepted is Integral else "a number"
            if isinstance(value, bool) or not isinstance(value, accepted) or not low <= float(value) <= high:
                raise _allowed(item.name, value, f"{kind} in [{low:.13g}..{high:.13g}]")
        self._check_choices()
        self._check_ripples()
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

    def _check_ripples(self) -> None:
        amplitudes, orders, phases = (
            self.torque_ripple_Nm,
            self.torque_ripple_per_motor_turn,
            self.torque_ripple_phase_rad,
        )
        for name, low, high in (
            ("torque_ripple_Nm", 0.0, 1e4),
            ("torque_ripple_per_motor_turn", 0.0, 1e4),
            ("torque_ripple_phase_rad", -100.0, 100.0),
        ):
            if not isinstance(getattr(self, name), tuple | list):
                raise _allowed(name, getattr(self, name), "a list of numbers")
            for value in getattr(self, name):
                if isinstance(value, bool) or not isinstance(value, Real) or not low <= float(value) <= high:
                    raise _allowed(name, getattr(self, name), f"numbers in [{low:g}..{high:g}]")
        if len(amplitudes) > RIPPLES:
            raise _allowed("torque_ripple_Nm", amplitudes, f"at most {RIPPLES} amplitudes")
        if len(orders) != len(amplitudes):
            raise _allowed("torque_ripple_per_motor_turn", orders, f"{len(amplitudes)} orders, one per amplitude")
        if len(phases) not in (0, len(amplitudes)):
            raise _allowed("torque_ripple_phase_rad", phases, f"left out, or {len(amplitudes)} phases")

    def _check_stability(self) -> None:
        """Explicit steps need stiffness h^2 / inertia and damping h / inertia well below 1."""
        driven = self.motor_side_inertia_kgm2 if self.flexible else self.inertia_kgm2
        link = self.inertia_kgm2 - self.motor_side_inertia_kgm2 if self.flexible else self.inertia_kgm2
        springs = []
        if self.friction_kind == FrictionKind.LUGRE:
            springs.append(("bristle", driven))
        if self.flexible:
            springs.append(("reducer", driven * link / (driven + link)))
        if self.end_stops:
            springs.append(("end_stop", link))
        for name, inertia in springs:
            for unit, power in (("stiffness_Nmprad", 2), ("damping_Nmspr", 1)):
                value, largest = getattr(self, f"{name}_{unit}"), 0.25 * inertia / self.step_s**power
                if value > largest:
                    allowed = f"at most {largest:.6g}, or the step of step_s={self.step_s:g} is too long for it"
                    raise _allowed(f"{name}_{unit}", value, allowed)

    def named(self) -> dict[str, Any]:
        """Every setting by name, for a log or a report."""
        return {item.name: getattr(self, item.name) for item in fields(self)}


def decay(step_s: float, time_constant_s: float) -> float:
    """Factor of an exact first-order step; 0 without a time constant."""
    return math.exp(-step_s / time_constant_s) if time_constant_s > 0.0 else 0.0
