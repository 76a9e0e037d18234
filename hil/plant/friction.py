"""Friction of the virtual joint, and the motion of the mass it acts on.

All kinds share the sliding curve (11), which is motor side; here it is times the reduction ratio and the scale of its
direction, so that it is at the joint, positive against positive motion.

* SIGN: the curve at the velocity at the start of the substep; 0 at exactly zero velocity.  It chatters around zero.
* STICK_SLIP: set-valued at zero velocity.  At rest it holds while the net torque is within the static friction of
  either direction.  Where the velocity reaches zero inside a substep, that instant is worked out and the rest of the
  substep is at rest, or in the other direction.
* LUGRE: dz/dt = v - sigma0 |v| z / g(v), friction = sigma0 z + sigma1 dz/dt (Canudas de Wit et al. 1995), g the
  magnitude of the sliding curve, viscous part included, so that steady sliding gives (11).  z takes an implicit step,
  which is stable at any stiffness and has the exact steady state.

Its break-away depends on the rate (a few per cent below the static friction for a quick rise), and it creeps under
vibration, as LuGre does.

Not modelled: dwell-time dependence of the static friction, dependence on load torque, position-dependent stiction.
"""

from __future__ import annotations

from jointctl.firmware_py.friction import friction_motor_torque_Nm
from jointctl.firmware_py.kernel import inlined, kernel
from jointctl.hil.plant.actuator import sine_of_turns
from jointctl.hil.plant.records import FrictionKind, PlantConstants, PlantState

_LEAST_FRICTION_Nm = 1e-9  # a curve that touches zero must not divide by it


@inlined
def modulation(c: PlantConstants, s: PlantState, position_rad: float) -> float:
    """Factor on friction: ``1 + a sin(k q)`` times the temperature's ``1 + b (T - ambient)`` (at least 0.05)."""
    factor = 1.0
    if c.friction_modulated != 0:
        factor += c.friction_ripple * sine_of_turns(c.friction_ripple_turns_prad * position_rad)
        if c.thermal != 0:
            warm = 1.0 + c.friction_per_kelvin * (s.motor_temperature_degC - c.ambient_degC)
            factor *= max(warm, 0.05)
    return factor


@inlined
def sliding_torque_Nm(c: PlantConstants, velocity_radps: float) -> float:
    """(11) at the joint for velocity != 0, with its sign; ripple and temperature are not in it."""
    factor = c.positive_factor if velocity_radps > 0.0 else c.negative_factor
    return factor * friction_motor_torque_Nm(c.friction, velocity_radps)


@inlined
def lugre_torque_Nm(c: PlantConstants, s: PlantState, velocity_radps: float, factor: float) -> float:
    """LuGre friction at the joint; advances the bristle deflection by one substep."""
    z = s.bristle_deflection_rad
    z_next = z
    if velocity_radps != 0.0:
        g = max(abs(sliding_torque_Nm(c, velocity_radps)) * factor, _LEAST_FRICTION_Nm)
        travel = c.step_s * velocity_radps
        z_next = (z + travel) * g / (g + c.bristle_stiffness_Nmprad * abs(travel))
        s.bristle_deflection_rad = z_next
    return c.bristle_stiffness_Nmprad * z_next + c.bristle_damping_Nmspr * c.inverse_step_Hz * (z_next - z)


@kernel
def _from_rest(c: PlantConstants, net_torque_Nm: float, time_s: float, factor: float) -> tuple[float, float, float]:
    """Velocity, travel and friction `time_s` after standstill under a constant torque, for the set-valued kind."""
    forward = c.positive_factor * factor * c.friction.positive.static_Nm
    backward = -c.negative_factor * factor * c.friction.negative.static_Nm
    if net_torque_Nm > forward:
        friction = forward
    elif net_torque_Nm < backward:
        friction = backward
    else:
        return 0.0, 0.0, net_torque_Nm
    velocity = (net_torque_Nm - friction) * c.inverse_driven_inertia * time_s
    return velocity, 0.5 * velocity * time_s, friction


@inlined
def advance(
    c: PlantConstants, s: PlantState, velocity_radps: float, position_rad: float, net_torque_Nm: float
) -> tuple[float, float, float]:
    """One substep of the mass that friction acts on: new velocity [rad/s], travel [rad], friction [Nm at the joint].

    `net_torque_Nm` is everything but friction, constant over the substep, so that the travel is exact.
    """
    step_s = c.step_s
    friction = 0.0
    kind = c.friction_kind
    if kind != FrictionKind.NONE:
        factor = modulation(c, s, position_rad)
        if kind == FrictionKind.LUGRE:
            friction = lugre_torque_Nm(c, s, velocity_radps, factor)
        elif velocity_radps != 0.0:
            friction = factor * sliding_torque_Nm(c, velocity_radps)
        elif kind == FrictionKind.STICK_SLIP:
            return _from_rest(c, net_torque_Nm, step_s, factor)
    acceleration = (net_torque_Nm - friction) * c.inverse_driven_inertia
    new_velocity = velocity_radps + step_s * acceleration
    if kind == FrictionKind.STICK_SLIP and (
        velocity_radps > 0.0 >= new_velocity or velocity_radps < 0.0 <= new_velocity
    ):
        # the velocity changed, so that the acceleration is not zero, and standstill comes within the substep
        until_rest_s = min(-velocity_radps / acceleration, step_s)
        travel_to_rest = 0.5 * velocity_radps * until_rest_s
        rest_velocity, rest_travel, rest_friction = _from_rest(c, net_torque_Nm, step_s - until_rest_s, factor)
        return rest_velocity, travel_to_rest + rest_travel, rest_friction
    return new_velocity, 0.5 * step_s * (velocity_radps + new_velocity), friction
