"""One random scenario: a plant, a trajectory, one fault or its harmless twin.  Number and seed decide everything."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from jointctl.firmware_py.axis import low_pass_gain
from jointctl.firmware_py.schema import new
from jointctl.hil.faults.kinds import FaultConstants, FaultKind
from jointctl.hil.plant.joint import plant
from jointctl.hil.plant.records import FrictionKind
from jointctl.tools.campaign.fault_classes import EMERGENCY_CODES, FAULT_CLASSES, SIGNED, Sizes
from jointctl.tools.campaign.sweep_motion import LONGEST_s, SweepStrokes, draw_strokes
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.plant_settings import plant_settings
from jointctl.tools.configuration.trajectory import Hold, MinJerk, Sine, Trapezoid

HARMLESS_SHARE = 0.35
REACH_RAD = 0.4  # of the trajectories; the limits are at 0.7
TOP_SPEED_RADPS = 0.6  # of the trajectories; the limit is 1
FILTER_OF_SWAPS = (100.0, 0.001)  # cutoff [Hz] and period [s] with which every reordering of a twin is harmless
BEFORE_s = 1.8  # until the trajectory begins, at most


@dataclass(frozen=True)
class Scenario:
    """What happens; `plant` holds the settings that differ from the configuration's."""

    number: int
    seed: int
    kind: FaultKind
    harmless: bool
    at_s: float  # after the start of the run
    duration_s: float
    magnitude: float
    trajectory: Any
    start_offset_rad: float  # of the joint from the first point of the trajectory
    plant: dict[str, Any]

    def fault(self) -> Any:
        """`FaultConstants`, a record array of one."""
        faults = new(FaultConstants)
        record = faults[0]
        record.kind, record.start_s, record.duration_s = self.kind, self.at_s, self.duration_s
        record.magnitude, record.seed = self.magnitude, self.number + 1
        return faults

    def describe(self) -> dict[str, Any]:
        """For the report."""
        trajectory = self.trajectory
        strokes = isinstance(trajectory, SweepStrokes)
        return {
            **{k: v for k, v in asdict(self).items() if k != "trajectory"},
            "kind": self.kind.name.lower(),
            "trajectory": asdict(trajectory) if strokes else trajectory.model_dump(exclude_none=True),
            "plant": {k: (v.name.lower() if isinstance(v, FrictionKind) else v) for k, v in self.plant.items()},
        }


def _trajectory(random: np.random.Generator, duration_s: float) -> Any:
    kind = random.integers(4)
    if kind == 0:
        return Hold(kind="hold", duration_s=duration_s, position_rad=float(random.uniform(-REACH_RAD, REACH_RAD)))
    if kind == 1:
        amplitude = random.uniform(0.02, REACH_RAD)
        highest = min(0.5, TOP_SPEED_RADPS / (amplitude * math.tau))
        return Sine(
            kind="sine", duration_s=duration_s, amplitude_rad=float(amplitude),
            frequency_Hz=float(random.uniform(0.05, highest)), shift_s=float(random.uniform(0.0, 3.0)),
        )  # fmt: skip
    start, target = (float(x) for x in random.uniform(-REACH_RAD, REACH_RAD, 2))
    way = max(abs(target - start), 1e-3)
    if kind == 2:
        move_s = max(1.875 * way / random.uniform(0.1, TOP_SPEED_RADPS), 0.4)
        return MinJerk(
            kind="min_jerk", duration_s=duration_s, start_rad=start, target_rad=target, move_s=float(move_s),
            dwell_s=float(random.uniform(0.0, 0.3)), repeat=True,
        )  # fmt: skip
    return Trapezoid(
        kind="trapezoid", duration_s=duration_s, start_rad=start, target_rad=target,
        speed_radps=float(random.uniform(0.1, TOP_SPEED_RADPS)), acceleration_radps2=float(random.uniform(0.5, 3.0)),
        dwell_s=float(random.uniform(0.0, 0.3)), repeat=True,
    )  # fmt: skip


def _plant(random: np.random.Generator) -> dict[str, Any]:
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


def draw_scenario(seed: int, number: int, *, sweep: bool = False) -> Scenario:
    """Scenario `number` of the campaign with this seed; `sweep`: during a sweep instead of a run."""
    random = np.random.default_rng([seed, number])
    kinds = list(FAULT_CLASSES)
    chosen = FAULT_CLASSES[kinds[number % len(kinds)]]  # in turn: every kind gets its share
    harmless = chosen.harmful is None or (chosen.harmless is not None and random.random() < HARMLESS_SHARE)
    sizes = chosen.harmless if harmless else chosen.harmful
    assert sizes is not None
    duration, magnitude = _size(random, sizes)
    if chosen.kind in SIGNED and random.random() < 0.5:
        magnitude = -magnitude
    if chosen.kind is FaultKind.DRIVE_FAULT:
        magnitude = float(random.choice(EMERGENCY_CODES))
    tracking_s = float(random.uniform(0.5, 2.5))
    return Scenario(
        number, seed, chosen.kind, harmless,
        at_s=float(random.uniform(0.0, BEFORE_s + (LONGEST_s if sweep else tracking_s))),
        duration_s=duration,
        magnitude=magnitude,
        trajectory=draw_strokes(random) if sweep else _trajectory(random, tracking_s),
        start_offset_rad=float(random.uniform(-0.1, 0.1)),
        plant=_plant(random),
    )  # fmt: skip


def fitted(config: Config, scenario: Scenario) -> Scenario:
    """The scenario with a harmless size that is harmless with this configuration's velocity filter.

    A swapped sample reads as half the speed and the next one as twice that.  The filter of configs/virtual.toml lets
    any number of swaps pass for harmless; one that passes more reads two in a row as 1.8 times the speed, and 0.6 rad/s
    as more than the limit: there a harmless reordering is one swap.
    """
    if scenario.kind is not FaultKind.TPDO_REORDERED or not scenario.harmless:
        return scenario
    period_s = 1.0 / config.loop.rate_Hz
    if low_pass_gain(config.control.velocity_cutoff_Hz, period_s) <= low_pass_gain(*FILTER_OF_SWAPS):
        return scenario
    return replace(scenario, duration_s=1.5 * period_s, magnitude=1.0)


def plant_of(config: Config, scenario: Scenario, position_rad: float) -> tuple[Any, Any]:
    """Constants and state of the scenario's plant, at this start position."""
    settings = {**plant_settings(config), **scenario.plant, "initial_position_rad": position_rad}
    return plant(**settings)
