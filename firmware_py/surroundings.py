"""What the loop checks apart from the motion: drive, bus, schedule and supervisor."""

from __future__ import annotations

from jointctl.firmware_py.kernel import kernel
from jointctl.firmware_py.records import AxisConstants, AxisState, Sample
from jointctl.firmware_py.safety import drive_fault
from jointctl.firmware_py.sequence import latch_fault, powered, react, trip
from jointctl.firmware_py.states import AxisPhase, DriveState, Fault, Reaction


@kernel
def _check_drive(state: AxisState, sample: Sample) -> None:
    """Restart, fault, or not enabled any more.

    A drive that brakes by itself (Quick Stop Active, on its watchdog say) is left braking: power off would make it
    coast, and drop a load.
    """
    fault = drive_fault(sample.drive_state, powered(state.phase), sample.restarts)
    if fault == Fault.DRIVE_NOT_ENABLED and sample.drive_state == DriveState.STOPPING:
        latch_fault(state, fault, float(sample.status_word), sample.drive_error)
        react(state, Reaction.QUICK_STOP)
    else:
        trip(state, fault, float(sample.status_word), sample.drive_error)


@kernel
def check_surroundings(
    constants: AxisConstants, state: AxisState, sample: Sample, skipped_cycles: int, supervisor_age_cycles: int
) -> None:
    """Faults of the drive, the bus, the schedule and the supervisor; the drive's first, it tells most of the cause."""
    if state.phase >= AxisPhase.DISABLING:
        return
    _check_drive(state, sample)
    limits = constants.limits
    if state.phase >= AxisPhase.ENABLING and state.phase <= AxisPhase.RELEASING:
        if state.sample_age_cycles > limits.sample_age_max_cycles:
            trip(state, Fault.STALE_SAMPLE, float(state.sample_age_cycles), sample.drive_error)
        if sample.bus_errors > limits.sample_age_max_cycles:
            trip(state, Fault.BUS_ERROR, float(sample.bus_errors), 0)
        # not before: in WAITING the power is off, and without the supervisor's word it stays off
        if 0 < constants.sequence.supervisor_max_cycles < supervisor_age_cycles:
            trip(state, Fault.SUPERVISOR_LOST, float(supervisor_age_cycles), 0)
        # last: samples that stay away as well tell more, and sooner
        if 0 < limits.heartbeat_age_max_cycles < sample.heartbeat_age_cycles:
            trip(state, Fault.DRIVE_SILENT, float(sample.heartbeat_age_cycles), sample.drive_error)
    if powered(state.phase) and skipped_cycles > limits.skipped_max_cycles:
        trip(state, Fault.OVERRUN, float(skipped_cycles), 0)


@kernel
def check_suspension(state: AxisState, suspended_s: float) -> None:
    """The computer slept for so long: nobody watched, whatever the clock of the loop says."""
    if state.phase < AxisPhase.QUICK_STOPPING:
        trip(state, Fault.SUSPENDED, suspended_s, 0)
