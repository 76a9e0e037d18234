"""Disturbance observer: what the model does not explain, estimated from momentum and applied torque.

    r = L (z - J q'),   z' = tau_applied - known + r        =>   r' = L (d - r),   d = known parts of the model missing

`r` [Nm at the joint] follows minus the unknown torque with bandwidth L [rad/s]; the law adds it with the sign that
cancels.  No acceleration is differentiated.  The applied torque is the one that was sent, limited, as many cycles
ago as a command needs to become torque, so that saturation does not wind the observer up.  `known` is that of this
cycle, or, `paired`, that of the same command: then friction fed forward ahead of the motion is no disturbance.  While
the joint hardly moves (the average of the desired speed over AVERAGE_s is below PAIRED_FROM_radps) the other way is
the better one all the same: bristles load up over a distance, and a joint that sticks breaks loose with less torque.
"""

from __future__ import annotations

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import TORQUE_HISTORY, ObserverConstants, ObserverState

AVERAGE_s = 0.1
PAIRED_FROM_radps = 0.005


@kernel
def reset_observer(state: ObserverState, momentum_Nms: float) -> None:
    """No disturbance known, the joint moving with the given momentum."""
    state.integral_Nms = momentum_Nms
    state.disturbance_Nm = 0.0
    state.newest = 0
    state.primed = 0
    state.known_torque_Nm = 0.0
    state.speed_radps = 0.0
    for i in range(TORQUE_HISTORY):
        state.known_Nm[i] = 0.0
        state.sent_torque_Nm[i] = 0.0


@kernel
def applied_torque_Nm(constants: ObserverConstants, state: ObserverState, sent_torque_Nm: float) -> float:
    """The torque at work: that of `delay_cycles` before the command of the cycle before, which it takes note of."""
    state.newest = (state.newest + 1) % TORQUE_HISTORY
    state.sent_torque_Nm[state.newest] = sent_torque_Nm
    delay = min(max(constants.delay_cycles, 0), TORQUE_HISTORY - 1)
    return state.sent_torque_Nm[(state.newest - delay + TORQUE_HISTORY) % TORQUE_HISTORY]


@kernel
def known_since_Nm(constants: ObserverConstants, state: ObserverState, known_Nm: float) -> float:
    """What a paired observer that is not to be paired leaves to the model [Nm]: the change of what was fed forward
    between the command that is at work and this cycle.  Call it before `step_observer`."""
    at = (state.newest + 1) % TORQUE_HISTORY
    state.known_Nm[at] = known_Nm
    if state.speed_radps >= PAIRED_FROM_radps:
        return 0.0
    late = min(max(constants.delay_cycles, 0) + 1, TORQUE_HISTORY - 1)
    return known_Nm - state.known_Nm[(at - late + TORQUE_HISTORY) % TORQUE_HISTORY]


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
    applied = applied_torque_Nm(constants, state, sent_torque_Nm)
    state.integral_Nms += period_s * (applied - known_torque_Nm - state.disturbance_Nm)
    state.disturbance_Nm = constants.bandwidth_radps * (state.integral_Nms - momentum_Nms)
    return state.disturbance_Nm


@kernel
def add_to_disturbance(constants: ObserverConstants, state: ObserverState, torque_Nm: float) -> None:
    """Hand a torque over to the observer without a jump of their sum (iterative learning that starts anew)."""
    if constants.bandwidth_radps > 0.0:
        state.integral_Nms += torque_Nm / constants.bandwidth_radps
        state.disturbance_Nm += torque_Nm
        if constants.paired != 0:  # as if it had been the observer's in the commands that are no torque yet, too
            for i in range(TORQUE_HISTORY):
                state.sent_torque_Nm[i] += torque_Nm
                state.known_Nm[i] -= torque_Nm
