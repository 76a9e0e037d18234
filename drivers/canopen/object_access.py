"""Reading and writing the drive's objects over SDO, with EDS and drive as the judges of what exists.

An EDS often describes more than the drive at hand has (other firmware, an option that was not bought).  What may be
absent counts as absent when the drive itself says so; what must be there is refused with that reason.

Time-outs are retried (drives leave SDOs unanswered now and then); an abort is an answer and is not.
"""

from __future__ import annotations

import random
import struct
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

import canopen
from canopen.objectdictionary import ObjectDictionaryError
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from jointctl.drivers.canopen.sdo_download import download
from jointctl.drivers.errors import DeviceError, NoDeviceError

ATTEMPTS = 3
COLLISIONS = 10  # with the transfers of another master on the one SDO channel, such as those of `jointctl stop`
COLLISION_PAUSE_S = 0.01
NO_ANSWER = "No SDO response received"  # by the library, in contrast to an answer that does not fit
Result = TypeVar("Result")
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


def was_refused(error: Exception) -> bool:
    """Whether the drive itself said no (SDO abort), rather than accepting a value and holding another."""
    return isinstance(error.__cause__, SdoAbortedError)


def object_name(index: int, sub: int = 0) -> str:
    """6040 or 1018:2."""
    return f"{index:04X}:{sub}" if sub else f"{index:04X}"


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
        self.gate: Callable[[], None] = lambda: None  # raises where no more is to be said to the drive
        self._verified: dict[tuple[int, int], tuple[int, str]] = {}  # what `write_verified` has set, and its name
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
                return ""  # whoever needs the object will see
        return "" if self._answered[index, sub] else f"node {self._node.id}, unlike EDS {self._eds_name}, has no"

    def require(self, index: int, sub: int = 0, *, what: str) -> None:
        """`DeviceError` unless the EDS lists the object."""
        self._required(index, sub, what)

    def _variable(self, index: int, sub: int) -> Any:
        return self._node.object_dictionary.get_variable(index, sub)

    def _required(self, index: int, sub: int, what: str) -> Any:
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
                hint="use the EDS file that belongs to this drive and firmware",
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

    def _number(self, variable: Any, data: bytes, what: str) -> int:
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

    def _encoded(self, variable: Any, value: int, what: str) -> bytes:
        try:
            return bytes(variable.encode_raw(value))
        except (ObjectDictionaryError, ValueError, TypeError):
            place = f"EDS {self._eds_name}: object {object_name(variable.index, variable.subindex)} ({what})"
            raise DeviceError(f"{place} has {len(variable)} bits, which do not hold {value}") from None

    def highest(self, index: int, sub: int = 0) -> int | None:
        """HighLimit of the EDS; None if it does not tell."""
        variable = self._variable(index, sub)
        return None if variable is None else variable.max

    def indices(self, first: int, last: int) -> Iterator[int]:
        """Objects of the EDS from `first` to `last`, in order."""
        return (index for index in self._node.object_dictionary if first <= index <= last)

    def read(self, index: int, sub: int = 0, *, what: str) -> int:
        """Integer value of an object; `what` names it in messages."""
        variable = self._required(index, sub, what)
        return self._transfer(
            lambda: self._number(variable, self._node.sdo.upload(index, sub), what), "reading", index, sub, what
        )

    def read_if_present(self, index: int, sub: int = 0, *, what: str) -> int | None:
        """`read` where EDS and drive have the object; None where one has not."""
        if self._variable(index, sub) is None or not self._answered.get((index, sub), True):
            return None
        try:
            return self.read(index, sub, what=what)
        except DeviceError as error:
            if self._says_absent(error, index, sub):
                return None
            raise

    def _says_absent(self, error: DeviceError, index: int, sub: int) -> bool:
        """Whether the drive has refused because it lacks the object; that is kept."""
        absent = isinstance(error.__cause__, SdoAbortedError) and error.__cause__.code in ABSENT
        if absent:
            self._answered[index, sub] = False
        return absent

    def write(self, index: int, sub: int, value: int, *, what: str) -> None:
        """Write an integer object; the type and so the length come from the EDS."""
        data = self._encoded(self._required(index, sub, what), value, what)
        self._transfer(lambda: download(self._node.sdo, index, sub, data), f"writing {value} to", index, sub, what)

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
            self.remarks.append(f"{object_name(index, sub)} ({what}) cannot be written; it is {value}, as it must be")
        found = self.read(index, sub, what=what)
        if found != value:
            place = f"node {self._node.id}: object {object_name(index, sub)} ({what})"
            raise DeviceError(f"{place} reads back {found}, {value} was written")
        self._verified[index, sub] = value, what
        return found

    def verified(self) -> dict[tuple[int, int], tuple[int, str]]:
        """What was written and read back since commissioning began: (index, sub) -> value and name."""
        return dict(self._verified)

    def encoded(self, index: int, sub: int, value: int, *, what: str) -> bytes:
        """A value as the object holds it on the wire."""
        return self._encoded(self._required(index, sub, what), value, what)

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
                    f"({what}) is {found}, {value} was set",
                    hint="it was restarted, or another program has used it; start the run again",
                )

    def write_if_present(self, index: int, sub: int, value: int, *, what: str) -> bool:
        """`write_verified` where EDS and drive have the object; False where one has not."""
        if self._variable(index, sub) is None or not self._answered.get((index, sub), True):
            return False
        try:
            self.write_verified(index, sub, value, what=what)
        except DeviceError as error:
            if self._says_absent(error, index, sub):
                return False
            raise
        return True

    def text(self, index: int) -> str:
        """A visible string such as 1008 (device name); empty if there is none."""
        if self._variable(index, 0) is None:
            return ""
        try:
            return bytes(self._node.sdo.upload(index, 0)).rstrip(b"\0").decode("latin-1").strip()
        except (SdoAbortedError, SdoCommunicationError, struct.error):  # the last: an answer that is too short
            return ""
