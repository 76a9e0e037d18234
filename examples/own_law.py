"""A law in Python against the law of a configuration, at simulated time: which one follows a sine better?

python examples/own_law.py
"""

from __future__ import annotations

import math

import numpy as np

import jointctl

AMPLITUDE_rad, FREQUENCY_Hz, SECONDS = 0.1, 0.5, 6.0
OMEGA_radps = math.tau * FREQUENCY_Hz


def wanted(t_s: float) -> tuple[float, float, float]:
    """Position, velocity and acceleration; the amplitude grows for two seconds."""
    u = min(t_s / 2.0, 1.0)
    share, rate, bend = (
        u**3 * (10 - 15 * u + 6 * u * u),
        30 * u * u * (1 - u) ** 2 / 2.0,
        60 * u * (1 - u) * (1 - 2 * u) / 4.0,
    )
    sine, cosine = math.sin(OMEGA_radps * t_s), math.cos(OMEGA_radps * t_s)
    return (
        AMPLITUDE_rad * share * sine,
        AMPLITUDE_rad * (rate * sine + share * OMEGA_radps * cosine),
        AMPLITUDE_rad * (bend * sine + 2.0 * rate * OMEGA_radps * cosine - share * OMEGA_radps**2 * sine),
    )


def proportional_and_derivative() -> float:
    """RMSE [mrad] of a PD law with the inertia's torque, written here."""
    errors = []
    with jointctl.Joint("precise", lockstep=True) as joint:
        joint.enable()
        inertia_kgm2 = joint.config.joint.inertia_kgm2
        start_rad = joint.state.position_rad
        state, period_s = joint.state, 1.0 / joint.config.loop.rate_Hz
        for k in range(round(SECONDS / period_s)):
            position_rad, velocity_radps, acceleration_radps2 = wanted(k * period_s)
            error_rad = state.position_rad - start_rad - position_rad
            errors.append(error_rad)
            feedback = 1000.0 * error_rad + 60.0 * (state.velocity_radps - velocity_radps)
            state = joint.step_torque(inertia_kgm2 * (acceleration_radps2 - feedback))
    return 1e3 * float(np.sqrt(np.mean(np.square(errors))))


def configured() -> float:
    """RMSE [mrad] of the law of the configuration, which gets the same sine as set-points."""
    with jointctl.Joint("precise", lockstep=True) as joint:
        joint.enable()
        start_rad = joint.state.desired_position_rad
        for k in range(1, round(100 * SECONDS)):
            position_rad, velocity_radps, acceleration_radps2 = wanted(0.01 * k)
            joint.command(start_rad + position_rad, velocity_radps, acceleration_radps2, time_s=0.01 * k)
            joint.step(0.01)
        moving = joint.records[joint.records.desired_velocity_radps != 0.0]
    return 1e3 * float(np.sqrt(np.mean(np.square(moving.error_rad))))


if __name__ == "__main__":
    print(f"PD law of this program   {proportional_and_derivative():.3f} mrad")
    print(f"law of the configuration {configured():.3f} mrad")
