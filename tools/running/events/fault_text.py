"""What each fault of the loop means to the person at the bench: what happened, likely cause, next step."""

from __future__ import annotations

from dataclasses import dataclass

from jointctl.drivers.canopen.cia402 import state_text
from jointctl.firmware_py.records import ENCODER_RESTARTED
from jointctl.firmware_py.states import Fault
from jointctl.tools.running.events.emergency_text import emergency_text


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


FAULT_TEXTS: dict[Fault, FaultText] = {
    Fault.POSITION_LIMIT: FaultText(
        "the joint left its position limits at {value:.4f} rad",
        "the joint was moved by hand, or limits and encoder zero do not belong together",
        "compare limits.position_* and encoder.zero_counts with where the joint stands",
    ),
    Fault.VELOCITY_LIMIT: FaultText(
        "the joint moved at {value:.3f} rad/s, faster than limits.velocity_max_radps",
        "wrong sign of encoder or torque, or gains that the loop delay does not allow",
        "check encoder.direction and drive.torque_direction before the next run",
    ),
    Fault.REFERENCE_LIMIT: FaultText(
        "the desired motion would leave the limits at {value:.4f} rad",
        "the trajectory, or its approach from where the joint stands, does not fit the limits",
        "change the trajectory, the start position or limits.*",
    ),
    Fault.FOLLOWING_ERROR: FaultText(
        "the joint was {value:.4f} rad away from its reference",
        "blocked or overloaded joint, wrong sign of encoder or torque, or too little torque",
        "turn the joint by hand with the power off; check the directions and limits.torque_max_Nm",
    ),
    Fault.STALE_SAMPLE: FaultText(
        "no position came for {value:.0f} cycles",
        "frames lost, cable, bus load, or the drive went silent",
        "check wiring and termination; watch the bus with candump",
    ),
    Fault.NOT_FINITE: FaultText(
        "the law computed {value}, which is not a number to send",
        "gains or friction values that overflow",
        "report the run log: this should not happen with a checked configuration",
    ),
    Fault.TORQUE_SATURATED: FaultText(
        "the torque stayed at its limit ({value:.1f} Nm) for too long",
        "the joint is blocked, or limits.torque_max_Nm is too low for load and friction",
        "turn the joint by hand with the power off, then look at the friction values",
    ),
    Fault.LIMIT_CYCLE: FaultText(
        "torque or error swung back and forth at about {value:.1f} Hz instead of settling",
        "more loop delay than the gains allow, gains too high for a heavy or soft joint, learning that diverges, "
        "or an encoder of too little resolution",
        "run `jointctl check`; then lower the gains (kp, kv, observer_radps), switch learning off, "
        "or measure with more counts",
    ),
    Fault.DRIVE_FAULT: FaultText(
        "the drive reported a fault (statusword {word})",
        "see the drive's error code",
        "remove the cause, then reset the drive's fault; jointctl never does it by itself",
    ),
    Fault.DRIVE_NOT_ENABLED: FaultText(
        "the drive left Operation Enabled by itself (statusword {word})",
        "its enable input or STO was opened, a limit switch, or another master on the bus",
        "check the enable and STO wiring",
    ),
    Fault.DRIVE_RESTARTED: FaultText(
        "the drive restarted while the loop was running",
        "its supply dropped, or somebody reset it",
        "check the supply; the drive has lost its configuration, start again",
    ),
    Fault.ENABLE_TIMEOUT: FaultText(
        "the drive did not reach Operation Enabled in time (statusword {word})",
        "no motor supply, STO open, or an interlock of the drive",
        "check voltage and STO; the statusword's bit 4 is the motor supply",
    ),
    Fault.SUPERVISOR_LOST: FaultText(
        "the supervising process was silent for {value:.0f} cycles",
        "it was killed, stopped, or the computer was overloaded",
        "look for what blocked it: disk, memory, a debugger",
    ),
    Fault.BUS_ERROR: FaultText(
        "{value:.0f} frames in a row could not be sent",
        "interface down, bus off, or nobody acknowledges: cable or bit rate",
        "ip -details link show, then bring the interface up again",
    ),
    Fault.STOP_TIMEOUT: FaultText(
        "the joint did not come to rest ({value:.3f} rad/s)",
        "unstable gains or an outside torque",
        "lower the gains; look at the last seconds of the run log",
    ),
    Fault.OFF_TIMEOUT: FaultText(
        "the drive did not confirm that its power stage is off (statusword {word})",
        "the drive is unreachable",
        "use the emergency stop; then check the bus",
    ),
    Fault.NO_SAMPLES: FaultText(
        "not one sample came from the drive",
        "the drive does not answer SYNC: PDOs disabled, or not operational",
        "look for SYNC (080) and the TPDO (180 + node) with candump",
    ),
    Fault.SAMPLES_MISSING: FaultText(
        "positions came, but never {value:.0f} of them in a row, as sequence.settle_s wants it before enabling",
        "a computer too busy for loop.rate_Hz, or a bus that loses a frame now and then",
        "run `jointctl doctor`, then `jointctl monitor`; set loop.priority, or lower loop.rate_Hz",
    ),
    Fault.NOT_AT_STANDSTILL: FaultText(
        "the joint moved at {value:.3f} rad/s before it was enabled",
        "somebody moves it, or the encoder is noisy",
        "let it rest, or raise limits.standstill_radps",
    ),
    Fault.OVERRUN: FaultText(
        "the loop was held up for {value:.0f} cycles",
        "the computer was busy: no real-time priority, power saving, a debugger",
        "run `jointctl doctor`; set loop.priority and loop.cpu",
    ),
    Fault.DRIVE_STAYS_ENABLED: FaultText(
        "the drive is enabled although nobody asked for it, and does not switch off (statusword {word})",
        "another master on the bus, or a drive that ignores the controlword",
        "use the emergency stop; check who else writes object 6040",
    ),
    Fault.POSITION_FROZEN: FaultText(
        "the position reading stood still although the joint was driven (reference moved by {value:.4f} rad)",
        "the encoder or its cable is dead, or the joint is blocked",
        "turn the joint by hand with the power off and watch the position; check the encoder cable",
    ),
    Fault.SUSPENDED: FaultText(
        "the computer slept for {value:.1f} s while the loop was running",
        "standby or hibernation: lid, power button, energy saving",
        "switch standby off (systemd-inhibit jointctl run ...); the drive's watchdog stopped the joint meanwhile",
    ),
    Fault.DRIVE_SILENT: FaultText(
        "the drive's own heartbeat stayed away for {value:.0f} cycles although its samples came",
        "the drive's communication is partly dead, or another program has set its object 1017",
        "watch 700h + node with candump; restart the drive",
    ),
    Fault.POSITION_DISAGREEMENT: FaultText(
        "the two encoders of the joint differ by {value:.4f} rad (the other one minus the one that feeds the law)",
        "one encoder or its cable, a slipping coupling, or zero, counts, direction or reduction_ratio of one are wrong",
        "turn the joint by hand with the power off and compare both; see [encoder] and [joint_encoder]",
    ),
    Fault.MOVED_BEFORE_START: FaultText(
        "the joint was moved by {value:.4f} rad since the motion was shown",
        "somebody turned it, or it sank under its load while the drive was off",
        "let it rest, then start again: the motion is planned anew from where it stands",
    ),
    Fault.POSITION_JUMP: FaultText(
        "the position jumped by {value:.4f} rad between two samples",
        "encoder or its cable, or counts_per_turn too small by a factor",
        "check the encoder cable and encoder.counts_per_turn",
    ),
}


# with [joint_encoder] a sample counts only once both encoders have answered
TWO_ENCODER_TEXTS: dict[Fault, FaultText] = {
    Fault.STALE_SAMPLE: FaultText(
        "no position of both encoders came for {value:.0f} cycles",
        "frames lost, cable, bus load, or the drive or the joint's encoder went silent",
        "check wiring and termination; watch the bus with candump: which of the two is missing?",
    ),
    Fault.NO_SAMPLES: FaultText(
        "not one sample came from both encoders of the joint",
        "the drive or the joint's encoder does not answer SYNC: PDOs disabled, or not operational",
        "look for SYNC (080) and the TPDOs of both (180 + node, 280 + node of the drive) with candump",
    ),
}
_ENCODER_CURE = "check the encoder's supply, cable and mounting; its manual tells the error code"
# EMCY classes of CiA 301 with which a drive says that it does not hear this computer as it should
_COMMUNICATION_ERRORS = (0x8100, 0x8200)


def _word_text(value: float) -> str:
    """`0297h, quick stop active`."""
    if not 0.0 <= value <= 65535.0:
        return f"{value}"
    word = round(value)
    return f"{word:04X}h, {state_text(word)}"


def _encoder_words(encoder_error: int) -> str:
    if encoder_error == ENCODER_RESTARTED:
        return "the encoder node restarted"
    return f"the encoder node's error code is {emergency_text(encoder_error)}"


def fault_text(
    fault: Fault, value: float, drive_error: int, encoder_error: int = 0, *, two_encoders: bool = False
) -> FaultText:
    """The text of a fault with its numbers filled in; a drive that stopped because it did not hear us says so.

    `encoder_error`: see `Sample.encoder_error`.  `two_encoders`: a sample is the answer of both.
    """
    text = FAULT_TEXTS[fault]
    if two_encoders:
        text = TWO_ENCODER_TEXTS.get(fault, text)
    if encoder_error and fault in TWO_ENCODER_TEXTS:
        text = FaultText(text.happened, "an encoder with an error, or that restarted, is not believed", _ENCODER_CURE)
    happened = text.happened.format(value=value, word=_word_text(value))
    if drive_error:
        happened += f"; the drive's error code is {emergency_text(drive_error)}"
    if encoder_error:
        happened += f"; {_encoder_words(encoder_error)}"
    if fault in (Fault.DRIVE_FAULT, Fault.DRIVE_NOT_ENABLED) and drive_error & 0xFF00 in _COMMUNICATION_ERRORS:
        return FaultText(
            happened,
            "the drive heard our frames too seldom or damaged and stopped by itself: cable, bus load, or a computer "
            "that was held up",
            "check wiring, termination and bus load; `jointctl doctor` tells what holds this computer up",
        )
    return FaultText(happened, text.cause, text.next_step)
