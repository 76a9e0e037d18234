"""What each kind of fault may do: its sizes, harmful and harmless, and the causes that the loop may then name.

A harmless size is just inside what the limits of `configs/virtual.toml` allow: it must not stop the joint.  Five
kinds have none: a drive that restarts or is in fault is off, a corrupted frame may say anything, and a single sample
counted the wrong way is a leap at any speed worth a trajectory.  Causes are those of the fault itself; `LATE_CAUSES`
may follow any fault that begins when the joint is already being stopped.
"""

from __future__ import annotations

from dataclasses import dataclass

from jointctl.firmware_py.states import Fault
from jointctl.hil.faults.kinds import FaultKind

LONG_s = 30.0  # longer than any scenario
MOTION = frozenset(
    {
        Fault.POSITION_LIMIT, Fault.VELOCITY_LIMIT, Fault.FOLLOWING_ERROR, Fault.POSITION_JUMP, Fault.POSITION_FROZEN,
        Fault.TORQUE_SATURATED, Fault.LIMIT_CYCLE, Fault.STOP_TIMEOUT,
    }
)  # fmt: skip
# what a joint that seems to move, or does, shows before it is enabled
NOT_STARTED = frozenset({Fault.NOT_AT_STANDSTILL, Fault.MOVED_BEFORE_START})
DRIVE = frozenset({Fault.DRIVE_FAULT, Fault.DRIVE_NOT_ENABLED, Fault.DRIVE_RESTARTED})
# before the joint is enabled, or after it was asked to stop, a fault of the wire shows as one of these
LATE_CAUSES = frozenset(
    {
        Fault.NO_SAMPLES, Fault.STALE_SAMPLE, Fault.SAMPLES_MISSING, Fault.ENABLE_TIMEOUT, Fault.STOP_TIMEOUT,
        Fault.OFF_TIMEOUT,
    }
)  # fmt: skip


@dataclass(frozen=True)
class Sizes:
    """Ranges that a scenario draws from, evenly: duration [s] and magnitude (see `FaultKind`)."""

    duration_s: tuple[float, float]
    magnitude: tuple[float, float]
    log_duration: bool = False


@dataclass(frozen=True)
class FaultClass:
    """`certain`: a harmful fault that begins while the joint tracks must be noticed, whatever the motion.

    `emergency`: the drive's own error code that must be told with DRIVE_NOT_ENABLED; 0: any.
    """

    kind: FaultKind
    harmful: Sizes | None
    harmless: Sizes | None
    causes: frozenset[Fault] = frozenset()
    certain: bool = False
    on_wire: bool = False
    emergency: int = 0


def _lost(
    kind: FaultKind, causes: frozenset[Fault], *, certain: bool, harmless_s: float = 0.045, emergency: int = 0
) -> FaultClass:
    return FaultClass(
        kind, Sizes((0.06, LONG_s), (1.0, 1.0), log_duration=True), Sizes((0.001, harmless_s), (1.0, 1.0)),
        causes, certain, True, emergency,
    )  # fmt: skip


RPDO_DEADLINE = 0x8250  # EMCY of a drive whose RPDOs stay away
_ALWAYS = (0.001, LONG_s)
_STALE = frozenset({Fault.STALE_SAMPLE})
_CLASSES = (
    _lost(FaultKind.FRAMES_LOST, _STALE | {Fault.DRIVE_NOT_ENABLED}, certain=True),
    _lost(FaultKind.SYNC_LOST, _STALE, certain=True),
    _lost(
        FaultKind.RPDO_LOST, MOTION | _STALE | {Fault.DRIVE_NOT_ENABLED}, certain=False, harmless_s=0.01,
        emergency=RPDO_DEADLINE,
    ),
    _lost(FaultKind.TPDO_LOST, _STALE | MOTION, certain=True),
    _lost(FaultKind.BUS_OFF, _STALE | {Fault.BUS_ERROR}, certain=True, harmless_s=0.015),
    FaultClass(
        FaultKind.CONTROLLER_HEARTBEAT_LOST, Sizes((0.4, LONG_s), (1.0, 1.0)), Sizes((0.001, 0.06), (1.0, 1.0)),
        _STALE | {Fault.DRIVE_NOT_ENABLED}, True, on_wire=True,
    ),
    FaultClass(
        FaultKind.DRIVE_HEARTBEAT_LOST, Sizes((0.85, LONG_s), (1.0, 1.0)), Sizes((0.001, 0.35), (0.0, 1.0)),
        frozenset({Fault.DRIVE_SILENT}), True, on_wire=True,
    ),
    FaultClass(
        FaultKind.RPDO_DELAYED, Sizes((0.01, 5.0), (0.003, 0.05)), Sizes(_ALWAYS, (0.0001, 0.001)), MOTION,
        on_wire=True,
    ),
    FaultClass(
        FaultKind.TPDO_DELAYED, Sizes((0.01, 5.0), (0.003, 0.05)), Sizes(_ALWAYS, (0.0001, 0.001)), MOTION | _STALE,
        on_wire=True,
    ),
    FaultClass(FaultKind.RPDO_DUPLICATED, None, Sizes(_ALWAYS, (0.0, 1.0)), on_wire=True),
    FaultClass(FaultKind.TPDO_DUPLICATED, None, Sizes(_ALWAYS, (0.0, 1.0)), on_wire=True),
    FaultClass(
        FaultKind.RPDO_REORDERED, Sizes(_ALWAYS, (0.3, 1.0)), Sizes(_ALWAYS, (0.0, 0.3)), MOTION, on_wire=True
    ),
    FaultClass(
        # before enabling, settle_s of good samples in a row are asked for
        FaultKind.TPDO_REORDERED, Sizes(_ALWAYS, (0.3, 1.0)), Sizes(_ALWAYS, (0.0, 0.05)), MOTION, on_wire=True
    ),
    FaultClass(FaultKind.RPDO_CORRUPTED, Sizes((0.0005, 0.003), (0.3, 1.0)), None, MOTION | DRIVE, on_wire=True),
    FaultClass(
        FaultKind.TPDO_CORRUPTED, Sizes((0.0015, 0.05), (0.3, 1.0)), None,
        MOTION | DRIVE | NOT_STARTED | {Fault.DRIVE_STAYS_ENABLED}, on_wire=True,
    ),
    FaultClass(
        FaultKind.RPDO_LENGTH, Sizes((0.06, LONG_s), (0.0, 3.99)), Sizes((0.001, 0.01), (0.0, 8.99)),
        MOTION | _STALE | {Fault.DRIVE_NOT_ENABLED}, on_wire=True, emergency=RPDO_DEADLINE,
    ),
    FaultClass(
        FaultKind.TPDO_LENGTH, Sizes((0.06, LONG_s), (0.0, 7.99)), Sizes((0.001, 0.045), (0.0, 8.99)),
        _STALE | MOTION, True, on_wire=True,
    ),
    FaultClass(FaultKind.FOREIGN_FRAMES, None, Sizes(_ALWAYS, (1.0, 16.0)), on_wire=True),
    FaultClass(
        FaultKind.DRIVE_REBOOT, Sizes(_ALWAYS, (1.0, 1.0)), None,
        frozenset({Fault.DRIVE_RESTARTED, Fault.OFF_TIMEOUT}), True,  # it says nothing more: off is not confirmed
    ),
    FaultClass(FaultKind.DRIVE_FAULT, Sizes((0.01, LONG_s), (1.0, 1.0)), None, frozenset({Fault.DRIVE_FAULT}), True),
    FaultClass(
        FaultKind.ENCODER_STUCK, Sizes((0.05, LONG_s), (1.0, 1.0)), Sizes((0.001, 0.002), (1.0, 1.0)),
        MOTION | NOT_STARTED,
    ),
    FaultClass(
        FaultKind.ENCODER_JUMP, Sizes(_ALWAYS, (0.0205, 1.0)), Sizes(_ALWAYS, (0.00001, 0.0005)),
        MOTION | NOT_STARTED, True,
    ),
    FaultClass(
        FaultKind.ENCODER_DRIFT, Sizes(_ALWAYS, (0.05, 1.0)), Sizes((0.001, 1.0), (0.0001, 0.01)),
        MOTION | NOT_STARTED | {Fault.REFERENCE_LIMIT},
    ),
    FaultClass(FaultKind.ENCODER_REVERSED, Sizes((0.3, LONG_s), (1.0, 1.0)), None, MOTION | NOT_STARTED),
    FaultClass(
        FaultKind.TORQUE_REVERSED, Sizes((0.3, LONG_s), (1.0, 1.0)), Sizes((0.001, 0.002), (1.0, 1.0)), MOTION
    ),
    FaultClass(
        FaultKind.TORQUE_SATURATED, Sizes((0.05, LONG_s), (0.0, 30.0)), Sizes(_ALWAYS, (58.0, 100.0)), MOTION
    ),
    FaultClass(
        FaultKind.CURRENT_LOOP_DEAD, Sizes((0.05, LONG_s), (1.0, 1.0)), Sizes((0.001, 0.002), (1.0, 1.0)), MOTION
    ),
    FaultClass(
        FaultKind.LOAD_JUMP, Sizes((0.01, 0.2), (15.0, 40.0)), Sizes(_ALWAYS, (0.5, 4.0)),
        MOTION | NOT_STARTED,
    ),
    FaultClass(
        FaultKind.LOOP_HELD_UP, Sizes((0.06, 1.0), (1.0, 1.0)), Sizes((0.001, 0.025), (1.0, 1.0)),
        MOTION | _STALE | {Fault.OVERRUN, Fault.DRIVE_NOT_ENABLED}, True, on_wire=True,
    ),
    FaultClass(
        FaultKind.CLOCK_STEP, Sizes((0.01, 0.01), (0.06, 100.0)), Sizes((0.01, 0.01), (0.001, 0.045)),
        frozenset({Fault.OVERRUN}), True,
    ),
    FaultClass(
        FaultKind.SUPERVISOR_SILENT, Sizes((1.05, LONG_s), (1.0, 1.0)), Sizes((0.01, 0.95), (1.0, 1.0)),
        frozenset({Fault.SUPERVISOR_LOST}),
    ),
)  # fmt: skip
FAULT_CLASSES = {item.kind: item for item in _CLASSES}
EMERGENCY_CODES = (0x2311, 0x3120, 0x3310, 0x4310, 0x5441, 0x7121, 0x7300, 0x8480, 0x8611)
SIGNED = frozenset({FaultKind.ENCODER_JUMP, FaultKind.ENCODER_DRIFT, FaultKind.LOAD_JUMP})
