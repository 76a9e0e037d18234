"""The control law in numpy, one tick a call: what one would write without a compiler, vectorised over the neurons."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


class NumpyLaw:
    """Computed torque, LuGre on the desired velocity, network; SI units, torques at the joint.

    The constants are copied out of the records first, since reading a field of a record costs more than the law.
    """

    def __init__(self, axis: Any) -> None:
        law, network = axis.law, axis.law.network
        self.period_s, self.inertia_kgm2 = float(law.period_s), float(law.inertia_kgm2)
        self.kp, self.kv, self.ratio = float(law.kp), float(law.kv), float(law.reduction_ratio)
        self.coriolis_Nmspr, self.gravity_Nm = float(law.coriolis_Nmspr), float(law.gravity_Nm)
        self.gravity_zero_rad = float(law.gravity_zero_rad)
        self.stiffness_Nmprad, self.damping_Nmspr = float(law.lugre.stiffness_Nmprad), float(law.lugre.damping_Nmspr)
        self.branches = [self._branch(law.friction.positive), self._branch(law.friction.negative)]
        self.centres = np.array(network.centres)
        self.inverse_width = np.array(network.inverse_width)
        self.p_b = np.array(network.p_b)
        self.learning_rate, self.leakage = float(network.learning_rate), float(network.leakage)
        self.weight_limit, self.dead_zone_rad = float(network.weight_limit), float(network.dead_zone_rad)
        self.gain = float(axis.velocity.period_gain)
        self.torque_max_Nm = float(axis.limits.torque_max_Nm)
        self.torque_step_Nm = float(axis.limits.torque_rate_max_Nmps) * self.period_s
        self.weights = np.full(len(self.centres), float(network.initial_weight))
        self.last: tuple[float, float] | None = None
        self.velocity_radps = self.error_rate_radps = self.deflection_rad = self.sent_Nm = 0.0

    @staticmethod
    def _branch(branch: Any) -> tuple[Any, ...]:
        return (
            float(branch.coulomb_Nm), float(branch.static_Nm), float(branch.stribeck_speed_radps),
            float(branch.viscous_Nmspr), [float(a) for a in branch.cubic], float(branch.knee_radps),
            float(branch.max_radps),
        )  # fmt: skip

    def _sliding_Nm(self, velocity_radps: float) -> float:
        tc, ts, ws, tv, a, knee, most = self.branches[0 if velocity_radps > 0.0 else 1]
        speed = abs(velocity_radps)
        if speed <= knee:
            return self.ratio * (tc + (ts - tc) * math.exp(-speed / ws) + tv * speed)
        u = min(speed, most)
        torque = a[0] + u * (a[1] + u * (a[2] + u * a[3]))
        return self.ratio * (torque + (speed - u) * (a[1] + u * (2.0 * a[2] + 3.0 * u * a[3])))

    def _friction_Nm(self, velocity_radps: float) -> float:
        speed = abs(velocity_radps)
        if speed == 0.0:
            return self.stiffness_Nmprad * self.deflection_rad
        sliding = self._sliding_Nm(velocity_radps)
        settled = math.copysign(sliding / self.stiffness_Nmprad, velocity_radps)
        moved = settled + (self.deflection_rad - settled) * math.exp(
            -speed * self.period_s * self.stiffness_Nmprad / sliding
        )
        rate = (moved - self.deflection_rad) / self.period_s
        self.deflection_rad = moved
        return self.stiffness_Nmprad * moved + self.damping_Nmspr * rate

    def _network_Nm(self, x: np.ndarray) -> float:
        hidden = np.exp(-np.sum((x - self.centres) ** 2, axis=1) * self.inverse_width)
        output = float(self.weights @ hidden)
        if abs(x[0]) >= self.dead_zone_rad:
            self.weights = (1.0 - self.leakage * self.period_s) * self.weights
            self.weights += self.learning_rate * float(x @ self.p_b) * self.period_s * hidden
            if self.weight_limit > 0.0:
                self.weights = np.clip(self.weights, -self.weight_limit, self.weight_limit)
        return output

    def tick(self, position: float, desired: float, desired_velocity: float, desired_acceleration: float) -> float:
        """The limited torque [Nm]."""
        error = position - desired
        if self.last is not None:
            velocity = (position - self.last[0]) / self.period_s
            rate = (error - self.last[1]) / self.period_s
            self.velocity_radps += self.gain * (velocity - self.velocity_radps)
            self.error_rate_radps += self.gain * (rate - self.error_rate_radps)
        self.last = (position, error)
        torque = self.inertia_kgm2 * (desired_acceleration - self.kv * self.error_rate_radps - self.kp * error)
        torque += self.coriolis_Nmspr * self.velocity_radps
        torque += self.gravity_Nm * math.sin(position - self.gravity_zero_rad)
        torque += self._friction_Nm(desired_velocity)
        torque -= self._network_Nm(np.array((error, self.error_rate_radps)))
        if not math.isfinite(torque):
            torque = 0.0
        torque = min(max(torque, -self.torque_max_Nm), self.torque_max_Nm)
        self.sent_Nm = min(max(torque, self.sent_Nm - self.torque_step_Nm), self.sent_Nm + self.torque_step_Nm)
        return self.sent_Nm

    def ticks(self, inputs: np.ndarray, torque_Nm: np.ndarray) -> None:
        """One tick after another: rows [position, desired position, velocity, acceleration]."""
        for i, row in enumerate(inputs.tolist()):
            torque_Nm[i] = self.tick(*row)
