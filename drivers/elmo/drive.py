"""One Elmo drive on a serial port: commissioning over the ASCII interpreter, what it reports, making it safe."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from jointctl.drivers.drive import Approval, CommissioningReport, DriveIdentity, refuse_unless_at_rest
from jointctl.drivers.elmo.cyclic import ElmoPort
from jointctl.drivers.elmo.dialogue import (
    AMPLIFIER_MASK,
    FAULT_LATCHED,
    SAFE_ATTEMPTS,
    BytePort,
    Dialogue,
    RefusedError,
    ReplyKind,
    SerialPort,
    UnitMode,
    changed,
    encode,
    error_text,
    finite_number,
    motor_fault_text,
    motor_off_cause,
    status_text,
    switch_off,
)
from jointctl.drivers.elmo.settings import (
    LARGEST_SHARE,
    ElmoSettings,
    MeasuredExchange,
    highest_rate_Hz,
    measured_exchange,
)
from jointctl.drivers.errors import BusError, ConfigurationError, DeviceError, JointctlError, NoDeviceError
from jointctl.firmware_py.schema import new

MEASURED_CYCLES = 20
TC_STEP_A = 1e-3
QUESTION = "The motor is on, and at rest. Stop it and switch it off?"
ENABLE_RETRY_S = 0.5
ASKED_ATTEMPTS = 20  # twice those of `jointctl stop`, which talks on the same line in the meantime and takes replies

# --- what a drive reports, read only: nothing is written, nothing is switched, no counter is reset ---

UNIT_MODES = {int(mode): mode.name.lower() for mode in UnitMode}
# name, index, what it is, what one count or ampere of it means
_QUESTIONS: tuple[tuple[str, int | None, str, str], ...] = (
    ("EC", None, "last refused command", "code"),  # first: a question that is refused changes it
    ("SN", 4, "serial number", ""),
    ("MO", None, "motor", "switch"),
    ("UM", None, "unit mode", "mode"),
    ("SR", None, "status register", "status"),
    ("MF", None, "motor fault", "fault"),
    ("EO", None, "echo", "switch"),
    ("RM", None, "analog reference", "switch"),
    ("PX", None, "position", "position"),
    ("VX", None, "velocity", "velocity"),
    ("TC", None, "torque command", "current"),
    ("IQ", None, "active current", "current"),
    ("MC", None, "largest current", "limit current"),
    ("CL", 1, "continuous current limit", "limit current"),
    ("PL", 1, "peak current limit", "limit current"),
    ("PL", 2, "peak time", "time"),
    ("HL", 2, "speed limit, high", "velocity"),
    ("LL", 2, "speed limit, low", "velocity"),
    ("HL", 3, "position limit, high", "position"),
    ("LL", 3, "position limit, low", "position"),
    ("ER", 2, "speed error limit", "speed size"),
    ("ER", 3, "position error limit", "angle size"),
)


@dataclass(frozen=True)
class Fact:
    """One answer: `value` as the drive wrote it, `meaning` in words or in the units of the joint."""

    name: str
    label: str
    value: str
    meaning: str
    number: float | None = None  # in the unit of `unit`
    unit: str = ""


def read_facts(line: Dialogue, settings: ElmoSettings) -> list[Fact]:
    """Everything a drive of this family reports; what it does not know is stated so, because firmwares differ."""
    facts = []
    questions = list(_QUESTIONS)
    parameter = settings.counts_parameter
    if parameter is not None:
        questions.append((parameter[:2], int(parameter[3:-1]), "encoder counts a turn", "counts"))
    for name, index, label, kind in questions:
        shown = name if index is None else f"{name}[{index}]"
        try:
            text = line.query(name, index)
        except RefusedError as refusal:
            facts.append(Fact(shown, label, "", f"not reported: {error_text(refusal.code)}"))
            continue
        facts.append(_fact(shown, label, text, kind, settings))
    return facts


def _fact(shown: str, label: str, text: str, kind: str, settings: ElmoSettings) -> Fact:
    if not kind:
        return Fact(shown, label, text, "")
    number = finite_number(shown, text)
    whole = round(number)
    words = _words(kind, whole)
    if words:
        return Fact(shown, label, text, words, whole)
    value, unit = _joint_value(number, kind, settings)
    return Fact(shown, label, text, f"{value:.6g} {unit}" if unit else "", value, unit)


def _words(kind: str, whole: int) -> str:
    """What a number stands for; empty for a quantity."""
    if kind == "switch":
        return "on" if whole else "off"
    if kind == "mode":
        return UNIT_MODES.get(whole, "not in the list")
    if kind == "status":
        return f"{whole:X}h: {status_text(whole)}"
    if kind == "fault":
        return motor_fault_text(whole)
    if kind == "code":
        return error_text(whole) if whole else "none"
    return ""


def _joint_value(number: float, kind: str, settings: ElmoSettings) -> tuple[float, str]:
    """(value, unit) at the joint; sizes and limits of currents without the sign of the direction."""
    if kind == "position":
        return (number - settings.zero_counts) * settings.rad_per_count, "rad"
    if kind == "velocity":
        return number * settings.rad_per_count, "rad/s"
    if kind == "current":
        return number * settings.torque_NmpA, "Nm"
    if kind == "limit current":
        return number * abs(settings.torque_NmpA), "Nm"
    if kind == "speed size":
        return number * abs(settings.rad_per_count), "rad/s"
    if kind == "angle size":
        return number * abs(settings.rad_per_count), "rad"
    return number, "s" if kind == "time" else ""


# --- the drive ---


class ElmoDrive:
    """Implements `drivers.drive.Drive`."""

    def __init__(
        self,
        settings: ElmoSettings,
        open_port: Callable[[str, int], BytePort] = SerialPort,
        clock: Callable[[], float] = time.monotonic,
        gate: Callable[[], None] = lambda: None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """`gate` is called before each command until the loop runs, and raises once the user has asked for a stop."""
        self._settings = settings
        self._byte_port = open_port(settings.port, settings.baud_rate_bitps)
        self._line = Dialogue(self._byte_port, settings.reply_timeout_s, clock)
        self._line.gate = gate
        self._clock, self._sleep = clock, sleep
        self._taken = False  # whether a drive has been found and was sent anything
        self._commissioned = False
        self._speed_mode = False

    def commission(self, approve: Approval | None = None) -> CommissioningReport:
        """See `Drive.commission`.  The motor is off and the drive in torque or speed mode when this returns."""
        settings, line = self._settings, self._line
        self._budget_Hz()
        found: dict[str, str] = {}
        remarks: list[str] = []
        identity = self.identify()
        if line.integer("MO") != 0:
            refuse_unless_at_rest(
                f"the motor on {settings.port} is on (MO=1)", lambda: line.integer("PX"), settings.rad_per_count,
                approve, QUESTION, self._sleep,
            )  # fmt: skip
            self._taken = True
            switch_off(self._byte_port, line)
            remarks.append("the motor was on, at rest: it has been stopped and switched off")
        self._taken = True
        self._set_echo()
        self._motor_off()
        self._refuse_fault()
        self._compare_counts(found)
        measured = self._choose_mode(found, remarks)
        start_counts = line.integer("PX")
        self._commissioned = True
        return CommissioningReport(
            identity=identity,
            mode=SPEED_MODE if self._speed_mode else TORQUE_MODE,
            commands_velocity=self._speed_mode,
            start_position_rad=(start_counts - settings.zero_counts) * settings.rad_per_count,
            torque_resolution_Nm=TC_STEP_A * abs(settings.torque_NmpA),
            position_resolution_rad=abs(settings.rad_per_count),
            settings=found,
            remarks=(
                *remarks,
                "a serial line has no heartbeat: if cable or PC fails, only the drive's own limits stop the joint",
            ),
            loop_delay_s=measured.loop_delay_s,
        )

    def identify(self) -> DriveIdentity:
        """Which drive answers; raises as `commission` does where none or another one does.  Nothing is written."""
        settings, line = self._settings, self._line
        place = f"{settings.port} at {settings.baud_rate_bitps} baud"
        try:
            line.resynchronise()
            version = line.query("VR")
        except NoDeviceError:
            if line.interpreter.garbage_bytes:
                raise self._wrong_baud_rate(place) from None
            raise NoDeviceError(
                f"no drive answers on {place}", "power, cable (TX and RX crossed), port, baud rate of the drive"
            ) from None
        except BusError as error:
            if line.interpreter.garbage_bytes:
                raise self._wrong_baud_rate(place) from None
            raise error
        if settings.product is not None and settings.product not in version:
            raise DeviceError(f"another drive on {place}: VR (={version}) must contain {settings.product!r}")
        words = version.split()
        return DriveIdentity("Elmo", words[0] if words else "", " ".join(words[1:]), "", version)

    def _wrong_baud_rate(self, place: str) -> NoDeviceError:
        count = self._line.interpreter.garbage_bytes
        return NoDeviceError(
            f"something answers on {place}, but {count} bytes of it make no reply",
            "most likely the baud rate: drive.baud_rate_bitps must be the drive's",
        )

    def _set_echo(self) -> None:
        """EO, and proof that the drive does it: the loop distinguishes replies by it."""
        line, wanted = self._line, self._settings.echo
        try:
            line.assign("EO", int(wanted))
        except RefusedError as error:
            if line.once(encode("MO")).echoed != wanted:
                raise DeviceError(f"drive.echo (={str(wanted).lower()}) cannot be set: {error.message}") from None
        line.interpreter.echo = None
        if line.once(encode("MO")).echoed != wanted:
            raise DeviceError(f"drive.echo (={str(wanted).lower()}) was set, but the drive does not follow")
        line.interpreter.echo = wanted

    def _motor_off(self) -> None:
        self._line.assign("MO", 0)
        if self._line.integer("MO") != 0:
            raise DeviceError("MO (=1) of the drive does not become 0: the motor cannot be switched off")

    def _choose_mode(self, found: dict[str, str], remarks: list[str]) -> MeasuredExchange:
        """Speed mode where it is wanted and can be had with all its limits, else torque mode; what the line carries."""
        if self._settings.mode != "torque":
            try:
                return self._set_mode(True, found, remarks)
            except (DeviceError, ConfigurationError) as reason:
                if self._settings.mode == "speed":
                    raise
                remarks.append(f"torque mode, because speed mode cannot be had: {reason.message}")
        return self._set_mode(False, found, remarks)

    def _set_mode(self, speed: bool, found: dict[str, str], remarks: list[str]) -> MeasuredExchange:
        settings, line = self._settings, self._line
        line.forget_verified()
        digits = settings.velocity_digits if speed else 0
        budget_Hz = self._budget_Hz(digits)
        set_here = set_torque_mode(line)  # in either case: the limits are written, and TC is known to be zero
        missing = write_limits(line, settings, set_here, speed_mode=speed)
        if speed:
            if missing:
                raise DeviceError(f"in speed mode all limits must be in force: {missing[0]}")
            set_here |= set_speed_mode(line, settings)
        measured = self.measure(digits)
        self._refuse_rate(measured)
        set_here["exchange"] = (
            f"{measured.cycle_s * 1e3:.2f} ms, worst {measured.worst_cycle_s * 1e3:.2f} ms: "
            f"up to {measured.highest_rate_Hz:.0f} Hz; {budget_Hz:.0f} Hz by the baud rate"
        )
        found.update(set_here)
        remarks.extend(missing)
        self._speed_mode = speed
        return measured

    def _budget_Hz(self, velocity_digits: int = 0) -> float:
        """The rate that the baud rate allows (`velocity_digits` > 0: in speed mode); a faster loop is refused."""
        settings = self._settings
        budget_Hz = highest_rate_Hz(settings.baud_rate_bitps, settings.echo, velocity_digits)
        if settings.rate_Hz > budget_Hz:
            targets = ", for JV and BG in every cycle" if velocity_digits else ""
            raise ConfigurationError(
                f"loop.rate_Hz (={settings.rate_Hz:g}) must be at most {budget_Hz:.0f} at drive.baud_rate_bitps "
                f"(={settings.baud_rate_bitps}) with drive.echo (={str(settings.echo).lower()}){targets}"
            )
        return budget_Hz

    def _refuse_fault(self) -> None:
        """A drive that could not be enabled anyway; nothing is reset here."""
        status, fault = self._line.integer("SR"), self._line.integer("MF")
        if status & (FAULT_LATCHED | AMPLIFIER_MASK):
            raise DeviceError(
                f"the drive is in fault: {motor_off_cause(status, fault)} (SR {status:X}h: {status_text(status)})",
                "remove the cause, then `jointctl clear-fault`; nothing is reset by itself",
            )

    def _compare_counts(self, found: dict[str, str]) -> None:
        parameter = self._settings.counts_parameter
        if parameter is None:
            return
        counts = self._line.integer(parameter[:2], int(parameter[3:-1]))
        if counts != self._settings.counts_per_turn:
            expected = self._settings.counts_per_turn
            raise DeviceError(f"encoder.counts_per_turn (={expected}) differs from the drive's {parameter}, {counts}")
        found[parameter] = f"{counts} counts a turn"

    def measure(self, velocity_digits: int = 0, cycles: int = MEASURED_CYCLES) -> MeasuredExchange:
        """Time the questions of a cycle, of speed mode with `velocity_digits` > 0; nothing moves."""
        position_s, rest_s = [], []
        target = "JV" if velocity_digits else "TC"
        for _ in range(cycles):
            started_s = self._clock()
            self._line.query("PX")
            half_s = self._clock()
            self._line.query(target)
            self._line.query("SR")
            position_s.append(half_s - started_s)
            rest_s.append(self._clock() - half_s)
        baud_rate_bitps, echo = self._settings.baud_rate_bitps, self._settings.echo
        return measured_exchange(position_s, rest_s, baud_rate_bitps, echo, velocity_digits)

    def _refuse_rate(self, measured: MeasuredExchange) -> None:
        rate_Hz = self._settings.rate_Hz
        if rate_Hz > measured.highest_rate_Hz:
            raise DeviceError(
                f"loop.rate_Hz (={rate_Hz:g}) must be at most {measured.highest_rate_Hz:.0f}: one exchange takes "
                f"{measured.cycle_s * 1e3:.2f} ms on this line, at most {LARGEST_SHARE:.0%} of a period may be used",
                "lower loop.rate_Hz, raise drive.baud_rate_bitps, or reduce the adapter's latency timer",
            )

    # --- the loop has the line ---

    def thermometer(self) -> None:
        """The loop has the line for itself; see `Drive.thermometer`."""

    def settings_guard(self) -> None:
        """The loop has the line for itself; see `Drive.settings_guard`."""

    def start_cyclic(self) -> None:
        """From here on the loop has the line; this object is silent until `make_safe`.

        The user may have taken minutes to confirm.  A drive whose supply was off since, or that another program has
        used, has its own unit mode, reference and limits again: all is read back once more before MO=1.
        """
        line, echo = self._line, self._settings.echo
        line.resynchronise()
        line.interpreter.echo = None
        answer = line.once(encode("MO"))
        line.interpreter.echo = echo
        if answer.kind is ReplyKind.VALUE and answer.echoed != echo:
            raise changed("EO", str(int(answer.echoed)), str(int(echo)))
        line.verify_again()
        for name in ("MO",) if self._speed_mode else ("MO", "TC"):
            if (found := line.number(name)) != 0.0:
                raise changed(name, f"{found:g}", "0")
        line.resynchronise()

    def port(self) -> Any:
        if not self._commissioned:
            raise DeviceError("the drive has not been commissioned")
        settings = self._settings
        ports = new(ElmoPort)
        port = ports[0]
        port.fd = -1
        port.echo = int(settings.echo)
        port.position_radpcount = settings.rad_per_count
        port.zero_counts = settings.zero_counts
        port.torque_NmpA = settings.torque_NmpA
        port.target_is_velocity = int(self._speed_mode)
        port.max_velocity_cps = settings.max_velocity_cps
        port.max_current_mA = int(1000.0 * min(settings.max_current_A, settings.peak_current_A))
        port.period_ns = round(1e9 / settings.rate_Hz)
        port.enable_retry_cycles = max(1, round(ENABLE_RETRY_S * settings.rate_Hz))
        port.dead_man_cycles = max(1, round(settings.dead_man_s * settings.rate_Hz))
        return ports

    # --- looking without touching ---

    def motion(self) -> tuple[float, float, float]:
        """(position [rad], velocity [rad/s], torque from IQ [Nm]) of the joint now."""
        settings, line = self._settings, self._line
        position_rad = (line.integer("PX") - settings.zero_counts) * settings.rad_per_count
        return position_rad, line.number("VX") * settings.rad_per_count, line.number("IQ") * settings.torque_NmpA

    def facts(self) -> list[Fact]:
        """Everything that it reports about itself; after `identify`."""
        return read_facts(self._line, self._settings)

    def status(self) -> tuple[int, int]:
        """(SR, MF) now."""
        return self._line.integer("SR"), self._line.integer("MF")

    # --- the end ---

    def make_safe(self, *, asked: bool = False) -> str:
        """TC=0, JV=0, ST, MO=0 until MO reads 0.  Never raises; a drive that was never found is left alone.

        `asked`: by `jointctl stop`.  The one of the two that is done first leaves the line to the other.
        """
        self._line.gate = lambda: None
        if not self._taken:
            return "untouched"
        try:
            return switch_off(self._byte_port, self._line, ASKED_ATTEMPTS if asked else SAFE_ATTEMPTS)
        except JointctlError as error:
            return f"unknown: {error.message}; only the drive's own limits stop it now, use the emergency stop"

    def clear_fault(self) -> str:
        """See `Drive.clear_fault`.  MF and the latch in SR are cleared by MO=1 alone: in torque mode, with TC at zero.

        So the motor is on for a moment, without torque, and is switched off again.  Before that UM=1,
        RM=0 and TC=0 have been read back: without that confirmation MO=1 is not said.
        """
        line = self._line
        self.identify()
        self._taken = True
        self._motor_off()
        status, fault = line.integer("SR"), line.integer("MF")
        if not status & (FAULT_LATCHED | AMPLIFIER_MASK):
            return "no fault"
        cause = motor_off_cause(status, fault)
        if status & AMPLIFIER_MASK:
            raise DeviceError(f"the fault cannot be cleared while its cause remains: {cause}")
        set_torque_mode(line)
        off = b"TC=0\rMO=0\r"
        try:  # in one go: the drive has all of it even if this program dies
            line.ask(encode("MO", value=1), 1, behind=off)
        finally:
            self._byte_port.write(b"\r" + off)
            line.resynchronise()
        self._motor_off()
        status, fault = line.integer("SR"), line.integer("MF")
        if status & (FAULT_LATCHED | AMPLIFIER_MASK):
            raise DeviceError(f"the fault came back: {motor_off_cause(status, fault)}")
        return f"cleared: {cause}"

    def close(self) -> None:
        self._byte_port.close()


# --- What commissioning sets in the drive and reads back: its unit mode (UM) and its own limits ---
# The motor is off.  The limits are all that watches the joint when the line is cut.


TORQUE_MODE, SPEED_MODE = "torque (UM=1)", "speed (UM=2)"  # as commissioning reports them
PEAK_SHARE = 1.02  # in speed mode, of the current of limits.torque_max_Nm: the loop must see that it is reached


def set_torque_mode(line: Dialogue) -> dict[str, str]:
    """UM=1 without the analog reference (RM=0), and TC known to be zero: MO=1 then applies no torque.

    Before every MO=1 in this mode; the motor is off.  Raises `DeviceError` where the drive does not confirm it.
    """
    found = {n: f"{line.assign_verified(n, v):g}" for n, v in (("UM", int(UnitMode.TORQUE)), ("RM", 0))}
    kept_A = line.number("TC")
    if kept_A != 0.0:
        with contextlib.suppress(RefusedError):  # most drives take TC only with the motor on
            line.assign("TC", 0)
        kept_A = line.number("TC")
    if kept_A != 0.0:
        raise DeviceError(
            f"TC (={kept_A:g}) of the drive must be 0 with the motor off: it would push at MO=1",
            "switch the drive's supply off and on",
        )
    return found


def set_speed_mode(line: Dialogue, settings: ElmoSettings) -> dict[str, str]:
    """UM=2 along the drive's own ramps (PM=1) without the analog reference, and JV known to be zero.

    AC, DC and SD are steeper than what the loop asks for, and bound what one damaged command does in a cycle.
    The motor is off.  Raises `DeviceError` where the drive does not confirm it.
    """
    ramp_cps2 = round(settings.ramp_radps2 / abs(settings.rad_per_count))
    values = [
        ("UM", int(UnitMode.SPEED)),
        ("RM", 0),
        ("PM", 1),
        ("AC", ramp_cps2),
        ("DC", ramp_cps2),
        ("SD", ramp_cps2),
    ]
    found = {name: f"{line.assign_verified(name, value):g}" for name, value in [*values, ("JV", 0)]}
    step_radps = abs(settings.rad_per_count)
    return found | {"speed": f"at most {settings.max_velocity_cps} counts/s, steps of {step_radps:.2g} rad/s"}


def _write_currents(line: Dialogue, settings: ElmoSettings, found: dict[str, str], speed_mode: bool) -> None:
    """CL and PL.  In speed mode the drive decides on the current: PL[1] stands for the loop's torque limit."""
    maximum_A = line.number("MC")
    continuous_A, peak_A = settings.continuous_current_A, settings.peak_current_A
    for key, value in (("peak", peak_A), ("continuous", continuous_A)):
        if value > maximum_A:
            raise DeviceError(f"drive.{key}_current_A (={value:g}) must be at most {maximum_A:g}, the drive's MC")
    found["MC"] = f"{maximum_A:g} A"
    if speed_mode:
        peak_A = min(peak_A, PEAK_SHARE * settings.max_current_A)
        continuous_A = min(continuous_A, peak_A)
    # lower the continuous limit first: it may not be above the peak limit at any moment
    order = [("CL", 1, continuous_A, "A"), ("PL", 1, peak_A, "A")]
    if continuous_A > line.number("PL", 1):
        order.reverse()
    for name, index, value, unit in [*order, ("PL", 2, settings.peak_time_s, "s")]:
        found[f"{name}[{index}]"] = f"{line.assign_verified(name, value, index):g} {unit}"


def write_limits(line: Dialogue, settings: ElmoSettings, found: dict[str, str], *, speed_mode: bool) -> list[str]:
    """All limits into `found`; returns what is not in force, in words.  The motor is off."""
    _write_currents(line, settings, found, speed_mode)
    per_rad = 1.0 / abs(settings.rad_per_count)
    speed = round((1.0 + settings.limit_margin) * settings.velocity_max_radps * per_rad)
    slack_rad = settings.limit_margin * (settings.position_max_rad - settings.position_min_rad)
    ends = sorted(
        settings.counts_at(position)
        for position in (settings.position_min_rad - slack_rad, settings.position_max_rad + slack_rad)
    )
    limits = [
        ("HL", 2, speed), ("LL", 2, -speed), ("HL", 3, ends[1]), ("LL", 3, ends[0]),
        ("ER", 2, round(settings.speed_error_radps * per_rad)),
        ("ER", 3, round(settings.position_error_rad * per_rad)),
    ]  # fmt: skip
    missing = []
    for name, index, count in limits:
        try:
            found[f"{name}[{index}]"] = f"{line.assign_verified(name, count, index):.0f} counts"
        except RefusedError as error:
            if (name, index) in (("HL", 2), ("LL", 2)):
                raise  # without a speed limit of the drive nothing would stop a joint whose line is cut
            missing.append(f"{name}[{index}] is not in force: {error.message}")
    return missing
