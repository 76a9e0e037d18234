"""What must hold before the user is asked whether the joint may move: a yes must not be refused afterwards."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jointctl.drivers.drive import CommissioningReport
from jointctl.drivers.errors import ConfigurationError, MotionFault
from jointctl.firmware_py.records import TrajectoryConstants
from jointctl.firmware_py.schema import new
from jointctl.firmware_py.states import Fault
from jointctl.firmware_py.trajectory import approach_start
from jointctl.tools.configuration.config import Config
from jointctl.tools.configuration.records import fill_trajectory, trajectory_table
from jointctl.tools.output import Output
from jointctl.tools.recording.log_folder import remove_oldest, require_room
from jointctl.tools.running.events.fault_text import fault_text

START_SHARE = 0.1  # of the following error: how far from the trajectory a run without an approach may begin


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


def require_start(config: Config, start_rad: float) -> None:
    """`MotionFault` if there is no approach and the trajectory begins elsewhere: the law would pull the joint there."""
    if config.sequence.approach_s != 0.0:
        return
    constants = new(TrajectoryConstants)
    fill_trajectory(constants[0], config)
    first_rad = float(approach_start(constants[0], trajectory_table(config)).position_rad)
    allowed_rad = START_SHARE * config.limits.following_error_max_rad
    if not abs(first_rad - start_rad) <= allowed_rad:
        raise MotionFault(
            f"the joint stands at {start_rad:.4f} rad, and with sequence.approach_s (=0) it must stand within "
            f"{allowed_rad:g} rad of the beginning of the trajectory, {first_rad:.4f} rad",
            'give it time, sequence.approach_s = "auto"; without, it would be pulled there with all its torque',
        )


def require_same_motion(config: Config, table: np.ndarray) -> None:
    """`ConfigurationError` if trajectory.file is another one than the loop has got: times and envelope are its own."""
    if not np.array_equal(trajectory_table(config), table):
        raise ConfigurationError(
            f"{config.path}: trajectory.file was changed after it had been read; nothing moved",
            "start again: the motion that was shown is not the one that the loop has",
        )


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
