"""What a run is about to do, in words, before anything moves."""

from __future__ import annotations

from collections.abc import Iterable

from jointctl.drivers.drive import CommissioningReport
from jointctl.firmware_py.records import Reference
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.trajectory import peak_of, reference_at
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.records import axis_constants, trajectory_table


def motion_envelope(config: Config, report: CommissioningReport) -> list[str]:
    """Lines that say where the joint will go, how fast, with how much torque, for how long."""
    constants = axis_constants(config, start_position_rad=report.start_position_rad)[0]
    table = trajectory_table(config)
    low, high, speed, acceleration = peak_of(constants.trajectory, table)
    first = new(Reference)[0]
    reference_at(constants.trajectory, table, 0, 0.0, first)
    approach = float(constants.sequence.approach_s)
    limits = config.limits
    duration = config.trajectory.duration_s
    time_text = f"{approach + duration:.0f} s" if duration else "until stopped"
    lines = [
        *where_lines(report),
        f"approach   to {first.position_rad:+.4f} rad in {approach:.1f} s"
        if approach
        else f"approach   none: at once to {first.position_rad:+.4f} rad",
        f"trajectory {config.trajectory.kind}: {low:+.4f} .. {high:+.4f} rad, up to {speed:.3f} rad/s "
        f"and {acceleration:.3f} rad/s2, {time_text}",
        f"limits     {limits.position_min_rad:+.3f} .. {limits.position_max_rad:+.3f} rad, "
        f"{limits.velocity_max_radps:.2f} rad/s, {limits.torque_max_Nm:.1f} Nm, "
        f"following error {limits.following_error_max_rad:.3f} rad",
    ]
    return lines + remark_lines(report.remarks)


def where_lines(report: CommissioningReport) -> list[str]:
    """Which drive it is, and where the joint stands."""
    identity = report.identity
    return [
        f"drive      {identity.name or 'unnamed'}, vendor {identity.vendor}, serial {identity.serial or 'unknown'}, "
        f"{report.mode}",
        f"now at     {report.start_position_rad:+.4f} rad",
    ]


def remark_lines(remarks: Iterable[str]) -> list[str]:
    return [f"remark     {remark}" for remark in remarks]
