"""One Elmo drive on a serial port: commissioning over the ASCII interpreter, and making it safe afterwards."""

from __future__ import annotations

from typing import Any

from jointctl.drivers.drive import DriveIdentity
from jointctl.drivers.elmo.codes import (
    AMPLIFIER_MASK,
    FAULT_LATCHED,
    motor_off_cause,
)
from jointctl.drivers.elmo.commissioning import ElmoCommissioning
from jointctl.drivers.elmo.dialogue import changed
from jointctl.drivers.elmo.inspection import Fact, read_facts
from jointctl.drivers.elmo.interpreter import ReplyKind, encode
from jointctl.drivers.elmo.port import ElmoPort
from jointctl.drivers.elmo.switch_off import SAFE_ATTEMPTS, switch_off
from jointctl.drivers.elmo.unit_modes import set_torque_mode
from jointctl.drivers.errors import DeviceError, JointctlError
from jointctl.firmware_py.schema import new

ENABLE_RETRY_S = 0.5
ASKED_ATTEMPTS = 20  # twice those of `jointctl stop`, which talks on the same line meanwhile and takes replies


class ElmoDrive(ElmoCommissioning):
    """Implements `drivers.drive.Drive`: commissioning is inherited, here are the cyclic half and making it safe."""

    def thermometer(self) -> None:
        """The loop has the line for itself; see `Drive.thermometer`."""

    def settings_guard(self) -> None:
        """The loop has the line for itself; see `Drive.settings_guard`."""

    def start_cyclic(self) -> None:
        """From here on the loop has the line; this object is silent until `make_safe`.

        The user may have taken minutes to confirm.  A drive whose supply was switched off meanwhile, or that another
        program has used, has its own unit mode, reference and limits again: all is read back once more before MO=1.
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
        """See `Drive.port`: an `ElmoPort`."""
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

    def identify(self) -> DriveIdentity:
        """Who answers; raises as `commission` does where nobody or another drive does.  Nothing is written."""
        return self._identify()

    def facts(self) -> list[Fact]:
        """Everything that it tells about itself; after `identify`."""
        return read_facts(self._line, self._settings)

    def status(self) -> tuple[int, int]:
        """(SR, MF) now."""
        return self._line.integer("SR"), self._line.integer("MF")

    # --- the end ---

    def make_safe(self, *, asked: bool = False) -> str:
        """TC=0, JV=0, ST, MO=0 until MO reads 0.  Never raises; a drive that was never found is left alone.

        `asked`: by `jointctl stop`.  Whoever of the two is done first leaves the line to the other.
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

        So the motor is on for the time of one exchange, without torque, and is switched off again.  Before that UM=1,
        RM=0 and TC=0 have been read back: without that confirmation MO=1 is not said.
        """
        line = self._line
        self._identify()
        self._taken = True
        self._motor_off()
        status, fault = line.integer("SR"), line.integer("MF")
        if not status & (FAULT_LATCHED | AMPLIFIER_MASK):
            return "no fault"
        cause = motor_off_cause(status, fault)
        if status & AMPLIFIER_MASK:
            raise DeviceError(f"the fault cannot be cleared while its cause remains: {cause}")
        set_torque_mode(line)
        try:
            line.assign("MO", 1, attempts=1)
        finally:
            self._byte_port.write(b"\rTC=0\rMO=0\r")
            line.resynchronise()
        self._motor_off()
        status, fault = line.integer("SR"), line.integer("MF")
        if status & (FAULT_LATCHED | AMPLIFIER_MASK):
            raise DeviceError(f"the fault came back: {motor_off_cause(status, fault)}")
        return f"cleared: {cause}"

    def close(self) -> None:
        """Leave the port."""
        self._byte_port.close()
