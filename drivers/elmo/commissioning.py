"""Commissioning of an Elmo drive over the ASCII interpreter: who it is, torque mode, limits, what the line carries."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

from drivers.drive import CommissioningReport, DriveIdentity
from drivers.elmo.codes import (
    AMPLIFIER_MASK,
    FAULT_LATCHED,
    UnitMode,
    motor_off_cause,
    status_text,
)
from drivers.elmo.dialogue import Dialogue, RefusedError
from drivers.elmo.interpreter import encode
from drivers.elmo.line_budget import LARGEST_SHARE, MeasuredExchange, highest_rate_Hz, measured_exchange
from drivers.elmo.serial_port import BytePort, SerialPort
from drivers.elmo.settings import ElmoSettings
from drivers.errors import BusError, ConfigurationError, DeviceError, NoDeviceError

MEASURED_CYCLES = 20
TC_STEP_A = 1e-3


class ElmoCommissioning:
    """The first half of a drive: from an unknown one to one whose limits are read back, its motor off."""

    def __init__(
        self,
        settings: ElmoSettings,
        open_port: Callable[[str, int], BytePort] = SerialPort,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._settings = settings
        self._byte_port = open_port(settings.port, settings.baud_rate_bitps)
        self._line = Dialogue(self._byte_port, settings.reply_timeout_s, clock)
        self._clock = clock
        self._taken = False  # whether a drive has been found and told anything
        self._commissioned = False

    # --- commissioning ---

    def commission(self) -> CommissioningReport:
        """See `Drive.commission`.  The motor is off and the drive in torque mode when this returns."""
        settings, line = self._settings, self._line
        budget_Hz = highest_rate_Hz(settings.baud_rate_bitps, settings.echo)
        if settings.rate_Hz > budget_Hz:
            raise ConfigurationError(
                f"loop.rate_Hz (={settings.rate_Hz:g}) must be at most {budget_Hz:.0f} at drive.baud_rate_bitps "
                f"(={settings.baud_rate_bitps}) with drive.echo (={str(settings.echo).lower()})"
            )
        found: dict[str, str] = {}
        remarks: list[str] = []
        identity = self._identify()
        self._taken = True
        self._set_echo()
        if line.integer("MO") != 0:
            remarks.append("the motor was on: it has been switched off")
        self._motor_off()
        self._refuse_fault()
        found.update(self._torque_mode())
        self._write_limits(found, remarks)
        self._compare_counts(found)
        measured = self.measure()
        self._refuse_rate(measured)
        found["exchange"] = (
            f"{measured.cycle_s * 1e3:.2f} ms, worst {measured.worst_cycle_s * 1e3:.2f} ms: "
            f"up to {measured.highest_rate_Hz:.0f} Hz; {budget_Hz:.0f} Hz by the baud rate"
        )
        start_counts = line.integer("PX")
        self._commissioned = True
        return CommissioningReport(
            identity=identity,
            mode="torque (UM=1)",
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

    def _torque_mode(self) -> dict[str, str]:
        """UM=1 without the analog reference (RM=0), and TC known to be zero: MO=1 then applies no torque.

        Before every MO=1; the motor is off.  Raises `DeviceError` where the drive does not confirm it.
        """
        line = self._line
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

    def _refuse_fault(self) -> None:
        """A drive that could not be enabled anyway; nothing is reset here."""
        status, fault = self._line.integer("SR"), self._line.integer("MF")
        if status & (FAULT_LATCHED | AMPLIFIER_MASK):
            raise DeviceError(
                f"the drive is in fault: {motor_off_cause(status, fault)} (SR {status:X}h: {status_text(status)})",
                "remove the cause, then `jointctl clear-fault`; nothing is reset by itself",
            )

    def _write_limits(self, found: dict[str, str], remarks: list[str]) -> None:
        """The drive's own limits, read back.  They are all that watches the joint when the line is cut."""
        settings, line = self._settings, self._line
        maximum_A = line.number("MC")
        for key, value in (("peak", settings.peak_current_A), ("continuous", settings.continuous_current_A)):
            if value > maximum_A:
                raise DeviceError(f"drive.{key}_current_A (={value:g}) must be at most {maximum_A:g}, the drive's MC")
        found["MC"] = f"{maximum_A:g} A"
        # lower the continuous limit first: it may not be above the peak limit at any moment
        current = line.number("PL", 1)
        order = [("CL", 1, settings.continuous_current_A, "A"), ("PL", 1, settings.peak_current_A, "A")]
        if settings.continuous_current_A > current:
            order.reverse()
        for name, index, value, unit in [*order, ("PL", 2, settings.peak_time_s, "s")]:
            found[f"{name}[{index}]"] = f"{line.assign_verified(name, value, index):g} {unit}"
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
        for name, index, count in limits:
            try:
                found[f"{name}[{index}]"] = f"{line.assign_verified(name, count, index):.0f} counts"
            except RefusedError as error:
                if (name, index) in (("HL", 2), ("LL", 2)):
                    raise  # without a speed limit of the drive nothing would stop a joint whose line is cut
                remarks.append(f"{name}[{index}] is not in force: {error.message}")

    def _compare_counts(self, found: dict[str, str]) -> None:
        parameter = self._settings.counts_parameter
        if parameter is None:
            return
        counts = self._line.integer(parameter[:2], int(parameter[3:-1]))
        if counts != self._settings.counts_per_turn:
            expected = self._settings.counts_per_turn
            raise DeviceError(f"encoder.counts_per_turn (={expected}) differs from the drive's {parameter}, {counts}")
        found[parameter] = f"{counts} counts a turn"

    def measure(self, cycles: int = MEASURED_CYCLES) -> MeasuredExchange:
        """Time the questions of a cycle; nothing moves."""
        position_s, rest_s = [], []
        for _ in range(cycles):
            started_s = self._clock()
            self._line.query("PX")
            half_s = self._clock()
            self._line.query("TC")
            self._line.query("SR")
            position_s.append(half_s - started_s)
            rest_s.append(self._clock() - half_s)
        return measured_exchange(position_s, rest_s, self._settings.baud_rate_bitps, self._settings.echo)

    def _refuse_rate(self, measured: MeasuredExchange) -> None:
        rate_Hz = self._settings.rate_Hz
        if rate_Hz > measured.highest_rate_Hz:
            raise DeviceError(
                f"loop.rate_Hz (={rate_Hz:g}) must be at most {measured.highest_rate_Hz:.0f}: one exchange takes "
                f"{measured.cycle_s * 1e3:.2f} ms on this line, at most {LARGEST_SHARE:.0%} of a period may be used",
                "lower loop.rate_Hz, raise drive.baud_rate_bitps, or reduce the adapter's latency timer",
            )

    # --- the run ---
