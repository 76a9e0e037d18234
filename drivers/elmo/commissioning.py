"""Commissioning of an Elmo drive over the ASCII interpreter: who it is, unit mode, limits, what the line carries."""

from __future__ import annotations

import time
from collections.abc import Callable

from jointctl.drivers.at_rest import refuse_unless_at_rest
from jointctl.drivers.drive import Approval, CommissioningReport, DriveIdentity
from jointctl.drivers.elmo.codes import (
    AMPLIFIER_MASK,
    FAULT_LATCHED,
    motor_off_cause,
    status_text,
)
from jointctl.drivers.elmo.dialogue import Dialogue, RefusedError
from jointctl.drivers.elmo.interpreter import encode
from jointctl.drivers.elmo.limits import write_limits
from jointctl.drivers.elmo.line_budget import LARGEST_SHARE, MeasuredExchange, highest_rate_Hz, measured_exchange
from jointctl.drivers.elmo.serial_port import BytePort, SerialPort
from jointctl.drivers.elmo.settings import ElmoSettings
from jointctl.drivers.elmo.switch_off import switch_off
from jointctl.drivers.elmo.unit_modes import SPEED_MODE, TORQUE_MODE, set_speed_mode, set_torque_mode
from jointctl.drivers.errors import BusError, ConfigurationError, DeviceError, NoDeviceError

MEASURED_CYCLES = 20
TC_STEP_A = 1e-3
QUESTION = "The motor is on, and at rest. Stop it and switch it off?"


class ElmoCommissioning:
    """The first half of a drive: from an unknown one to one whose limits are read back, its motor off."""

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
        self._taken = False  # whether a drive has been found and told anything
        self._commissioned = False
        self._speed_mode = False

    def commission(self, approve: Approval | None = None) -> CommissioningReport:
        """See `Drive.commission`.  The motor is off and the drive in torque or speed mode when this returns."""
        settings, line = self._settings, self._line
        self._budget_Hz()
        found: dict[str, str] = {}
        remarks: list[str] = []
        identity = self._identify()
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

    def _identify(self) -> DriveIdentity:
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
        """EO, and proof that the drive does it: the loop tells replies apart by it."""
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
