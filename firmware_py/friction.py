"""Multi-stage friction model (11): Stribeck near zero speed, a cubic polynomial beyond the knee.

Torque is that at the MOTOR, speed that of the JOINT in rad/s; the joint feels `reduction_ratio` times the torque.
Each direction is stored mirrored (positive speed, positive friction), so that one expression serves both:

    u = |v| <= knee :  tc + (ts - tc) exp(-u / ws) + tv u
    u > knee        :  a0 + a1 u + a2 u^2 + a3 u^3
    u > maximum     :  value and slope at the maximum are held (the data end there, so extrapolation is a guess)

(11) prints the exponent of the negative direction as -v/ws, which diverges; mirrored it is -|v|/ws.
The two stages need not meet at the knee (Table 3 has steps of 0.0017 and 0.0013 Nm).

With a load and a temperature, C = tc + (ts - tc) exp(-u / ws) and V = the rest of (11) at that speed:

    (C + kc |tau|) exp(-bc (T - T0)) + (V + kv |tau| u) exp(-bv (T - T0))

tau is the torque that the reducer transmits, T the drive's temperature.  Friction that goes with |tau| always opposes
the motion, as in the load-dependent models of Rhoban's BAM; the exponential is that of a lubricant's viscosity.  All of
it is times 1 + sum a_k sin(o_k theta + phi_k), theta the motor's angle / n: what tooth and wave generator do at each
turn, with the direction of the motion.  A torque that goes with the angle alone is no friction: `[ripple]`.

Not modelled: friction that differs between driving and being driven."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jointctl.firmware_py.flexible_joint import value_at
from jointctl.firmware_py.kernel import inlined, kernel
from jointctl.firmware_py.records import FrictionBranch, FrictionConstants, LuGreConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import ZeroSpeedRule

# --- Multi-stage friction model (11): Stribeck near zero speed, a cubic polynomial beyond the knee ---


DEGREE = math.pi / 180.0


@inlined
def branch_torque_Nm(branch: FrictionBranch, speed_radps: float) -> float:
    """Friction of one direction at the motor [Nm] for a speed >= 0; at 0 it is the static friction."""
    if speed_radps <= branch.knee_radps:
        decay = math.exp(-speed_radps / branch.stribeck_speed_radps)
        return branch.coulomb_Nm + (branch.static_Nm - branch.coulomb_Nm) * decay + branch.viscous_Nmspr * speed_radps
    a = branch.cubic
    u = min(speed_radps, branch.max_radps)
    torque = a[0] + u * (a[1] + u * (a[2] + u * a[3]))
    if speed_radps > branch.max_radps:
        torque += (speed_radps - u) * (a[1] + u * (2.0 * a[2] + 3.0 * u * a[3]))
    return torque


class Condition(NamedTuple):
    """What friction depends on besides the speed."""

    load_Nm: float  # size of the torque that the reducer transmits, at the motor: that at the joint over the ratio
    coulomb: float  # factors of temperature and angle
    viscous: float


UNLOADED = Condition(0.0, 1.0, 1.0)  # and at the temperature for which the curve holds


@kernel
def condition_of(
    friction: FrictionConstants, load_Nm: float, temperature_degC: float, motor_rad: float = 0.0
) -> Condition:
    """`load_Nm`: the torque that the reducer transmits, at the motor, of any sign; `motor_rad`: its angle / n."""
    if friction.conditioned == 0:
        return Condition(0.0, 1.0, 1.0)
    warming_K = min(max(temperature_degC, friction.lowest_degC), friction.highest_degC) - friction.reference_degC
    coulomb = math.exp(-friction.temperature_coulomb_pK * warming_K)
    viscous = math.exp(-friction.temperature_viscous_pK * warming_K)
    of_angle = 1.0 + value_at(friction.of_angle, motor_rad)
    return Condition(abs(load_Nm), coulomb * of_angle, viscous * of_angle)


@inlined
def conditioned_torque_Nm(
    friction: FrictionConstants, branch: FrictionBranch, speed_radps: float, condition: Condition
) -> float:
    """`branch_torque_Nm` of one direction under load and at a temperature."""
    torque = branch_torque_Nm(branch, speed_radps)
    if friction.conditioned == 0:
        return torque
    decay = math.exp(-speed_radps / branch.stribeck_speed_radps)
    coulomb = branch.coulomb_Nm + (branch.static_Nm - branch.coulomb_Nm) * decay
    viscous = torque - coulomb + friction.load_viscous_spr * condition.load_Nm * speed_radps
    return (coulomb + friction.load_coulomb * condition.load_Nm) * condition.coulomb + viscous * condition.viscous


@inlined
def friction_motor_torque_Nm(
    friction: FrictionConstants, velocity_radps: float, condition: Condition = UNLOADED
) -> float:
    """Friction at the motor [Nm], opposing the motion and counted positive for positive velocity; 0 at v = 0."""
    if velocity_radps > 0.0:
        return conditioned_torque_Nm(friction, friction.positive, velocity_radps, condition)
    if velocity_radps < 0.0:
        return -conditioned_torque_Nm(friction, friction.negative, -velocity_radps, condition)
    return 0.0


@kernel
def compensation_motor_torque_Nm(
    friction: FrictionConstants,
    zero_rule: int,
    zero_band_radps: float,
    velocity_radps: float,
    condition: Condition = UNLOADED,
) -> float:
    """Feed-forward friction torque at the motor [Nm] with an explicit rule at v = 0, where friction is set-valued.

    PAPER gives +static friction at exactly zero; LINEAR draws a line through zero inside +-zero_band_radps.
    """
    if zero_rule == ZeroSpeedRule.LINEAR and abs(velocity_radps) < zero_band_radps:
        edge = math.copysign(zero_band_radps, velocity_radps)
        return friction_motor_torque_Nm(friction, edge, condition) * abs(velocity_radps) / zero_band_radps
    if zero_rule == ZeroSpeedRule.PAPER and velocity_radps == 0.0:
        return conditioned_torque_Nm(friction, friction.positive, 0.0, condition)
    return friction_motor_torque_Nm(friction, velocity_radps, condition)


class PrintedBranch(NamedTuple):
    """One direction in the numbers of (11), in any units."""

    tc: float
    ts: float
    ws: float
    tv: float
    cubic: Sequence[float]  # (a0, a1, a2, a3) with the signs of (11)
    knee: float  # may carry the sign of the direction, as `maximum`
    maximum: float


def branch_constants(
    printed: PrintedBranch, *, negative: bool, radps_per_unit: float, torque_scale: float = 1.0
) -> Any:
    """A `FrictionBranch` record.

    Speeds are in a unit of `radps_per_unit` rad/s of the joint; `torque_scale` turns the given torque into motor Nm.
    """
    tc, ts, ws, tv, cubic, knee, maximum = printed
    branch = new(FrictionBranch)[0]
    mirror = (-1.0, 1.0, -1.0, 1.0) if negative else (1.0, 1.0, 1.0, 1.0)
    branch.coulomb_Nm = tc * torque_scale
    branch.static_Nm = ts * torque_scale
    branch.stribeck_speed_radps = ws * radps_per_unit
    branch.viscous_Nmspr = tv * torque_scale / radps_per_unit
    for power in range(4):
        branch.cubic[power] = mirror[power] * cubic[power] * torque_scale / radps_per_unit**power
    branch.knee_radps = abs(knee) * radps_per_unit
    branch.max_radps = abs(maximum) * radps_per_unit
    return branch


def friction_constants(positive: FrictionBranch, negative: FrictionBranch) -> Any:
    """A `FrictionConstants` record array of one record from two branches."""
    constants = new(FrictionConstants)
    constants[0].positive = positive
    constants[0].negative = negative
    return constants


def paper_friction() -> Any:
    """Table 3 of the paper: speed in deg/s of the joint, torque at the motor."""
    positive = branch_constants(
        PrintedBranch(0.11985, 0.14537, 1.2301, 0.0026518, (0.17995, 0.0012298, -6.5261e-7, -7.6969e-9), 40.0, 200.0),
        negative=False, radps_per_unit=DEGREE,
    )  # fmt: skip
    negative = branch_constants(
        PrintedBranch(0.1063, 0.1575, 2.887, 0.002475, (-0.1272, 0.0022866, 1e-5, 2.1182e-8), -40.0, -200.0),
        negative=True, radps_per_unit=DEGREE,
    )  # fmt: skip
    return friction_constants(positive, negative)


def friction_curve_Nm(constants: np.ndarray, velocity_radps: np.ndarray) -> np.ndarray:
    """(11) at many velocities; arrays of shape (N,)."""
    friction = constants[0]
    return np.array([friction_motor_torque_Nm(friction, float(v)) for v in velocity_radps])


# --- LuGre friction driven by a given velocity, for compensation: bristle deflection z [rad] at the joint ---
# z' = v - sigma0 |v| / g(v) z,     tau = sigma0 z + sigma1 z' + (viscous part)
#
# g(v) is the whole sliding curve n tau_f(v) of (11), viscous part included, so that the steady state is exactly (11)
# and no separate viscous term is added.  z is updated by the exact solution over one period at constant v, which is
# stable for any stiffness and period.


@inlined
def sliding_torque_Nm(
    friction: FrictionConstants, reduction_ratio: float, velocity_radps: float, condition: Condition
) -> float:
    """g(v) at the joint [Nm], for a speed other than 0."""
    branch = friction.positive if velocity_radps > 0.0 else friction.negative
    return reduction_ratio * conditioned_torque_Nm(friction, branch, abs(velocity_radps), condition)


@inlined
def bend_bristles(
    stiffness_Nmprad: float, damping_Nmspr: float, deflection_rad: float, velocity_radps: float, sliding_Nm: float,
    period_s: float,
) -> tuple[float, float]:  # fmt: skip
    """(new deflection [rad], friction torque at the joint [Nm]) after `period_s` at this velocity, other than 0."""
    settled_rad = math.copysign(sliding_Nm / stiffness_Nmprad, velocity_radps)
    decay = math.exp(-abs(velocity_radps) * period_s * stiffness_Nmprad / sliding_Nm)
    moved_rad = settled_rad + (deflection_rad - settled_rad) * decay
    rate_radps = (moved_rad - deflection_rad) / period_s
    return moved_rad, stiffness_Nmprad * moved_rad + damping_Nmspr * rate_radps


@kernel
def step_lugre(
    lugre: LuGreConstants,
    friction: FrictionConstants,
    reduction_ratio: float,
    deflection_rad: float,
    velocity_radps: float,
    period_s: float,
    condition: Condition = UNLOADED,
) -> tuple[float, float]:
    """(new deflection [rad], friction torque at the joint [Nm]) after `period_s` at `velocity_radps`."""
    if velocity_radps == 0.0:
        return deflection_rad, lugre.stiffness_Nmprad * deflection_rad
    sliding_Nm = sliding_torque_Nm(friction, reduction_ratio, velocity_radps, condition)
    return bend_bristles(
        lugre.stiffness_Nmprad, lugre.damping_Nmspr, deflection_rad, velocity_radps, sliding_Nm, period_s
    )
