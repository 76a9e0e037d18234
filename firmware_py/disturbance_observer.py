"""Disturbance observer: what the model does not explain, estimated from momentum and applied torque.

    r = L (z - J q'),   z' = tau_applied - known + r        =>   r' = L (d - r),   d = known parts of the model missing

`r` [Nm at the joint] follows minus the unknown torque with bandwidth L [rad/s]; the law adds it with the sign that
cancels.  No acceleration is differentiated.  The applied torque is the one that was sent, limited, as many cycles ago
as a command needs to become torque, so that saturation does not wind the observer up.
"""

from __future__ import annotations

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import TORQUE_HISTORY, ObserverConstants, ObserverState


@kernel
def reset_observer(state: ObserverState, momentum_Nms: float) -> None:
    """No disturbance known, the joint moving with the given momentum."""
    state.integral_Nms = momentum_Nms
    state.disturbance_Nm = 0.0
    state.newest = 0
    for i in range(TORQUE_HISTORY):
        state.sent_torque_Nm[i] = 0.0


@kernel
def step_observer(
    constants: ObserverConstants,
    state: ObserverState,
    sent_torque_Nm: float,
    known_torque_Nm: float,
    momentum_Nms: float,
    period_s: float,
) -> float:
    """Disturbance [Nm], positive when it opposes positive motion; to be added to the torque.

    `sent_torque_Nm` is the command of the cycle before; `known_torque_Nm` what the model says opposes the motion
    (friction, gravity), `momentum_Nms` is J q'.
    """
    state.newest = (state.newest + 1) % TORQUE_HISTORY
    state.sent_torque_Nm[state.newest] = sent_torque_Nm
    delay = min(max(constants.delay_cycles, 0), TORQUE_HISTORY - 1)
    applied = state.sent_torque_Nm[(state.newest - delay + TORQUE_HISTORY) % TORQUE_HISTORY]
    state.integral_Nms += period_s * (applied - known_torque_Nm - state.disturbance_Nm)
    state.disturbance_Nm = constants.bandwidth_radps * (state.integral_Nms - momentum_Nms)
    return state.disturbance_Nm


@kernel
def add_to_disturbance(constants: ObserverConstants, state: ObserverState, torque_Nm: float) -> None:
    """Hand a torque over to the observer without a jump of their sum (iterative learning that starts anew)."""
    if constants.bandwidth_radps > 0.0:
        state.integral_Nms += torque_Nm / constants.bandwidth_radps
        state.disturbance_Nm += torque_Nm
