"""What happened in a run, in words: faults with cause and next step, emergency codes, notices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jointctl.drivers.canopen.cia import state_text
from jointctl.drivers.errors import LimitCycle, MotionFault, StoodStill, text_Nm, text_radps
from jointctl.firmware_py.records import ENCODER_RESTARTED, AxisState
from jointctl.firmware_py.states import Fault, Notice
from jointctl.tools.recording.run_log import WARNING, Event

# --- Error codes of CANopen drives (EMCY, object 603Fh) in words ---
# Source: CiA 301 (classes), CiA 402 (codes), and the codes of the Elmo family from the project's facts sheet.  A code
# that is not listed is reported by its class: the upper byte, else the upper digit.


_CODES = {
    0x2310: "continuous overcurrent",
    0x2311: "current too high or feedback (maker's meaning differs)",
    0x2320: "short circuit or earth leakage at the output",
    0x2340: "short circuit",
    0x3110: "mains overvoltage",
    0x3120: "undervoltage",
    0x3130: "phase lost",
    0x3210: "DC link overvoltage",
    0x3220: "DC link undervoltage",
    0x3310: "overvoltage",
    0x4210: "device too hot",
    0x4310: "drive too hot",
    0x5441: "inhibit input active",
    0x5442: "abort input active",
    0x6300: "RPDO does not fit its mapping",
    0x7121: "motor blocked",
    0x7300: "feedback sensor",
    0x7305: "incremental sensor 1",
    0x7306: "commutation or incremental sensor 2",
    0x7380: "Hall sensors",
    0x7382: "commutation",
    0x8110: "CAN overrun, objects lost",
    0x8120: "CAN error passive",
    0x8130: "heartbeat lost",
    0x8140: "recovered from bus-off",
    0x8150: "identifier collision",
    0x8210: "PDO too short",
    0x8220: "PDO too long",
    0x8250: "RPDO timeout",
    0x8311: "peak current exceeded",
    0x8480: "speed tracking error",
    0x8481: "overspeed",
    0x8611: "following error",
    0x8612: "reference limit",
    0x8680: "position limit",
    0x8700: "SYNC lost",
    0xFF10: "cannot start the motor",
    0xFF20: "safe torque off (STO)",
}
_CLASSES = {
    0x1000: "generic error",
    0x2000: "current",
    0x3000: "voltage",
    0x4000: "temperature",
    0x5000: "device hardware",
    0x6000: "device software",
    0x7000: "additional modules",
    0x8000: "monitoring",
    0x8100: "communication",
    0x8200: "protocol",
    0x9000: "external error",
    0xF000: "additional functions",
    0xFF00: "maker's own",
}


def emergency_text(code: int) -> str:
    """`8130h, heartbeat lost`; the class for a code that is not listed."""
    name = _CODES.get(code) or _CLASSES.get(code & 0xFF00) or _CLASSES.get(code & 0xF000) or "not in the list"
    return f"{code:04X}h, {name}"


# --- What each fault of the loop means to the person at the bench: what happened, likely cause, next step ---


@dataclass(frozen=True)
class FaultText:
    """`happened` may hold {value}, the number that tripped the limit, and {word}, the same as a statusword (6041h)."""

    happened: str
    cause: str
    next_step: str

    @property
    def advice(self) -> str:
        """For the line below what happened."""
        return f"likely cause: {self.cause}; next: {self.next_step}"


def ended_by(fault: Fault, text: FaultText, before: str = "", after: str = "", then: str = "") -> MotionFault:
    """The error for a motion that this fault ended: what happened, between `before` and `after`, and the advice."""
    kind = {Fault.LIMIT_CYCLE: LimitCycle, Fault.POSITION_FROZEN: StoodStill}.get(fault, MotionFault)
    return kind(f"{before}{fault.name} ({int(fault)}): {text.happened}{after}", text.advice + then)


@dataclass(frozen=True)
class FaultWords(FaultText):
    """A row of the table: the words on a CAN bus, and those that differ."""

    two_encoders: FaultText | None = None  # with [joint_encoder] a sample counts only once both encoders have answered
    follows_pause: bool = False  # a loop that stands still commands its last torque, and receives nothing
    own_loop: tuple[str, str] | None = None  # (cause, next step) where the drive closes its own loop, [drive.cascade]


FAULT_TEXTS: dict[Fault, FaultWords] = {
    Fault.POSITION_LIMIT: FaultWords(
        "the joint left its position limits at {value:.4f} rad",
        "the joint was moved by hand, or limits and encoder zero do not belong together",
        "compare limits.position_* and encoder.zero_counts with where the joint stands",
        follows_pause=True,
    ),
    Fault.VELOCITY_LIMIT: FaultWords(
        "the joint moved at {speed}, faster than limits.velocity_max_radps",
        "wrong sign of encoder or torque, or gains that the loop delay does not allow",
        "check encoder.direction and drive.torque_direction before the next run",
        follows_pause=True,
        own_loop=(
            "wrong sign of encoder or velocity (607E), or gains of the drive that its joint does not allow",
            "check encoder.direction and the drive's gains, run `jointctl check`, all before the next run",
        ),
    ),
    Fault.REFERENCE_LIMIT: FaultWords(
        "the desired motion would leave the limits at {value:.4f} rad",
        "the trajectory, braked on its way, or its approach from where the joint stands, does not fit the limits",
        "change the trajectory, the start position, sequence.brake_radps2 or limits.*",
    ),
    Fault.FOLLOWING_ERROR: FaultWords(
        "the joint was {value:.4f} rad away from its reference",
        "blocked or overloaded joint, wrong sign of encoder or torque, or too little torque",
        "turn the joint by hand with the power off; check the directions and limits.torque_max_Nm",
        follows_pause=True,
        own_loop=(
            "blocked or overloaded joint, gains of the drive too low for friction, wrong sign of encoder or torque, "
            "or a drive whose own limits (6072, 607F) are below those of the file",
            "turn the joint by hand with the power off; run `jointctl check`; compare its gains with [drive.cascade]",
        ),
    ),
    Fault.STALE_SAMPLE: FaultWords(
        "no position came for {value:.0f} cycles, at once or again and again",
        "frames lost, cable, bus load, or the drive went silent",
        "check wiring and termination; watch the bus with candump",
        two_encoders=FaultText(
            "no position of both encoders came for {value:.0f} cycles, at once or again and again",
            "frames lost, cable, bus load, or the drive or the joint's encoder went silent",
            "check wiring and termination; watch the bus with candump: which of the two is missing?",
        ),
        follows_pause=True,
    ),
    Fault.NOT_FINITE: FaultWords(
        "the law computed {value}, which is not a number to send",
        "gains or friction values that overflow",
        "report the run log: this should not happen with a checked configuration",
    ),
    Fault.TORQUE_SATURATED: FaultWords(
        "the torque stayed at its limit ({torque}) for too long",
        "the joint is blocked, or limits.torque_max_Nm is too low for load and friction",
        "turn the joint by hand with the power off, then look at the friction values",
        own_loop=(
            "the joint is blocked, limits.torque_max_Nm too low for load and friction, or the drive's gains too high",
            "turn the joint by hand with the power off, then look at the drive's gains and at limits.torque_max_Nm",
        ),
    ),
    Fault.LIMIT_CYCLE: FaultWords(
        "torque or error swung back and forth at about {value:.1f} Hz instead of settling",
        "more loop delay than the gains allow, gains too high for a heavy or soft joint, learning that diverges, "
        "or an encoder of too little resolution",
        "run `jointctl check`; then lower the gains (kp, kv, observer_radps), switch learning off, "
        "or measure with more counts",
        follows_pause=True,
        own_loop=(
            "gains of the drive that are too high for its joint, or so low that its integral pushes against friction "
            "until the joint slips; in CSV a high drive.cascade.position_gain_ps; or an encoder of too few counts",
            "run `jointctl check`; change the drive's gains with its maker's software, and [drive.cascade] with them",
        ),
    ),
    Fault.CLIENT_SILENT: FaultWords(
        "the program that commands the joint was silent for {value:.2f} s",
        "it hangs, computes for longer than stream.client_timeout_s, or sends only set-points that are refused",
        "let it call the joint more often (wait instead of sleep), or raise stream.client_timeout_s",
    ),
    Fault.DRIVE_FAULT: FaultWords(
        "the drive reported a fault (statusword {word})",
        "see the drive's error code",
        "remove the cause, then reset the drive's fault; jointctl never does it by itself",
        follows_pause=True,
    ),
    Fault.DRIVE_NOT_ENABLED: FaultWords(
        "the drive left Operation Enabled, or the way there, by itself (statusword {word})",
        "its enable input or STO was opened, a limit switch, or another master on the bus",
        "check the enable and STO wiring",
        follows_pause=True,
    ),
    Fault.DRIVE_RESTARTED: FaultWords(
        "the drive restarted while the loop was running",
        "its supply dropped, or somebody reset it",
        "check the supply; the drive has lost its configuration, start again",
    ),
    Fault.ENABLE_TIMEOUT: FaultWords(
        "the drive did not reach Operation Enabled in time (statusword {word})",
        "no motor supply, STO open, an interlock of the drive, or, in an arm, a drive that is so much later than the "
        "others that one of their joints sank, enabled and not yet under torque",
        "check voltage and STO; the statusword's bit 4 is the motor supply",
    ),
    Fault.SUPERVISOR_LOST: FaultWords(
        "the supervising process was silent for {value:.0f} cycles",
        "it was killed, stopped, or the computer was overloaded",
        "look for what blocked it: disk, memory, a debugger",
    ),
    Fault.BUS_ERROR: FaultWords(
        "{value:.0f} frames could not be sent, at once or again and again",
        "interface down, bus off, or nobody acknowledges: cable or bit rate",
        "ip -details link show, then bring the interface up again",
    ),
    Fault.STOP_TIMEOUT: FaultWords(
        "the joint did not come to rest ({speed})",
        "unstable gains or an outside torque",
        "lower the gains; look at the last seconds of the run log",
        own_loop=(
            "gains of the drive that its joint does not allow, or an outside torque",
            "look at the last seconds of the run log; change the drive's gains with its maker's software",
        ),
    ),
    Fault.OFF_TIMEOUT: FaultWords(
        "the drive did not confirm that its power stage is off (statusword {word})",
        "the drive is unreachable",
        "use the emergency stop; then check the bus",
    ),
    Fault.NO_SAMPLES: FaultWords(
        "not one sample came from the drive",
        "the drive does not answer SYNC: PDOs disabled, or not operational",
        "look for SYNC (080) and the TPDO (180 + node) with candump",
        two_encoders=FaultText(
            "not one sample came from both encoders of the joint",
            "the drive or the joint's encoder does not answer SYNC: PDOs disabled, or not operational",
            "look for SYNC (080) and the TPDOs of both (180 + node, 280 + node of the drive) with candump",
        ),
    ),
    Fault.SAMPLES_MISSING: FaultWords(
        "positions came, but never {value:.0f} of them in a row, as sequence.settle_s wants it before enabling",
        "a computer too busy for loop.rate_Hz, or a bus that loses a frame now and then",
        "run `jointctl doctor`, then `jointctl monitor`; set loop.priority, or lower loop.rate_Hz",
        follows_pause=True,
    ),
    Fault.NOT_AT_STANDSTILL: FaultWords(
        "the joint moved at {speed} before it was enabled",
        "somebody moves it, or the encoder is noisy",
        "let it rest, or raise limits.standstill_radps",
    ),
    Fault.OVERRUN: FaultWords(
        "the loop was held up for {value:.0f} cycles, at once or again and again",
        "the computer was busy: no real-time priority, power saving, a debugger",
        "run `jointctl doctor`; set loop.priority and loop.cpu",
    ),
    Fault.DRIVE_STAYS_ENABLED: FaultWords(
        "the drive is enabled although nobody asked for it, and does not switch off (statusword {word})",
        "another master on the bus, or a drive that ignores the controlword",
        "use the emergency stop; check who else writes object 6040",
    ),
    Fault.POSITION_FROZEN: FaultWords(
        "the position reading stood still although the joint was driven (reference moved by {value:.4f} rad)",
        "the encoder or its cable is dead, the joint is blocked, or its friction is more than the torque of the loop",
        "turn the joint by hand with the power off and watch the position; check its cable; run `jointctl check`",
    ),
    Fault.SUSPENDED: FaultWords(
        "the computer slept for {value:.1f} s while the loop was running",
        "standby or hibernation: lid, power button, energy saving",
        "switch standby off (systemd-inhibit jointctl run ...); the drive's watchdog stopped the joint in the meantime",
    ),
    Fault.DRIVE_SILENT: FaultWords(
        "the drive's own heartbeat stayed away for {value:.0f} cycles although its samples came",
        "the drive's communication is partly dead, or another program has set its object 1017",
        "watch 700h + node with candump; restart the drive",
    ),
    Fault.POSITION_DISAGREEMENT: FaultWords(
        "the two encoders of the joint differ by {value:.4f} rad (the other one minus the one that feeds the law)",
        "one encoder or its cable, a slipping coupling, zero, counts, direction or reduction_ratio of one are wrong, "
        "or a soft reducer twists by more than disagreement_max_rad",
        "turn the joint by hand with the power off and compare both; see [encoder] and [joint_encoder]",
    ),
    Fault.MOVED_BEFORE_START: FaultWords(
        "the joint was moved by {value:.4f} rad since the motion was shown",
        "somebody turned it, or it sank under its load while the drive was off",
        "let it rest, then start again: the motion is planned anew from where it stands",
    ),
    Fault.POSITION_JUMP: FaultWords(
        "the position jumped by {value:.4f} rad between two samples",
        "encoder or its cable, or counts_per_turn too small by a factor",
        "check the encoder cable and encoder.counts_per_turn",
        follows_pause=True,
    ),
}
# what a drive looks like that has left its mode by itself: 6061 is read once a second, and these come sooner
OF_A_LEFT_MODE = frozenset({
    Fault.POSITION_FROZEN, Fault.FOLLOWING_ERROR, Fault.VELOCITY_LIMIT, Fault.POSITION_LIMIT, Fault.TORQUE_SATURATED,
    Fault.LIMIT_CYCLE, Fault.STOP_TIMEOUT,
})  # fmt: skip
LEFT_MODE = "look for the cause in the drive: an input or a program of its own that chooses modes"
_ENCODER_CURE = "check the encoder's supply, cable and mounting; its manual tells the error code"
# EMCY classes of CiA 301 with which a drive says that it does not hear this computer as it should
_COMMUNICATION_ERRORS = (0x8100, 0x8200)


def _word_text(value: float) -> str:
    """`0297h, quick stop active`."""
    if not 0.0 <= value <= 65535.0:
        return f"{value}"
    word = round(value)
    return f"{word:04X}h, {state_text(word)}"


def fault_text(
    fault: Fault,
    value: float,
    drive_error: int,
    encoder_error: int = 0,
    *,
    two_encoders: bool = False,
    own_loop: bool = False,
) -> FaultText:
    """The text of a fault with its numbers filled in; a drive that stopped because it did not hear us says so.

    `encoder_error`: see `Sample.encoder_error`.  `two_encoders`: a sample is the answer of both.
    `own_loop`: the drive closes its own loop, so that its gains are the drive's.
    """
    row = FAULT_TEXTS[fault]
    text = row.two_encoders if two_encoders and row.two_encoders else row
    if own_loop and row.own_loop:
        text = FaultText(text.happened, *row.own_loop)
    if encoder_error and row.two_encoders:
        text = FaultText(text.happened, "an encoder with an error, or that restarted, is not believed", _ENCODER_CURE)
    happened = text.happened.format(
        value=value, torque=text_Nm(value), speed=text_radps(value, 3), word=_word_text(value)
    )
    if drive_error:
        happened += f"; the drive's error code is {emergency_text(drive_error)}"
    if encoder_error == ENCODER_RESTARTED:
        happened += "; the encoder node restarted"
    elif encoder_error:
        happened += f"; the encoder node's error code is {emergency_text(encoder_error)}"
    if fault in (Fault.DRIVE_FAULT, Fault.DRIVE_NOT_ENABLED) and drive_error & 0xFF00 in _COMMUNICATION_ERRORS:
        return FaultText(
            happened,
            "the drive heard our frames too seldom or damaged and stopped by itself: cable, bus load, or a computer "
            "that was held up",
            "check wiring, termination and bus load; `jointctl doctor` tells what holds this computer up",
        )
    return FaultText(happened, text.cause, text.next_step)


# --- A fault that follows a pause of the loop: the text says so, or its reader looks for a fault of cable or drive ---


BEFORE_s = 0.5  # a pause longer ago has shown what it could do
LEAST_s = 0.005
LEAST_CYCLES = 3
SHARE_OF_AGE = 0.5  # of the time without a sample that a pause must have taken to be its cause


def longest_pause_s(records: np.recarray, period_s: float) -> float:
    """Longest pause of the loop up to the first record with a fault [s]: slots left out, or a cycle that took longer.

    `records`: array of LogRecord, shape (N,), the cycles before the fault among them.
    """
    faults = np.flatnonzero(records["fault"])
    if not len(faults):
        return 0.0
    until_ns = int(records["time_ns"][faults[0]])
    near = records[: faults[0] + 1]
    near = near[near["time_ns"] >= until_ns - BEFORE_s * 1e9]
    taken_ns = np.maximum.reduce([near["wake_late_ns"], near["work_ns"], near["round_trip_ns"]])
    return float(max(1e-9 * taken_ns.max(), period_s * near["skipped"].max()))


def held_up_text(fault: Fault, value: float, text: FaultText, records: np.recarray, rate_Hz: float) -> FaultText:
    """`text`, with the pause that came before the fault, if there was one that can have caused it."""
    if not FAULT_TEXTS[fault].follows_pause:
        return text
    pause_s = longest_pause_s(records, 1.0 / rate_Hz)
    age_s = value / rate_Hz if fault is Fault.STALE_SAMPLE else 0.0
    if pause_s < max(LEAST_s, LEAST_CYCLES / rate_Hz, SHARE_OF_AGE * age_s):
        return text
    return FaultText(
        f"{text.happened}, after the loop had been held up for {1e3 * pause_s:.0f} ms",
        f"the computer was busy: no real-time priority, power saving, a debugger; if that pause was not the cause, "
        f"{text.cause}",
        f"run `jointctl doctor`; {text.next_step}",
    )


def read_off_text(text: FaultText, state: str) -> FaultText:
    """`text` of OFF_TIMEOUT, of a drive that is off by the `state` that it reads afterwards: that is no emergency."""
    return FaultText(
        f"{text.happened}; it reads {state} now", "its own watchdog has stopped it, or its reports were lost",
        "look at what came before it, if anything did; else check the bus",
    )  # fmt: skip


# --- What the loop reports without ending the run, in words: torque noise, learning that was switched off ---


def notice_text(notice: Notice, state: AxisState) -> str:
    """One line, with the numbers of `state` and what to do about it."""
    if notice is Notice.TORQUE_NOISE:
        return (
            f"torque noise: the command changes by {text_Nm(float(state.swing.noise_told_Nm))} from cycle to cycle; "
            'an encoder with more counts, control.velocity_filter = "kalman", a lower control.velocity_cutoff_Hz or '
            "lower gains (kv, observer_radps) make it quieter"
        )
    if notice is Notice.HUNTS:
        swing = state.swing.rest_error
        return (
            f"the joint hunts about the place where it is to rest: {1e3 * float(swing.amplitude):.2f} mrad from peak "
            f"to peak, half a swing in {int(swing.half_cycles)} cycles; the law pushes against friction that sticks, "
            "until the joint slips past; a higher control.kv makes it less, a lower control.observer_radps rarer but "
            "greater, without an observer (0) the joint stays where friction holds it"
        )
    if notice is Notice.SANK:
        moved_rad = float(state.measured_position_rad - state.stood_rad)
        return (
            f"the joint moved by {moved_rad:.4f} rad while its torque was released, as under a load that friction does "
            "not hold, and the drive braked it: with the power off nothing but a brake holds it there; "
            "without one, support it, or let the motion end where the load is less"
        )
    return (
        "iterative learning is off for the rest of the run: its error grew in three repetitions, to "
        f"{1e3 * float(state.law.learning.error_rad):.3f} mrad (root mean square); lower control.learning.gain and "
        "error_gain_ps2, or the loop delay"
    )


class NoticeFinder:
    """Gives each notice of a run once."""

    def __init__(self) -> None:
        self._known = 0

    def take(self, state: AxisState, time_ns: int) -> list[Event]:
        """Events for what is new in `state`, which the loop goes on writing to."""
        notices = int(state.notices)
        new = [notice for notice in Notice if notices & ~self._known & notice]
        self._known |= notices
        return [Event(time_ns, WARNING, "loop", notice_text(notice, state)) for notice in new]
