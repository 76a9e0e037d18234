"""What a run says at its end: a fault in words, then the picture beside the log, and the table on stdout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jointctl.drivers.errors import INTERRUPTED, DataError, MotionFault
from jointctl.firmware_py.states import Fault
from jointctl.tools.configuration.config import Config
from jointctl.tools.output import Output
from jointctl.tools.recording.run_figure import save_run_figure
from jointctl.tools.recording.run_summary import summary_table
from jointctl.tools.running.result.drive_end import require_off
from jointctl.tools.running.result.run_result import RunResult


def run_title(config: Config) -> str:
    """What a run is called on its displays and its picture."""
    return f"{config.path.stem}: {config.trajectory.kind}"


def report_run(result: RunResult, output: Output, config: Config) -> int:
    """Print and save everything, and a picture unless log.picture forbids it; returns the exit code.

    That is 0, the one of `MotionFault`, or 130 after an interruption.  The cause of a fault comes before all
    else: on a busy computer the picture takes seconds.  `DeviceError` where the drive did not confirm that it is off;
    both outweigh the `DataError` of a result that cannot be written.
    """
    if result.fault_text is not None:
        text = result.fault_text
        output.error(f"{result.fault.name} ({int(result.fault)}): {text.happened}", text.advice)
    drawn = result.log_path.with_suffix(".png") if config.log.picture else None
    if drawn is not None:
        try:
            save_run_figure(result.records, drawn, run_title(config))
        except DataError as error:
            output.warning(error.message)
            drawn = None
    table = summary_table(result.summary)
    if result.serial:
        table.add_row("line load", f"{result.bus_load:.1%} of the characters from the drive")
    else:
        table.add_row("bus load", f"{result.bus_load:.1%} at worst-case stuffing")
    table.add_row("drive afterwards", result.drive_state)
    table.add_row("log", str(result.log_path))
    if drawn is not None:
        table.add_row("picture", str(drawn))
    try:
        output.result(table, _data(result, drawn))
    except DataError as error:
        if result.fault_text is None:
            require_off(result.drive_state)
            raise
        output.warning(error.message)
    if result.lost_records:
        output.warning(f"{result.lost_records} log records were lost: the supervisor was too slow")
    if result.fault_text is not None:
        return MotionFault.exit_code
    require_off(result.drive_state)
    if result.stopped_by:
        output.note(f"stopped by {result.stopped_by}; the joint is {result.drive_state}")
        return INTERRUPTED
    return 0


def _data(result: RunResult, picture: Path | None) -> dict[str, Any]:
    return {
        **result.summary.to_dict(),
        "bus_load": result.bus_load,
        "fault": None if result.fault is Fault.NONE else result.fault.name,
        "stopped_by": result.stopped_by or None,
        "drive_state": result.drive_state,
        "lost_records": result.lost_records,
        "log": str(result.log_path),
        "picture": None if picture is None else str(picture),
    }
