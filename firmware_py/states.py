"""The named integers that the loop, the drivers and the log share."""

from __future__ import annotations

from enum import IntEnum


def in_words(member: IntEnum) -> str:
    """`quick stopping` of QUICK_STOPPING."""
    return member.name.lower().replace("_", " ")


def fault_name(code: int) -> str:
    """`POSITION_LIMIT`; `FAULT_99` for a number that this version does not know, as a log of a newer one may hold."""
    return Fault(code).name if code in list(Fault) else f"FAULT_{code}"


class DriveState(IntEnum):
    """What a drive of any make is doing (a driver maps its own states onto these)."""

    UNKNOWN = 0  # nothing heard yet, or not ready
    OFF = 1  # power stage off
    STARTING = 2  # on the way to ENABLED, no torque yet
    ENABLED = 3  # follows the command
    STOPPING = 4  # the drive itself brakes (quick stop)
    FAULT = 5  # power off because of a fault
    FAULT_BRAKING = 6  # still carrying out the reaction to a fault
    PREPARED = 7  # one step before ENABLED: the power stage is on, a brake still closed


class DriveRequest(IntEnum):
    """What the loop wants of the drive; the driver finds the way there."""

    OFF = 0
    ENABLE = 1
    QUICK_STOP = 2
    PREPARE = 3  # up to PREPARED, and back to it from ENABLED


class AxisPhase(IntEnum):
    """Where the joint is in the life of one run; only ever goes forward."""

    WAITING = 0  # power off, waiting for valid samples at standstill
    ENABLING = 1  # the drive is asked to enable, torque zero
    APPROACH = 2  # from where the joint stands to the start of the trajectory
    TRACKING = 3
    RAMPING = 4  # controlled braking of the reference, the law active
    RELEASING = 5  # standstill, torque ramped to zero
    QUICK_STOPPING = 6  # the drive brakes by itself
    DISABLING = 7  # power off requested, waiting for the drive to say so
    FINISHED = 8


class Reaction(IntEnum):
    """What the loop does about a fault or a stop request; a greater one replaces a smaller one."""

    NONE = 0
    RAMP = 1  # brake along a ramp under control, then release and disable
    QUICK_STOP = 2  # the drive brakes by itself, then disable
    OFF = 3  # power off at once


class Fault(IntEnum):
    """Why a run was ended by the loop; the first one is latched.  A row is name, code, and reaction.

    The reaction is that of the phases in which the loop commands torque (`safety.powered`).  Before them, and when the
    drive brakes already, power off is the reaction to each.  OFF only where the drive does not follow anyway: it drops
    a gravity load.  RAMP only where measurement and law can still be trusted.
    """

    reaction: Reaction

    def __new__(cls, code: int, reaction: Reaction = Reaction.QUICK_STOP) -> Fault:
        fault = int.__new__(cls, code)
        fault._value_ = code
        fault.reaction = reaction
        return fault

    NONE = 0, Reaction.NONE
    POSITION_LIMIT = 1, Reaction.QUICK_STOP
    VELOCITY_LIMIT = 2, Reaction.QUICK_STOP
    REFERENCE_LIMIT = 3, Reaction.RAMP  # the desired position or velocity left the limits
    FOLLOWING_ERROR = 4, Reaction.QUICK_STOP
    STALE_SAMPLE = 5, Reaction.QUICK_STOP
    NOT_FINITE = 6, Reaction.QUICK_STOP
    TORQUE_SATURATED = 7, Reaction.QUICK_STOP  # at the torque limit for too long
    DRIVE_FAULT = 8, Reaction.OFF
    DRIVE_NOT_ENABLED = 9, Reaction.OFF  # left Operation Enabled without being asked
    DRIVE_RESTARTED = 10, Reaction.OFF
    ENABLE_TIMEOUT = 11, Reaction.QUICK_STOP
    SUPERVISOR_LOST = 12, Reaction.RAMP
    BUS_ERROR = 13, Reaction.QUICK_STOP
    STOP_TIMEOUT = 14, Reaction.QUICK_STOP  # standstill not reached in time
    OFF_TIMEOUT = 15, Reaction.QUICK_STOP  # the drive did not confirm power off
    NO_SAMPLES = 16, Reaction.QUICK_STOP  # not one valid sample before enabling
    NOT_AT_STANDSTILL = 17, Reaction.QUICK_STOP  # the joint moved while waiting to enable
    OVERRUN = 18, Reaction.RAMP  # too many cycles skipped
    POSITION_JUMP = 19, Reaction.QUICK_STOP  # the encoder moved faster than the joint can
    DRIVE_STAYS_ENABLED = 20, Reaction.QUICK_STOP  # enabled before the loop asked for it, and it does not switch off
    POSITION_FROZEN = 21, Reaction.QUICK_STOP  # the reading stands still although the reference moves
    SUSPENDED = 22, Reaction.QUICK_STOP  # the computer slept
    DRIVE_SILENT = 23, Reaction.QUICK_STOP  # the drive's own heartbeat stays away
    POSITION_DISAGREEMENT = 24, Reaction.QUICK_STOP  # the two encoders of the joint differ by more than they may
    MOVED_BEFORE_START = 25, Reaction.QUICK_STOP  # the joint is not where it was when the motion was shown
    SAMPLES_MISSING = 26, Reaction.QUICK_STOP  # samples came before enabling, but never enough of them in a row
    LIMIT_CYCLE = 27, Reaction.QUICK_STOP  # torque or error swing back and forth instead of settling
    CLIENT_SILENT = 28, Reaction.RAMP  # the program whose set-points the joint follows has gone silent


class Notice(IntEnum):
    """What the loop reports without ending the run; each is one bit of `AxisState.notices`, set once in a run."""

    TORQUE_NOISE = 1  # the command changes too much from cycle to cycle
    LEARNING_OFF = 2  # iterative learning made the error grow and was switched off
    SANK = 4  # nothing held the joint while its torque was released
    HUNTS = 8  # the joint swings, however slowly, about a place where it is to rest


class FeedForward(IntEnum):
    """The velocity at which the friction model is evaluated for compensation."""

    NONE = 0
    MEASURED = 1  # as the paper does
    DESIRED = 2
    LUGRE_DESIRED = 3  # LuGre dynamics driven by the desired velocity


class ZeroSpeedRule(IntEnum):
    """What the friction compensation gives at zero velocity, where friction is set-valued."""

    ZERO = 0
    PAPER = 1  # (11) read literally: +static friction at v = 0
    LINEAR = 2  # a straight line through zero inside a band


class ControllerKind(IntEnum):
    """Which law computes the torque."""

    COMPUTED_TORQUE = 0
    COMPUTED_TORQUE_RBF = 1  # the paper's (29)
    COMPUTED_TORQUE_OBSERVER = 2  # a disturbance observer in the network's place
    PID = 3  # no friction model unless the feed-forward is switched on
    OUTSIDE = 4  # none: the torque is given in each cycle, at simulated time only
    FLEXIBLE_JOINT = 5  # damping from the motor's encoder, position from the joint's


class Encoders(IntEnum):
    """What the law of a flexible joint reads."""

    BOTH = 0  # the link's feeds the law, the motor's is the other one
    MOTOR = 1
    LINK = 2


class TrajectoryKind(IntEnum):
    """The shape of the desired motion."""

    HOLD = 0
    SINE = 1
    MIN_JERK = 2
    TRAPEZOID = 3
    TABLE = 4
    STREAM = 5  # set-points that come while the joint moves, at rest where there are none


class SetPointProblem(IntEnum):
    """Why a set-point that comes while the joint moves is not followed."""

    NONE = 0
    TIME = 1  # not after the one before, or too long after it
    POSITION = 2  # a value that is not finite is outside every limit
    VELOCITY = 3  # at the set-point or on the way to it
    JUMP = 4  # too far from the one before
    ACCELERATION = 5
    TORQUE = 6
    TORQUE_RATE = 7
    STOPPING_WAY = 8  # braked from there, the joint would leave its position limits


class LimitSource(IntEnum):
    """Which position the position limits are checked with, where a joint has two encoders."""

    LAW = 0  # the one that feeds the law
    OTHER = 1
    BOTH = 2


class CommandKind(IntEnum):
    """What the loop sends to the drive."""

    TORQUE = 0
    VELOCITY = 1  # the drive closes the velocity loop itself
    POSITION = 2  # the drive closes the position loop as well


class StopRequest(IntEnum):
    """Value of the stop word that the supervisor writes."""

    NONE = 0
    RAMP = 1
    QUICK_STOP = 2
    OFF = 3
