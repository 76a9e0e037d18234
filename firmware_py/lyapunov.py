"""The Lyapunov equation P A + A^T P = -Q of (21) for the error dynamics A = [[0, 1], [-kp, -kv]]."""

from __future__ import annotations

import math

from jointctl.firmware_py.kernel import kernel, plain


@kernel
def right_column_of_p(kp: float, kv: float, q1: float, q2: float) -> tuple[float, float]:
    """(P12, P22), all that the adaptation law needs of P; nothing is checked."""
    p12 = q1 / (2.0 * kp)
    return p12, (q2 + 2.0 * p12) / (2.0 * kv)


_right_column_of_p = plain(right_column_of_p)


def solve_lyapunov_p(kp: float, kv: float, q1: float, q2: float) -> tuple[float, float, float]:
    """(P11, P12, P22) for Q = diag(q1, q2), in closed form; kp, kv > 0.

    The off-diagonal and lower right elements give P12 = q1 / (2 kp) and P22 = (q2 + 2 P12) / (2 kv);
    the off-diagonal equation gives P11 = kp P22 + kv P12.
    """
    if not (kp > 0.0 and kv > 0.0):
        raise ValueError(f"kp (={kp:g}) and kv (={kv:g}) must be > 0: the error dynamics would not be stable")
    if not (q1 > 0.0 and q2 > 0.0):
        raise ValueError(f"Q (=diag({q1:g}, {q2:g})) must be positive definite")
    p12, p22 = _right_column_of_p(kp, kv, q1, q2)
    return kp * p22 + kv * p12, p12, p22


def eigenvalues(p11: float, p12: float, p22: float) -> tuple[float, float]:
    """(smallest, largest) eigenvalue of the symmetric 2x2 matrix; the smaller without cancellation."""
    largest = 0.5 * (p11 + p22) + math.hypot(0.5 * (p11 - p22), p12)
    return (p11 * p22 - p12 * p12) / largest, largest


def ultimate_bounds(
    p11: float, p12: float, p22: float, q1: float, q2: float, inertia_kgm2: float, residual_Nm: float
) -> tuple[float, float]:
    """Bounds on |x| = |(e, e')| for |eps| <= residual_Nm: (as (30) prints it, the tighter one with |P B|).

    (30) uses |M0^-1| lmax(P); the term that appears in V' is x^T P B eps, so |P B| is enough.
    """
    smallest_q = min(q1, q2)
    loose = 2.0 * eigenvalues(p11, p12, p22)[1] / inertia_kgm2 * residual_Nm / smallest_q
    tight = 2.0 * math.hypot(p12, p22) / inertia_kgm2 * residual_Nm / smallest_q
    return loose, tight
