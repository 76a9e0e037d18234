"""A reading of the position that stands still although the joint must move."""

from __future__ import annotations

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import AxisConstants, AxisState
from jointctl.firmware_py.sequence import trip
from jointctl.firmware_py.states import CommandKind, Fault

# at a torque that a sound joint gives way to: it moves by a milliradian in that time
PUSHED_CYCLES = 20


@kernel
def check_reading(constants: AxisConstants, state: AxisState, elapsed_cycles: int) -> None:
    """A reading that stands still although the reference moves on, or although the joint is pushed hard.

    It must be early: behind a stuck encoder the law pushes ever harder, and the joint moves unseen, long before the
    following error is too large.  Where the drive closes the velocity loop, the torque is the one that it measures.
    Of an overrun's `elapsed_cycles`, the reference's way counts for one: the drive was told of no other.
    """
    limits = constants.limits
    torque_Nm = state.command_torque_Nm
    if constants.command_kind == CommandKind.VELOCITY:
        torque_Nm = state.measured_torque_Nm
    state.frozen_way_rad += (state.reference.position_rad - state.frozen_reference_rad) / elapsed_cycles
    state.frozen_reference_rad = state.reference.position_rad
    way_rad = state.frozen_way_rad
    if state.frozen_samples == 0:
        state.frozen_way_rad = 0.0
        state.pushed_cycles = 0
    elif state.sample_age_cycles == 0:
        if 0.0 < limits.frozen_max_rad < abs(way_rad):
            trip(state, Fault.POSITION_FROZEN, way_rad, 0)
        if 0.0 < limits.frozen_torque_Nm < abs(torque_Nm):
            state.pushed_cycles += 1
            if state.pushed_cycles > PUSHED_CYCLES:
                trip(state, Fault.POSITION_FROZEN, way_rad, 0)
        else:
            state.pushed_cycles = 0
