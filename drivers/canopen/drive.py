"""One CANopen CiA 402 drive: commissioning through the `canopen` library, and making it safe afterwards."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

import can

from drivers.can.bus_claim import BusClaim
from drivers.canopen.bus_watchers import refuse_second_controller
from drivers.canopen.cia402 import State
from drivers.canopen.commissioning import VELOCITY_MODES, Findings, commission
from drivers.canopen.connection_loss import clear_rpdo_deadlines
from drivers.canopen.eds_file import read_eds
from drivers.canopen.encoder_end import EncoderEnd
from drivers.canopen.encoder_settings import DRIVE_RANGE_COUNTS
from drivers.canopen.fault_reset import reset_fault
from drivers.canopen.identifiers import NmtCommand
from drivers.canopen.network import new_network
from drivers.canopen.object_access import ATTEMPTS as SDO_ATTEMPTS
from drivers.canopen.object_access import ObjectAccess
from drivers.canopen.scaling import joint_angle_per_count_rad, new_port, start_position_rad
from drivers.canopen.settings import CanopenSettings
from drivers.canopen.switch_off import SDO_TIMEOUT_S, SwitchOff, state_of
from drivers.canopen.thermometer import Thermometer
from drivers.canopen.watchdog_proof import prove_watchdog
from drivers.drive import UNTOUCHED, CommissioningReport
from drivers.errors import BusError, ConfigurationError, DeviceError, JointctlError, NoDeviceError

SEARCH_S = 0.3
REOPEN_ATTEMPTS = 10
REOPEN_PAUSE_S = 0.3  # an adapter that was plugged in again needs a second or two


class CanopenDrive:
    """Implements `drivers.drive.Drive`.  `bus` is a python-can bus of its own, closed by `close`, as `claim` is.

    Where an adapter serves one program at a time, `reopen` is given: `start_cyclic` closes the bus for the loop, and
    `make_safe` opens it again.  In between nobody but the loop talks to the drive; it is disabled until the loop
    enables it, and from the loop's first heartbeat on its own watchdog stops it when the loop ends.
    """

    def __init__(
        self,
        bus: can.BusABC,
        settings: CanopenSettings,
        sleep: Callable[[float], None] = time.sleep,
        reopen: Callable[[], can.BusABC] | None = None,
        claim: BusClaim | None = None,
    ) -> None:
        self._settings = settings
        self._sleep = sleep
        self._findings: Findings | None = None
        self._taken = False  # whether the drive has heard anything from us
        self._started = False  # whether the loop may send SYNC
        self._reopen, self._claim = reopen, claim
        self._lent = False
        self._thermometer: Thermometer | None = None
        self._network = new_network(bus, sleep)
        self._network.connect()
        sdo_timeout_s = settings.sdo_timeout_s or SDO_TIMEOUT_S
        try:
            self._eds = read_eds(settings.eds_path, settings.node)
            self._encoder = EncoderEnd(self._network, settings, sdo_timeout_s)
        except ConfigurationError:
            self.close()
            raise
        self._node = self._network.add_node(settings.node, self._eds.dictionary)
        self._node.sdo.RESPONSE_TIMEOUT = sdo_timeout_s
        self._objects = ObjectAccess(self._node, self._eds.name, self._eds.unusable)
        encoder = settings.joint_encoder.node if settings.joint_encoder is not None else None
        self._switch_off = SwitchOff(self._network, settings.node, self._objects, encoder, sleep)

    def _find(self) -> None:
        """Make sure that the node answers, also one that is still booting; else say who does.

        "Pre-operational" is said again each time: a node that boots in the meantime has not heard it, and some go
        to operational by themselves.
        """
        for _ in range(round(self._settings.boot_timeout_s / (self._node.sdo.RESPONSE_TIMEOUT * SDO_ATTEMPTS))):
            with contextlib.suppress(NoDeviceError):
                self._objects.read(0x1000, what="device type")
                break
            self._node.nmt.send_command(NmtCommand.ENTER_PRE_OPERATIONAL)
        try:
            self._objects.read(0x1000, what="device type")
        except NoDeviceError as error:
            self._network.scanner.nodes.clear()
            self._network.scanner.search()
            self._sleep(SEARCH_S)
            others = sorted(set(self._network.scanner.nodes) - {self._settings.node})
            if others:
                message = f"node {self._settings.node} does not answer; these do: {', '.join(map(str, others))}"
                raise NoDeviceError(message, hint="set drive.node in the configuration") from error
            raise NoDeviceError(
                f"node {self._settings.node} does not answer, and neither does any other",
                hint="power, wiring, termination, and the bit rate of the drive",
            ) from error

    def _prove_watchdog(self) -> str:
        """See `prove_watchdog`; afterwards the node is brought back to pre-operational."""
        settings = self._settings
        seen = prove_watchdog(self._network, settings.node, settings.master_node, settings.heartbeat_s, self._sleep)
        self._node.nmt.send_command(NmtCommand.ENTER_PRE_OPERATIONAL)
        return seen

    def commission(self) -> CommissioningReport:
        """See `Drive.commission`; the node is left in pre-operational."""
        try:
            refuse_second_controller(self._network, self._sleep)
            self._taken, self._started = True, False
            # first: a node that its watchdog or an earlier run left in "stopped" does not answer SDO
            self._node.nmt.send_command(NmtCommand.ENTER_PRE_OPERATIONAL)
            self._find()
            if self._thermometer is None and self._settings.temperature is not None:
                wanted = self._settings.temperature
                self._thermometer = Thermometer(self._network, self._node, wanted, self._eds.name)
            self._objects.forget_verified()
            findings = commission(self._objects, self._settings, self._eds, self._sleep, self._prove_watchdog)
            encoder = self._encoder.commission()
            if encoder is not None:
                findings.second = encoder[0]
                findings.settings["joint encoder"] = encoder[0].words
                findings.remarks += encoder[1]
        except can.CanError as error:
            raise BusError(f"the bus failed during commissioning: {error}") from None
        self._findings = findings
        angle_rad = joint_angle_per_count_rad(self._settings)
        second = findings.second
        start_rad = start_position_rad(
            self._settings,
            findings.start_counts,
            second.start_counts if second is not None else 0,
            second.range_counts if second is not None else DRIVE_RANGE_COUNTS,
        )
        return CommissioningReport(
            identity=findings.identity,
            mode=findings.settings["mode"],
            start_position_rad=start_rad,
            torque_resolution_Nm=findings.torque_per_permille_Nm,
            position_resolution_rad=angle_rad,
            settings=findings.settings,
            remarks=tuple(findings.remarks),
            measures_torque=findings.layout is None or findings.layout.torque_at >= 0,
        )

    def start_cyclic(self) -> None:
        """NMT operational: PDOs are valid from here on.  The drive stays disabled until the loop enables it.

        The user may have taken minutes to confirm.  A drive that was switched off meanwhile, or that another program
        has made safe, has lost its watchdog or its limits: everything is read back once more.  `BusError` if another
        controller is active by now.
        """
        if self._findings is None:
            raise DeviceError("the drive has not been commissioned")
        try:
            self._objects.verify_again()
            shown = self._objects.read(0x6061, what="modes of operation display")
            if shown != self._findings.mode:
                raise DeviceError(
                    f"node {self._settings.node}: 6061 shows mode {shown}, it was {self._findings.mode:d}"
                )
            self._encoder.verify_again()
            # whoever came after our commissioning has the drive: its load must not be dropped by our controlword
            refuse_second_controller(self._network, self._sleep)
            self._started = True
            self._encoder.tell(NmtCommand.START)
            self._node.nmt.send_command(NmtCommand.START)
        except can.CanError as error:
            raise BusError(f"the bus failed before the run: {error}") from None
        if self._reopen is not None:
            self._lent = True
            with contextlib.suppress(Exception):  # whoever opens it next is told
                self._network.disconnect()

    def _take_back(self) -> None:
        """Open the bus again if the loop has had it; `BusError` if it cannot be opened."""
        if not self._lent or self._reopen is None:
            return
        for attempt in range(1, REOPEN_ATTEMPTS + 1):
            try:
                self._network.bus = self._reopen()
                break
            except BusError:
                if attempt == REOPEN_ATTEMPTS:
                    raise
                self._sleep(REOPEN_PAUSE_S)
        self._network.connect()
        self._lent = False

    def port(self) -> Any:
        """See `Drive.port`."""
        if self._findings is None:
            raise DeviceError("the drive has not been commissioned")
        found = self._findings
        velocity = found.mode in VELOCITY_MODES
        return new_port(
            self._settings,
            found.torque_per_permille_Nm,
            found.max_permille,
            velocity=velocity,
            layout=found.layout,
            heartbeat_watched=found.heartbeat_watched,
            second_range_counts=found.second.range_counts if found.second is not None else DRIVE_RANGE_COUNTS,
        )

    def thermometer(self) -> Thermometer | None:
        """See `Drive.thermometer`; a bus that the loop has for itself carries no SDO of ours."""
        return None if self._lent else self._thermometer

    def make_safe(self) -> str:
        """See `SwitchOff.make_safe`.

        A drive that `commission` has not taken over is left alone, and so is one that another controller has taken
        before our loop was started: its motion is not ours to end.
        """
        if not self._taken:
            return UNTOUCHED
        if not self._started:
            try:
                refuse_second_controller(self._network, self._sleep)
            except BusError:
                return UNTOUCHED
        try:
            self._take_back()
        except JointctlError as error:
            return (
                f"unknown: the bus cannot be opened again ({error.message}); the loop's heartbeat has ended, "
                f"the drive's own watchdog stops the joint within {self._settings.heartbeat_s:g} s"
            )
        return self._switch_off.make_safe()

    def clear_fault(self) -> str:
        """Reset the drive's fault on the user's word; refuses while another controller is active, or it is enabled.

        An enabled drive has no fault, and somebody needs it so, perhaps without SYNC: its watchdog and power stay.
        """
        refuse_second_controller(self._network, self._sleep)
        with contextlib.suppress(NoDeviceError):  # one that was stopped does not answer yet
            if state_of(self._objects) is State.OPERATION_ENABLED:
                raise DeviceError(
                    f"node {self._settings.node} is in operation enabled: there is no fault, and it was left as it is",
                    hint="`jointctl stop` switches it off",
                )
        self._taken = True
        self._node.nmt.send_command(NmtCommand.ENTER_PRE_OPERATIONAL)
        self._find()
        # nobody sends a heartbeat now: a watchdog that is still armed would keep its fault alive
        self._objects.write_if_present(0x1016, 1, 0, what="consumer heartbeat time")
        clear_rpdo_deadlines(self._objects)
        return reset_fault(self._objects, self._sleep)

    def close(self) -> None:
        """Leave the bus; what went wrong on it has been told before."""
        with contextlib.suppress(Exception):
            self._network.disconnect()
        if self._claim is not None:
            self._claim.close()
