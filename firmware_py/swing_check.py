"""A joint that swings instead of settling, a command that is noise, learning that makes it worse.

What counts as a swing is in `safety`.
"""

from __future__ import annotations

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import AxisConstants, AxisState, Sample
from jointctl.firmware_py.safety import note_rest, swing_fault, swing_Hz, torque_noise
from jointctl.firmware_py.sequence import powered, trip
from jointctl.firmware_py.states import AxisPhase, Fault, Notice


@kernel
def watch_rest(constants: AxisConstants, state: AxisState, sample: Sample) -> None:
    """A new sample, before its velocity is taken: while the power is off, what does the reading do by itself?"""
    if state.phase == AxisPhase.WAITING:
        moving = not abs(state.velocity.velocity_radps) <= constants.limits.standstill_radps
        note_rest(state.swing, sample.position_rad, state.velocity.primed == 0 or moving)


@kernel
def check_swing(constants: AxisConstants, state: AxisState, torque_Nm: float) -> None:
    """A torque or an error that swings while the law is active; `torque_Nm` is the command, or the measured torque.

    What the desired acceleration asks for is no swing, however quick.  While the torque is released, nothing is looked
    at: the law is no longer active.
    """
    if state.phase < AxisPhase.APPROACH or state.phase > AxisPhase.RAMPING:
        return
    reference = state.reference
    fault = swing_fault(
        constants.limits,
        state.swing,
        torque_Nm - constants.law.inertia_kgm2 * reference.acceleration_radps2,
        state.measured_position_rad - reference.position_rad,
        reference.velocity_radps,
        state.cycle,
    )
    if fault != Fault.NONE:
        trip(state, fault, swing_Hz(state.swing, constants.law.period_s), 0)


@kernel
def take_notice(constants: AxisConstants, state: AxisState, torque_Nm: float) -> None:
    """What is reported without ending the run; `torque_Nm` is the command that follows `state.command_torque_Nm`."""
    if not powered(state.phase):
        return
    if torque_noise(constants.limits.swing, state.swing, torque_Nm - state.command_torque_Nm):
        if state.notices & Notice.TORQUE_NOISE == 0:
            state.swing.noise_told_Nm = state.swing.noise_Nm
        state.notices |= Notice.TORQUE_NOISE
    if state.law.learning.stopped != 0:
        state.notices |= Notice.LEARNING_OFF
