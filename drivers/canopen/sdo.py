"""The drive's objects over SDO: written and read one by one, or read again and again beside the loop.

An EDS often describes more than the drive at hand has (other firmware, an option that was not bought).  What may be
absent counts as absent when the drive itself says so; what must be there is refused with that reason.

Time-outs are retried (drives leave SDOs unanswered now and then); an abort is an answer and is not.
"""

from __future__ import annotations

import contextlib
import io
import random
import struct
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import can
import canopen
from canopen.objectdictionary import ObjectDictionaryError, ODVariable
from canopen.sdo.client import SdoClient, WritableStream
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from jointctl.drivers.errors import DeviceError, NoDeviceError

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

ATTEMPTS = 3
COLLISIONS = 10  # with the transfers of another master on the one SDO channel, such as those of `jointctl stop`
COLLISION_PAUSE_S = 0.01
NO_ANSWER = "No SDO response received"  # by the library, in contrast to an answer that does not fit
ANSWER_S = 1.0  # how long an answer may take
QUIET_S = 0.05  # no one else may have used the SDO channel for so long: it is one for all masters
_UPLOAD, _ABORT = 0x40, 0x80  # command specifiers of CiA 301, 7.2.4.3
_ANSWERS = 16  # that may wait between two looks; others on the bus may use the same SDO channel
ABSENT = (0x06020000, 0x06090011)  # no such object, no such sub-index
ABORT_TEXT = {
    0x05040000: "the transfer timed out, as when frames are lost",
    0x06010000: "access is not supported",
    0x06090030: "value out of range",
    0x06090031: "value too high",
    0x06090032: "value too low",
    0x06020000: "object does not exist",
    0x06090011: "sub-index does not exist",
    0x06010002: "object is read only",
    0x06010001: "object is write only",
    0x06040041: "object cannot be mapped to a PDO",
    0x06040042: "mapped objects exceed the PDO length",
    0x08000022: "not in the present device state",
}
Result = TypeVar("Result")


class _DownloadStream(WritableStream):
    """The library's stream, after which nothing follows once the transfer has failed.

    The canopen library's `SdoClient.download` leaves its stream open when a segmented transfer (more than 4 bytes, or
    none: CiA 301, 7.2.4.3.3) is refused at its beginning or not answered.  Whenever that stream is collected, its
    destructor sends one more segment, which belongs to no transfer and may fall into another one, waits for the answer,
    and fails; since Python 3.13 that failure is printed with its traceback.  Refused later, the same segment is sent
    again, and the abort code of that hides the reason.  Here the stream of a failed transfer ends silently.
    `_begun`: the server takes part in a transfer, whose last segment `close` may send.
    """

    _begun = False

    def __init__(self, client: SdoClient, index: int, sub: int, size: int) -> None:
        super().__init__(client, index, sub, size)  # type: ignore[no-untyped-call]
        self._begun = True

    def write(self, data: ReadableBuffer) -> int:
        """Send the next segment, or all of an expedited transfer; how many bytes were taken."""
        self._begun = False
        taken = int(super().write(data))  # type: ignore[no-untyped-call]
        self._begun = True
        return taken

    def close(self) -> None:
        """End the transfer where there is one."""
        if self._begun:
            super().close()  # type: ignore[no-untyped-call]
        else:
            io.RawIOBase.close(self)


def download(client: SdoClient, index: int, sub: int, data: bytes) -> None:
    """Write `data` to an object: expedited up to 4 bytes, else in segments.

    Raises `SdoAbortedError` if the server refuses, `SdoCommunicationError` if it does not answer, as the library does.
    """
    with _DownloadStream(client, index, sub, len(data)) as stream:
        rest = memoryview(data)
        while rest:
            rest = rest[stream.write(rest) :]


def was_refused(error: Exception) -> bool:
    """Whether the drive itself said no (SDO abort), rather than accepting a value and holding another."""
    return isinstance(error.__cause__, SdoAbortedError)


def object_name(index: int, sub: int = 0) -> str:
    """6040 or 1018:2."""
    return f"{index:04X}:{sub}" if sub else f"{index:04X}"


def visible_string(data: bytes) -> str:
    """A VISIBLE_STRING such as 1008; what makers write beyond its ASCII is UTF-8, else Latin-1."""
    try:
        return data.rstrip(b"\0").decode()
    except UnicodeDecodeError:
        return data.rstrip(b"\0").decode("latin-1")


def value_text(index: int, sub: int, value: int) -> str:
    """As it is read: COB-IDs, and objects that are mapped into a PDO, in hexadecimal."""
    cob_id = index == 0x1005 or (sub == 1 and (0x1400 <= index < 0x1600 or 0x1800 <= index < 0x1A00))
    mapped = sub > 0 and (0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00)
    return f"{value & 0xFFFFFFFF:08X}h" if cob_id or mapped else str(value)


class ObjectAccess:
    """Typed access to one node's object dictionary."""

    def __init__(
        self, node: canopen.RemoteNode, eds_name: str, unusable: Mapping[tuple[int, int], str] | None = None
    ) -> None:
        """`unusable`: objects that the EDS describes wrongly, and how."""
        self._node = node
        self._eds_name = eds_name
        self._unusable = unusable or {}
        self.remarks: list[str] = []  # what was tolerated
        self.gate: Callable[[], None] = lambda: None  # raises where nothing more may be sent to the drive
        self._verified: dict[tuple[int, int], tuple[int, str]] = {}  # what `write_verified` has set, and its name
        self._lowered: dict[tuple[int, int], tuple[int, int, str]] = {}  # limits: what they held, hold now, their name
        self._answered: dict[tuple[int, int], bool] = {}  # whether the drive has what the EDS lists

    def has(self, index: int, sub: int = 0) -> bool:
        """Whether the EDS lists the object and the drive, which is asked once, does not say that it lacks it."""
        return self.lack(index, sub) == ""

    def lack(self, index: int, sub: int = 0) -> str:
        """Who lacks the object, in words that end where its name is to follow; empty where it is there."""
        if self._variable(index, sub) is None:
            return f"EDS {self._eds_name} has no"
        if (index, sub) not in self._answered:
            self.gate()
            try:
                self._node.sdo.upload(index, sub)
                self._answered[index, sub] = True
            except SdoAbortedError as error:  # any other refusal is one of this moment, or of reading
                self._answered[index, sub] = error.code not in ABSENT
            except (SdoCommunicationError, struct.error):
                return ""  # the caller that needs the object will see
        return "" if self._answered[index, sub] else f"node {self._node.id}, unlike EDS {self._eds_name}, has no"

    def _variable(self, index: int, sub: int) -> Any:
        return self._node.object_dictionary.get_variable(index, sub)

    def require(self, index: int, sub: int = 0, *, what: str) -> Any:
        """What the EDS says of the object; `DeviceError` unless it lists it."""
        variable = self._variable(index, sub)
        if variable is None and (index, sub) in self._unusable:
            raise DeviceError(
                f"EDS {self._eds_name}: object {object_name(index, sub)} ({what}) {self._unusable[index, sub]}, "
                "and jointctl needs it",
                hint="correct that line, or use the EDS file that belongs to this drive and firmware",
            )
        if variable is None:
            raise DeviceError(
                f"EDS {self._eds_name} has no object {object_name(index, sub)} ({what}), which jointctl needs",
                hint="if that is the file of this drive and firmware, jointctl cannot drive it in this drive.mode "
                "(docs/drives)",
            )
        return variable

    def _failure(self, error: Exception, action: str, index: int, sub: int, what: str) -> Exception:
        place = f"node {self._node.id}: {action} object {object_name(index, sub)} ({what})"
        if isinstance(error, SdoAbortedError):
            reason = ABORT_TEXT.get(error.code, "refused")
            hint = f"EDS {self._eds_name} lists it: use the EDS file that belongs to this drive and firmware"
            return DeviceError(
                f"{place} was refused: {reason} (SDO abort {error.code:08X}h)", hint if error.code in ABSENT else ""
            )
        return NoDeviceError(f"{place} got no answer in {ATTEMPTS} attempts")

    def _number(self, variable: ODVariable, data: bytes, what: str) -> int:
        try:
            value = variable.decode_raw(data)
            if isinstance(value, (int, float)):
                return int(value)
        except (ObjectDictionaryError, ValueError, OverflowError):
            pass
        place = f"node {self._node.id}: object {object_name(variable.index, variable.subindex)} ({what})"
        raise DeviceError(
            f"{place} answers {len(data)} bytes, which is no {len(variable)} bit number",
            hint="use the EDS file that belongs to this drive and firmware",
        )

    def highest(self, index: int) -> int | None:
        """HighLimit of the EDS; None if it has none."""
        variable = self._variable(index, 0)
        return None if variable is None else variable.max

    def indices(self, first: int, last: int) -> Iterator[int]:
        """Objects of the EDS from `first` to `last`, in order."""
        return (index for index in self._node.object_dictionary if first <= index <= last)

    def read(self, index: int, sub: int = 0, *, what: str) -> int:
        """Integer value of an object; `what` names it in messages."""
        variable = self.require(index, sub, what=what)
        return self._transfer(
            lambda: self._number(variable, self._node.sdo.upload(index, sub), what), "reading", index, sub, what
        )

    def read_if_present(self, index: int, sub: int = 0, *, what: str) -> int | None:
        """`read` where EDS and drive have the object; None where one has not."""
        return self._if_present(index, sub, lambda: self.read(index, sub, what=what))

    def _if_present(self, index: int, sub: int, transfer: Callable[[], int]) -> int | None:
        """What `transfer` gives; None where EDS or drive lack the object, which is asked for no more then."""
        if self._variable(index, sub) is None or not self._answered.get((index, sub), True):
            return None
        try:
            return transfer()
        except DeviceError as error:
            if not (isinstance(error.__cause__, SdoAbortedError) and error.__cause__.code in ABSENT):
                raise
            self._answered[index, sub] = False
            return None

    def write(self, index: int, sub: int, value: int, *, what: str) -> None:
        """Write an integer object; the type and so the length come from the EDS."""
        data = self.encoded(index, sub, value, what=what)
        action = f"writing {value_text(index, sub, value)} to"
        self._transfer(lambda: download(self._node.sdo, index, sub, data), action, index, sub, what)

    def _transfer(self, transfer: Callable[[], Result], action: str, index: int, sub: int, what: str) -> Result:
        """ATTEMPTS for an answer that does not come; more where the answer was to another master's request."""
        attempts = collisions = 0
        while True:
            self.gate()
            try:
                return transfer()
            except (SdoAbortedError, SdoCommunicationError, struct.error) as error:
                collided = isinstance(error, SdoCommunicationError) and str(error) != NO_ANSWER
                if collided and collisions < COLLISIONS:
                    collisions += 1
                    time.sleep(random.uniform(0.0, COLLISION_PAUSE_S))
                    continue
                attempts += 1
                if isinstance(error, SdoAbortedError) or attempts == ATTEMPTS:
                    raise self._failure(error, action, index, sub, what) from error

    def write_verified(self, index: int, sub: int, value: int, *, what: str) -> int:
        """Write, read back and compare.  A refused write is none where the object already holds the value."""
        try:
            self.write(index, sub, value, what=what)
        except DeviceError:
            if self.read(index, sub, what=what) != value:
                raise
            shown = value_text(index, sub, value)
            self.remarks.append(f"{object_name(index, sub)} ({what}) cannot be written; it is {shown}, as it must be")
        found = self.read(index, sub, what=what)
        if found != value:
            place = f"node {self._node.id}: object {object_name(index, sub)} ({what})"
            read, written = (value_text(index, sub, each) for each in (found, value))
            raise DeviceError(f"{place} reads back {read}, {written} was written")
        self._verified[index, sub] = value, what
        return found

    def lower(self, index: int, sub: int, value: int, before: int, *, what: str) -> None:
        """`write_verified` of a limit that held `before`, which `give_limits_back` writes again."""
        last = self._lowered.get((index, sub), (before, before, what))
        held, lowered, _ = last
        self._lowered[index, sub] = (held if lowered == before else before), value, what
        try:
            self.write_verified(index, sub, value, what=what)
        except DeviceError as error:
            self._lowered[index, sub] = last
            if not was_refused(error):  # it holds something else now
                with contextlib.suppress(DeviceError):
                    self.write(index, sub, before, what=what)
            raise

    def give_limits_back(self) -> None:
        """Limits that `lower` has written hold what they held before; one that another program has set since stays."""
        for (index, sub), (before, lowered, what) in list(self._lowered.items()):
            if self.read(index, sub, what=what) == lowered != before:
                self.write_verified(index, sub, before, what=what)
            del self._lowered[index, sub]  # not before: where the drive did not answer, another call tries again

    def verified(self) -> dict[tuple[int, int], tuple[int, str]]:
        """What was written and read back since commissioning began: (index, sub) -> value and name."""
        return dict(self._verified)

    def encoded(self, index: int, sub: int, value: int, *, what: str) -> bytes:
        """A value as the object holds it on the wire."""
        variable = self.require(index, sub, what=what)
        try:
            return bytes(variable.encode_raw(value))
        except (ObjectDictionaryError, ValueError, TypeError):
            place = f"EDS {self._eds_name}: object {object_name(index, sub)} ({what})"
            raise DeviceError(f"{place} has {len(variable)} bits, which do not hold {value}") from None

    def forget_verified(self) -> None:
        """Commissioning begins anew."""
        self._verified.clear()
        self._answered.clear()

    def verify_again(self, wanted: Callable[[int, int], bool] = lambda *_: True) -> None:
        """Read everything that was verified once more; `DeviceError` if the drive has changed in the meantime."""
        for (index, sub), (value, what) in self._verified.items():
            if not wanted(index, sub):
                continue
            found = self.read(index, sub, what=what)
            if found != value:
                raise DeviceError(
                    f"node {self._node.id} has changed since it was commissioned: object {object_name(index, sub)} "
                    f"({what}) is {value_text(index, sub, found)}, {value_text(index, sub, value)} was set",
                    hint="it was restarted, or another program has used it; start the run again",
                )

    def write_if_present(self, index: int, sub: int, value: int, *, what: str) -> bool:
        """`write_verified` where EDS and drive have the object; False where one has not."""
        return self._if_present(index, sub, lambda: self.write_verified(index, sub, value, what=what)) is not None

    def text(self, index: int) -> str:
        """A visible string such as 1008 (device name); empty if there is none."""
        if self._variable(index, 0) is None:
            return ""
        try:
            return visible_string(bytes(self._node.sdo.upload(index, 0))).strip()
        except (SdoAbortedError, SdoCommunicationError, struct.error):  # the last: an answer that is too short
            return ""


# --- read again and again, asked and answered without waiting ---


@dataclass
class SdoRead:
    """One object; `on_answer(time_ns, data, problem)` gets its bytes, or None and why."""

    index: int
    sub: int
    period_s: float
    on_answer: Callable[[int, bytes | None, str], None]
    next_ns: int = 0


class SdoReads:
    """Call `poll` often.  It never waits and never raises for what the drive or the bus does.

    One SDO upload at a time.  On the bus it costs two frames of the lowest priority but for the heartbeats, which delay
    a cycle's frames by one frame at most (0.14 ms at 1 Mbit/s).
    """

    def __init__(
        self, network: canopen.Network, node: canopen.RemoteNode, clock_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._network, self._clock_ns = network, clock_ns
        self._rx, self._tx = node.sdo.rx_cobid, node.sdo.tx_cobid
        self._reads: list[SdoRead] = []
        self._answers: deque[tuple[int, bytes]] = deque(maxlen=_ANSWERS)
        self._open: SdoRead | None = None  # whose answer is waited for
        self._asked_ns = 0
        self._quiet_ns = clock_ns()  # not before
        self._kept_ns: int | None = None  # since when another program keeps it from asking for what is due
        network.subscribe(self._tx, self._on_frame)

    def add(self, index: int, sub: int, period_s: float, on_answer: Callable[..., None]) -> None:
        self._reads.append(SdoRead(index, sub, period_s, on_answer, self._clock_ns()))

    def _on_frame(self, _: int, data: bytearray, __: float) -> None:
        """In the receiving thread; judged in `poll`."""
        self._answers.append((self._clock_ns(), bytes(data)))

    def poll(self, *, may_ask: bool = True) -> None:
        """Take what has come, and ask for what is due."""
        while self._answers:
            came_ns, data = self._answers.popleft()
            if self._open is None or not self._take(self._open, came_ns, data):
                self._quiet_ns = came_ns + round(QUIET_S * 1e9)
        now_ns = self._clock_ns()
        if (read := self._open) is not None and now_ns - self._asked_ns >= ANSWER_S * 1e9:
            self._open = None
            read.on_answer(now_ns, None, f"no answer within {ANSWER_S:g} s")
        may_ask = may_ask and self._open is None
        due = [read for read in self._reads if may_ask and read.next_ns <= now_ns]
        if not due or now_ns >= self._quiet_ns:
            self._kept_ns = None
            if due:
                self._ask(min(due, key=lambda read: read.next_ns), now_ns)
        elif self._kept_ns is None:
            self._kept_ns = now_ns
        elif now_ns - self._kept_ns >= ANSWER_S * 1e9:
            self._kept_ns = now_ns
            for read in due:
                read.next_ns = now_ns + round(read.period_s * 1e9)
                read.on_answer(now_ns, None, "SDO transfers of another program leave no time for it")

    def _ask(self, read: SdoRead, now_ns: int) -> None:
        read.next_ns = now_ns + round(read.period_s * 1e9)
        try:
            self._network.send_message(self._rx, struct.pack("<BHB4x", _UPLOAD, read.index, read.sub))
        except (can.CanError, OSError):  # the loop sees what is wrong with the bus, and reports it
            return
        self._open, self._asked_ns = read, now_ns

    def _take(self, read: SdoRead, came_ns: int, data: bytes) -> bool:
        """Whether these bytes are the answer of the SDO server to this request."""
        if len(data) != 8 or struct.unpack_from("<HB", data, 1) != (read.index, read.sub):
            return False
        value, problem = None, ""
        if data[0] == _ABORT:
            (code,) = struct.unpack_from("<I", data, 4)
            problem = f"{ABORT_TEXT.get(code, 'refused')} (SDO abort {code:08X}h)"
        elif data[0] & 0xE0 != _UPLOAD:
            return False
        elif data[0] & 2:
            value = data[4 : 4 + (4 - (data[0] >> 2 & 3) if data[0] & 1 else 4)]
        else:
            problem = f"{data.hex()} is no expedited answer"
        self._open = None
        read.on_answer(came_ns, value, problem)
        return True
