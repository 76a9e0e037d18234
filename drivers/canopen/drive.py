"""One CANopen CiA 402 drive: commissioning through the `canopen` library, and making it safe afterwards."""

from __future__ import annotations

import contextlib
import math
import struct
import time
from collections.abc import Callable, Iterator
from typing import Any

import can
import canopen
from canopen.objectdictionary import ObjectDictionaryError
from canopen.objectdictionary.datatypes import NUMBER_TYPES

from jointctl.drivers.canopen.cia import MODE_SHOWN, Mode, NmtCommand
from jointctl.drivers.canopen.commissioning import VELOCITY_MODES, Findings, commission
from jointctl.drivers.canopen.eds import read_eds
from jointctl.drivers.canopen.encoder import EncoderEnd
from jointctl.drivers.canopen.network import OtherControllers, new_network, receive_beside_loop, report_own_frames
from jointctl.drivers.canopen.pdo import joint_angle_per_count_rad, new_port, start_position_rad
from jointctl.drivers.canopen.sdo import ATTEMPTS as SDO_ATTEMPTS
from jointctl.drivers.canopen.sdo import ObjectAccess, SdoReads, object_name
from jointctl.drivers.canopen.settings import DRIVE_RANGE_COUNTS, CanopenSettings, TemperatureObject
from jointctl.drivers.canopen.switch_off import (
    POWERED_STATES,
    SDO_TIMEOUT_S,
    SwitchOff,
    brake_if_enabled,
    reset_fault,
    state_of,
)
from jointctl.drivers.canopen.watchdog import (
    WatchdogGuard,
    clear_rpdo_deadlines,
    is_kept,
    prove_watchdog,
    rpdo_identifiers,
    watched_nodes,
)
from jointctl.drivers.drive import UNTOUCHED, Approval, CommissioningReport, Reading, is_safe
from jointctl.drivers.errors import BusError, ConfigurationError, DeviceError, JointctlError, NoDeviceError
from jointctl.firmware_py.states import in_words

SEARCH_S = 0.3
GATE_S = 0.05  # a wait is interrupted after so long at most
REOPEN_ATTEMPTS = 10
REOPEN_PAUSE_S = 0.3  # an adapter that was plugged in again needs a second or two


class CanopenDrive:
    """Implements `drivers.drive.Drive`.  `bus` is a python-can bus of its own, closed by `close`.

    Of an arm, each drive but the first is given the one before it as its `bus`: all share that end of the bus, what
    listens for other controllers there, and the heartbeat.  Their `commission`, `start_cyclic` and `close` are called
    by `drivers.drive.DriveGroup`.

    It listens for other controllers from its making on; `private`: see `OtherControllers`.  `gate` is called between
    any two steps before the loop runs, and raises once the user has asked for a stop: no step follows then but those of
    `make_safe`.
    Where an adapter serves one program at a time, `reopen` is given: `start_cyclic` closes the bus for the loop, and
    `make_safe` opens it again.  In between no one but the loop talks to the drive; it is disabled until the loop
    enables it, and from the loop's first heartbeat on its own watchdog stops it when the loop ends.
    """

    def __init__(
        self,
        bus: can.BusABC | CanopenDrive,
        settings: CanopenSettings,
        sleep: Callable[[float], None] = time.sleep,
        reopen: Callable[[], can.BusABC] | None = None,
        gate: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
        private: bool = False,
    ) -> None:
        self._settings = settings
        self._sleep, self._gate, self._clock = sleep, gate, clock
        self._findings: Findings | None = None
        self._taken = False  # whether the drive has heard anything from us
        self._started = False  # whether the loop may send SYNC
        self._reopen = reopen
        self._handed_over = False
        self._thermometer: Thermometer | None = None
        self._reads: SdoReads | None = None
        self._guard: WatchdogGuard | None = None
        encoder = settings.joint_encoder.node if settings.joint_encoder is not None else None
        nodes = [settings.node] if encoder is None else [settings.node, encoder]
        self._remarks: list[str] | None = None  # of `take_over`
        self._arm: list[CanopenDrive] = [self]  # all drives of this end of the bus, one list
        self._others: OtherControllers
        self._network: canopen.Network
        if isinstance(bus, CanopenDrive):
            self._others, self._network, self._arm = bus._others, bus._network, bus._arm
            self._others.add_nodes(nodes)
            self._arm.append(self)
        else:
            self._others = OtherControllers(nodes, settings.master_node, clock, private)
            self._network = new_network(bus, sleep, self._others)
            report_own_frames(self._network, self._others)
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
        self._objects.gate = gate
        self._switch_off = SwitchOff(
            self._network, settings.node, self._objects, encoder, sleep, settings.stop_timeout_s, settings.off_timeout_s
        )

    def _pause(self, seconds: float) -> None:
        """Sleep, and leave as soon as the user has asked for a stop."""
        while seconds > 0.0:
            self._gate()
            self._sleep(min(seconds, GATE_S))
            seconds -= GATE_S
        self._gate()

    def _listen(self) -> None:
        """Nothing is sent to a bus that was not listened to; `BusError` names what another controller has sent."""
        self._pause(self._others.to_listen_s)
        self._others.refuse()

    def _answers(self) -> bool:
        """Whether the node answers SDO in the NMT state that it has."""
        try:
            self._objects.read(0x1000, what="device type")
        except NoDeviceError:
            return False
        return True

    def _find(self) -> None:
        """Make sure that the node answers, also one that is still booting; else say which nodes do.

        Only a node that does not answer is sent "pre-operational", again each time: one that boots in the meantime
        has not received it, and some go to operational by themselves.
        """
        for _ in range(round(self._settings.boot_timeout_s / (self._node.sdo.RESPONSE_TIMEOUT * SDO_ATTEMPTS))):
            if self._answers():
                break
            self._others.refuse()
            self._node.nmt.send_command(NmtCommand.ENTER_PRE_OPERATIONAL)
        try:
            self._objects.read(0x1000, what="device type")
        except NoDeviceError as error:
            self._network.scanner.nodes.clear()
            self._network.scanner.search()
            self._pause(SEARCH_S)
            others = sorted(set(self._network.scanner.nodes) - {self._settings.node})
            if others:
                message = f"node {self._settings.node} does not answer; these do: {', '.join(map(str, others))}"
                raise NoDeviceError(message, hint="set drive.node in the configuration") from error
            raise NoDeviceError(
                f"node {self._settings.node} does not answer, and neither does any other",
                hint="power, wiring, termination, and the bit rate of the drive",
            ) from error

    def _refuse_by_the_drives_word(self) -> list[str]:
        """What the drive's own objects say of another controller (`BusError`); remarks."""
        self._others.add_rpdos(rpdo_identifiers(self._objects))
        self._others.refuse()
        heartbeats = self._others.heartbeats
        for watched in watched_nodes(self._objects):
            if watched in heartbeats:
                raise BusError(
                    f"node {self._settings.node} watches the heartbeat of node {watched} (1016), which is on this bus: "
                    "another controller has the drive",
                    "end it first; only one controller may use the bus",
                )
        if not heartbeats:
            return []
        numbers = ", ".join(map(str, sorted(heartbeats)))
        return [f"other nodes are on the bus: heartbeats of {numbers}"]

    def _prove_watchdog(self) -> str:
        """See `prove_watchdog`; afterwards the node is brought back to pre-operational.

        So are the other drives of an arm that watch the same heartbeat already.
        """
        settings = self._settings
        seen = prove_watchdog(self._network, settings.node, settings.master_node, settings.heartbeat_s, self._pause)
        for drive in self._arm:
            if drive._taken:
                drive._node.nmt.send_command(NmtCommand.ENTER_PRE_OPERATIONAL)
        return seen

    def take_over(self, approve: Approval | None = None) -> None:
        """The first part of `commission`: afterwards the drive is known to be off.

        Nothing is sent before the bus was silent for LISTEN_S, no NMT command before the drive is known to be off.
        """
        with self._blamed("during commissioning"):
            self._started = False
            self._objects.remarks.clear()
            self._listen()
            self._find()
            remarks = self._refuse_by_the_drives_word()
            angle_rad = joint_angle_per_count_rad(self._settings)
            braked = brake_if_enabled(
                self._objects, self._settings.node, angle_rad, approve, self._pause, self._others.refuse
            )
            self._others.refuse()
            self._taken = True
            self._remarks = [*([braked] if braked else []), *remarks]

    @contextlib.contextmanager
    def _blamed(self, when: str) -> Iterator[None]:
        """What goes wrong, with another controller as its cause where there is one."""
        try:
            yield
        except can.CanError as error:
            raise BusError(f"the bus failed {when}: {error}") from None
        except (DeviceError, NoDeviceError):
            self._others.refuse()  # explains it
            raise

    def commission(self, approve: Approval | None = None) -> CommissioningReport:
        """See `Drive.commission`; the node is left in pre-operational."""
        if self._remarks is None:
            self.take_over(approve)
        angle_rad = joint_angle_per_count_rad(self._settings)
        with self._blamed("during commissioning"):
            remarks, self._remarks = self._remarks or [], None
            self._node.nmt.send_command(NmtCommand.ENTER_PRE_OPERATIONAL)
            if self._reads is None:
                self._reads = SdoReads(self._network, self._node, lambda: round(self._clock() * 1e9))
            if self._thermometer is None and self._settings.temperature is not None:
                wanted = self._settings.temperature
                self._thermometer = Thermometer(self._node, wanted, self._eds.name, self._reads)
            self._objects.forget_verified()
            findings = commission(self._objects, self._settings, self._eds, self._pause, self._prove_watchdog)
            encoder = self._encoder.commission()
            if encoder is not None:
                findings.second = encoder[0]
                findings.settings["joint encoder"] = encoder[0].words
                findings.remarks += encoder[1]
        findings.remarks += remarks
        self._findings = findings
        second = findings.second
        of_second = (second.start_counts, second.range_counts) if second is not None else (0, DRIVE_RANGE_COUNTS)
        start_rad = start_position_rad(self._settings, findings.start_counts, *of_second)
        return CommissioningReport(
            identity=findings.identity,
            mode=findings.settings["mode"],
            start_position_rad=start_rad,
            torque_resolution_Nm=findings.torque_per_permille_Nm,
            position_resolution_rad=angle_rad,
            settings=findings.settings,
            remarks=tuple(findings.remarks),
            counts_per_motor_turn=findings.counts_per_motor_turn,
            commands_velocity=findings.mode in VELOCITY_MODES,
            measures_torque=findings.layout is None or findings.layout.torque_at >= 0,
        )

    def start_cyclic(self) -> None:
        """NMT operational: PDOs are valid from here on.  The drive stays disabled until the loop enables it.

        The user may have taken minutes to confirm.  A drive that was switched off since, or that another program has
        made safe, has lost its watchdog or its limits: everything is read back once more.  `BusError` if another
        controller was on the bus since commissioning began.
        """
        self.verify()
        self._start()

    def verify(self) -> None:
        """The first part of `start_cyclic`: of an arm, all drives go through it before the first one is started."""
        if self._findings is None or self._reads is None:
            raise DeviceError("the drive has not been commissioned")
        with self._blamed("before the run"):
            self._objects.verify_again()
            self._require_mode(self._findings.mode)
            self._encoder.verify_again()
            # another controller that came after our commissioning has the drive: its load must not be dropped by us
            self._others.refuse()
            self._gate()

    def _start(self) -> None:
        """The second part of `start_cyclic`, for a drive that was verified."""
        assert self._findings is not None
        assert self._reads is not None
        with self._blamed("before the run"):
            self._started = True
            self._encoder.send_command(NmtCommand.START)
            self._node.nmt.send_command(NmtCommand.START)
            self._others.own_loop_begins()
            if self._reopen is not None:
                self._objects.verify_again(is_kept)
                self._require_mode(self._findings.mode)
                self._others.refuse()
                self._gate()
            else:
                receive_beside_loop(self._network, self._others.nodes)
                self._guard = WatchdogGuard(
                    self._objects, self._reads, self._settings.node, self._findings.mode, self._others.refuse
                )
        if self._reopen is not None:
            self._handed_over = True
            with contextlib.suppress(Exception):  # the next one to open it gets the error
                self._network.disconnect()

    def _require_mode(self, mode: int) -> None:
        shown = self._objects.read(0x6061, what=MODE_SHOWN)
        if shown != mode:
            raise DeviceError(f"node {self._settings.node}: 6061 shows mode {shown}, it was {mode:d}")

    def settings_guard(self) -> WatchdogGuard | None:
        """See `Drive.settings_guard`; an adapter that the loop has for itself carries no SDO of ours."""
        return self._guard

    def _take_back(self) -> None:
        """Open the bus again if the loop has had it; `BusError` if it cannot be opened."""
        if not self._handed_over or self._reopen is None:
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
        self._handed_over = False

    def port(self) -> Any:
        if self._findings is None:
            raise DeviceError("the drive has not been commissioned")
        found = self._findings
        velocity = found.mode in VELOCITY_MODES
        return new_port(
            self._settings,
            found.torque_per_permille_Nm,
            found.max_permille,
            velocity=velocity,
            position=found.mode is Mode.CYCLIC_SYNC_POSITION,
            layout=found.layout,
            heartbeat_watched=found.heartbeat_watched,
            second_range_counts=found.second.range_counts if found.second is not None else DRIVE_RANGE_COUNTS,
        )

    def thermometer(self) -> Thermometer | None:
        """See `Drive.thermometer`; a bus that the loop has for itself carries no SDO of ours."""
        return None if self._handed_over else self._thermometer

    def make_safe(self, *, asked: bool = False) -> str:
        """See `SwitchOff.make_safe`.

        A drive that `commission` has not taken over is left alone, and so is one that another controller has taken
        before our loop was started: its motion is not ours to end.  `asked`: the user wants a stop, whose frames look
        like another controller's.  The watchdog that we have armed is taken away when the drive is off, and the
        maker's own limit that we have lowered is given back.
        """
        self._gate = self._objects.gate = lambda: None
        if not self._taken:
            return UNTOUCHED
        if not self._started and not asked and self._others.found():
            return UNTOUCHED
        try:
            self._take_back()
        except JointctlError as error:
            return (
                f"unknown: the bus cannot be opened again ({error.message}); the loop's heartbeat has ended, "
                f"the drive's own watchdog stops the joint within {self._settings.heartbeat_s:g} s"
            )
        state = self._switch_off.make_safe()
        if is_safe(state):
            with contextlib.suppress(JointctlError, can.CanError):
                self._take_watchdog_away()
            with contextlib.suppress(JointctlError, can.CanError):
                self._objects.give_limits_back()
        return state

    def _take_watchdog_away(self) -> None:
        """Our heartbeat has ended with the loop; a drive that is off need not watch it any more.

        Another program may have armed it for itself since: then it stays.
        """
        armed, _ = self._objects.verified().get((0x1016, 1), (0, ""))
        what = "consumer heartbeat time"
        if armed and self._objects.read(0x1016, 1, what=what) == armed:
            self._objects.write_verified(0x1016, 1, 0, what=what)

    def clear_fault(self) -> str:
        """Reset the drive's fault on the user's word; refuses while another controller is active, or it has power.

        A drive with power has no fault, and its controller needs it so, perhaps without SYNC: it is left as it is.
        """
        self._listen()
        self._find()
        self._refuse_by_the_drives_word()
        if (state := state_of(self._objects)) in POWERED_STATES:
            raise DeviceError(
                f"node {self._settings.node} is in {in_words(state)}: there is no fault, and it was left as it is",
                hint="`jointctl stop` switches it off",
            )
        self._others.refuse()
        self._taken = True
        self._node.nmt.send_command(NmtCommand.ENTER_PRE_OPERATIONAL)
        # no one sends a heartbeat now: a watchdog that is still armed would keep its fault alive
        self._objects.write_if_present(0x1016, 1, 0, what="consumer heartbeat time")
        clear_rpdo_deadlines(self._objects)
        return reset_fault(self._objects, self._pause)

    def close(self) -> None:
        """Leave the bus; what went wrong on it has been reported before."""
        with contextlib.suppress(Exception):
            self._network.disconnect()


# --- The drive's temperature while the loop runs: one SDO upload a second, asked and answered without waiting ---
# CiA 402 has no object for it; the configuration names the drive's own.  Whatever goes wrong with it (abort, no answer,
# nonsense) makes the temperature unknown and nothing else.


PERIOD_S = 1.0
_WIDEST_BITS = 32  # of an expedited answer


class Thermometer:
    """Call `poll` often; it sends a request a second and returns what has come of the one before."""

    def __init__(self, node: canopen.RemoteNode, wanted: TemperatureObject, eds_name: str, reads: SdoReads) -> None:
        """`reads`: those of the same node, which has one SDO channel.  `DeviceError` if the EDS has no such number."""
        self._wanted = wanted
        self._name = f"object {object_name(wanted.index, wanted.sub)} (temperature)"
        variable: Any = node.object_dictionary.get_variable(wanted.index, wanted.sub)
        if variable is None or variable.data_type not in NUMBER_TYPES or len(variable) > _WIDEST_BITS:
            raise DeviceError(
                f"EDS {eds_name} has no {self._name} that is a number of at most {_WIDEST_BITS} bits",
                "correct drive.temperature_object, or leave it out",
            )
        self._variable = variable
        self._newest: Reading | None = None
        self._reads = reads
        self._reads.add(wanted.index, wanted.sub, PERIOD_S, self._on_answer)

    def _on_answer(self, time_ns: int, data: bytes | None, problem: str) -> None:
        value = self._number(data) if data is not None else None
        if value is not None:
            self._newest = Reading(time_ns, self._wanted.unit_degC * value + self._wanted.offset_degC)
            return
        if data is not None:
            problem = f"{len(self._variable)} bits are expected, not {data.hex()}"
        self._newest = Reading(time_ns, None, f"{self._name}: {problem}")

    def poll(self) -> Reading | None:
        """What is new, or None.  Never waits and never raises for what the drive or the bus does."""
        self._reads.poll()
        found, self._newest = self._newest, None
        return found

    def _number(self, data: bytes) -> float | None:
        """None if it is none; a server may answer with more bytes than the object has."""
        try:
            value = self._variable.decode_raw(data[: len(self._variable) // 8])
        except (ObjectDictionaryError, ValueError, OverflowError, struct.error):
            return None
        return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None
