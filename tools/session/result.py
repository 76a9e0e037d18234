"""What a run leaves behind: how the drive is, figures, log, picture, and what is said at its end."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Group
from rich.table import Table

from jointctl.drivers.drive import UNTOUCHED, CommissioningReport, is_safe
from jointctl.drivers.errors import DECLINED, INTERRUPTED, DataError, DeviceError, MotionFault
from jointctl.firmware_py.states import Fault
from jointctl.tools.configuration.config import Config
from jointctl.tools.output import Output
from jointctl.tools.recording.run_summary import RunSummary, save_run_figure, summary_table
from jointctl.tools.session.fault_words import FaultText, ended_by

if TYPE_CHECKING:
    from jointctl.tools.configuration.arm import ArmConfig

# --- How a run leaves the drive: code that reports to the user that it is disabled asks here first ---


ADVICE = "use the emergency stop"


def _off(state: str) -> bool:
    """Also a drive that this program has not taken over ("": not even opened)."""
    return state in ("", UNTOUCHED) or is_safe(state)


def warn_unless_off(state: str, output: Output) -> None:
    """One line where the power stage may be on."""
    if not _off(state):
        with contextlib.suppress(OSError):  # the terminal may have been closed
            output.warning(f"the drive did not confirm that it is off: {state}; {ADVICE}")


def require_off(state: str) -> None:
    """`DeviceError` with the true state where the power stage may be on."""
    if not _off(state):
        raise DeviceError(f"the drive did not confirm that it is off (={state})", ADVICE)


def words(state: str, *, interrupted: bool = False) -> str:
    """For a run that was not begun: how the drive is; `DeviceError` as above.

    `interrupted`: by the user, which is why the drive was not taken over, if it was not.
    """
    require_off(state)
    if state == UNTOUCHED and interrupted:
        return "the drive was left as it is"
    if state == UNTOUCHED:
        return "the drive was left alone: another controller has it"
    return "the drive is disabled" if state else "no drive was used"


def never_begun(state: str, output: Output, *, dry_run: bool = False) -> int:
    """A run that was declined, or a dry run: says how the drive is, and returns the exit code."""
    left = words(state)
    output.note(f"dry run: nothing moved; the drive was commissioned; {left}" if dry_run else f"nothing moved; {left}")
    return 0 if dry_run else DECLINED


def broken_off(state: str, output: Output, by_command: str) -> int:
    """A run that was interrupted before it was begun, `by_command` as `StopSignals` has it; returns the exit code."""
    output.note(f"interrupted{by_command}; nothing moved")
    require_off(state)
    return INTERRUPTED


@dataclass(frozen=True)
class RunResult:
    """What a run left behind."""

    summary: RunSummary
    records: Any
    histograms: np.ndarray[Any, Any]
    fault: Fault
    fault_text: FaultText | None
    stopped_by: str  # name of the signal, or ""
    drive_state: str  # in words, read after the run
    bus_load: float  # measured share: CAN with worst-case stuffing, a serial line in its busier direction
    load_row: tuple[str, str]  # the same in words
    lost_records: int
    log_path: Path
    report: CommissioningReport
    name: str = ""  # of the joint, where it is one of several
    others: tuple[RunResult, ...] = ()  # the other joints of an arm
    fault_slot_ns: int = 0  # the loop's time of the fault
    fault_value: float = 0.0  # that tripped the limit
    log_lost: bool = False  # it was removed during the run, which has warned of it

    @property
    def joints(self) -> tuple[RunResult, ...]:
        """One result for each joint."""
        return (self, *self.others)

    @property
    def log_place(self) -> str:
        """In words."""
        return "lost" if self.log_lost else str(self.log_path)

    @property
    def faulty(self) -> list[RunResult]:
        """The joints with a fault, the one that had it first before those that its stop has reached."""
        return sorted((joint for joint in self.joints if joint.fault_text), key=lambda joint: joint.fault_slot_ns)

    def motion_fault(self) -> MotionFault:
        """The fault of this joint, which must have one."""
        assert self.fault_text is not None
        name = f"{self.name}: " if self.name else ""
        return ended_by(self.fault, self.fault_text, before=name)


# --- What a run says at its end: a fault in words, then the picture beside the log, and the table on stdout ---


def run_title(config: Config | ArmConfig, motion: str = "") -> str:
    """What a run is called on its displays and its picture; `motion` where it is not the configured trajectory."""
    return f"{config.path.stem}: {motion or _first(config).trajectory.kind}"


def _first(config: Config | ArmConfig) -> Config:
    return config if isinstance(config, Config) else config.joints[0]


def report_run(result: RunResult, output: Output, config: Config | ArmConfig, motion: str = "") -> int:
    """Print and save everything, and a picture of each joint unless log.picture forbids it; returns the exit code.

    That is 0, the one of `MotionFault`, of `DataError` where a log is lost, or 130 after an interruption.  The cause of
    a fault comes before all else, and what people read before the picture, which takes a second or more.
    `DeviceError` where the drive did not confirm that it is off; both outweigh the `DataError` of a result that cannot
    be written.
    """
    joints, title = result.joints, run_title(config, motion)
    faulty = [joint.motion_fault() for joint in result.faulty]
    for fault in faulty:
        output.error(fault.message, fault.hint)
    wanted = [joint for joint in joints if _first(config).log.picture and not joint.log_lost]
    drawn = {} if output.for_people else {joint.name: _drawn(joint, output, title) for joint in wanted}
    tables = [_table(joint) for joint in joints]
    data = [_data(joint, drawn.get(joint.name)) for joint in joints]
    try:
        if result.others:
            named = [{"name": joint.name, **values} for joint, values in zip(joints, data, strict=True)]
            output.result(Group(*tables), {"joints": named}, result)
        else:
            output.result(tables[0], data[0], result)
        for joint in wanted if output.for_people else ():
            if path := _drawn(joint, output, title):
                output.result(f"picture    {path}")
    except DataError as error:
        if not faulty:
            require_off(result.drive_state)
            raise
        output.warning(error.message)
    if lost := sum(joint.lost_records for joint in joints):
        output.warning(f"{lost} log records were lost: the supervisor was too slow")
    if faulty:
        return MotionFault.exit_code
    require_off(result.drive_state)
    if any(joint.log_lost for joint in joints):
        return DataError.exit_code
    if result.stopped_by:
        whose = "the joints are" if result.others else "the joint is"
        output.note(f"stopped by {result.stopped_by}; {whose} {result.drive_state}")
        return INTERRUPTED
    return 0


def _table(result: RunResult) -> Table:
    table = summary_table(result.summary)
    if result.name:
        table.title = f"Run of {result.name}"
    table.add_row(*result.load_row)
    table.add_row("drive afterwards", result.drive_state)
    table.add_row("log", result.log_place)
    return table


def _drawn(result: RunResult, output: Output, title: str) -> Path | None:
    """The picture beside the log; why there is none then is a warning."""
    title = f"{title}, {result.name}" if result.name else title
    try:
        return save_run_figure(result.records, result.log_path.with_suffix(".png"), title)
    except DataError as error:
        output.warning(error.message)
        return None


def _data(result: RunResult, picture: Path | None) -> dict[str, Any]:
    return {
        **result.summary.to_dict(),
        "bus_load": result.bus_load,
        "fault": None if result.fault is Fault.NONE else result.fault.name,
        "stopped_by": result.stopped_by or None,
        "drive_state": result.drive_state,
        "lost_records": result.lost_records,
        "log": None if result.log_lost else str(result.log_path),
        "picture": None if picture is None else str(picture),
    }
