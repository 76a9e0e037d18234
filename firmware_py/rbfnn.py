"""The adaptive radial basis function network of (14) and (24).

    h_i(x) = exp(-|x - c_i|^2 / (2 b_i^2)),   fhat = w^T h(x),   w' = beta h(x) x^T P B,   x = [e, e']

With the paper's b = 5 and |x| << 1 every h_i lies in [0.9985, 1]: the network is then one integrator,
fhat' = (15 beta / J) (P12 e + P22 e').  Not in the paper, and off at zero: leakage (sigma-modification), projection
of the weights, a dead zone in the error.
"""

from __future__ import annotations

import math

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import NEURONS, NetworkConstants, NetworkState


@kernel
def reset_network(constants: NetworkConstants, state: NetworkState) -> None:
    """Set every weight to its initial value."""
    for i in range(NEURONS):
        state.weights[i] = constants.initial_weight
        state.hidden[i] = 0.0


@kernel
def network_torque_Nm(
    constants: NetworkConstants, state: NetworkState, error_rad: float, error_rate_radps: float
) -> float:
    """Hidden layer and output fhat(x) [Nm at the joint] with the present weights."""
    output = 0.0
    for i in range(NEURONS):
        d1 = error_rad - constants.centres[i, 0]
        d2 = error_rate_radps - constants.centres[i, 1]
        state.hidden[i] = math.exp(-(d1 * d1 + d2 * d2) * constants.inverse_width[i])
    for i in range(NEURONS):
        output += state.weights[i] * state.hidden[i]
    return output


@kernel
def adapt_network(
    constants: NetworkConstants, state: NetworkState, error_rad: float, error_rate_radps: float, period_s: float
) -> None:
    """One explicit Euler step of the adaptation law; call it after `network_torque_Nm` of the same x."""
    if abs(error_rad) < constants.dead_zone_rad:
        return
    drive = error_rad * constants.p_b[0] + error_rate_radps * constants.p_b[1]
    gain = constants.learning_rate * drive * period_s
    keep = 1.0 - constants.leakage * period_s
    for i in range(NEURONS):
        state.weights[i] = keep * state.weights[i] + gain * state.hidden[i]
    limit = constants.weight_limit
    if limit > 0.0:
        for i in range(NEURONS):
            state.weights[i] = min(max(state.weights[i], -limit), limit)
