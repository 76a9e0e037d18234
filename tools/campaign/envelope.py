"""How far and how fast the joint may get, and how long it may take: limits plus a derived stopping distance.

The loop reacts when a measured value passes its limit.  Until the reaction has begun, `t` later, the motor may push
with all that the drive allows in the worst direction, and friction is not counted on:

    a = (torque limit of the drive + ripple + loads) / J
    v1 = v_max + a t                     the greatest speed
    x1 = v_max t + a t^2 / 2             the way until then

From then on the joint is braked by at least its own Coulomb friction F, the weakest of the reactions (power off), less
the ripple and the load L of the configuration (gravity with its whole lever), or, under an added load, by the drive's
quick stop with what the load leaves of it:

    d = (F - ripple - L) / J,   x2 = v1^2 / (2 d)

`t` is `REACTION_s` where the loop measures and is heard, or more where these take longer: one period each for sample
and command, the velocity filter (three time constants, 5 ms at 100 Hz) and the motor's delay and lag.  Where the drive
does not hear the loop it holds the last torque, or in a sweep the last velocity, until its own watchdog acts: age limit
of the samples + IGNORED_MAX_CYCLES + drive.heartbeat_s.

A reading that is wrong by w (jump, drift) shifts the true position by w.  Behind a stuck encoder the joint is blind
until POSITION_FROZEN: it is pushed with at most frozen_torque_Nm for longer than PUSHED_CYCLES, 16 Nm more than the
Coulomb friction, which the viscous part (18 Nm s/rad below the knee) balances at 0.9 rad/s; the pushed cycles with
full torque add (60 - 13) Nm / J x 20 ms = 0.5 rad/s.  `BLIND_RADPS` is that and a quarter.
Not covered: more than one fault at a time, a drive that applies torque by itself, a load greater than the friction
for good (it needs a brake).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from jointctl.drivers.canopen.cyclic import IGNORED_MAX_CYCLES
from jointctl.hil.faults.kinds import FaultKind
from jointctl.tools.campaign.scenario import Scenario
from jointctl.tools.configuration.config import Config

REACTION_s = 0.010
FILTER_CONSTANTS = 3.0
MOTOR_s = 0.0013  # the longest delay and lag that a scenario draws
BLIND_RADPS = 1.8
BLIND_RAD = 1.0
BRAKE_SPARE_s = 1.0  # a quick stop of the virtual drive may end so much late
STANDSTILL_RADPS = 0.02
_UNHEARD = frozenset(
    {
        FaultKind.FRAMES_LOST, FaultKind.SYNC_LOST, FaultKind.RPDO_LOST, FaultKind.BUS_OFF, FaultKind.RPDO_LENGTH,
        FaultKind.RPDO_DELAYED, FaultKind.TPDO_DELAYED, FaultKind.LOOP_HELD_UP,
    }
)  # fmt: skip
_BLIND_FOR_A_WHILE = frozenset({FaultKind.TPDO_LOST, FaultKind.TPDO_LENGTH})


@dataclass(frozen=True)
class Envelope:
    """What must hold in every period of a scenario."""

    position_min_rad: float
    position_max_rad: float
    velocity_max_radps: float
    command_max_Nm: float
    command_step_Nm: float
    stop_s: float  # from the latched fault to power off and standstill, by quick stop or power off
    ramp_s: float  # the same by a controlled ramp
    command_max_radps: float = math.inf  # of the velocity command, where there is one
    command_step_radps: float = math.inf  # in one period


def _measuring_s(config: Config) -> float:
    """Longest time from passing a limit to a reaction, with samples and a drive that hears."""
    cutoff_Hz = config.control.velocity_cutoff_Hz
    filter_s = FILTER_CONSTANTS / (math.tau * cutoff_Hz) if cutoff_Hz else 0.0
    return max(REACTION_s, 2.0 / config.loop.rate_Hz + filter_s + MOTOR_s)


def reaction_s(config: Config, kind: FaultKind) -> float:
    """Longest time from passing a limit to the beginning of the reaction."""
    age_s, measuring_s = config.limits.sample_age_max_s, _measuring_s(config)
    if kind in _UNHEARD:
        ignored_s = IGNORED_MAX_CYCLES / config.loop.rate_Hz
        return measuring_s + age_s + ignored_s + config.canopen.heartbeat_s
    if kind in _BLIND_FOR_A_WHILE:
        return measuring_s + age_s
    return measuring_s


def load_Nm(config: Config) -> float:
    """The greatest load at the joint that is there without a fault."""
    virtual = config.virtual
    assert virtual is not None
    return abs(virtual.gravity_Nm) + abs(virtual.load_torque_Nm) + abs(virtual.load_step_Nm)


def _friction_floor_Nm(config: Config, scenario: Scenario) -> float:
    """The least Coulomb friction at the joint, of the slower direction and with its ripple."""
    virtual = config.virtual
    assert virtual is not None
    friction = virtual.friction or config.friction
    assert friction is not None
    curves = (
        abs(friction.positive.tc_Nm) * scenario.plant["friction_positive_scale"],
        abs(friction.negative.tc_Nm) * scenario.plant["friction_negative_scale"],
    )
    return config.joint.reduction_ratio * min(curves) * (1.0 - virtual.friction_ripple)


def envelope(config: Config, scenario: Scenario, constants: Any) -> Envelope:
    """See the module; `constants` is the AxisConstants record of the scenario."""
    limits, kind = constants.limits, scenario.kind
    inertia = scenario.plant["inertia_kgm2"]
    ripple = sum(scenario.plant["torque_ripple_Nm"])
    load = abs(scenario.magnitude) if kind is FaultKind.LOAD_JUMP else 0.0
    share = 1e-3 * (config.canopen.max_torque_permille or 1000)
    drive_Nm = share * (config.canopen.rated_torque_Nm or 0.0) * config.joint.reduction_ratio
    constant_Nm = load_Nm(config)
    floor = _friction_floor_Nm(config, scenario) - ripple - constant_Nm
    wait_s = reaction_s(config, kind)
    push = (drive_Nm + ripple + load + constant_Nm) / inertia
    speed = limits.velocity_max_radps + push * wait_s
    brake = (min(floor, drive_Nm + floor - load) if load else floor) / inertia
    way = limits.velocity_max_radps * wait_s + 0.5 * push * wait_s**2 + speed**2 / (2.0 * brake)
    stop_s = wait_s + speed / brake + BRAKE_SPARE_s
    if load > floor:  # after power off it moves the joint for the rest of its time
        pushed = (load - floor) / inertia * scenario.duration_s
        way += 0.5 * pushed * scenario.duration_s + pushed**2 / (2.0 * brake)
        speed = max(speed, pushed)
        stop_s += scenario.duration_s + pushed / brake
    shift = 0.0
    if kind is FaultKind.ENCODER_JUMP:
        shift = abs(scenario.magnitude)
    elif kind is FaultKind.ENCODER_DRIFT:
        run_s = constants.sequence.approach_s + constants.trajectory.duration_s + config.sequence.stop_timeout_s
        shift = abs(scenario.magnitude) * min(scenario.duration_s, run_s + 1.0)
        speed += abs(scenario.magnitude)
    elif kind is FaultKind.ENCODER_STUCK:
        shift, speed = BLIND_RAD, max(speed, BLIND_RADPS)
        stop_s += speed / brake
    elif kind is FaultKind.ENCODER_REVERSED:
        shift = 2.0 * limits.following_error_max_rad + way
    return Envelope(
        position_min_rad=limits.position_min_rad - way - shift,
        position_max_rad=limits.position_max_rad + way + shift,
        velocity_max_radps=speed,
        command_max_Nm=limits.torque_max_Nm,
        command_step_Nm=limits.torque_rate_max_Nmps * constants.law.period_s,
        stop_s=stop_s,
        ramp_s=config.sequence.stop_timeout_s + config.sequence.release_s + stop_s,
        command_max_radps=limits.velocity_max_radps,
        command_step_radps=constants.velocity_command.acceleration_max_radps2 * constants.law.period_s,
    )
