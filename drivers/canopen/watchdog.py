"""What stops the drive when this computer dies: the reaction is set, its detection proven, and both are kept.

Commissioning sets and reads back the reactions, and one there must be.  The proof of the watchdog shows that a lost
heartbeat is detected, with the power off.  That the motor then really stops is not tried at commissioning: it would
mean to enable before the user has been asked, and an enabled drive opens its brake, at zero torque as well.  What can
be had without that is the drive's own report of its reaction.

Another program may write the drive's objects at any time.  Before the loop may enable, four are read back in NMT
operational: who is watched (1016:1), the RPDO's deadline (1400:5), the reaction (6007), the mode (6061); and again once
a second as long as the loop runs, which costs four SDO uploads.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import can
import canopen

from jointctl.drivers.canopen.cia import EMERGENCY_ID, HEARTBEAT_ID, MODE_SHOWN, NmtState
from jointctl.drivers.canopen.pdo import (
    COMMUNICATION_RPDO,
    DISABLED,
    EVENT_TIMER,
    IDENTIFIER,
    LAST_PDO,
    joint_angle_per_count_rad,
    pdos_of,
)
from jointctl.drivers.canopen.sdo import ObjectAccess, SdoReads, object_name
from jointctl.drivers.canopen.settings import CanopenSettings
from jointctl.drivers.errors import DeviceError, JointctlError

ABORT_QUICK_STOP = 3  # object 6007
STOPPED = 2  # object 1029:1
RPDO_DEADLINE_SHARE = 0.5  # of drive.heartbeat_s
RPDO_DEADLINE_MIN_PERIODS = 5
LARGEST_MS = 0xFFFF
LARGEST_SUB = 0x80
HEARTBEAT_LOST = 0x8130  # EMCY error code of CiA 301
BEATS = 6
BEATS_PER_TIMEOUT = 3
POLLS_PER_TIMEOUT = 20
LONGEST_TIMEOUTS = 4
PERIOD_S = 1.0
MISSED = 3  # reads in a row without an answer, until it is an error before enabling and a warning afterwards
_HINT = "find out which; the run is over"
_ALONE = "RPDOs that get lost while our heartbeat does not stop the joint only when the loop withholds its heartbeat"


def arm_reaction(objects: ObjectAccess, settings: CanopenSettings) -> tuple[str, list[str]]:
    """Abort connection option (6007), quick stop option (605A) and error behaviour (1029:1); (in words, remarks).

    `DeviceError` for a drive that has neither 6007 nor 1029:1: nothing would say that it stops.
    """
    stops = objects.write_if_present(0x6007, 0, ABORT_QUICK_STOP, what="abort connection option")
    objects.write_if_present(0x605A, 0, settings.quick_stop_option, what="quick stop option")
    # a communication error must not leave the drive in operational
    leaves = objects.write_if_present(0x1029, 1, STOPPED, what="error behaviour")
    if not (stops or leaves):
        raise DeviceError(
            f"node {settings.node} has neither object 6007 (abort connection option) nor 1029:1 (error behaviour): "
            "nothing says that it stops when this computer dies",
            "use the EDS that belongs to the drive's firmware; such a drive is not enabled",
        )
    if not stops:
        return "1029:1 = 2 (stopped), read back", [
            "no object 6007: a lost heartbeat takes the drive out of operational; how the motor stops is "
            "up to the drive"
        ]
    return "6007 = 3 (quick stop)" + (", 1029:1 = 2 (stopped)" if leaves else "") + ", read back", []


# --- how fast its quick stop brakes ---

QUICK_STOP_RAMPS = {1: 0x6084, 2: 0x6085}  # of 605A, where 5 to 8 keep the power and are refused
_OTHER_REACTIONS = {
    0: "takes its power at once: the joint coasts",
    3: "brakes at its current limit: how fast is not known",
    4: "brakes at its voltage limit: how fast is not known",
}
_OWN_UNITS = {0xFB: "maxon", 0xAB: "Copley"}  # makers whose accelerations are in other units than counts/s2
# objects that scale accelerations, with the values that leave them in counts/s2: SI units, dimension and notation index
_UNITS = {0x60AA: (0, 0xB55700), 0x60A9: (0, 0xB50300), 0x60A8: (0, 0xB50000), 0x608E: (0,), 0x608D: (0,)}
_FACTORS = (0x6091, 0x6093, 0x6094, 0x6095, 0x6096, 0x6097)  # numerator and divisor: gear ratio, factors
_MAKER = 0x1018, 1
_LARGEST = 0xFFFFFFFF  # of 6084 and 6085
_SAME = 1e-3  # by so much a ramp may be slower and is not reported: rounding
Read = Callable[[int, int], int | None]  # an unsigned object; None where the drive does not give it


def needed_braking(settings: CanopenSettings) -> list[tuple[float, str]]:
    """How fast the drive must brake by itself [rad/s2 at the joint], each with what a slower one would be, in words.

    The first is that of the loop's own stop, the others those of the limits.
    """
    speed, brake = settings.velocity_max_radps or 0.0, settings.brake_radps2
    room = settings.position_max_rad - settings.position_min_rad
    needs = [
        (brake, f"slower than sequence.brake_radps2 (={brake:g})"),
        (0.5 * speed**2 / room, f"farther than between the position limits ({room:g} rad)"),
    ]
    if settings.stop_timeout_s:
        longest = f"longer than sequence.stop_timeout_s (={settings.stop_timeout_s:g})"
        needs.append((speed / settings.stop_timeout_s, longest))
    return needs


@dataclass(frozen=True)
class QuickStop:
    """What the drive's own quick stop does, in words; how fast it brakes the joint, None where that is not known."""

    words: str
    radps2: float | None = None
    index: int = 0  # of the object that holds the ramp
    rad_per_count: float = 0.0

    def problem(self, settings: CanopenSettings) -> str:
        """One line where it brakes slower than the loop's own stop, or than the limits need; "" else."""
        speed = settings.velocity_max_radps
        if self.radps2 is None or not speed:
            return ""
        seconds, way = speed / self.radps2, 0.5 * speed**2 / self.radps2
        needs = needed_braking(settings)
        missed = [(radps2, words) for radps2, words in needs if self.radps2 < radps2 * (1.0 - _SAME)]
        if not missed:
            return ""
        wanted = max(radps2 for radps2, _ in missed)
        least = math.ceil(wanted / self.rad_per_count)
        remedy = f"{self.index:04X} should be {least} or more"
        if least > _LARGEST:
            remedy = f"{wanted:.3g} rad/s2 is more than {self.index:04X} holds in counts of this encoder"
        return (
            f"{self.words}, {seconds:.2g} s and {way:.2g} rad from limits.velocity_max_radps (={speed:g}): "
            f"{', '.join(words for _, words in missed)}; {remedy}"
        )


def _unit_of_its_own(read: Read, settings: CanopenSettings) -> str:
    """Why accelerations may be in another unit than counts of the encoder per s2; "" where nothing says so."""
    if settings.velocity_unit != "counts/s":
        return f"drive.velocity_unit is {settings.velocity_unit}"
    maker = _OWN_UNITS.get(read(*_MAKER) or settings.vendor_id or 0)
    if maker is not None:
        return f"{maker} has a unit of its own"
    for index, plain in _UNITS.items():
        if (value := read(index, 0)) is not None and value not in plain:
            return f"{index:04X} is {value:X}h"
    pairs = {index: (read(index, 1), read(index, 2)) for index in (*_FACTORS, 0x6092, 0x608F)}
    for index in _FACTORS:
        above, below = pairs[index]
        if above is not None and below is not None and above != below:
            return f"{index:04X} is {above}:{below}"
    (feed, turns), (increments, motor_turns) = pairs[0x6092], pairs[0x608F]
    if feed and turns and increments and motor_turns and feed * motor_turns != increments * turns:
        return f"6092 is {feed}:{turns}"
    return ""


def quick_stop_of(read: Read, settings: CanopenSettings) -> QuickStop:
    """By 605A as a run sets it, and by the ramp that it names; nothing is written."""
    option = settings.quick_stop_option
    if read(0x605A, 0) is None:
        return QuickStop("no object 605A: how the drive's own quick stop brakes is not known")
    start = f"the drive's own quick stop (605A = {option})"
    index = QUICK_STOP_RAMPS.get(option, 0)
    if not index:
        return QuickStop(f"{start} {_OTHER_REACTIONS[option]}")
    if index == 0x6084 and settings.mode in ("pv", "velocity or torque"):
        return QuickStop(f"{start} brakes along 6084, which a run makes steeper than its motions where it needs it")
    value = read(index, 0)
    if not value:
        lacks = f"no {index:04X} that can be read" if value is None else f"{index:04X} is 0"
        return QuickStop(f"{start}: {lacks}, how fast it brakes is not known")
    if why := _unit_of_its_own(read, settings):
        return QuickStop(f"{start} brakes along {index:04X} = {value}, in a unit that is not known: {why}")
    rad_per_count = joint_angle_per_count_rad(settings)
    radps2 = value * rad_per_count
    of_mode = index == 0x6084 and settings.mode in ("cst", "tq", "auto")
    condition = ", unless its torque mode has a ramp of its own" if of_mode else ""
    words = f"{start} brakes with {radps2:.3g} rad/s2 at the joint ({index:04X} = {value}{condition})"
    return QuickStop(words, radps2, index, rad_per_count)


# --- the deadline of the RPDO ---


def rpdo_deadline_ms(settings: CanopenSettings) -> int:
    """How long RPDOs may stay away until the drive stops by itself."""
    seconds = max(RPDO_DEADLINE_SHARE * settings.heartbeat_s, RPDO_DEADLINE_MIN_PERIODS / settings.rate_Hz)
    return min(round(seconds * 1000.0), LARGEST_MS)


def _record_of(objects: ObjectAccess, rpdo_id: int) -> tuple[int, int]:
    """(communication record, COB-ID) of the RPDO with this identifier."""
    for base in pdos_of(objects, COMMUNICATION_RPDO):
        cob_id = objects.read(base, 1, what=f"PDO {base:04X} COB-ID") & 0xFFFFFFFF
        if cob_id & (DISABLED | IDENTIFIER) == rpdo_id:
            return base, cob_id
    raise DeviceError(f"no RPDO of the drive is enabled on {rpdo_id:03X}h any more")


def arm_rpdo_deadline(objects: ObjectAccess, settings: CanopenSettings, rpdo_id: int) -> tuple[str, list[str]]:
    """Event timer of the loop's RPDO (CiA 301: deadline monitoring, EMCY 8250h); ("", remarks) where there is none."""
    base, cob_id = _record_of(objects, rpdo_id)
    if not objects.has(base, EVENT_TIMER):
        return "", [f"no object {base:04X}:5 (RPDO event timer): {_ALONE}"]
    milliseconds = rpdo_deadline_ms(settings)
    error = _write_event_timer(objects, base, cob_id, milliseconds)
    if error is not None:
        return "", [f"{error.message}: {_ALONE}"]
    return f"{milliseconds} ms", []


def _write_event_timer(objects: ObjectAccess, base: int, cob_id: int, milliseconds: int) -> DeviceError | None:
    """Why the drive does not take it, or None.  The PDO is disabled in the meantime, as some drives insist."""
    what = f"PDO {base:04X} COB-ID"
    objects.write(base, 1, cob_id | DISABLED, what=what)
    try:
        objects.write_verified(base, EVENT_TIMER, milliseconds, what="RPDO event timer")
    except DeviceError as error:
        return error
    finally:
        objects.write_verified(base, 1, cob_id, what=what)
    return None


def clear_rpdo_deadlines(objects: ObjectAccess) -> None:
    """Event timers of all RPDOs to zero: which one an earlier run has armed is not known."""
    for base in pdos_of(objects, COMMUNICATION_RPDO):
        if objects.read_if_present(base, EVENT_TIMER, what="RPDO event timer"):
            cob_id = objects.read(base, 1, what=f"PDO {base:04X} COB-ID") & 0xFFFFFFFF
            error = _write_event_timer(objects, base, cob_id, 0)
            if error is not None:
                raise error


def rpdo_identifiers(objects: ObjectAccess) -> list[int]:
    """COB-IDs of the drive's enabled RPDOs, as it has them now; those that cannot be read are left out."""
    found = []
    for base in pdos_of(objects, COMMUNICATION_RPDO):
        with contextlib.suppress(DeviceError):
            cob_id = objects.read(base, 1, what=f"PDO {base:04X} COB-ID") & 0xFFFFFFFF
            if not cob_id & DISABLED:
                found.append(cob_id & IDENTIFIER)
    return found


def watched_nodes(objects: ObjectAccess) -> set[int]:
    """Nodes whose heartbeat the drive watches now (1016)."""
    found = set()
    for sub in range(1, LARGEST_SUB):
        entry = objects.read_if_present(0x1016, sub, what="consumer heartbeat time")
        if entry is None:
            break
        if entry & 0xFFFF:
            found.add(entry >> 16 & 0xFF)
    return found


# --- the proof ---


class _Witness:
    """What the drive reports about a lost heartbeat: EMCY 8130, or a heartbeat with another NMT state."""

    def __init__(self) -> None:
        self.seen = ""
        self._nmt_state: int | None = None

    def on_emergency(self, _: int, data: bytearray, __: float) -> None:
        """EMCY object of the drive."""
        if len(data) >= 2 and int.from_bytes(data[:2], "little") == HEARTBEAT_LOST:
            self.seen = f"EMCY {HEARTBEAT_LOST:04X}h"

    def on_heartbeat(self, _: int, data: bytearray, __: float) -> None:
        """Heartbeat of the drive."""
        state = data[0] & 0x7F if data else NmtState.BOOT_UP
        if self._nmt_state is not None and state != self._nmt_state:
            self.seen = self.seen or f"NMT state {state}"
        self._nmt_state = state


def prove_watchdog(
    network: canopen.Network, node: int, master_node: int, heartbeat_s: float, sleep: Callable[[float], None]
) -> str:
    """Send our heartbeat for a while, stop it, and return what the drive said; `DeviceError` if it said nothing.

    An armed object 1016 proves nothing: a drive may accept the value and ignore it.  The proof also has its twin: while
    the heartbeat comes, the drive must stay quiet.  What is proven is detection, not that the power goes off.
    Takes about three times `heartbeat_s`.  The drive must be disabled; it may end in another NMT state.
    """
    witness = _Witness()
    network.subscribe(EMERGENCY_ID + node, witness.on_emergency)
    network.subscribe(HEARTBEAT_ID + node, witness.on_heartbeat)
    try:
        apart_s = 0.0
        for _ in range(BEATS):
            network.send_message(HEARTBEAT_ID + master_node, bytes([NmtState.OPERATIONAL]))
            sent_s = time.monotonic()
            sleep(heartbeat_s / BEATS_PER_TIMEOUT)
            apart_s = max(apart_s, time.monotonic() - sent_s)
        if witness.seen and apart_s >= heartbeat_s:
            raise DeviceError(
                f"node {node}: the watchdog tripped ({witness.seen}), and rightly: this computer stood still, and its "
                f"heartbeats came {apart_s:.2f} s apart (allowed {heartbeat_s:g} s, drive.heartbeat_s)",
                "nothing has moved: try again with fewer programs beside it; `jointctl doctor` measures late wake-ups",
            )
        if witness.seen:
            raise DeviceError(
                f"node {node}: the watchdog tripped ({witness.seen}) although the heartbeat of node {master_node} came",
                "another program may own that node number; see drive.master_node",
            )
        for _ in range(LONGEST_TIMEOUTS * POLLS_PER_TIMEOUT):
            sleep(heartbeat_s / POLLS_PER_TIMEOUT)
            if witness.seen:
                return witness.seen
    finally:
        network.unsubscribe(EMERGENCY_ID + node, witness.on_emergency)
        network.unsubscribe(HEARTBEAT_ID + node, witness.on_heartbeat)
    raise DeviceError(
        f"node {node}: the heartbeat was stopped for {LONGEST_TIMEOUTS * heartbeat_s:g} s and the drive did not react",
        "its watchdog (object 1016) would not stop the joint if this computer died; jointctl does not enable it",
    )


# --- kept as it was proven ---


class WatchdogGuard:
    """`poll` it; a `DeviceError` ends the run."""

    def __init__(
        self, objects: ObjectAccess, reads: SdoReads, node: int, mode: int, refuse_others: Callable[[], None]
    ) -> None:
        """After commissioning has set what is to be kept, when the node is operational.

        `refuse_others` raises where another controller has sent a command, or has written what matters, since.
        """
        self._objects, self._mode = objects, mode
        self._reads, self._node, self._refuse_others = reads, node, refuse_others
        self._changed = ""
        self._missed: dict[str, tuple[int, str]] = {}
        self._warned: set[str] = set()
        self._unread: set[str] = set()  # not yet read back in operational
        expected = {place: found for place, found in objects.verified().items() if is_kept(*place)}
        expected[0x6061, 0] = (mode, MODE_SHOWN)
        for (index, sub), (value, what) in expected.items():
            name = f"object {object_name(index, sub)} ({what})"
            data = objects.encoded(index, sub, value, what=what)
            self._unread.add(name)
            reads.add(index, sub, PERIOD_S, self._judge(name, data, value))

    def _judge(self, name: str, expected: bytes, value: int) -> Callable[[int, bytes | None, str], None]:
        def on_answer(_: int, data: bytes | None, problem: str) -> None:
            if data is None:
                self._missed[name] = self._missed.get(name, (0, ""))[0] + 1, problem
                return
            self._missed.pop(name, None)
            self._unread.discard(name)
            if data[: len(expected)] != expected:
                found = int.from_bytes(data[: len(expected)], "little")
                self._changed = self._changed or (
                    f"node {self._node}: {name} was changed to {found} ({found:X}h) "
                    f"by another program or the drive itself, {value} was set"
                )

        return on_answer

    @property
    def confirmed(self) -> bool:
        """Whether everything has been read back in NMT operational: before that nothing may be enabled."""
        return not self._unread

    def poll(self, *, may_ask: bool = True) -> list[str]:
        """What is to be warned of; `DeviceError` where something was changed, or cannot be read before enabling.

        Without `may_ask` it only listens, and takes the answers that come.
        """
        self._refuse_others()
        self._reads.poll(may_ask=may_ask)
        if self._changed:
            raise DeviceError(self._changed, _HINT)
        warnings = []
        for name, (count, problem) in self._missed.items():
            if count < MISSED:
                continue
            text = f"node {self._node}: {name} cannot be read any more: {problem}"
            if not self.confirmed:
                raise DeviceError(text, "without it nothing proves that the drive stops when this computer dies")
            if name not in self._warned:
                self._warned.add(name)
                warnings.append(text)
        return warnings

    def mode_left(self) -> str:
        """See `SettingsGuard.mode_left`."""
        with contextlib.suppress(JointctlError, can.CanError):
            if (shown := self._objects.read(0x6061, what=MODE_SHOWN)) != self._mode:
                return f"node {self._node}: 6061 ({MODE_SHOWN}) is {shown} after the run, {self._mode} was set"
        return ""


def is_kept(index: int, sub: int) -> bool:
    """Whether an object belongs to what stops the drive when it is left alone."""
    return (index, sub) in ((0x1016, 1), (0x6007, 0)) or (
        0 <= index - COMMUNICATION_RPDO <= LAST_PDO and sub == EVENT_TIMER
    )
