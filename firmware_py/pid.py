"""PID on the joint's inertia, the honest baseline: no model but J.

    tau = J (q_d'' - kd e' - kp e - ki int(e) dt)

A triple pole p needs kd = 3 p, kp = 3 p^2, ki = p^3.
"""

from __future__ import annotations

from jointctl.firmware_py.kernel import kernel


@kernel
def integrate_error(integral_rads: float, error_rad: float, period_s: float, limit_rads: float) -> float:
    """Next value of the integral [rad s], held within +-limit (0 = no limit)."""
    moved = integral_rads + error_rad * period_s
    if limit_rads > 0.0:
        return min(max(moved, -limit_rads), limit_rads)
    return moved
