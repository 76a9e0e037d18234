"""What must hold before the user is asked whether the joint may move: a yes must not be refused afterwards."""

from __future__ import annotations

from pathlib import Path

from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import MotionFault
from jointctl.firmware_py.states import Fault
from jointctl.tools.configuration.config import Config
from jointctl.tools.output import Output
from jointctl.tools.recording.log_folder import remove_oldest, require_room
from jointctl.tools.running.events.fault_text import fault_text


def require_ready(config: Config, report: CommissioningReport, log_path: Path) -> None:
    """`MotionFault` if the joint stands outside its limits, `DataError` if the log could not be written."""
    limits, start_rad = config.limits, report.start_position_rad
    if not limits.position_min_rad <= start_rad <= limits.position_max_rad:
        text = fault_text(Fault.POSITION_LIMIT, start_rad, 0)
        raise MotionFault(
            f"{Fault.POSITION_LIMIT.name} ({int(Fault.POSITION_LIMIT)}): the joint stands at {start_rad:.4f} rad, "
            f"which must be in [{limits.position_min_rad:g}..{limits.position_max_rad:g}], the limits.position_*",
            text.advice,
        )
    require_room(config, log_path)


def prepare_log(config: Config, log_path: Path, output: Output) -> None:
    """Make way for a new log; one that cannot be removed is no reason not to run."""
    try:
        removed = remove_oldest(config, log_path)
    except OSError as error:
        output.warning(f"{log_path.parent}: an old log cannot be removed: {error.strerror or error}")
        return
    if removed:
        files = "1 file" if len(removed) == 1 else f"{len(removed)} files"
        output.note(f"{log_path.parent}: {files} of older runs removed (log.keep = {config.log.keep})")
