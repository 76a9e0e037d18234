"""One CANopen CiA 402 drive: commissioning through the `canopen` library, and making it safe afterwards."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable
from typing import Any

import can
import canopen

from drivers.canopen.cia402 import ControlWord, State, decode_state
from drivers.canopen.commissioning import Findings, commission
from drivers.canopen.object_access import ObjectAccess
from drivers.canopen.scaling import joint_angle_per_count_rad, new_port
from drivers.canopen.settings import CanopenSettings
from drivers.drive import CommissioningReport
from drivers.errors import ConfigurationError, DeviceError, JointctlError, NoDeviceError

SDO_TIMEOUT_S = 0.3
SEARCH_S = 0.3
NMT_PRE_OPERATIONAL = 128
NMT_OPERATIONAL = 1
NMT_STOPPED = 2
SAFE_ATTEMPTS = 5


class CanopenDrive:
    """Implements `drivers.drive.Drive`.  `bus` is a python-can bus of its own, closed by `close`."""

    def __init__(self, bus: can.BusABC, settings: CanopenSettings, sleep: Callable[[float], None] = time.sleep) -> None:
        self._settings = settings
        self._sleep = sleep
        self._findings: Findings | None = None
        # the library warns about every heartbeat state and unknown frame; what matters is told by this driver
        logging.getLogger("canopen").setLevel(logging.ERROR)
        self._network = canopen.Network(bus)
        self._network.NOTIFIER_CYCLE = 0.05
        self._network.connect()
        try:
            dictionary = canopen.import_od(str(settings.eds_path), settings.node)
        except Exception as error:
            self.close()
            raise ConfigurationError(f"drive.eds (={settings.eds_path}) is not a readable EDS file: {error}") from error
        self._node = self._network.add_node(settings.node, dictionary)
        self._node.sdo.RESPONSE_TIMEOUT = SDO_TIMEOUT_S
        self._objects = ObjectAccess(self._node, settings.eds_path.name)

    def _find(self) -> None:
        """Make sure that the node answers; else say who does."""
        try:
            self._objects.read(0x1000, what="device type")
        except NoDeviceError as error:
            self._network.scanner.nodes.clear()
            self._network.scanner.search()
            self._sleep(SEARCH_S)
            others = sorted(set(self._network.scanner.nodes) - {self._settings.node})
            if others:
                message = f"node {self._settings.node} does not answer; these do: {', '.join(map(str, others))}"
                raise NoDeviceError(
                    message, hint="drive.node in the configuration, or -t on the command line"
                ) from error
            raise NoDeviceError(
                f"node {self._settings.node} does not answer, and neither does any other",
                hint="power, wiring, termination, and the bit rate of the drive",
            ) from error

    def commission(self) -> CommissioningReport:
        """See `Drive.commission`; the node is left in pre-operational."""
        self._find()
        self._node.nmt.send_command(NMT_PRE_OPERATIONAL)
        findings = commission(self._objects, self._settings)
        self._findings = findings
        angle_rad = joint_angle_per_count_rad(self._settings)
        counts = findings.start_counts - self._settings.zero_counts
        return CommissioningReport(
            identity=findings.identity,
            mode=findings.settings["mode"],
            start_position_rad=counts * angle_rad * self._settings.encoder_direction,
            torque_resolution_Nm=findings.torque_per_permille_Nm,
            position_resolution_rad=angle_rad,
            settings=findings.settings,
            remarks=tuple(findings.remarks),
        )

    def start_cyclic(self) -> None:
        """NMT operational: PDOs are valid from here on.  The drive stays disabled until the loop enables it."""
        self._node.nmt.send_command(NMT_OPERATIONAL)

    def port(self) -> Any:
        """See `Drive.port`."""
        if self._findings is None:
            raise DeviceError("the drive has not been commissioned")
        return new_port(self._settings, self._findings.torque_per_permille_Nm, self._findings.max_permille)

    def make_safe(self) -> str:
        """Controlword 0 until the statusword says disabled, then pre-operational; NMT stop if SDO does not answer.

        The controlword is also in an RPDO, so leave operational first: two writers would fight over it.
        """
        state = State.UNDEFINED
        try:
            self._node.nmt.send_command(NMT_PRE_OPERATIONAL)
            for _ in range(SAFE_ATTEMPTS):
                self._objects.write(0x6040, 0, ControlWord.DISABLE_VOLTAGE, what="controlword")
                state = State(decode_state(self._objects.read(0x6041, what="statusword")))
                if state in (State.SWITCH_ON_DISABLED, State.FAULT):
                    break
                self._sleep(0.02)
            self._objects.write_if_present(0x6071, 0, 0, what="target torque")
            # our heartbeat has ended with the loop; disabled, the drive need not watch it any more
            self._objects.write_if_present(0x1016, 1, 0, what="consumer heartbeat time")
        except JointctlError as error:
            try:
                self._node.nmt.send_command(NMT_STOPPED)
            except can.CanError:
                return f"unknown: {error}; the bus does not take frames any more"
            return f"unknown: {error}; NMT stop was sent"
        except can.CanError as error:
            return f"unknown: the bus does not take frames any more ({error})"
        return state.name.lower().replace("_", " ")

    def close(self) -> None:
        """Leave the bus; what went wrong on it has been told before."""
        with contextlib.suppress(Exception):
            self._network.disconnect()
